"""The table and the figure of first situations that were only asked."""

from __future__ import annotations

import json

import duckdb
import pytest

from analysis.data.first_looks import first_looks
from analysis.data.study import Study
from analysis.explain import explain
from analysis.figures.first_look_figure import figure_of_first_looks
from analysis.tables import make_tables
from merge_runner.errors import UsageError
from merge_runner.results.first_looks import FIRST_LOOKS
from tests.harness import Run

EMULATOR = "emulator (scripted stand-in, no language model)"
RATE = "exchange rate (m per m/s)"


@pytest.fixture(scope="module")
def folder(prepare, tmp_path_factory):
    """The emulator and two programs, asked on a grid, and a trial that was driven."""
    folder = tmp_path_factory.mktemp("asked")
    grid = ("--grid", "h=-6:6:2,dv=-1.6:1.6:0.8")
    for ask in (
        ("seat", "first", "--samples", 4, *grid),
        ("seat", "first", "--model", "projected-order", "--samples", 2, *grid),
        ("seat", "first", "--model", "human-odds", "--samples", 4, "--grid", "h=0:2:2,dv=0"),
        ("seat", "first", "--model", "constant+emulator", "--samples", 1, "--grid", "h=0,dv=0"),
        ("sweep", "baseline", "--reps", 1, "--conditions", "N_0_0"),
    ):
        run: Run = prepare(folder, *ask)
        assert run.code == 0, run.err
    return folder


@pytest.fixture(scope="module")
def asked(folder):
    return Study(folder / "results/merge.duckdb")


@pytest.fixture(scope="module")
def table(asked):
    return make_tables(asked, ["first-look-surface"])[0]


def rows(table, driver):
    return {row.values["at"]: row for row in table.rows if row.values["driver"] == driver}


def test_the_planted_exchange_rate_of_the_emulator_is_found_beside_the_humans(table):
    own, human = rows(table, "emulator*")[RATE].values, rows(table, "human")[RATE].values
    assert own["m_ci"][0] < 3.30 / 1.11 < own["m_ci"][1]
    assert own["asked"] == 7 * 5 * 2 * 4
    assert (round(human["m"], 2), human["asked"]) == (2.97, 962)
    slope = rows(table, "human")["per m/s of velocity"].values
    assert (slope["action"], slope["asked"]) == (-0.338, 1898)
    assert slope["action_ci"] == pytest.approx((-0.375, -0.301))
    assert "m" not in slope


def test_a_point_counts_both_sides_by_their_own_headway_and_velocity(table, asked):
    point = rows(table, "emulator*")["h=+2 dv=-0.8"]
    with duckdb.connect(str(asked.db), read_only=True) as connection:
        counted = connection.execute(
            "SELECT count(*), avg((tactical = 'M')::INT), avg(acceleration_mps2) "
            "FROM trials JOIN decisions USING (trial_id, spec_hash) "
            "JOIN states USING (trial_id, spec_hash, side) "
            "WHERE source = 'seat' AND model_left = 'emulator' AND step = 1 AND ("
            "(side = 'left' AND projected_headway_m = 2 AND relative_velocity_mps = -0.8) OR "
            "(side = 'right' AND projected_headway_m = -2 AND relative_velocity_mps = 0.8))"
        ).fetchone()
        answers = connection.execute(explain(asked, table, point.id).sources[0].query).fetchall()
    names = ("asked", "m", "action")
    assert tuple(point.values[name] for name in names) == pytest.approx(counted)
    assert len(answers) == counted[0] == 8


def test_a_driver_without_chance_counts_once_and_has_no_interval(table):
    found = rows(table, "projected-order")
    assert found["h=+2 dv=+0"].values["asked"] == 2
    assert not any(value for row in found.values() for name, value in row.values.items()
                   if name.endswith("_ci"))  # fmt: skip
    assert "projected-order/baseline: it declares no chance" in "\n".join(table.notes)
    assert found["per m of headway"].values["action"] > 0


def test_a_program_that_draws_counts_with_each_answer_and_has_intervals(table):
    point = rows(table, "human-odds")["h=+0 dv=+0"].values
    assert point["asked"] == 2 * 4
    low, high = point["action_ci"]
    assert low < point["action"] < high
    assert not any("human-odds/baseline: it declares" in note for note in table.notes)


def test_the_drivers_of_a_mixed_pair_are_told_apart(table, asked):
    program = rows(table, "constant of emulator+constant")
    model = rows(table, "emulator of emulator+constant*")
    assert set(program) == set(model) == {"h=+0 dv=+0"}
    assert program["h=+0 dv=+0"].values.get("m") is None
    with duckdb.connect(str(asked.db), read_only=True) as connection:
        for rows_of_one, side in ((program, "left"), (model, "right")):
            (source,) = explain(asked, table, rows_of_one["h=+0 dv=+0"].id).sources
            answers = connection.execute(source.query).fetchall()
            assert [answer[1] for answer in answers] == [side]
    assert model["h=+0 dv=+0"].values["m"] in (0, 1)


