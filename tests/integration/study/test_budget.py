"""What a study has spent counts against its budget, whichever ledger holds it."""

from __future__ import annotations

from tests.support.harness import FAST

MODEL = """
[priced]
provider = "emulator"
format = "openai-chat"
id = "scripted-driver"
max_output_tokens = 4000
price = { input = 1.0, output = 4.0, source = "made up" }
"""
STUDY = 'models = ["priced"]\nrepetitions = {}\nconditions = ["N_0_0"]\n{}'


async def test_what_was_spent_before_there_was_a_budget_counts_against_it(merge_runner, tmp_path):
    (tmp_path / "models.toml").write_text(MODEL)
    sweep = ("sweep", "mine.toml", "--yes", "--json", *FAST)
    (tmp_path / "mine.toml").write_text(STUDY.format(1, ""))
    first = await merge_runner(*sweep)
    assert first.code == 0, first.err
    spent_usd = first.summary["sweep_cost_usd"]
    assert spent_usd > 0
    budget = f"[budget]\ntotal_usd = {spent_usd}\n"
    (tmp_path / "mine.toml").write_text(STUDY.format(2, budget))
    second = await merge_runner(*sweep)
    assert (second.code, second.summary["calls"]["live"]) == (3, 0)
    assert "USD of mine/priced/set0 count against the budget, too" in second.err
