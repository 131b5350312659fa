"""Random small studies under a cap all end: no trial waits for ever, and the cap holds.

Trials share calls of two models; calls fail, cost more than expected or an unknown sum; runs are
stopped or killed, and resumed under a higher cap, with and without batches.
`STUDIES=2000 pytest -n0 tests/unit/llm/test_deadlocks.py` plays many more.
"""

import asyncio
import os
import random
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from merge_runner.drivers.language_model import Question
from merge_runner.errors import SweepStopped, TrialSuspended
from merge_runner.llm.batch.rounds import BatchSender, Rounds
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Calls
from merge_runner.llm.http_outcome import TransportFailure
from merge_runner.llm.ledger import Ledger
from merge_runner.llm.limiter import Limiter
from merge_runner.providers import ModelEntry
from merge_runner.records import Decision, Slot
from merge_runner.run.local_runner import LocalRunner
from tests.support.batch_mode import Memory
from tests.support.clients import PRICE, answer, budget_of, client_of, error
from tests.support.virtual_time import in_virtual_time

STUDIES = int(os.environ.get("STUDIES", "150"))
IN_MEMORY = "/dev/shm" if os.path.isdir("/dev/shm") else None
MODELS, SIDES = ("a", "b"), ("left", "right")
MOST_TOKENS = 100
WORST_USD = 0.001
ENTRY = {"provider": "openai", "format": "openai-chat", "max_output_tokens": MOST_TOKENS}
ENTRY |= {"price": PRICE, "timeout_s": 300, "deadline_s": 600}


@pytest.fixture(scope="module")
def cache():
    with tempfile.TemporaryDirectory(dir=IN_MEMORY) as folder:
        cache = ResponseCache(Path(folder))
        yield cache
        cache.close()


class Server:
    """Answers late, fails now and then, and bills up to the worst case or, ``endless``, beyond."""

    def __init__(self, chance, *, endless):
        self.chance, self.endless, self.bill_usd = chance, endless, 0.0
        self.loses = chance.choice([0.05, 0.5])

    async def send(self, request, *, attempt, timeout_s):
        chance = self.chance
        await asyncio.sleep(chance.choice([0, 0, 0.01, 1, 50]))
        if chance.random() < self.loses:
            self.bill_usd += MOST_TOKENS * PRICE.output / 1e6
            raise TransportFailure("timeout", "no reply")
        match chance.random():
            case x if x < 0.85:
                most = MOST_TOKENS * (3 if self.endless and chance.random() < 0.1 else 1)
                tokens = chance.randint(0, most)
                self.bill_usd += (10 * PRICE.input + tokens * PRICE.output) / 1e6
                return answer(usage=(10, tokens))
            case x if x < 0.93:
                return error(503)
            case x if x < 0.96:
                raise TransportFailure("no_connection", "refused", sent=False)
            case x if x < 0.98:
                return error(429, retry_after="30")
            case _:
                return error(400)


class Batches(Memory):
    """Loses, fails and bills lines at random."""

    def __init__(self, server):
        super().__init__()
        self.server = server

    async def results(self, paths):
        async for key, _ in super().results(paths):
            kind = self.server.chance.choice(["ok"] * 8 + ["failed", "expired"])
            if kind == "ok":
                tokens = self.server.chance.randint(0, MOST_TOKENS)
                self.server.bill_usd += (10 * PRICE.input + tokens * PRICE.output) / 2e6
                yield key, answer(usage=(10, tokens))
            else:
                yield key, error(500) if kind == "failed" else None


class Trial:
    """Asks the questions of its steps, one step after the other."""

    def __init__(self, spec):
        self.spec, self.steps, self.failed_calls = spec, [*spec.steps], []

    def pending(self):
        return self.steps[0] if self.steps else []

    def answer(self, decisions):
        self.steps = self.steps[1:]

    def fail(self, side, error):
        self.steps = []

    def record(self):
        return self


def decided(prompt, reply):
    return Decision((0.0,), (0.0,), prompt=prompt, reply=reply)


