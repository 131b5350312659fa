"""Rehearsals: the emulator in the place of a provider, in its format, with the model's prices."""

from __future__ import annotations

import json

import pytest

# Models of OpenAI and Gemini that answer at once.
QUICK = """
[quick-o3]
provider = "openai"
format = "openai-chat"
id = "o3-2025-04-16"
max_output_tokens = 16000
rpm = 60
tpm = 450000
typical_output_tokens = 1500
typical_latency_s = 0.05

[quick-gemini]
provider = "gemini"
format = "gemini"
id = "gemini-2.5-pro"
max_output_tokens = 16000
typical_output_tokens = 2500
typical_latency_s = 0.05
"""
ONE_TRIAL = ("sweep", "baseline", "--reps", 1, "--conditions", "N_0_0", "--yes", "--json")


@pytest.fixture(autouse=True)
def _registry(tmp_path):
    (tmp_path / "models.toml").write_text(QUICK)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "price", "tokens"), [("quick-o3", 8.0, 1500), ("quick-gemini", 10.0, 2500)]
)
async def test_a_rehearsal_needs_no_key_and_costs_what_the_model_would(
    merge_runner, tmp_path, model, price, tokens
):
    run = await merge_runner(*ONE_TRIAL, "--model", model, "--rehearse")
    assert run.code == 0, run.err
    assert "REHEARSAL" in run.err
    assert (run.summary["driver"], run.summary["scripted"]) == (f"{model} at localhost", True)
    assert run.summary["audit"]["findings"] == []
    calls = run.summary["calls"]["live"]
    assert calls >= 18
    assert run.summary["cost_usd"] == pytest.approx(calls * tokens * price / 1e6, rel=0.25)
    assert run.summary["attempts_of_unknown_cost"] == 0
    if model == "quick-o3":  # 60 a minute, ten times as fast
        assert (calls - 2) / 10 <= run.summary["playing_s"] < calls - 1
    # Nothing lies where a real run would look for it.
    assert not (tmp_path / "cache/responses").exists()
    assert not (tmp_path / "results/merge.duckdb").exists()


@pytest.mark.slow
async def test_what_was_rehearsed_is_exported_replayed_and_marked(merge_runner):
    folder = "results/rehearsal"
    assert (await merge_runner(*ONE_TRIAL, "--model", "quick-gemini", "--rehearse")).code == 0
    again = await merge_runner(*ONE_TRIAL, "--model", "quick-gemini", "--rehearse")
    assert again.summary["trials"]["stored_before"] == 1  # the same command goes on
    there = ("--db", f"{folder}/merge.duckdb")
    export = ("recording", "export", "mine.parquet", *there, "--cache", f"{folder}/responses")
    assert (await merge_runner(*export)).code == 0
    replay = ("replay", "baseline", "--model", "quick-gemini", "--recording", "mine.parquet")
    replayed = await merge_runner(*replay, "--json")
    assert (replayed.code, replayed.summary["scripted"]) == (0, True)
    assert replayed.summary["driver"] == "quick-gemini at localhost"
    assert (await merge_runner("digest")).out == (await merge_runner("digest", *there)).out


async def test_the_rehearsal_of_a_study_lies_beside_its_file(merge_runner, tmp_path):
    (tmp_path / "mine").mkdir()
    study = 'models = ["quick-gemini"]\nrepetitions = 1\nconditions = ["N_0_0"]\n'
    (tmp_path / "mine/study.toml").write_text(study + "[scenario]\ntimeout_s = 1.0\n")
    run = await merge_runner("sweep", "mine/study.toml", "--rehearse", "--yes")
    assert run.code == 0, run.err
    assert {path.name for path in (tmp_path / "mine/results/rehearsal").iterdir()} >= {
        "merge.duckdb",
        "responses",
    }
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    ("options", "environment", "why"),
    [
        (["--model", "emulator"], {}, "one of o3, gpt-5.6-sol"),
        (["--model", "constant"], {}, "one of o3, gpt-5.6-sol"),
        (["--model", "o3", "--model", "gemini-2.5-pro"], {}, "takes one model"),
        (["--model", "o3"], {"OPENAI_BASE_URL": "http://gateway/v1"}, "its provider's own address"),
        (["--model", "o3", "--db", "mine.duckdb"], {}, "leave --db"),
        (["--model", "o3", "--cache", "mine"], {}, "leave --db"),
        (["--model", "o3", "--replay"], {}, "leave --db"),
        (["--model", "o3", "--batch"], {}, "leave --db"),
        (["--model", "o3", "--dask", "local:1"], {}, "leave --db"),
    ],
)
async def test_what_cannot_be_rehearsed_is_refused_with_what_can(
    merge_runner, options, environment, why
):
    run = await merge_runner(
        "sweep", "baseline", *options, "--rehearse", "--dry-run", **environment
    )
    assert (run.code, why in run.err) == (2, True), run.err


async def test_the_estimate_of_a_rehearsal_is_that_of_the_sweep(merge_runner):
    said = []
    for more in ([], ["--rehearse"]):
        run = await merge_runner("sweep", "baseline", "--model", "o3", "--dry-run", "--json", *more)
        said.append({k: v for k, v in json.loads(run.out).items() if k != "driver"})
    assert said[0] == said[1]
