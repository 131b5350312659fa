"""A model that costs something, and what a server was asked of it."""

import json
import shutil
from collections import Counter

import httpx
import pytest

from tests.support.harness import PROJECT, a_model

# A mock model that costs something, so that there is money to lose; it is told the slot.
PRICE = {"input": 2.0, "output": 8.0, "source": "made up"}


@pytest.fixture
def priced(tmp_path):
    """A model that costs something, in trials of four decisions."""
    shutil.copytree(PROJECT / "experiments", tmp_path / "experiments")
    (tmp_path / "models.toml").write_text(a_model("priced", price=PRICE))
    (tmp_path / "short.toml").write_text("[repetitions]\nbaseline = 1\n[scenario]\ntimeout_s = 4\n")


async def answered(server):
    """How often each slot was answered: in batches, and singly."""
    async with httpx.AsyncClient() as client:
        counts = (await client.get(f"{server.url}/emulator/answered")).json()
    batched, alone = Counter(), Counter()
    for each in counts:
        (alone if each["custom_id"] is None else batched)[each["slot"]] += each["answered"]
    return batched, alone


async def rows(merge_runner, query, db="results/merge.duckdb"):
    return json.loads((await merge_runner("sql", query, "--db", db, "--format", "json")).out)
