"""Sweeps that are answered by servers which others wrote."""

import asyncio

import pytest

from tests.support.harness import FAST

PROVIDERS = {
    "openai-chat": "openai",
    "openai-responses": "openai",
    "gemini": "gemini",
    "anthropic": "anthropic",
}
KEYS = dict.fromkeys(("OPENAI_API_KEY", "GOOGLE_API_KEY", "ANTHROPIC_API_KEY"), "a-dummy-key")


@pytest.fixture
def plan():
    """An answer that keeps the speed."""
    return f"M\nI keep my speed.\n```python\n{[0.0] * 20}\n```"


@pytest.fixture
def sweeps(merge_runner, tmp_path):
    """Runs one trial in each of the formats, at its base URL, and holds what is true of all."""

    async def run(urls):
        (tmp_path / "experiments").mkdir()
        (tmp_path / "experiments/short.toml").write_text("[repetitions]\nbaseline = 1\n")
        (tmp_path / "experiments/models.toml").write_text(
            "".join(
                f'[{wire}]\nprovider = "{PROVIDERS[wire]}"\nformat = "{wire}"\nid = "{wire}"\n'
                f'price = "free"\nbase_url = "{url}"\nmax_output_tokens = 1000\n'
                for wire, url in urls.items()
            )
        )

        async def sweep(wire):
            where = ("--db", f"{wire}.duckdb", "--cache", wire)
            one = ("--model", wire, "--conditions", "R_-4_8", "--json", "--yes", "--trust")
            return await merge_runner("sweep", "short", *one, *where, *FAST, **KEYS)

        runs = dict(zip(urls, await asyncio.gather(*map(sweep, urls)), strict=True))
        for run in runs.values():
            assert run.code == 0, run.err
            assert run.summary["audit"]["findings"] == []
            assert run.summary["trials"]["failed"] == 0
        return runs

    return run
