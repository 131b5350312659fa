"""Reasoning on a trial's page: folded, whatever format it came in, never taken for an answer."""

from __future__ import annotations

import json
import re

import duckdb
import pytest
from starlette.testclient import TestClient

from merge_runner_analysis.explorer.app import explorer
from merge_runner_analysis.explorer.site import Site
from tests.integration.explorer.test_listing import HOST
from tests.support.studies import Drive, Said, write_study


def chat(content, **message):
    return {"choices": [{"message": {"content": content, **message}}]}


REPLIES = {
    0: chat("<think>It is <b>faster</b>.</think>M"),
    1: chat("M", reasoning_content="It is <b>faster</b>."),
    2: {"content": [{"type": "thinking", "thinking": "It is <b>faster</b>."}]},
    3: {
        "candidates": [{"content": {"parts": [{"text": "It is <b>faster</b>.", "thought": True}]}}]
    },
    4: {"output": [{"type": "reasoning", "summary": [{"text": "It is <b>faster</b>."}]}]},
    5: chat("M\nI never write `</think>`."),
    6: "no JSON object at all",
    7: chat(f"<think>{'x' * 100_000}"),
}


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    db = tmp_path_factory.mktemp("thoughts") / "t.duckdb"
    missing = {1: Said(failure="no_decision")}
    write_study(db, [Drive("o3", "baseline", "L_4_0", 1, (0.1,) * 9, (-0.1,) * 9, missing)])
    with duckdb.connect(str(db)) as connection:
        connection.executemany(
            "UPDATE calls SET reply = ? WHERE side = 'left' AND decision = ?",
            [(json.dumps(reply), number) for number, reply in REPLIES.items()],
        )
        connection.execute("UPDATE decisions SET tactical = if(failure IS NULL, 'M', NULL)")
    with TestClient(explorer(Site(db)), base_url=f"http://{HOST}") as client:
        yield client


def panel(client, number):
    """The panel of a decision."""
    text = client.get("/trials/o3/baseline/L_4_0/rep01").text
    (found,) = re.findall(rf'key">left</span> decision {number}\b.*?</article>', text, re.DOTALL)
    return found


@pytest.mark.parametrize("number", range(5))
def test_the_reasoning_is_shown_folded(client, number):
    assert (
        '<details><summary>Its reasoning</summary>\n<pre class="said" dir="ltr">'
        "It is &lt;b&gt;faster&lt;/b&gt;.</pre>\n</details>" in panel(client, number)
    )


@pytest.mark.parametrize("number", [5, 6, 8])
def test_where_there_is_none_nothing_is_said_of_it(client, number):
    assert "Its reasoning" not in panel(client, number)


def test_of_long_reasoning_the_beginning_is_shown(client):
    assert re.search(r"[\d,]+ more characters: <a [^>]*>the whole reply</a>", panel(client, 7))


def test_a_missing_decision_is_named_beside_its_plan(client):
    assert "no tactical decision</strong>, though one was asked for</p>" in panel(client, 1)
    assert "though one was asked for" not in panel(client, 2)