class Study:
    """A study by its seed, and its runs."""

    def __init__(self, cache, seed):
        self.cache, self.seed = cache, seed
        chance = self.chance = random.Random(seed)
        self.server = Server(chance, endless=chance.random() < 0.2)
        self.services = {model: Batches(self.server) for model in MODELS}
        self.specs = [self.spec(order) for order in range(chance.randint(2, 5))]
        calls = sum(len(step) for spec in self.specs for step in spec.steps)
        self.cap_usd = max(1, calls) * WORST_USD * chance.uniform(0.2, 1.0)
        self.trial_usd = WORST_USD * chance.uniform(0.2, 6)
        self.has_batches = chance.random() < 0.25

    def spec(self, order):
        """A trial: at each step one or both sides ask; equal repetitions may share calls."""
        chance = self.chance
        repetition, models = chance.randint(1, 4), chance.choices(MODELS, k=2)
        steps = []
        for decision in range(chance.randint(1, 3)):
            asking = chance.choice([SIDES, SIDES[:1], SIDES[1:]])
            steps.append([
                Question(model, Slot("A1", repetition, side, decision, 0), "prompt", None, decided)
                for side, model in zip(SIDES, models, strict=True)
                if side in asking
            ])  # fmt: skip
        return SimpleNamespace(order=order, arm=order, steps=steps)

    def write(self, operation):
        """As the writer of the cache does, but at once and in this thread; none is made if dead."""
        loop = asyncio.get_running_loop()
        future = loop.create_future()

        def run():
            if self.is_dead:
                return
            (result,) = self.cache._run_each([operation])
            if not future.cancelled():
                put = future.set_exception if isinstance(result, Exception) else future.set_result
                put(result)

        loop.call_later(0.001, run)
        return future

    def runner(self):
        chance, calls, rounds = self.chance, Calls(), None
        if self.has_batches:
            rounds = Rounds(self.cache, MODELS, submits=chance.random() < 0.7, say=lambda _: None)
            rounds.services |= self.services
            rounds = rounds if rounds.submits or rounds.batches else None
        budget = budget_of(Ledger(self.cache, "study"), self.cap_usd, lambda _: self.trial_usd)
        verified = rounds is not None and rounds.submits
        clients = {
            model: client_of(
                model, ModelEntry(id=model, **ENTRY), "openai", self.cache, self.server,
                limiter=Limiter(rpm=chance.choice([None, None, 20])), budget=budget, calls=calls,
                batch=BatchSender(rounds, model, 0.5) if rounds else None,
                verified=verified, has_answered=chance.random() < 0.8,
            )
            for model in MODELS
        }  # fmt: skip
        nothing = SimpleNamespace(prompts={}, programs={})
        plan = SimpleNamespace(by_label=dict, entries={}, parts=nothing)
        runner = LocalRunner(plan, clients, chance.randint(1, 8), rounds=rounds, calls=calls)
        runner._trials = SimpleNamespace(
            arms={
                spec.arm: SimpleNamespace(
                    full_names={q.slot.side: q.model for step in spec.steps for q in step}
                )
                for spec in self.specs
            },
            make=Trial,
        )
        return runner, rounds

    async def run(self):
        """Play the trials; the run may be stopped or killed. Returns how each trial ended."""
        ended, (runner, rounds) = {}, self.runner()
        playing = asyncio.create_task(
            runner.play(self.specs, lambda spec, record: ended.update({spec.order: record}))
        )
        how = self.chance.choice(["to its end", "to its end", "stopped", "killed"])
        limit_s = None if how == "to its end" else self.chance.choice([0, 0.01, 1, 30, 200])
        await asyncio.wait([playing], timeout=limit_s)
        self.is_dead = how == "killed"
        playing.cancel()
        if not self.is_dead:
            await asyncio.gather(playing, return_exceptions=True)
            await runner.calls.drain()
            if rounds is not None:
                await rounds.close()
        rest = asyncio.all_tasks() - {asyncio.current_task()}
        for task in rest:
            task.cancel()
        await asyncio.gather(*rest, return_exceptions=True)
        self.is_dead = False
        error = None if playing.cancelled() else playing.exception()
        if error is not None and not isinstance(error, SweepStopped):
            raise error
        return how, error, ended

    async def play(self):
        self.is_dead = False
        for _ in range(self.chance.randint(1, 3)):
            how, error, ended = await self.run()
            if how == "to its end" and error is None:
                assert len(ended) == len(self.specs)
            assert all(isinstance(e, Trial | TrialSuspended) for e in ended.values())
            if not self.server.endless:
                committed_usd = Ledger(self.cache, "study").read().committed_usd
                assert self.server.bill_usd - 1e-9 <= committed_usd <= self.cap_usd + 1e-9
            self.cap_usd *= self.chance.choice([1.0, 1.2, 2.0])
            if self.chance.random() < 0.3:
                ledger = Ledger(self.cache, "study")
                ledger.release()
                self.server.bill_usd = ledger.spending.spent_usd


def test_every_study_ends_and_its_bill_is_in_the_ledger_and_below_the_cap(cache, monkeypatch):
    monkeypatch.setattr("merge_runner.llm.batch.rounds.IDLE_POLL_S", 1.0)
    stuck = []
    for seed in range(STUDIES):
        cache.run_now(
            [lambda run: [run(f"DELETE FROM {table}") for table in ("Cache", "open", "spent")]]
        )
        study = Study(cache, seed)
        monkeypatch.setattr(cache, "write", study.write)
        try:
            in_virtual_time(study.play)()
        except TimeoutError:
            stuck.append(seed)
    assert stuck == []
