"""The first screen of a study answers its question, with numbers that are computed here, too."""

import re
import subprocess

import duckdb
import pytest
from playwright.sync_api import expect

from merge_runner_analysis.study import Study
from tests.support.gate import HANGS_S
from tests.support.harness import PROGRAM, environment
from tests.support.serving import served
from tests.support.tables import values_of

STUDY = """
description = "Does a persona and a hurry change who goes first?"
models = ["emulator"]
repetitions = 3
mirror = true
[factors]
persona = ["none", "taxi"]
hurry = ["no", "yes"]
opponent = ["self", "projected-order"]
[texts.persona.taxi]
add = [{ after = "C3.human", text = "You are a taxi driver." }]
given_to = "ego"
[texts.hurry.yes]
add = [{ after = "C3.human", text = "You are late." }]
given_to = "ego"
emulator = { own_first = 1.5 }
"""
OUTCOMES = """
SELECT condition, opponent, persona, hurry, merged_first = ego AS first FROM (
    SELECT trial_id, spec_hash, max(value) FILTER (factor = 'opponent') AS opponent,
        max(value) FILTER (factor = 'persona') AS persona,
        max(value) FILTER (factor = 'hurry') AS hurry
    FROM trial_factors GROUP BY ALL
) JOIN trials USING (trial_id, spec_hash) JOIN trial_drivers USING (trial_id, spec_hash)
WHERE merged_first IS NOT NULL
"""


@pytest.fixture(scope="module")
def db(tmp_path_factory):
    folder = tmp_path_factory.mktemp("question")
    (folder / "study.toml").write_text(STUDY)
    asked = ("sweep", "study.toml", "--db", "study.duckdb", "--quiet")
    subprocess.run([PROGRAM, *asked], cwd=folder, env=environment(), check=True)
    return folder / "study.duckdb"


@pytest.fixture(scope="module")
def site(db):
    with served(db) as address:
        yield address


@pytest.fixture(scope="module")
def outcomes(db):
    with duckdb.connect(str(db), read_only=True) as connection:
        return connection.execute(OUTCOMES).df()


def test_levels_and_effects_have_the_counts_and_shares_of_the_trials(db, outcomes):
    study = Study(db)
    levels, effects = values_of(study, "levels"), values_of(study, "effects")
    for factor in ("persona", "hurry", "opponent"):
        for level, rows in outcomes.groupby(factor):
            k, n = int(rows["first"].sum()), len(rows)
            own = levels[f"{factor}={level}"]
            assert (own["k"], own["n"], own["value"]) == (k, n, pytest.approx(100 * k / n))
    for row in effects.values():
        reference, level = (
            levels.get(f"{row['factor']}={row[name]}") for name in ("reference", "level")
        )
        if row["measure"] == "goes first (%)" and level:
            assert row["estimate"] == level["value"]
            assert row["estimate_reference"] == reference["value"]


def test_the_first_screen_answers_a_study_of_two_factors(page, db, outcomes):
    page.set_viewport_size({"width": 1440, "height": 900})
    page.goto("/")
    answer = page.locator(".answer")
    expect(answer).to_contain_text("Hurry changes who goes first", timeout=1000 * HANGS_S)
    said = answer.inner_text().replace("\N{NO-BREAK SPACE}", " ")
    for level, rows in outcomes.groupby("hurry"):
        k, n = int(rows["first"].sum()), len(rows)
        share = f"{100 * k / n:.2f} %"
        assert share in said, level
        assert f"({k} of {n})" in said, level
    points = page.locator(".levels .point title").all_text_contents()
    for factors in ("persona", "hurry", ["persona", "hurry"]):
        for _, rows in outcomes.groupby(factors):
            k, n = int(rows["first"].sum()), len(rows)
            assert any(f"{k} of {n}, {100 * k / n:.2f} [" in text for text in points)
    text = page.locator("#crossings").inner_text()
    assert re.search(r"hurry × persona: no interaction is shown, ", text)
    for part in (answer, page.locator(".levels").last, page.locator("#crossings")):
        box = part.bounding_box()
        assert box["y"] + box["height"] <= 900
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") == 0
    # A count of the headline leads to exactly its trials.
    count = answer.get_by_role("link").first.inner_text()
    answer.get_by_role("link").first.click()
    expect(page.locator(".totals")).to_contain_text(f"{count} trials", timeout=1000 * HANGS_S)
