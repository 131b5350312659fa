"""A driver, a condition, a block and a metric that a study adds, as docs/extend.md says."""

import json
import subprocess
import sys

import pytest

from merge_runner.results.store import query, results_digest
from merge_runner.run.plan import make_plan
from merge_runner.study.file import PLUGIN, TEMPLATE
from tests.support.harness import FAST, PROJECT, how_to

PARTS = PROJECT / "tests/cases/parts"
CODE = {
    "driver": (PARTS / "driver.py").read_text(),
    "condition": how_to("Condition"),
    "prompt_block": how_to("Prompt block"),
    "metric": (PARTS / "metric.py").read_text(),
}
STUDY = f"""
models = ["emulator+impulsive", "constant+hesitant", "wild", "projected-order"]
conditions = ["far", "fast-tie", "N_0_0"]
repetitions = {{ baseline = 1, A8 = 1, A9 = 1 }}
[scenario]
step_s = 0.05
plan_step_s = 0.2
[plugins]
files = {[f"{kind}.py" for kind in CODE]}
[drivers.wild]
program = "impulsive"
strength = 0.9
clock = 1.0
"""
WITH = ("--study", "study.toml", "--trust")
WARNING = "Mind the speed of the other car: at "
NAME, HEADING = "mean_abs_acceleration_mps2", "mean |a| (m/s²)"
MEAN = """
SELECT avg(a) FROM (SELECT avg(abs(acceleration_mps2)) AS a FROM states
JOIN trials USING (trial_id, spec_hash) WHERE time_s > 0 AND status = 'finished'
AND variant = 'A8' AND model_left = 'emulator' GROUP BY trial_id, spec_hash)
"""


def write(folder, **changed):
    folder.mkdir(exist_ok=True)
    (folder / "study.toml").write_text(changed.get("study", STUDY))
    for kind, code in CODE.items():
        (folder / f"{kind}.py").write_text(changed.get(kind, code))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory, prepare):
    """Where the study has been played."""
    folder = write(tmp_path_factory.mktemp("added"))
    prepare(folder, "sweep", "study.toml", "--trust", *FAST, code=0)
    return folder


@pytest.fixture
def run(folder, prepare):
    def run(*arguments):
        return prepare(folder, *arguments, code=0)

    return run


@pytest.fixture
def rows(folder):
    return lambda sql: query(folder / "results/merge.duckdb", sql)[1]


def test_the_driver_passes_the_lint_of_those_that_ship():
    ruff = [sys.executable, "-m", "ruff", "check", "--stdin-filename"]
    file = "merge_runner/drivers/impulsive.py"
    subprocess.run([*ruff, file, "-"], input=CODE["driver"], text=True, cwd=PROJECT, check=True)


def test_a_driver_decides_at_its_own_rate_and_is_drawn_from_its_seed(rows, run, folder):
    found = rows(
        "SELECT if(side = 'left', model_left, model_right), decision, time_s, len(applied), "
        "len(plan) FROM decisions JOIN trials USING (trial_id, spec_hash) "
        "WHERE model_left <> 'projected-order'"
    )
    rates = {"emulator": 1, "constant": 1, "hesitant": 5, "impulsive": 20, "wild": 1}
    assert {name for name, *_ in found} == rates.keys()
    for name, number, time_s, applied, plan in found:
        assert time_s == pytest.approx(number / rates[name])
        # An action of a program lasts a step of the world, one of the model's plan 0.2 s.
        in_a_second = 5 if name == "emulator" else 20
        assert (applied, plan) == (in_a_second / rates[name], 4 * in_a_second)
    wild = "FROM decisions JOIN trials USING (trial_id, spec_hash) WHERE model_left = 'wild'"
    ((hardest,),) = rows(f"SELECT max(abs(plan[1])) {wild}")
    assert 0.5 < hardest <= 0.9
    run("replay", "study.toml", "--trust", "--db", "again.duckdb")
    assert results_digest(folder / "again.duckdb") == results_digest(
        folder / "results/merge.duckdb"
    )


def test_a_block_is_in_the_variants_that_add_it_and_changes_no_other(rows):
    prompts = rows(
        "SELECT variant, contains(prompt, 'Road type: merge'), prompt FROM decisions "
        "JOIN trials USING (trial_id, spec_hash) WHERE prompt IS NOT NULL"
    )
    assert {variant for variant, *_ in prompts} == {"baseline", "A8", "A9"}
    for variant, before_the_merge, prompt in prompts:
        assert (WARNING in prompt) == (variant in {"A8", "A9"} and before_the_merge)
        assert ("History of" in prompt) == (variant != "A9")
        assert prompt.split("\n\n")[-1].startswith("Output format:")


