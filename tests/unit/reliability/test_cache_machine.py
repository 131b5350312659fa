"""Cache and ledger in any order of calls, kills, damage and second processes.

`HYPOTHESIS_EXAMPLES=2000 pytest -n0 tests/unit/reliability/test_cache_machine.py` plays many more.
"""

import asyncio
import contextlib
import os
import shutil
import sqlite3
import tempfile
from functools import partial
from pathlib import Path

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from merge_runner.errors import TrialSuspended
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.ledger import CallLabel, Cap, Ledger
from merge_runner.llm.store import CachedCall
from merge_runner.records import Attempt, Slot, make_request
from tests.support.clients import budget_of

QUESTIONS = 4
PROCESSES = 2
WORST_USD = 10
# Nothing is cut off from its power here, so nothing needs to wait for a disk.
IN_MEMORY = "/dev/shm" if os.path.isdir("/dev/shm") else None
EXAMPLES = int(os.environ.get("HYPOTHESIS_EXAMPLES", "25"))
NAMED = {"provider": "openai", "endpoint": "openai", "model": "m", "path": "/p", "headers": {}}
REQUESTS = [
    make_request(**NAMED, body={"prompt": number}, slot=Slot("A1", 1, "left", number, 0))
    for number in range(QUESTIONS)
]
questions = st.integers(0, QUESTIONS - 1)
costs = st.integers(0, WORST_USD)


class Process:
    """One merge-runner on the folder: what it has open, and the calls that it has in flight."""

    def __init__(self, folder, cap_usd):
        self.cache = ResponseCache(folder)
        self.budget = budget_of(Ledger(self.cache, "s"), cap_usd)
        self.in_flight_calls = {}  # its cache, the paid attempt and those before, by question