def test_rows_have_the_ids_of_other_tables(table):
    ids = {row.id for row in table.rows}
    assert "emulator/baseline/h=+2 dv=-0.8" in ids
    assert {f"emulator+constant/baseline/{side}/h=+0 dv=+0" for side in ("left", "right")} <= ids


@pytest.mark.slow
def test_the_answers_of_a_driver_from_both_seats_are_one(prepare, tmp_path):
    pair = ("--model", "emulator+constant", "--mirror", "--samples", 2, "--grid", "h=2,dv=0")
    run = prepare(tmp_path, "seat", "first", *pair)
    assert run.code == 0, run.err
    study = Study(tmp_path / "results/merge.duckdb")
    (table,) = make_tables(study, ["first-look-surface"])
    points = {row.id: row for row in table.rows if " dv=" in row.id}
    here = [f"emulator+constant/baseline/{side}/h={h} dv=+0" for side in ("left", "right")
            for h in ("+2", "-2")]  # fmt: skip
    assert sorted(points) == sorted(here)
    own = points[here[0]]
    assert own.values["driver"] == "emulator of emulator+constant*"
    assert own.values["asked"] == 2
    for row in points.values():
        (source,) = explain(study, table, row.id).sources
        with duckdb.connect(str(study.db), read_only=True) as connection:
            found = connection.execute(source.query).fetchall()
        assert len(found) == 2
        assert len({side for _, side, *_ in found}) == 1


def test_the_figure_has_a_panel_for_words_and_one_for_actions(asked):
    figure = figure_of_first_looks(asked)
    assert len(figure.axes) == 2 * len(first_looks(asked)) == 10
    figure.canvas.draw()


@pytest.mark.slow
def test_models_and_factors_restrict_it(asked):
    assert [looks.label for looks in first_looks(Study(asked.db, ["emulator"]))] == [EMULATOR]
    none = Study(asked.db, where={"prompt": ["baseline"], "model": ["emulator"]})
    assert [looks.label for looks in first_looks(none)] == [EMULATOR]


@pytest.mark.slow
def test_drivers_and_levels_that_were_only_asked_can_be_chosen(asked):
    study = Study(asked.db, ["projected-order"], where={"model": ["projected-order"]})
    assert [looks.label for looks in first_looks(study)] == ["projected-order"]
    assert study.models == []
    with pytest.raises(UsageError, match=r"valid: human, emulator, .*projected-order"):
        Study(asked.db, ["idm"])


@pytest.mark.slow
def test_a_reply_without_a_plan_is_counted_and_is_no_action(prepare, tmp_path):
    assert prepare(tmp_path, "seat", "first", "--samples", 1).code == 0
    with duckdb.connect(str(tmp_path / "results/merge.duckdb")) as connection:
        connection.execute(
            "UPDATE decisions SET valid = false, plan = NULL, failure = 'no_array', "
            "fallback = true WHERE trial_id LIKE '%N_0_0%' AND side = 'left'"
        )
    study = Study(tmp_path / "results/merge.duckdb")
    values = rows(make_tables(study, ["first-look-surface"])[0], "emulator*")["h=+0 dv=+0"].values
    assert (values["asked"], values["invalid"]) == (2, 1)
    (looks,) = first_looks(study)
    right = looks.rows[(looks.rows["condition"] == "N_0_0") & (looks.rows["side"] == "right")]
    assert values["action"] == right["action_mps2"].iloc[0]


@pytest.mark.slow
def test_a_first_second_is_told_only_of_trials_that_lasted_one(prepare, tmp_path):
    (tmp_path / "mine.toml").write_text(
        'repetitions = 1\nconditions = ["N_0_0"]\n[factors]\nprompt_rate_hz = [2.5, 1.0, 0.5]\n'
    )
    assert prepare(tmp_path, "seat", "first", "mine.toml").code == 0
    with duckdb.connect(str(tmp_path / "results/merge.duckdb"), read_only=True) as connection:
        found = connection.execute(
            f"SELECT end_time_s, mean_mps2 IS NOT NULL FROM ({FIRST_LOOKS}) "
            "JOIN trials USING (trial_id, spec_hash) GROUP BY ALL ORDER BY ALL"
        ).fetchall()
    assert found == [(0.4, False), (1.0, True), (2.0, True)]
    table = make_tables(Study(tmp_path / "results/merge.duckdb"), ["first-look-surface"])[0]
    told = [row.values["mean"] is None for row in table.rows if row.id.endswith("dv=+0")]
    assert sorted(told) == [False, False, True]


def test_the_explorer_lists_no_situation_and_no_run_that_only_asked(asked):
    from analysis.explorer.catalogue import Catalogue

    catalogue = Catalogue(asked.db)
    catalogue.refresh()
    assert [row["source"] for row in catalogue.ask("SELECT source FROM listed")] == ["llm"]
    (sweep,) = catalogue.ask("SELECT config::VARCHAR AS config FROM sweeps")
    assert "seat" not in json.loads(sweep["config"])
