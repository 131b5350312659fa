"""Trials of a few seconds, each an example of one account."""

from merge_runner.config import ScenarioConfig
from merge_runner.records import SIDES
from merge_runner.scenarios.merge.geometry import TRACK
from merge_runner_analysis.web.trial.account import Course
from tests.support.studies import SCENARIO, Drive, Said, played

NO_PLAN = Said(failure="no_array")
EXAMPLES = {
    "nobody braked, both sped up": ("N_0_0", (0.5,) * 5, (0.4,) * 5, None),
    "both braked": ("N_0_0", (-0.5,) * 3, (-0.55,) * 3, None),
    "nobody braked, one sped up": ("N_0_0", (), (0.12,) * 4, None),
    "nobody braked or sped up": ("N_0_0", (), (0.02,) * 5, None),
    # Its vehicle is still faster than at the start when they collide.
    "one braked": ("N_0_0", (0.5,) * 5, (0.5, 0.5, -0.3), None),
    "no valid plan": ("N_0_0", (0.5,) * 5, (0.4,) * 5, {1: NO_PLAN}),
    "near miss": ("N_0_0", (0.12,) * 3, (-0.1,) * 3, None),
    "long wait": ("L_4_0", (-0.9,) * 3 + (0.0, 0.3), (-1.0,) * 3, None),
    None: ("L_4_0", (0.4,) * 3, (-0.4,) * 3, None),
}

# The gap is 2.0 m, and then the follower closes in until it touches the other within 0.95 s.
CLOSING_IN = Drive(
    "o5", "baseline", "N_0_0", 1, (0.15,) * 3 + (-0.2,) * 2, (-0.15,) * 3 + (0.0,) * 2 + (0.3,) * 3
)


def drive(account, driver="o3"):
    condition, left, right, said = EXAMPLES[account]
    return Drive(
        driver, "baseline", condition, 1 + list(EXAMPLES).index(account), left, right, said
    )


def decided(record):
    """The decisions of a trial, as they are stored."""
    return [
        {
            "side": row.side,
            "decision": row.number,
            "time_s": row.time_s,
            "valid": row.decision.valid,
            "fallback": row.decision.fallback,
            "failure": row.decision.failure,
            "tactical": row.decision.tactical,
        }
        for row in record.decisions
    ]


def course_of(record, scenario: ScenarioConfig = SCENARIO):
    of = {side: [row for row in record.states if row.side == side] for side in SIDES}
    return Course(
        scenario,
        TRACK,
        [row.time_s for row in of["left"]],
        {side: [row.position_m for row in rows] for side, rows in of.items()},
        {side: [row.velocity_mps for row in rows] for side, rows in of.items()},
    )


def crash(condition, left, right, said=None, scenario=SCENARIO):
    """A collision: its course and its decisions."""
    record = played(Drive("o3", "baseline", condition, 1, left, right, said), scenario)
    assert record.status == "collided"
    return course_of(record, scenario), decided(record)
