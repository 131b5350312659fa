"""What the first page says of drivers beside people, with the notes on their numbers."""

from dataclasses import replace

import pytest

from merge_runner_analysis.web.judged import Driver, noted
from merge_runner_analysis.web.marks import Cell
from merge_runner_analysis.web.next_steps import is_found, next_steps
from merge_runner_analysis.web.people import (
    could_see,
    counted,
    equal_trials,
    gap_weights,
    likeness_of,
    other_differences,
    verdict_rules,
)
from merge_runner_analysis.wording import MOCK, OPEN, PROGRAM, SHOWN, STRONGER, WEAKER


def driver(name, **verdicts):
    cells = {of: Cell(values, None, "", "", "", "") for of, values in verdicts.items()}
    return Driver(name, "baseline", PROGRAM, cells, "", None, "", "")


def least(**by_measure):
    """Verdicts with these detectable differences; without one, too few trials for a verdict."""
    return {
        name: {"detectable": size, "state": OPEN, "n": 110 if size else 11, "ended": 110}
        for name, size in by_measure.items()
    }


@pytest.mark.parametrize(
    ("drivers", "text"),
    [
        ([{}], ""),
        ([least(collisions=None)], ""),
        ([least(collisions=12.0)], "12.00\xa0points in crashes"),
        (
            [least(collisions=12.0), least(collisions=7.5), least(collisions=9.0), {}],
            "7.50 (b) to 12.00 (a) points in crashes",
        ),
        ([least(collisions=6.221), least(collisions=6.219)], "6.22\xa0points in crashes"),
        (
            [least(collisions=12.0, gap=3.0), least(gap=2.0)],
            "12.00\xa0points in crashes, 2.00 (b) to 3.00 (a) m in the gap",
        ),
        (
            [{"collisions": {"undecided": 4}, **least(gap=3.0)}],
            "3.00\xa0m in the gap; in crashes unknown, as another crash rule ended some trials",
        ),
        ([{"collisions": {"undecided": 4}}], ""),
        ([{"gap": least(gap=3.0)["gap"] | {"n": 19, "ended": 19}}], ""),
    ],
)
def test_the_least_and_the_largest_detectable_differences_name_their_drivers(drivers, text):
    named = [driver(name, **of) for name, of in zip("abcd", drivers, strict=False)]
    assert could_see(named, {name: name for name in "abcd"}) == text


JUDGED = {"gap": {"state": OPEN, "n": 30, "ended": 30}}


@pytest.mark.parametrize(
    ("drivers", "text"),
    [
        ([JUDGED], "all tests of a driver;"),
        (
            [JUDGED | {"headway": {"p_holm": 0.3}}],
            "all tests of a driver (1: who goes first, by who is ahead);",
        ),
        (
            [JUDGED | {"headway": {"p_holm": 0.3}}, JUDGED, {"gap": {"p_holm": 0.3}}],
            "all tests of a driver (0 to 1: who goes first, by who is ahead; mean gap);",
        ),
    ],
)
def test_the_rule_of_a_verdict_has_the_number_of_tests_where_it_is_known(drivers, text):
    named = [driver(name, **of) for name, of in zip("abc", drivers, strict=False)]
    assert text in verdict_rules(named, {})[2]


@pytest.mark.parametrize("drivers", [[], [{}], [{"gap": {"state": OPEN, "n": 19, "ended": 19}}]])
def test_without_a_verdict_only_the_rule_of_none_is_said(drivers):
    (rule,) = verdict_rules([driver("a", **of) for of in drivers], {"ci": (2.0, 4.0)})
    assert rule.startswith("No verdict: fewer than 20")


