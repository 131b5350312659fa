"""What a user sees of a sweep: its progress while it runs, and a summary of what came of it.

The progress is also in a small file beside the database, for other processes.
"""

from __future__ import annotations

import asyncio
import hashlib
import os
import platform
import sys
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from io import StringIO
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args
from urllib.parse import quote

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, NonNegativeInt, ValidationError

from merge_runner.audit.checks import Audit
from merge_runner.drivers.registry import EMULATOR
from merge_runner.llm.call import Meter
from merge_runner.llm.ledger import APART, Ledger
from merge_runner.paths import DEFAULT_CACHE, DEFAULT_DB, command_at
from merge_runner.prompts.blocks import decomposed
from merge_runner.records import SIDES, ReplayMiss, Status
from merge_runner.results.export import write_table
from merge_runner.run.estimate import Estimate, prompts_of
from merge_runner.run.plan import Options, Plan
from merge_runner.run.trials import Player
from merge_runner.text_safety import printable, say

if TYPE_CHECKING:
    from rich.text import Text

PULSE_S = 0.05
# In pulses: how often the file and a terminal are written, and plain lines.
PUBLISHED_EVERY, PLAIN_EVERY = 20, 100
SHOWN, REASONS_SHOWN = 10, 3
CLOSE_IT = "you may close this: the same command goes on"
STALE_S = 10.0
MOST_BYTES = 1_000_000
# Identifies the machine among those that share a folder: process ids mean nothing on another one.
MACHINE = hashlib.sha256(platform.node().encode()).hexdigest()[:8]