def test_what_is_added_changes_no_spec_that_does_without(tmp_path, monkeypatch):
    monkeypatch.chdir(write(tmp_path))
    of_the_study = STUDY.replace("[plugins]", "[perception]\n[plugins]")
    (tmp_path / "plain.toml").write_text(of_the_study[: of_the_study.index("[perception]")])
    asked = {"models": "emulator", "repetitions": 1, "conditions": ["N_0_0"]}
    specs = [
        make_plan(study, **asked, variants=["baseline"], trust=True).trial_specs()
        for study in ("study.toml", "plain.toml")
    ]
    assert specs[0] == specs[1]


def test_who_keeps_the_speed_of_a_condition_deviates_from_it_by_nothing(rows):
    assert rows(
        "SELECT DISTINCT least(rmse_left_mps, rmse_right_mps) FROM trial_metrics "
        "JOIN trials USING (trial_id, spec_hash) "
        "WHERE condition = 'fast-tie' AND model_left = 'projected-order'"
    ) == [(0.0,)]


def test_a_metric_is_in_the_tables_and_leads_to_its_trials(run, rows):
    latex = run("tables", "indicators", "contrasts", "--format", "latex", *WITH).out
    assert latex.count("$|$a$|$") >= 2
    told = json.loads(run("tables", "ablation-quantitative", "--format", "json", *WITH).out)
    table = {row["row"]: row for row in told["tables"][0]["rows"]}
    row = table["emulator+impulsive/A8"]
    assert row[NAME] == pytest.approx(rows(MEAN)[0][0])
    assert table["human"][NAME] is None
    assert f"{HEADING}: no human value is published, and none is imported" in table["human"]["note"]
    cell = f"emulator+impulsive/A8:{NAME}"
    told = json.loads(run("explain", "ablation-quantitative", cell, "--json", *WITH).out)
    (source,) = told["sources"]
    assert [trial_id for trial_id, *_ in rows(source["query"])] == source["trials"]
    assert len(source["trials"]) == rows(MEAN.replace("avg(a)", "count(a)"))[0][0] < row["n"]


def test_a_kept_table_is_of_the_metric_as_it_stands(run, folder):
    table = ("tables", "ablation-quantitative")
    assert HEADING in run(*table, *WITH).out
    write(folder, metric=CODE["metric"].replace('label="mean |a|"', 'label="average |a|"'))
    assert "average |a| (m/s²)" in run(*table, *WITH).out
    write(folder)
    assert "|a|" not in run(*table).out


def test_an_audit_replays_all_where_the_study_is_named(run):
    assert "not replayed" not in run("audit", *WITH).out


MISPLACED = """
from merge_runner.plugin import BLOCKS, VARIANTS, Block, Variant
BLOCKS.register("C6", Block("x", "Text.", None, before="C9"))
VARIANTS.register("A8", Variant(adds=frozenset({"C6"})))
VARIANTS.register("A9", Variant(adds=frozenset({"C6"})))
"""
REFUSED = {
    "a world that is too coarse": (
        {"study": STUDY.replace("0.05", "0.2").replace("emulator+", "constant+")},
        "the driver impulsive cannot decide 20.0 times a second: the time between two decisions = "
        "0.05 s is no whole number of 0.2 s; set a step_s that fits under [scenario] of the "
        "sweep's file, and beside it plan_step_s = 0.2 to leave a language model's plan as it is",
    ),
    "a condition beyond": (
        {
            "condition": CODE["condition"] + "CONDITIONS.register('beyond', Condition(60.0, 0.0))",
            "study": STUDY.replace('"far"', '"beyond"'),
        },
        "at the merge point",
    ),
    "a block without a place": (
        {"prompt_block": MISPLACED},
        "unknown place of the prompt block C6, before 'C9",
    ),
}


@pytest.mark.parametrize(("changed", "says"), REFUSED.values(), ids=REFUSED)
def test_a_part_that_cannot_be_is_refused_in_one_line_before_any_call(
    prepare, tmp_path, changed, says
):
    done = prepare(write(tmp_path, **changed), "sweep", "study.toml", "--trust")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert done.err.startswith("error: ")
    assert says in done.err


def test_a_mistake_in_the_sql_of_a_metric_is_told_in_one_line(prepare, folder):
    wrong = CODE["metric"].replace("avg(abs(acceleration_mps2))", "avg(nothing)")
    write(folder, metric=wrong)
    done = prepare(folder, "tables", "gap", *WITH)
    write(folder)
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert done.err.startswith(f"error: the SQL of the metric {NAME} fails: ")


@pytest.mark.parametrize("part", ["Driver", "Metric"])
def test_the_page_shows_the_driver_and_the_metric_that_init_writes(part):
    written = (TEMPLATE / PLUGIN).read_text()
    for paragraph in how_to(part).split("\n\n\n"):
        for lines in paragraph.splitlines() if "import " in paragraph else [paragraph.strip()]:
            assert lines in written