class CacheMachine(RuleBasedStateMachine):
    """``answered`` holds the entries that were kept, until their row is damaged.

    ``tried`` holds the attempts that were kept for a call without an answer, where these are known;
    ``charged_usd`` is what the server has charged, of which the program may know nothing.
    """

    def __init__(self):
        super().__init__()
        self.place = Path(tempfile.mkdtemp(dir=IN_MEMORY))
        self.cap_usd, self.charged_usd, self.made = 3.0 * WORST_USD, 0.0, 0
        self.answered, self.tried, self.damaged = {}, {}, set()
        self.loop = asyncio.new_event_loop()
        self.running = {}

    def teardown(self):
        for process in self.running.values():
            process.cache.close()
        self.loop.close()
        shutil.rmtree(self.place)

    def wait(self, job):
        return self.loop.run_until_complete(asyncio.wait_for(job, 20))

    @rule(question=questions)
    def ask(self, question):
        """Begin an attempt, where no entry is kept, it is not asked already, and the cap allows it.

        Each process has a model, and its questions, of its own: others may not ask it meanwhile.
        """
        number, key = question % PROCESSES, REQUESTS[question].key
        if number not in self.running:
            self.running[number] = Process(self.place, self.cap_usd)
        process = self.running[number]
        if question in process.in_flight_calls:
            return
        process.cache.run_now([partial(process.cache.quarantine, key)])
        known = process.cache.get(key)
        if question in self.answered:
            assert known == self.answered[question], "what is answered is not asked again"
            return
        assert known is None
        earlier = list(process.cache.look_up(key)[1])
        if paid := self.paid_for(process, question, earlier):
            self.tried.pop(question, None)
            process.in_flight_calls[question] = process.cache, paid, earlier

    def paid_for(self, process, question, earlier):
        """Set the worst case aside; None where there is no money, or none before others end."""

        async def at_once():
            key, asked = REQUESTS[question].key, CallLabel("", "", WORST_USD)
            waiting = asyncio.create_task(process.budget.reserve([question], key, asked))
            for _ in range(3):
                await asyncio.sleep(0)
            if not waiting.done():
                waiting.cancel()
            paid = await waiting
            try:
                await paid.begin(len(earlier) + 1)
            except TrialSuspended:
                paid.close()
                raise
            return paid

        try:
            return self.wait(at_once())
        except (TrialSuspended, asyncio.CancelledError):
            return None

    def in_flight(self):
        return [each.in_flight_calls for each in self.running.values() if each.in_flight_calls]

    def landed(self, data):
        calls = data.draw(st.sampled_from(self.in_flight()))
        question = data.draw(st.sampled_from(sorted(calls)))
        return question, *calls.pop(question)

    def booked(self, paid, attempt, keep):
        async def book():
            return await paid.book(attempt, keep)

        return self.wait(book())

    @precondition(in_flight)
    @rule(data=st.data(), cost=costs)
    def answer(self, data, cost):
        question, cache, paid, attempts = self.landed(data)
        self.made += 1
        self.charged_usd += cost
        reply = f'{{"text": "ä {self.made}"}}'
        attempts.append(Attempt(len(attempts) + 1, "ok", 200, reply=reply, cost_usd=float(cost)))
        entry = CachedCall(REQUESTS[question], tuple(attempts))
        kept = self.booked(paid, attempts[-1], partial(cache.keep, entry))
        paid.close()
        assert kept == entry
        self.answered[question] = entry
        self.tried[question] = ()

    @precondition(in_flight)
    @rule(data=st.data(), cost=costs, known=st.booleans())
    def fail(self, data, cost, known):
        """An attempt brings no answer, and what it cost is told or not."""
        question, cache, paid, attempts = self.landed(data)
        self.charged_usd += cost
        told = float(cost) if known else None
        attempts.append(Attempt(len(attempts) + 1, "server_error", 500, cost_usd=told))
        key = REQUESTS[question].key
        self.booked(paid, attempts[-1], partial(cache.keep_attempts, key, tuple(attempts)))
        paid.close()
        self.tried[question] = tuple(attempts)

    @precondition(lambda self: self.running)
    @rule(data=st.data(), cost=costs)
    def kill(self, data, cost):
        """The server charges for what is in flight all the same."""
        process = self.running.pop(data.draw(st.sampled_from(sorted(self.running))))
        self.charged_usd += cost * len(process.in_flight_calls)
        process.cache.close()  # the kernel closes the files, and nothing is put in order

    @rule(more=st.integers(1, 4 * WORST_USD))
    def raise_the_cap(self, more):
        """The same command with a higher --max-cost."""
        self.cap_usd += more
        for process in self.running.values():
            process.budget.ledger.cap = Cap(self.cap_usd)

    @precondition(lambda self: (self.place / "cache.db").exists())
    @rule(data=st.data())
    def damage(self, data):
        """One byte of one row changes on the disk."""
        with contextlib.closing(sqlite3.connect(self.place / "cache.db")) as database, database:
            rows = database.execute("SELECT rowid, key FROM Cache ORDER BY rowid").fetchall()
            # What is damaged twice may be whole again.
            others = [row for row in rows if row[1] != "format" and row[0] not in self.damaged]
            calls = [row for row in others if len(row[1]) == 64 or row[1].startswith("attempts ")]
            if not others:
                return
            rowid, name = data.draw(st.sampled_from(calls or others) | st.sampled_from(others))
            read = "SELECT CAST(value AS BLOB) FROM Cache WHERE rowid = ?"
            ((content,),) = database.execute(read, [rowid])
            self.damaged.add(rowid)
            changed = bytearray(content or b"x")
            changed[data.draw(st.integers(0, len(changed) - 1))] ^= data.draw(st.integers(1, 255))
            write = "UPDATE Cache SET value = CAST(? AS TEXT) WHERE rowid = ?"
            database.execute(write, [bytes(changed), rowid])
        for question, request in enumerate(REQUESTS):
            if request.key == name:
                self.answered.pop(question, None)
                self.tried.pop(question, None)
            if name == f"attempts {request.key}":
                self.tried.pop(question, None)

    @invariant()
    def the_sum_never_passes_the_cap(self):
        for process in self.running.values():
            counted_usd = Ledger(process.cache, "s").read().committed_usd
            assert self.charged_usd <= counted_usd + 1e-6
            assert counted_usd <= self.cap_usd + 1e-6

    @invariant()
    def every_stored_byte_is_what_was_answered(self):
        for process in self.running.values():
            found = {entry.request.key: entry for entry in process.cache.entries()}
            assert found == {REQUESTS[q].key: entry for q, entry in self.answered.items()}
            for question in self.tried.keys() - self.answered.keys():
                assert process.cache.look_up(REQUESTS[question].key)[1] == self.tried[question]


def test_nothing_answered_is_asked_again_and_the_cap_holds_in_any_order():
    """Nor is more spent than is counted, and every stored byte is what was answered."""
    run_state_machine_as_test(
        CacheMachine,
        settings=settings(max_examples=EXAMPLES, stateful_step_count=30, deadline=None),
    )