class Standing(BaseModel):
    """Snapshot of a sweep, for its display and for other processes.

    ``ended`` trials have an outcome, those that were stored before this run among them. ``left_s``
    is the estimated time left, None while there is no estimate. ``rows`` are what is shown, each
    with its name: ``WARNING``, ``waiting`` (for what), ``trials``, ``cost`` and so on.
    """

    model_config = ConfigDict(frozen=True)

    sweep_id: str
    pid: int = Field(default_factory=os.getpid, ge=1, lt=2**31)
    machine: str = MACHINE
    updated_at: AwareDatetime
    doing: Literal["playing", "checking"]
    ended: NonNegativeInt
    failed: NonNegativeInt
    cost_usd: float
    left_s: float | None
    rows: tuple[tuple[str, str], ...]

    @property
    def alive(self) -> bool:
        """Whether the sweep is still running, by its file and its process."""
        try:
            if self.machine == MACHINE:
                os.kill(self.pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:
            pass  # it is another user's
        return (datetime.now(UTC) - self.updated_at).total_seconds() < STALE_S


def write_standing(db: Path, standing: Standing) -> None:
    """Replace a sweep's file as a whole: a reader sees the old state or the new one, never a part.

    A sweep goes on where it cannot be written.
    """
    path = _path(db, standing.sweep_id)
    made = path.with_suffix(".tmp")
    with suppress(OSError):
        path.parent.mkdir(exist_ok=True)
        made.write_text(standing.model_dump_json(), encoding="utf-8")
        os.replace(made, path)


def remove_standing(db: Path, sweep_id: str) -> None:
    """Remove the file of a sweep that has ended normally."""
    path = _path(db, sweep_id)
    with suppress(OSError):
        path.with_suffix(".tmp").unlink(missing_ok=True)
        path.unlink(missing_ok=True)
        path.parent.rmdir()


def read_standing(db: Path, sweep_id: str) -> Standing | None:
    """The snapshot of a sweep that runs, or was killed; None without a file."""
    return _read(_path(db, sweep_id))


def running(db: Path) -> list[Standing]:
    """The snapshots of the sweeps into this database that are running now."""
    return [standing for _, standing in _standings(db) if standing.alive]


def clear_dead(db: Path) -> None:
    """Remove what killed sweeps left, and nothing else."""
    with suppress(OSError):
        for path, standing in _standings(db):
            if not standing.alive:
                path.unlink(missing_ok=True)


def _standings(db: Path) -> Iterator[tuple[Path, Standing]]:
    folder = _path(db, "").parent
    with suppress(OSError):
        for path in [] if folder.is_symlink() else list(folder.iterdir()):
            if standing := _read(path):
                yield path, standing


def _path(db: Path, sweep_id: str) -> Path:
    return db.with_name(f"{db.name}.progress") / f"{quote(sweep_id, safe='+')}.json"


def _read(path: Path) -> Standing | None:
    if not path.is_file():
        return None  # reading a pipe might never end
    try:
        with path.open("rb") as file:
            return Standing.model_validate_json(file.read(MOST_BYTES))
    except (OSError, ValidationError):
        return None


@dataclass(slots=True)
class Progress:
    """Where a sweep stands; ``runner`` plays its trials.

    ``planned`` is the number of all trials, ``stored`` of those that were stored before this run.
    ``outcome_counts`` counts how the trials of this run ended: with a Status, or ``suspended``
    until there is more money. ``worst_stall_s`` is the longest delay of the event loop.
    """

    plan: Plan
    planned: int
    runner: Player
    ledger: Ledger
    stored: int = 0
    cap_usd: float | None = None
    outcome_counts: Counter[str] = field(default_factory=Counter)
    began_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    ended_at: datetime | None = None
    worst_stall_s: float = 0.0
    doing: Literal["playing", "checking"] = "playing"
    unstored: Callable[[], str] = str  # says why trials are not stored; empty: nothing is wrong
    batches: Callable[[], list[str]] = list  # says which batches are waited for

    def meter(self) -> Meter:
        """What the meters of all models have counted."""
        whole = Meter()
        for each in self.runner.meters.values():
            whole.add(each)
        return whole

    def standing(self, sweep_id: str) -> Standing:
        """Where the sweep stands now."""
        meter = self.meter()
        now = datetime.now(UTC)
        elapsed_s = (now - self.began_at).total_seconds()
        failed = self.outcome_counts["failed"]
        ended = self.outcome_counts.total() - self.outcome_counts["suspended"] - failed
        batches = first_of(self.batches(), "others")
        # How long a batch takes nobody knows.
        left_s = (
            None
            if batches
            else self._left_s(elapsed_s, ended + failed, meter.calls_live + meter.calls_cached)
        )
        before = f" (+{self.stored} stored before)" if self.stored else ""
        workers = "" if self.runner.workers is None else f" on {self.runner.workers} workers"
        running = f"{self.runner.running} running{workers}"
        total = self.planned - self.stored
        trials = f"{ended + failed}/{total} ended{before}, {running}"
        cost = f"{meter.cost_usd:.2f} USD"
        if self.cap_usd is not None:
            cost += f", {self.ledger.committed_usd:.2f} of {self.cap_usd:g} over all runs"
        left = "" if left_s is None else f", about {left_s:.0f} s left"
        rows = [
            *dict.fromkeys(("WARNING", text) for text in self._warnings()),
            ("trials", trials),
            *(("decided", text) for text in self._decided() if ended + failed < total),
            ("failed", str(failed)),
            ("calls", _calls(*meter.answered)),
            ("cost", cost),
            *(("waiting", text) for text in batches + [CLOSE_IT] * bool(batches) + self._waits()),
            ("time", f"{elapsed_s:.0f} s{left}"),
        ]
        return Standing(
            sweep_id=sweep_id,
            updated_at=now,
            doing=self.doing,
            ended=self.stored + ended,
            failed=failed,
            cost_usd=meter.cost_usd,
            left_s=left_s,
            rows=tuple((name, printable(text)) for name, text in rows),
        )

    def _left_s(self, elapsed_s: float, ended: int, calls: int) -> float | None:
        """The estimated time left in s; None while there is nothing to estimate it from.

        Trials that run in step all end late, so early in a run the calls are a better basis.
        """
        total = self.planned - self.stored
        expected_calls = sum(self.plan.usual_calls.values()) * total / self.plan.trials
        by_calls = min(calls / expected_calls, 0.99) if expected_calls else 0.0
        part = max(ended / total, by_calls) if ended < total else 0.0
        return elapsed_s / part - elapsed_s if part else None

    def _decided(self) -> Iterator[str]:
        """How much of its decisions each model has made, or of all where one drives.

        How many a trial takes is known when it has ended: the share is of the usual number.
        """
        part = (self.planned - self.stored) / self.plan.trials
        expected, made = dict[str, float](), Counter[str]()
        for name, calls in self.plan.usual_calls.items():
            model = self.plan.registered[name]
            expected[model] = expected.get(model, 0.0) + calls * part
            if meter := self.runner.meters.get(name):
                made[model] += meter.calls_live + meter.calls_cached
        for model, calls in expected.items():
            share = min(made[model] / calls, 0.99) if calls else 0.0
            yield f"{f'{model}: ' * (len(expected) > 1)}about {share:.0%} of the decisions"

    def _warnings(self) -> Iterator[str]:
        if problem := self.unstored():
            yield problem
        for name, meter in self.runner.meters.items():
            yield from (f"another model answers: {pair}" for pair in sorted(meter.mismatches))
            if meter.stand_ins:
                yield f"a scripted stand-in answers, not {name}"
            yield from (f"{name}: {underpriced(tier)}" for tier in sorted(meter.underpriced))

    def _waits(self) -> list[str]:
        """How many calls wait, for what, and the latest time until when, if known."""
        texts = []
        for what, number in Counter(wait.what for wait in self.runner.waits).most_common():
            ends = [w.until for w in self.runner.waits if w.what == what and w.until is not None]
            until = f" until {max(ends):%H:%M:%S} UTC" if ends else ""
            texts.append(f"{number} {what}{until}")
        return first_of(texts, "other reasons")


def underpriced(tier: str) -> str:
    """Return the warning about replies whose service tier has no price in the registry."""
    return (
        f"replies are of the service tier {tier!r}, which is billed at about twice the price that "
        "is counted, and --max-cost knows nothing of that: leave that tier out, or give the model "
        f"a price with tiers = {{ {tier} = 2.0 }}"
    )


def first_of(texts: list[str], others: str, shown: int = REASONS_SHOWN) -> list[str]:
    """The first texts, and how many ``others`` there are."""
    left_out = len(texts) - shown
    return [*texts[:shown], f"{left_out} {others}"] if left_out > 0 else texts


@asynccontextmanager
async def show_progress(
    progress: Progress, db: Path, sweep_id: str, *, quiet: bool
) -> AsyncIterator[None]:
    """Show the progress on stderr and in a file beside the database while the body runs.

    ``quiet``: only the clients' messages.
    """
    live, log = None, Log()
    if not quiet and sys.stderr.isatty():
        from rich.console import Console
        from rich.live import Live

        live = Live(console=Console(stderr=True), auto_refresh=False)
        live.start()  # the text stays below what is printed meanwhile

    def show(*, ended: bool = False) -> None:
        with suppress(OSError):  # the terminal may be closed
            for note in _notes(progress):
                say(note)
            if live is not None:
                live.update(terminal_text(progress), refresh=not ended)
            elif not quiet:
                log.show(progress)

    def publish() -> None:
        write_standing(db, progress.standing(sweep_id))

    async def follow() -> None:
        """Publish and show it, and measure how late the event loop wakes a task that sleeps."""
        loop = asyncio.get_running_loop()
        for pulse in count(1):
            due = loop.time() + PULSE_S
            await asyncio.sleep(PULSE_S)
            progress.worst_stall_s = max(progress.worst_stall_s, loop.time() - due)
            if pulse % PUBLISHED_EVERY == 0:
                publish()
            if pulse % (PLAIN_EVERY if live is None else PUBLISHED_EVERY) == 0:
                show()

    clear_dead(db)
    publish()
    following = asyncio.create_task(follow())
    try:
        yield
    finally:
        following.cancel()
        show(ended=True)  # a terminal is written once more when the display stops
        with suppress(OSError):
            if live is not None:
                live.stop()
        remove_standing(db, sweep_id)
        with suppress(asyncio.CancelledError):
            await following


def terminal_text(progress: Progress) -> Text:
    """What is shown on a terminal; text from a server must not be read as markup."""
    from rich.text import Text

    mock = " (a mock)" if progress.plan.scripted else ""
    rows = (f"{name:<8} {text}" for name, text in progress.standing("").rows)
    return Text(
        printable("\n".join([f"{progress.plan.name}: {progress.plan.driver}{mock}", *rows]))
    )


@dataclass
class Log:
    """The progress as short lines, where no terminal shows it: without what is as it should be."""

    said: str = ""

    def show(self, progress: Progress) -> None:
        """Say where the sweep stands; once the trials have ended, only what is new."""
        rows = progress.standing("").rows
        usual = {("failed", "0"), ("cost", "0.00 USD")}
        shown = (row for row in rows if row not in usual and row[0] not in {"calls", "time"})
        line = "; ".join(text if name == "decided" else f"{name}: {text}" for name, text in shown)
        if line != self.said or progress.doing == "playing":
            say(f"{line}; {dict(rows)['time']}")
        self.said = line


def _notes(progress: Progress) -> list[str]:
    """The clients' messages since the last call: each once, and the first SHOWN."""
    notes: dict[str, None] = {}
    for meter in progress.runner.meters.values():
        notes |= dict.fromkeys(meter.notes)
        meter.notes.clear()
    return first_of(list(notes), "more like these", SHOWN)


def as_dict(
    options: Options,
    progress: Progress,
    expected: Estimate | None,
    checked: tuple[dict[str, Any], Audit] | None,
    **told: object,
) -> dict[str, Any]:
    """The summary as JSON values; ``expected`` is the estimate made before the run, if any.

    ``checked`` is what the database holds of the sweep. From ``decisions`` on, values are there
    where anything is stored. ``told`` goes into it.
    """
    plan, spending, meter = progress.plan, progress.ledger.spending, progress.meter()
    playing_s = ((progress.ended_at or progress.began_at) - progress.began_at).total_seconds()
    summary: dict[str, Any] = {
        **told,
        "name": plan.name,
        "run_name": options.name,
        "model": plan.model,
        "driver": plan.driver,
        "scripted": plan.scripted,
        "db": str(options.db),
        "cache": str(options.cache),
        "trials": {
            "planned": plan.trials,
            "stored_before": progress.stored,
            "suspended": progress.outcome_counts["suspended"],
        },
        "calls": {"live": meter.calls_live, "cached": meter.calls_cached},
        "calls_shared": meter.calls_shared,
        "calls_recorded": meter.calls_recorded,
        "attempts": meter.outcomes,
        "cost_usd": round(meter.cost_usd, 6),
        "calls_of_unknown_cost": meter.cost_unknown,
        "estimate": None if expected is None else asdict(expected),
        "sweep_cost_usd": round(spending.spent_usd, 6),
        "set_aside_usd": round(spending.reserved_usd, 6),
        "attempts_of_unknown_cost": spending.open_attempts,
        "over_the_worst_case_usd": round(spending.overrun_usd, 6),
        "dearest": spending.dearest,
        "underpriced": meter.underpriced,
        "damaged_entries": meter.damaged,
        "open_batches": progress.batches(),
        "playing_s": round(playing_s, 3),
        "worst_stall_s": round(progress.worst_stall_s, 3),
        "audit": None,
    }
    if checked is None:
        return summary
    facts, audit = checked
    summary["trials"] |= dict.fromkeys(get_args(Status), 0) | dict(facts["outcomes"])
    shown = {"condition": [*plan.conditions, "all"], **plan.levels}
    order = [(factor, level) for factor, levels in shown.items() for level in levels]
    by_level = {(row["factor"], row["level"]): row for row in facts["levels"]}
    return summary | {
        "scripted": bool(facts["stand_ins"]),
        "audit": audit.as_dict(),
        "decisions": facts["decisions"],
        "invalid_decisions": facts["invalid"],
        "fallbacks": facts["fallbacks"],
        "no_decision": facts["no_decision"],
        "model_mismatches": {f"{asked} -> {served}": n for asked, served, n in facts["others"]},
        "stand_ins": [row[:3] for row in facts["stand_ins"]],
        "same_prompts": [variants for (variants,) in facts["same_prompts"]],
        "failed": dict(facts["failed"]),
        "outcomes_by_level": [by_level[place] for place in order if place in by_level],
        "first_looks": facts["first_looks"],
    }


def as_lines(summary: dict[str, Any]) -> Iterator[str]:
    """The summary by ``as_dict`` for a reader."""
    is_stored = summary["audit"] is not None
    if summary["run_name"]:
        yield f"run: {summary['run_name']}"
    if is_stored:
        yield from _results(summary)
    yield from _costs(summary)
    yield from (f"open batch: {text}" for text in summary["open_batches"])
    for key in summary["damaged_entries"]:
        yield f"WARNING: a recorded reply was damaged, set aside and asked again: {key}"
    if is_stored:
        yield from _faults(summary)


def _results(summary: dict[str, Any]) -> Iterator[str]:
    """How the trials ended, or what drivers do first."""
    if looks := summary["first_looks"]:
        yield as_table(looks)
    else:
        yield _outcomes(summary)
    decisions, invalid = summary["decisions"], summary["invalid_decisions"]
    share = f" ({invalid / decisions:.1%})" if invalid else ""
    missing = summary["no_decision"]
    yield (
        f"decisions: {decisions}, {invalid} invalid{share}, {summary['fallbacks']} fallbacks"
        + (f", {missing} without the tactical decision asked for" if missing else "")
    )


def _outcomes(summary: dict[str, Any]) -> str:
    """How the trials ended that are stored, in one line."""
    rows = {(row["factor"], row["level"]): row for row in summary["outcomes_by_level"]}
    whole = dict(rows.get(("condition", "all"), {"trials": 0}))
    trials, planned = whole.pop("trials"), summary["trials"]["planned"]
    of = f" of {planned}" if trials < planned else ""
    stored = summary["trials"]["stored_before"]
    before = f", {stored} of them stored before this run" if stored else ""
    ways = [
        f"{number} {way}" for way, number in whole.items() if isinstance(number, int) and number
    ]
    return f"trials: {trials}{of}" + (f" ({', '.join(ways)})" if ways else "") + before


def _calls(live: int, cached: int, shared: int, recorded: int) -> str:
    """How many calls were asked, and how many had an answer.

    Of these ``shared`` ones got it in this run, and ``recorded`` ones from a recording that was
    named.
    """
    parts = {
        "from recordings": recorded,
        "from the cache": cached - shared - recorded,
        "shared with another trial": shared,
    }
    had = [f"{number} {how}" for how, number in parts.items() if number]
    return ", ".join([f"{live} asked"] * bool(live or not had) + had)


def _costs(summary: dict[str, Any]) -> Iterator[str]:
    number = summary["calls_of_unknown_cost"]
    unknown = f" and {number} calls of unknown cost" if number else ""
    made = (*summary["calls"].values(), summary["calls_shared"], summary["calls_recorded"])
    calls = _calls(*made)
    spent_usd, aside_usd = summary["sweep_cost_usd"], summary["set_aside_usd"]
    apart = bool(aside_usd) or round(spent_usd, 4) != round(summary["cost_usd"], 4)
    alone = " in this run" if apart else ""
    text = f"calls: {calls}; cost {summary['cost_usd']:.4f} USD{alone}{unknown}"
    if (expected := summary["estimate"]) is not None:
        text += f"; estimated before: {expected['calls']} calls, {_about(expected['cost_usd'])}"
    yield text
    if apart:
        ledger = command_at("merge-runner ledger", "--cache", summary["cache"], DEFAULT_CACHE)
        why = f", and {aside_usd:.4f} set aside (`{ledger}` says why)"
        yield f"this sweep over all its runs: {spent_usd:.4f} USD{why if aside_usd else ''}"
        yield APART
    if over_usd := summary["over_the_worst_case_usd"]:
        yield (
            f"WARNING: replies cost {over_usd:.4f} USD more than their worst case "
            f"({summary['dearest']}): the server does not keep to the output cap"
        )
    for tier, answers in summary["underpriced"].items():
        yield f"WARNING: {answers} {underpriced(tier)}"


def _faults(summary: dict[str, Any]) -> Iterator[str]:
    """Who answered in whose place, what the audit says, and which trials failed."""
    for pair, answers in summary["model_mismatches"].items():
        yield f"WARNING: another model answered than was asked for: {pair} ({answers} answers)"
    for driver, model, provider in summary["stand_ins"]:
        if provider == EMULATOR:
            yield f"The model `{model}` is a scripted stand-in, no language model."
        else:
            yield f"{driver}: a scripted stand-in answered, not {model}"
    if same := summary["same_prompts"]:
        prompts = "; ".join(map(", ".join, same))
        yield (
            f"the same trials with these prompts: {prompts}. The emulator reads no words: plant an "
            "effect to rehearse (docs/run-a-study.md#text-factors)"
        )
    audit = summary["audit"]
    audit_it = command_at("merge-runner audit", "--db", summary["db"], DEFAULT_DB)
    found = f"{len(audit['findings'])} findings, which `{audit_it}` lists"
    checked = found if audit["findings"] else "no problems"
    yield f"checked: {checked}; database: {summary['db']}"
    notes = [f"note: {each}" for each in audit["notes"]]
    yield from first_of(notes, f"more notes: `{audit_it}`", SHOWN)
    failed = [f"failed: {trial_id}: {error}" for trial_id, error in summary["failed"].items()]
    yield from first_of(failed, "more, in the table trials", SHOWN)
    if failed and summary["exit_code"] != ReplayMiss.exit_code:
        yield "Run the same command again to play the failed trials anew."


def as_table(rows: Sequence[dict[str, Any]]) -> str:
    """The table of a few rows, numbers shortened; empty without a row."""
    text = StringIO()
    if rows:
        cells = ([f"{v:g}" if isinstance(v, float) else v for v in r.values()] for r in rows)
        write_table([*rows[0]], map(tuple, cells), text)
    return text.getvalue()


def _about(cost_usd: float | None) -> str:
    return "an unknown price" if cost_usd is None else f"about {cost_usd:.2f} USD"


def _output_caps(expected: Estimate) -> Iterator[str]:
    """The most tokens that a reply may have, by which a longer one is cut off."""
    caps = expected.output_caps
    if caps:
        same = len({*caps.values()}) == 1
        most = [f"{n}{'' if same else f' with {model}'}" for model, n in caps.items()]
        each = ", ".join(most[:1] if same else most)
        yield f"        a reply is cut off at {each} output tokens (max_output_tokens)"


def _by_model(expected: Estimate) -> Iterator[str]:
    """What each of several models costs."""
    if len(expected.usd_by_model) > 1:
        yield from (f"        {name}: {_about(usd)}" for name, usd in expected.usd_by_model.items())


def _by_cap(expected: Estimate) -> Iterator[str]:
    """How far the money goes, where it will not do for all."""
    left_usd, cost_usd = expected.left_usd, expected.cost_usd
    if left_usd is not None and cost_usd and left_usd < cost_usd:
        yield (
            f"        stops at {left_usd:.2f} USD, about {100 * left_usd / cost_usd:.0f} % of it: "
            "what --max-cost, or the study's budget, leaves"
        )


def prompt_lines(plan: Plan) -> Iterator[str]:
    """The blocks, in order, of each prompt that has words of the study's factors."""
    for name, prompt in plan.parts.prompts.items():
        if decomposed(name)[1]:
            yield f"prompt  {name}: {', '.join(prompt.blocks)}"


def shown_prompts(plan: Plan) -> list[dict[str, Any]]:
    """The text of each prompt that a language model reads in a plan, and by whom it is read."""
    readers: dict[tuple[str, str], list[str]] = {}
    for arm in plan.arms:
        for name, text in prompts_of(plan, arm).items():
            sides = [s for s in SIDES if arm.asked[s] in arm.entries and arm.prompt(s) == name]
            who = "both drivers" if len(sides) == len(SIDES) else f"the {sides[0]} driver"
            readers.setdefault((name, text), []).append(f"{who} of {arm.label}")
    return [{"prompt": name, "read_by": who, "text": text} for (name, text), who in readers.items()]


def shown_prompt_lines(plan: Plan) -> Iterator[str]:
    """The same for a reader, with the numbers of one situation."""
    for each in shown_prompts(plan):
        who = "; ".join(first_of(each["read_by"], "others", SHOWN))
        yield f"\nprompt  {each['prompt']}, read by {who}:\n{each['text']}"


def estimate_lines(expected: Estimate) -> Iterator[str]:
    """What a run will take, for a reader."""
    measured = ", as measured before" if expected.measured else ""
    tokens = f"about {expected.input_tokens} in, {expected.output_tokens} out{measured}"
    if not expected.trials:
        if recorded := expected.planned - expected.stored:
            stored = f"{expected.stored} trials are stored"
            yield f"Nothing left to ask: {stored}, and {recorded} are played from recorded replies."
        else:
            yield f"Nothing left to play: all {expected.planned} trials are stored."
        return
    yield f"driver  {expected.driver}"
    yield f"trials  {expected.trials} that have not ended yet"
    yield f"calls   about {expected.calls} that are not recorded yet"
    yield f"tokens  {tokens}"
    yield from _output_caps(expected)
    if not expected.rounds:
        yield f"cost    {_about(expected.cost_usd)}"
        yield from _by_model(expected)
        yield from _by_cap(expected)
        yield f"time    about {expected.minutes} minutes"
        return
    singly = f"{_about(expected.singly_usd)} and {expected.minutes} minutes if asked singly"
    yield f"cost    {_about(expected.cost_usd)} in batches; {singly}"
    yield from _by_model(expected)
    yield from _by_cap(expected)
    yield (
        f"time    about {expected.rounds} rounds; each takes as long as its slowest batch: "
        "minutes, an hour, a day at most"
    )
