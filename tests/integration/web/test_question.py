"""The first screen of a study answers its question, with numbers that are computed here, too."""

import re
import subprocess

import duckdb
import pandas as pd
import pytest
import statsmodels.formula.api as smf
from playwright.sync_api import expect

from merge_runner.results.store import query, results_digest
from merge_runner_analysis.figures.figure2 import figure2
from merge_runner_analysis.selection import Selection
from merge_runner_analysis.stats.human_reference import human_gap
from merge_runner_analysis.study import StudyResults
from tests.support.gate import HANGS_S
from tests.support.harness import PROGRAM, environment
from tests.support.serving import Page, client_of, listed, served
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
emulator = { own_first = 0.2 }
[texts.hurry.yes]
add = [{ after = "C3.human", text = "You are late." }]
given_to = "ego"
emulator = { own_first = 1.5 }
"""
# Who goes first as the ego has it; where both are told the same, either is.
OUTCOMES = """
SELECT opponent, persona, hurry, ego, projected_headway_m AS h, relative_velocity_mps AS dv,
    focal IS NULL AND model_left = model_right AS both, (merged_first = ego)::DOUBLE AS first
FROM (
    SELECT trial_id, spec_hash, max(value) FILTER (factor = 'opponent') AS opponent,
        max(value) FILTER (factor = 'persona') AS persona,
        max(value) FILTER (factor = 'hurry') AS hurry
    FROM trial_factors GROUP BY ALL
) JOIN trials USING (trial_id, spec_hash) JOIN trial_drivers USING (trial_id, spec_hash)
WHERE merged_first IS NOT NULL
"""


def readings(outcomes):
    """Each trial as its ego has it, and one whose drivers are told the same as both have it."""
    sign = outcomes["ego"].map({"left": 1, "right": -1})
    seen = outcomes.assign(h=sign * outcomes["h"], dv=sign * outcomes["dv"])
    seen["weight"] = 1 - seen["both"] / 2
    same = seen[seen["both"]]
    turned = same.assign(h=-same["h"], dv=-same["dv"], ego="right", first=1 - same["first"])
    return pd.concat([seen, turned])


def fitted(rows, factor, others):
    """By least squares in points, with a level for each situation."""
    situation = rows[["h", "dv", "ego", *others]].astype(str).agg("/".join, axis=1)
    rows = rows.assign(cell=situation)
    return smf.wls(f"first ~ C({factor}) + C(cell)", rows, weights=rows["weight"]).fit().params


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
    study = StudyResults(db)
    levels, effects = values_of(study, "levels"), values_of(study, "effects")
    for factor in ("persona", "hurry", "opponent"):
        for level, rows in outcomes.groupby(factor):
            share = rows["first"].mask(rows["both"], 0.5).mean()
            k = None if rows["both"].any() else rows["first"].sum()
            own = levels[f"{factor}={level}"]
            assert (own["k"], own["n"], own["value"]) == (k, len(rows), pytest.approx(100 * share))
    for row in effects.values():
        if row["estimate"] is not None:
            apart = row["estimate"] - row["estimate_reference"]
            assert row["difference"] == pytest.approx(apart)


def test_where_sides_are_counterbalanced_who_goes_first_is_said_of_the_ego(db):
    counts = """
    SELECT ego, count(*) FILTER (merged_first = ego) AS k, count(merged_first) AS n
    FROM trials JOIN trial_drivers USING (trial_id, spec_hash)
    WHERE condition = 'L_4_8' AND variant = 'hurry=yes' AND model_left = model_right
    GROUP BY ego ORDER BY ego
    """
    with duckdb.connect(str(db), read_only=True) as connection:
        (left, right) = connection.execute(counts).fetchall()
    study = StudyResults(db)
    figure = figure2(study, study.baselines)
    assert "ego first" in figure.axes[0].get_title()
    with client_of(db) as client:
        driver = client.get("/drivers/emulator?variant=hurry%3Dyes&condition=L_4_8").text
        condition = client.get("/conditions/L_4_8?variant=hurry%3Dyes&model=emulator").text
    said = Page(driver).text
    for side, k, n in (left, right):
        assert f"Ego on the {side} goes first {k} of {n}" in said
    assert "trials with the ego on the right are not mirrored here" in said
    (_, left_k, left_n), (_, right_k, right_n) = left, right
    assert f"{left_k + right_k} of {left_n + right_n} " in Page(condition).text


AHEAD = "sign(projected_headway_m) = if(merged_first = 'left', 1, -1)"
SLOWER = "sign(relative_velocity_mps) = if(merged_first = 'left', -1, 1)"
LIKENESS = f"""
SELECT count(*) FILTER (status = 'collided'), count(*) FILTER (status <> 'failed'),
    count(*) FILTER (projected_headway_m <> 0 AND {AHEAD}),
    count(merged_first) FILTER (projected_headway_m <> 0),
    count(*) FILTER (projected_headway_m = 0 AND relative_velocity_mps <> 0 AND {SLOWER}),
    count(merged_first) FILTER (projected_headway_m = 0 AND relative_velocity_mps <> 0)
