"""A study of words that are given to one driver, from its file to what is stored and replayed."""

import math
import re

import pytest

from merge_runner.results.store import query, results_digest
from tests.support.harness import FAST
from tests.support.words_study import EXAMPLE

# That of the page, in one condition.
PLANTED = EXAMPLE.replace("repetitions = 10", 'repetitions = 20\nconditions = ["N_0_0"]')
STUDY = PLANTED.replace("emulator = { own_first = 1.5 }\n", "")
FIRST = """
SELECT value, focal, count(*) FILTER (merged_first = coalesce(focal, 'left')),
    count(*) FILTER (merged_first IS NOT NULL)
FROM trials JOIN trial_levels USING (trial_id, spec_hash)
WHERE factor = 'hurry' AND model_left = model_right GROUP BY ALL ORDER BY ALL
"""


@pytest.fixture(scope="module")
def db(prepare, tmp_path_factory):
    """The study, played in two runs: first a part of it, and then the rest."""
    folder = tmp_path_factory.mktemp("words")
    (folder / "words.toml").write_text(PLANTED)
    for part in (("--only", "hurry=yes"), ()):
        prepare(folder, "sweep", "words.toml", *part, *FAST, code=0)
    return folder / "results/merge.duckdb"


def test_two_factors_of_words_and_one_of_opponents_take_15_lines():
    assert len([line for line in EXAMPLE.splitlines() if line]) <= 15


def test_the_planted_effect_is_that_of_the_treated_driver_on_both_sides(db):
    _, rows = query(db, FIRST)
    shares = {(level, focal): (first, trials) for level, focal, first, trials in rows}
    assert {*shares} == {("no", None), *((y, s) for y in ("no", "yes") for s in ("left", "right"))}
    # 43 % for the left one without an effect, in logits -0.3.
    for side, base in (("left", -0.3), ("right", 0.3)):
        first, trials = shares["yes", side]
        share = 1 / (1 + math.exp(-base - 1.5))
        assert trials >= 36
        assert first / trials == pytest.approx(
            share, abs=4 * math.sqrt(share * (1 - share) / trials)
        )


def test_levels_and_the_focal_side_are_stored(db):
    _, rows = query(
        db,
        "SELECT DISTINCT variant, focal, ego, driver, persona.value, hurry.value, prompt.value "
        "FROM trials JOIN trial_drivers USING (trial_id, spec_hash) "
        "JOIN trial_levels AS persona USING (trial_id, spec_hash) "
        "JOIN trial_levels AS hurry USING (trial_id, spec_hash) "
        "JOIN trial_levels AS prompt USING (trial_id, spec_hash) "
        "WHERE model_left = model_right AND persona.factor = 'persona' "
        "AND hurry.factor = 'hurry' AND prompt.factor = 'prompt' ORDER BY ALL",
    )
    assert rows == [
        ("baseline", None, "left", "emulator", "none", "no", "baseline"),
        *(
            (variant, side, side, "emulator", persona, hurry, "baseline")
            for variant, persona, hurry in (
                ("hurry=yes", "none", "yes"),
                ("persona=taxi", "taxi", "no"),
                ("persona=taxi hurry=yes", "taxi", "yes"),
            )
            for side in ("left", "right")
        ),
    ]
    _, prompts = query(
        db,
        "SELECT DISTINCT side = focal, contains(prompt, 'in a hurry'), "
        "contains(prompt, 'taxi driver') "
        "FROM decisions JOIN trials USING (trial_id, spec_hash) "
        "WHERE variant = 'persona=taxi hurry=yes' AND prompt IS NOT NULL ORDER BY ALL",
    )
    assert prompts == [(False, False, False), (True, True, True)]


async def test_it_replays_from_its_recording_to_the_same_digest_and_is_audited(
    merge_runner, db, tmp_path
):
    (tmp_path / "words.toml").write_text(PLANTED)
    cache = db.parents[1] / "cache/responses"
    await merge_runner("recording", "export", "r.parquet", "--cache", cache, "--db", db, code=0)
    again = ("replay", "words.toml", "--recording", "r.parquet", "--db", "again", *FAST)
    await merge_runner(*again, code=0)
    assert results_digest(tmp_path / "again") == results_digest(db)
    assert query(tmp_path / "again", FIRST) == query(db, FIRST)
    await merge_runner("audit", "--db", "again", code=0)


async def test_a_run_says_where_several_prompts_gave_the_same_trials(merge_runner, tmp_path):
    text = STUDY.replace("repetitions = 20", "repetitions = 2")
    (tmp_path / "words.toml").write_text(text)
    told = await merge_runner("sweep", "words.toml", "--only", "opponent=self", *FAST, code=0)
    assert (
        "the same trials with these prompts: baseline, hurry=yes, persona=taxi, persona=taxi "
        "hurry=yes. The emulator reads no words: plant an effect to rehearse "
        "(docs/run-a-study.md#text-factors)"
    ) in told.err + told.out
    text = text + "emulator = { own_first = 6 }\n"
    (tmp_path / "words.toml").write_text(text)
    told = await merge_runner("sweep", "words.toml", "--only", "opponent=self", *FAST)
    said = "with these prompts: baseline, persona=taxi; hurry=yes, persona=taxi hurry=yes."
    assert said in told.err + told.out


async def test_a_dry_run_shows_of_what_each_prompt_is_composed_and_each_whole(
    merge_runner, tmp_path
):
    (tmp_path / "words.toml").write_text(PLANTED)
    told = await merge_runner("sweep", "words.toml", "--dry-run")
    blocks = "C3.human, persona=taxi.1, hurry=yes.1, C3.distance"
    assert f"prompt  persona=taxi hurry=yes: C0, C1, C2, C3.safety, {blocks}" in told.out
    one = ("--only", "persona=taxi", "--only", "hurry=yes", "--only", "opponent=self")
    whole = await merge_runner("sweep", "words.toml", *one, "--dry-run", "--show-prompts")
    shown = dict(re.findall(r"^prompt  (.*?), read by (.*):$", whole.out, re.MULTILINE))
    ego = "the left driver of persona=taxi hurry=yes opponent=self; the right driver of "
    assert shown["persona=taxi hurry=yes"].startswith(ego)
    assert shown["baseline"].startswith("the right driver of persona=taxi hurry=yes opponent=self")
    assert whole.out.count("You are a taxi driver.\n") == 1
    assert whole.out.count("You are late, and in a hurry.\n") == 1
    told = await merge_runner("sweep", "words.toml", "--show-prompts")
    assert (told.code, "--show-prompts goes with --dry-run" in told.err) == (2, True)