def test_drivers_with_the_same_note_on_a_measure_share_it():
    few, other = {"note": "few trials"}, {"note": "other rule"}
    drivers = [
        driver("a", collisions=few, gap=few),
        driver("b", collisions=few, gap={}),
        driver("c", collisions=other),
        driver("d"),
    ]
    crashes = [(["a", "b"], "crashes", "Few trials"), (["c"], "crashes", "Other rule")]
    assert noted(drivers, {"collisions": "crashes"}) == crashes
    gap = [(["a"], "gap", "Few trials")]
    assert sorted(noted(drivers, {"collisions": "crashes", "gap": "gap"})) == sorted(crashes + gap)
    assert noted(drivers, {"gap": "gap"}, {"gap": "not posed"}) == [
        (["a", "b", "c", "d"], "gap", "Not posed")
    ]


NAMES = {"a": "a", "b": "b"}


def played(*, trials, n, ended, human=(True, False)):
    """A driver with n of its trials counted, and how many ended in two situations."""
    crashes = {"state": OPEN, "n": n, "ended": n, "counted": f"0 of {n}"}
    others = {name: {"state": SHOWN, "n": n, "ended": n} for name in ("headway", "velocity", "gap")}
    of = replace(driver("a", collisions=crashes, **others), facts={"trials": trials})
    cells = [{"ended": number} for number in ended]
    humans = [{"ended": 90} if is_so else None for is_so in human]
    names = ["L_4_0", "N_0_0"]
    return of, {"names": names, "rows": [(of, cells)], "humans": humans}


@pytest.mark.parametrize(
    ("of", "says"),
    [
        (played(trials=20, n=20, ended=(10, 10), human=(True, True)), ""),
        (
            played(trials=20, n=3, ended=(10, 8)),
            "3 counted; not counted: 7 repeat another one, 8 in situations that nobody drove, "
            "2 did not end",
        ),
        (
            played(trials=20, n=11, ended=(10, 10), human=(True, True)),
            "11 counted; not counted: 9 repeat another one",
        ),
    ],
)
def test_trials_that_are_not_counted_have_a_reason(of, says):
    assert counted(*of) == says


def test_crashes_that_another_rule_ended_are_given_by_peoples_rule_first():
    values = {"measure": "collisions", "state": OPEN, "n": 98, "k": 2, "undecided": 12, "row": "a",
              "ended": 110, "counted": "14 of 110",
              "counted_by": "the rule of centres"}  # fmt: skip
    cell = Cell(values, None, "", "", "", "")
    shown = likeness_of(replace(driver("a"), cells={"collisions": cell}))["collisions"]
    assert (shown.surely, shown.by_people.replace("\xa0", " ")) == (
        2,
        "to 14 of 110, 1.82 to 12.73 % by people's rule: the vehicles' outlines overlap",
    )
    assert (shown.k, shown.n, shown.text.replace("\xa0", " ")) == (
        14,
        110,
        "12.73 % by the rule played here: the vehicles' centres are closer than a vehicle length",
    )


def test_people_s_gap_is_given_as_each_driver_is_compared_with_it():
    of = [driver(name, gap={"state": OPEN, "n": 30, "human": gap}) for name, gap in
          (("a", 3.851), ("b", 3.869))]  # fmt: skip
    assert gap_weights(of, NAMES).replace("\xa0", " ") == (
        "People's mean gap depends on the situations, so it is computed for those of each driver: "
        "3.85 to 3.87 m. The row of people has the one for a"
    )
    assert gap_weights(of[:1], NAMES) == ""


def test_every_verdict_has_its_rule():
    rules = verdict_rules([driver("a", **JUDGED)], {"ci": (2.0, 4.0)})
    assert [rule.split()[0] for rule in rules] == ["Like", "Same", "More,", "Cannot", "No"]
    assert rules[0].endswith("people's mean gap is known only to ± 1.00 m, from nine pairs")


TYPED = ["sweep", "s.toml", "--model", "emulator", "--yes"]


