"""Databases for the analysis: trials driven by constant actions, written as any sweep's are."""

import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import duckdb

from merge_runner.config import ScenarioConfig
from merge_runner.records import SIDES, Attempt, ChatReply, ChatRequest, Decision, Side, Slot
from merge_runner.results.store import Store
from merge_runner.scenarios.merge.conditions import CONDITIONS, HUMAN_CONDITIONS
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner.scenarios.merge.world import World
from merge_runner.trial_records import DecisionRow, FailedCall, TrialRecord, TrialSpec
from merge_runner_analysis.study import StudyResults

SCENARIO = ScenarioConfig()
ANSWERS = ("ok", "refusal", "truncated", "empty")


@dataclass(frozen=True)
class Said:
    """What became of the left driver's call: the outcomes of its attempts, the answer's last.

    With a ``failure`` the answer holds no plan, or no tactical decision (``no_decision``), and with
    ``lost`` there is no answer; what is driven is the same. ``served`` is the model that answered.
    """

    outcomes: tuple[str, ...] = ("ok",)
    failure: str | None = None
    lost: bool = False
    served: str | None = None


@dataclass(frozen=True)
class Drive:
    """One trial: its cell, and the normalised action of either driver in every second.

    ``said`` holds what was said at which decision, elsewhere the call was answered at once; None:
    no model was asked.
    """

    driver: str
    variant: str
    condition: str
    rep: int
    left: tuple[float, ...]
    right: tuple[float, ...]
    said: Mapping[int, Said] | None = None


def played(drive: Drive, scenario: ScenarioConfig = SCENARIO) -> TrialRecord:
    """Play a trial; after the last given second the drivers keep their speed."""
    world = World(scenario, CONDITIONS[drive.condition], TRACK)
    decisions: list[DecisionRow] = []
    lost: list[FailedCall] = []
    number = 0
    while world.status is None and not lost:
        plans = {
            side: tuple(
                actions[number + later] if number + later < len(actions) else 0.0
                for later in range(4)
                for _ in range(5)
            )
            for side, actions in (("left", drive.left), ("right", drive.right))
        }
        for side in SIDES:
            found = answered(drive, side, number, Decision(plans[side], plans[side][:5]))
            if isinstance(found, FailedCall):
                lost.append(found)
            else:
                decisions.append(DecisionRow(number, world.time_s, side, found))
        for index in range(5):
            if world.status is None and not lost:
                world.drive([plans["left"][index]], [plans["right"][index]])
        number += 1
    return TrialRecord(
        spec=TrialSpec(
            trial_id=f"{drive.driver}/{drive.variant}/{drive.condition}/rep{drive.rep:02d}",
            spec_hash=f"{drive.driver}-{drive.variant}",
            source="llm",
            model_left=drive.driver,
            model_right=drive.driver,
            variant=drive.variant,
            condition=drive.condition,
            repetition=drive.rep,
            sample_set=0,
            order=0,
            kinematics=CONDITIONS[drive.condition],
        ),
        status="failed" if lost else world.status,
        merged_first=None if lost else world.merged_first(),
        end_time_s=world.time_s,
        error="no answer after 2 attempts" if lost else None,
        states=world.states(),
        decisions=tuple(decisions),
        failed_calls=tuple(lost),
    )


def answered(drive: Drive, side: Side, number: int, decision: Decision) -> Decision | FailedCall:
    """The decision with its call, as this was answered; a call without an answer has failed."""
    if drive.said is None:
        return decision
    said = drive.said.get(number, Said()) if side == "left" else Said()
    slot = Slot(drive.condition, drive.rep, side, number, 0)
    key = f"{drive.driver}/{drive.variant}/{drive.condition}/{drive.rep}/{side}/{number}"
    request = ChatRequest(key, "openai", "openai", drive.driver, "/chat", {}, "{}", slot)
    attempts = tuple(
        Attempt(
            index,
            outcome,
            http_status=200 if outcome in ANSWERS else None,
            model_served=(said.served or drive.driver) if outcome in ANSWERS else None,
            cost_usd=None if outcome == "unknown" else 0.01,
        )
        for index, outcome in enumerate(said.outcomes, 1)
    )
    if said.lost:
        return FailedCall(number, side, request, attempts)
    has_plan = said.failure in {None, "no_decision"}
    return replace(
        decision,
        plan=decision.plan if has_plan else None,
        failure=said.failure,
        fallback=not has_plan,
        reply=ChatReply("", said.outcomes[-1], request, attempts, cached_attempts=0),
    )