FROM trials WHERE variant = 'baseline' AND model_left = model_right
"""


def test_likeness_to_people_is_said_in_counts_that_lead_to_their_trials(db):
    with duckdb.connect(str(db), read_only=True) as connection:
        (counts,) = connection.execute(LIKENESS).fetchall()
    with client_of(db) as client:
        text = client.get("/").text
        table = text.partition('<table class="likeness"')[2].partition("</table>")[0]
        people, row = (Page(part) for part in re.findall(r"<tr.*?</tr>", table, re.DOTALL)[1:3])
        assert [*map(int, re.findall(r"(\d+) of (\d+)", people.text)[0])] == [28, 990]
        assert "675 of 704 95.88 %" in people.text
        assert "158 of 173 91.33 %" in people.text
        bounds = f"0 to {counts[0]} of {counts[1]}, "  # by people's rule, before the played one
        assert bounds in row.text.partition("by the rule played here: the vehicles' centres")[0]
        pairs = re.findall(r"(\d+) of (\d+)", row.text.replace(bounds, ""))
        assert [int(count) for pair in pairs for count in pair] == [*counts]
        assert "cannot tell" in row.text
        assert "who goes first is drawn by lot, with people's odds" in row.text
        assert "people's mean gap is known only to ± 0.9" in Page(text).text
        links = [(to, int(count)) for to, count in row.to("/trials") if count.isdigit()]
        assert len(links) >= 4
        for to, count in links:
            assert listed(client.get(to).text) == count
        # Numbers of all prompts are not narrowed by one; which one is compared is said beside it.
        assert 'name="variant"' not in text
        assert 'name="model"' not in text
        assert "Prompt Baseline. With other prompts: " in Page(text).text


def test_the_gap_of_people_is_that_of_the_situations_that_were_played(db):
    study = StudyResults(db, Selection(condition="L_4_8"))
    group = next(group for group in study.baselines if group.driver == "emulator")
    there, every = human_gap(study.human, group), human_gap(study.human, study.human)
    assert abs(there.value - every.value) > 0.05
    with client_of(db) as client:
        page = Page(client.get("/", params={"condition": "L_4_8"}).text).text
    people = page.partition("Gap at the merge point people")[2].partition("emulator")[0]
    assert f"{there.value:.2f} m [{there.low:.2f}, {there.high:.2f}]" in people.replace("\xa0", " ")


def test_counts_of_a_part_of_the_trials_lead_to_just_these(db):
    with client_of(db) as client:
        (sweep,) = query(db, "SELECT sweep_id FROM sweeps")[1][0]
        page = Page(client.get("/", params={"condition": "L_4_8", "sweep": sweep}).text)
        links = [(to, int(text)) for to, text in page.to("/trials?cell") if text.isdigit()]
        assert len(links) > 8
        for to, count in links:
            listing = client.get(to).text
            assert listed(listing) == count
            assert {*re.findall(r"<th[^>]*><a[^>]*>([^<]*) · ", listing)} <= {"L_4_8", "R_-4_-8"}


def test_results_are_cited_from_the_foot_of_every_page(db):
    with client_of(db) as client:
        assert Page(client.get("/").text).to("/cite")
        said = Page(client.get("/cite").text).text
    digest, trials = results_digest(db)[0], query(db, "SELECT count(*) FROM trials")[1][0][0]
    played = r"played [-0-9]{10} [0-9:]{5}( to [-0-9]{10} [0-9:]{5})? UTC"
    assert re.search(f"from {trials:,} trials, {played}; digest of the results {digest}", said)
    assert "doi:10.4121/19550377" in said


def test_the_first_screen_answers_a_study_of_two_factors(page, db, outcomes):
    page.set_viewport_size({"width": 1440, "height": 900})
    page.goto("/")
    answer = page.locator(".answer")
    said_first = "a mock model, hurry changes who goes first"
    expect(answer).to_contain_text(said_first, timeout=1000 * HANGS_S)
    said = answer.inner_text().replace("\N{NO-BREAK SPACE}", " ")
    points = page.locator(".levels .point title").all_text_contents()
    effects = values_of(StudyResults(db), "effects")
    for level in ("persona=taxi", "hurry=yes"):
        row = effects[f"{level}/left_first_percent"]
        low, high = (row["estimate_reference"] + end for end in row["ci"])
        assert f"emulator: {row['estimate']:.2f} [{low:.2f}, {high:.2f}]" in points
        assert f"emulator: {row['estimate_reference']:.2f}" in points
    for _, rows in outcomes.groupby(["persona", "hurry"]):
        share = 100 * rows["first"].mask(rows["both"], 0.5).mean()
        assert any(f"{share:.2f}" in text for text in points)
    every = readings(outcomes)
    slope = 100 * fitted(every, "hurry", ("persona", "opponent"))["C(hurry)[T.yes]"]
    beside = page.locator("main").inner_text().replace("\N{NO-BREAK SPACE}", " ")
    assert f"The difference is +{slope:.2f} points" in beside
    assert "yes: “You are late.”, to the driver under study" in beside
    assert "the one that alone gets the words of persona or hurry, else the one named" in beside
    assert "who was left and right equally often" in beside
    first = outcomes[outcomes["hurry"] == "no"]
    halves = first["first"].mask(first["both"], 0.5).sum()
    assert f"no: {halves:g} of {len(first)}, where some count half" in beside
    assert "log-odds of going first by +0.2 (at most +5 points in a situation)" in beside
    assert "log-odds of going first by +1.5 (at most +36 points in a situation)" in beside
    (shown,) = re.findall(r"(\d+) finished trials, (\d+) with a crash", beside)
    assert sum(map(int, shown)) == query(db, "SELECT count(*) FROM trials")[1][0][0]
    shares = [float(share) for share in re.findall(r"(\d+\.\d\d) %", said)]
    assert shares[0] - shares[1] == pytest.approx(slope, abs=0.011)
    none, taxi = (
        fitted(every[every["persona"] == name], "hurry", ("opponent",))["C(hurry)[T.yes]"]
        for name in ("none", "taxi")
    )
    text = page.locator("#crossings").inner_text().replace("\N{NO-BREAK SPACE}", " ")
    found = re.search(r"hurry × persona: no interaction is shown, (\S+) points", text)
    assert float(found[1].replace("−", "-")) == pytest.approx(100 * (taxi - none), abs=0.006)
    for part in (answer, page.locator(".levels").last, page.locator("#crossings")):
        box = part.bounding_box()
        assert box["y"] + box["height"] <= 900
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") == 0
    # A count leads to exactly its trials.
    hurried = outcomes[outcomes["hurry"] == "yes"]
    count = str(int(hurried["first"].sum()))
    changes = page.locator(".changes").first
    changes.get_by_role("link", name=count, exact=True).first.click()
    expect(page.locator(".totals")).to_contain_text(f"{count} trials", timeout=1000 * HANGS_S)