@pytest.mark.parametrize(
    ("of", "kind", "sweep", "steps"),
    [
        (
            played(trials=10, n=10, ended=(10, 0)),
            MOCK,
            TYPED,
            [
                ("This was a rehearsal", "m sweep s.toml --model MODEL --dry-run"),
            ],
        ),
        (
            played(trials=10, n=10, ended=(10, 0)),
            PROGRAM,
            TYPED,
            [("a: fewer than 20 counted", "m sweep s.toml --model emulator --yes --reps N")],
        ),
        (
            played(trials=110, n=11, ended=(110, 0)),
            PROGRAM,
            TYPED,
            [("a: fewer than 20 different trials", "")],
        ),
        (
            played(trials=110, n=110, ended=(110, 0)),
            PROGRAM,
            ["sweep", "STUDY"],
            [],
        ),
        (
            played(trials=110, n=110, ended=(110, 0)),
            MOCK,
            ["replay", "s.toml", "--recording", "r.parquet", "--model", "emulator"],
            [("This was", "m sweep s.toml --model MODEL --dry-run")],
        ),
    ],
)
def test_the_next_steps_follow_from_the_result(of, kind, sweep, steps):
    a, conditions = of
    a = replace(a, kind=kind)
    conditions = conditions | {"rows": [(a, conditions["rows"][0][1])]}
    given = next_steps("m", sweep, "", [a], NAMES, conditions, None)
    assert len(given) == len(steps)
    for (text, command), (begins, run) in zip(given, steps, strict=True):
        assert text.startswith(begins)
        assert command.startswith(run)
        assert bool(command) == bool(run)


@pytest.mark.parametrize(
    ("words", "study", "place", "line"),
    [
        (TYPED, "repetitions = 1", "at the top of s.toml", 'scenario.collision_rule = "rectangle"'),
        (
            TYPED,
            "[scenario]\nstep_s = 0.1",
            "in [scenario] of s.toml",
            'collision_rule = "rectangle"',
        ),
        (
            ["sweep", "baseline"],
            "",
            "at the top of a copy of baseline.toml",
            'scenario.collision_rule = "rectangle"',
        ),
    ],
)
def test_another_rule_of_crashes_is_given_as_the_line_of_the_file(words, study, place, line):
    a, conditions = played(trials=110, n=110, ended=(110, 0))
    a = replace(a, cells=driver("a", collisions={"undecided": 4, "n": 106, "ended": 110}).cells)
    conditions = conditions | {"rows": [(a, conditions["rows"][0][1])]}
    steps = next_steps("m", words, study, [a], NAMES, conditions, None)
    ((text, given),) = [step for step in steps if step[0].startswith("By people's rule")]
    assert f"set this {place}, and play" in text
    assert given == line


def test_a_difference_in_a_measure_without_a_column_is_named_in_the_row():
    apart = {"state": STRONGER, "n": 110, "ended": 110}
    shown = driver("a", **{"gap": apart, "gap-headway": apart | {"measure": "gap-headway"}})
    more = "each metre that one is ahead adds more to its gap than to people's"
    assert other_differences(shown) == f"in another measure (gap, by who is ahead): {more}"
    assert other_differences(driver("a", gap=apart)) == ""


@pytest.mark.parametrize(
    ("state", "kind", "is_so"),
    [(WEAKER, PROGRAM, True), (WEAKER, MOCK, False), (OPEN, PROGRAM, False)],
)
def test_a_difference_from_people_is_found_where_no_mock_model_drove(state, kind, is_so):
    values = {"measure": "headway", "state": state, "n": 110, "ended": 110}
    assert is_found([replace(driver("a", headway=values), kind=kind)], None) is is_so


def test_drivers_most_of_whose_trials_went_as_an_earlier_one_are_named_with_their_counts():
    facts = {"trials": 110, "ended": 110}
    of = {"state": STRONGER, "n": 110, "ended": 110}
    most, half = (
        replace(driver(name, collisions=of | {"equal": equal}), facts=facts)
        for name, equal in (("a", 99), ("b", 55))
    )
    assert equal_trials([most, half], NAMES) == "99 of 110 trials of a"