def as_humans(db: Path) -> None:
    """Let the trials of the driver ``human`` be humans'; their variant names the pair, or P1."""
    with duckdb.connect(str(db)) as connection:
        connection.execute(
            "UPDATE trials SET source = 'human', variant = NULL, model_left = NULL, "
            "model_right = NULL, pair = CASE variant WHEN 'baseline' THEN 'P1' ELSE variant END "
            "WHERE trial_id LIKE 'human/%'"
        )


def write_study(
    path: Path,
    drives: Iterable[Drive],
    scenario: ScenarioConfig = SCENARIO,
    config: object = None,
    asked: Mapping[str, object] | None = None,
) -> Path:
    """Write the trials of a sweep, which was configured so, into a new database.

    ``asked`` is what the specs say of both drivers: the endpoint, and the body of a request.
    """
    records = [played(drive, scenario) for drive in drives]
    path.write_bytes(_empty())
    store = Store(path)
    specs = {
        record.spec.spec_hash: json.dumps(
            {"scenario": scenario.model_dump()} | ({"left": asked, "right": asked} if asked else {})
        )
        for record in records
    }
    sweep = {
        "sweep_id": "sweep-1",
        "name": "test",
        "started_at": datetime(2026, 11, 21, tzinfo=UTC).replace(tzinfo=None),
        "config": json.dumps(config or {}),
        "versions": "{}",
    }
    store.begin_sweep(sweep, specs, [])
    store.write("sweep-1", records, patience_s=5)
    return path


def damage(db: Path, *statements: str) -> None:
    """Change a database by statements, each of which must change something."""
    with duckdb.connect(str(db)) as connection:
        for statement in statements:
            rows = connection.execute(statement).fetchall()
            assert rows[0][0] > 0, f"nothing was damaged: {statement}"


def changed(db: Path, *statements: str) -> StudyResults:
    """The study of a database after some changes."""
    with duckdb.connect(str(db)) as connection:
        for statement in statements:
            connection.execute(statement)
    return StudyResults(db)


@cache
def _empty() -> bytes:
    """A database without a row: making one takes longer than writing a study."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "empty.duckdb"
        Store(path)
        return path.read_bytes()


def yielding(driver: str, variant: str = "baseline", reps: int = 3) -> list[Drive]:
    """A driver like the humans: who is ahead, or slower where level, goes first."""
    drives = []
    for name, condition in HUMAN_CONDITIONS.items():  # whatever a study before has registered
        ahead = condition.projected_headway_m - 2 * condition.relative_velocity_mps
        for rep in range(1, reps + 1):
            # One repetition in five, and every second where nobody is ahead, is decided otherwise.
            left = ahead > 0 or (ahead == 0 and rep % 2 == 0)
            if rep % 5 == 0:
                left = not left
            strength = 0.30 + 0.04 * rep + 0.02 * abs(condition.projected_headway_m)
            faster, slower = (strength,) * 3, (-strength,) * 3
            actions = (faster, slower) if left else (slower, faster)
            drives.append(Drive(driver, variant, name, rep, *actions))
    return drives


def scaled(drives: list[Drive], share: float, crashes: Collection[int] = ()) -> list[Drive]:
    """The drives with a share of their accelerations, and with none in repetitions that crash."""
    changed = []
    for drive in drives:
        sides = {s: tuple(share * x for x in getattr(drive, s)) for s in ("left", "right")}
        if drive.rep in crashes:
            sides = {"left": (0.0,), "right": (0.0,)}
        changed.append(replace(drive, **sides))
    return changed
