"""Figures that the docs give are computed anew from what they are about."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from importlib import metadata

import httpx
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.integration.test_installed import built, checkout_in
from tests.support.harness import PROJECT
from tests.support.serving import served

DOCS = PROJECT / "docs"
NUMBER = r"-?\d+(?:\.\d+)?"
WHO_FIRST = ("intercept", "projected_headway", "relative_velocity")
GAP = ("intercept", "abs_projected_headway", "abs_relative_velocity", "headway_x_velocity")
# No vehicle is ahead when the first reaches the merge point: who yields is drawn.
TIED = "L_0_-8,N_0_0,R_0_8"
CONDITIONS = 11


def told(page: str, pattern: str) -> tuple[str, ...]:
    """The numbers in a sentence of a page, which has `#` for each."""
    text = " ".join((PROJECT / page).read_text(encoding="utf-8").split())
    found = re.search(re.escape(pattern).replace(r"\#", f"({NUMBER})"), text)
    assert found, f"{page} does not say {pattern}"
    return found.groups()


async def sql(merge_runner, query, db="results/merge.duckdb"):
    return json.loads((await merge_runner("sql", query, "--db", db, "--json")).out)


async def test_the_gaps_of_idm(merge_runner, tmp_path):
    sets = ("highway-env", "treiber-kesting")
    drivers = "".join(f'[drivers.{name}]\nprogram = "idm"\nset = "{name}"\n' for name in sets)
    (tmp_path / "idm.toml").write_text(f"models = {[*sets]}\nrepetitions = 1\n{drivers}")
    for part in ((), ("--conditions", TIED, "--reps", 10)):
        assert (await merge_runner("sweep", "idm.toml", *part)).code == 0
    rows = await sql(
        merge_runner,
        "with ways as (select distinct model_left, condition, round(gap_m, 6) as gap_m "
        "from trials join trial_metrics using (trial_id, spec_hash) where status = 'finished') "
        "select model_left, condition, avg(gap_m) as gap_m from ways group by all",
    )
    assert len(rows) == 2 * CONDITIONS
    means = (
        sum(row["gap_m"] for row in rows if row["model_left"] == name) / CONDITIONS for name in sets
    )
    assert told(
        "docs/reference/reference-drivers.md",
        "gaps of # m (`highway-env`) and # m (`treiber-kesting`) on the average of the 11 cond",
    ) == tuple(f"{mean:.1f}" for mean in means)


async def test_what_990_trials_of_the_drivers_with_chance_come_to(merge_runner):
    run = await merge_runner(
        *("sweep", "baseline", "--reps", 90, "--model", "human-odds", "--model", "quantal")
    )
    assert run.code == 0, run.err
    rows = await sql(
        merge_runner,
        "select model_left, count(*) as n, count_if(status = 'collided') as collided "
        "from trials group by all order by all",
    )
    odds, quantal = (row["collided"] for row in rows)
    assert {row["n"] for row in rows} == {990}
    out = (await merge_runner("tables", "who-first", "gap", "--json")).out
    fits = {
        (table["name"], row["row"]): f"{row['b']:.2f}"
        for table in json.loads(out)["tables"]
        for row in table["rows"]
    }

    def terms(driver: str, table: str, names: tuple[str, ...]) -> list[str]:
        return [fits[table, f"{driver}/{name}"] for name in names]

    page = "docs/reference/reference-drivers.md"
    assert told(
        page,
        "Of 990 trials against itself # collide by the paper's rule (humans: 28), and the "
        "regression on the others has #, # and #.",
    ) == (str(odds), *terms("human-odds/baseline", "who-first", WHO_FIRST))
    assert told(page, "| collisions | # | # |") == (str(quantal), "28")
    for row, table, names in (
        ("who goes first: intercept, headway, relative velocity", "who-first", WHO_FIRST),
        ("gap: intercept, abs. headway, abs. velocity, product", "gap", GAP),
    ):
        places = ", ".join(["#"] * len(names))
        assert told(page, f"| {row} | {places} | {places} |") == (
            *terms("quantal/baseline", table, names),
            *terms("human", table, names),
        )


async def test_how_the_driver_cei_collides(merge_runner, tmp_path):
    (tmp_path / "cei.toml").write_text(
        'models = ["cei"]\nrepetitions = 90\n'
        '[scenario]\nresistance = "human"\ncollision_rule = "rectangle"\n'
    )
    assert (await merge_runner("sweep", "cei.toml")).code == 0
    with served(tmp_path / "results/merge.duckdb") as address:
        text = httpx.get(f"{address}/trials.csv", timeout=120).text
    trials = csv.DictReader(io.StringIO(text))
    found = Counter(row["account"] for row in trials if row["status"] == "collided")
    published = list(
        csv.DictReader((PROJECT / "tests/unit/analysis/accounts/collision_accounts.csv").open())
    )
    humans, model = (
        {row["account"]: row["collisions"] for row in published if row["drivers"] == drivers}
        for drivers in ("humans", "published model")
    )
    assert found.keys() == {"both gave way", "no action"}, found
    assert told(
        "docs/reference/explorer.md",
        "# of # human collisions, and # of the # of the published model `cei`. Of # collisions of "
        "our `cei` in 990 trials by the humans' rule and under the human simulator's drag, # are "
        "`both gave way` and # is `no action`; the published ones are # same action, # no action "
        "and # one too little.",
    ) == (
        *(humans["same action"], str(sum(map(int, humans.values())))),
        *(model["same action"], str(sum(map(int, model.values())))),
        *map(str, (found.total(), found["both gave way"], found["no action"])),
        *(model[account] for account in ("same action", "no action", "one too little")),
    )


async def test_what_the_study_of_the_readme_takes(merge_runner, tmp_path):
    page = "README.md"
    trials, usd = told(page, "# trials, about # USD by `--dry-run`.")
    study = re.search(r"```toml\n(.*?)```", (PROJECT / page).read_text(), re.DOTALL)[1]
    (tmp_path / "mine.toml").write_text(study)
    run = await merge_runner("sweep", "mine.toml", "--dry-run", "--json")
    estimate = json.loads(run.out)
    assert (trials, usd) == (str(estimate["trials"]), f"{estimate['cost_usd']:.0f}")


def closure(names):
    """The distributions of these names with all that they need, and their sizes in MB.

    Without what Python compiles, which not every installation has.
    """
    found, todo = {}, [canonicalize_name(name) for name in names]
    while todo:
        name = todo.pop()
        if name in found:
            continue
        one = metadata.distribution(name)
        files = [file for file in one.files if file.suffix != ".pyc"]
        found[name] = sum(file.locate().stat().st_size for file in files) / 1e6
        needs = [Requirement(text) for text in one.requires or ()]
        todo += [
            canonicalize_name(need.name)
            for need in needs
            if need.marker is None or need.marker.evaluate({"extra": ""})
        ]
    return found


def test_how_large_the_wheel_and_its_environment_are(tmp_path):
    page = "docs/reference/installing.md"
    wheel_mb = built("wheel", checkout_in(tmp_path), tmp_path).stat().st_size / 1e6
    text = (PROJECT / page).read_text()
    alone = re.search(r"`--no-deps`, and `([a-z\s-]+)`", text)[1].split()
    needed = metadata.distribution("merge-runner").requires
    every = closure(Requirement(need).name for need in needed if "extra" not in need)
    sweeps = sum(closure(alone).values())
    sizes = (
        wheel_mb,
        sum(every.values()),
        sweeps,
        sum(every.values()) - sweeps,
    )
    shown = (
        *told(page, "The wheel (# MB)"),
        *told(page, "A plain install is # MB, a third more once Python has compiled it"),
        *told(page, "pydantic, rich and the like | # |"),
        *told(page, "statsmodels, matplotlib | # |"),
    )
    assert [*map(float, shown)] == [pytest.approx(size, rel=0.1) for size in sizes]
