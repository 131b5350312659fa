"""Records as rows of the tables."""

import json

import pytest

from merge_runner.records import Attempt, ChatRequest, Slot
from merge_runner.results.rows import call_row

REQUEST = ChatRequest("key", "openai", "e", "m", "/chat", {}, "{}", Slot("N_0_0", 1, "left", 0, 0))
REPLY = 21
HALF, PAIR = r'{"said": "\ud83d"}', r'{"said": "\ud83d\ude00"}'


@pytest.mark.parametrize(
    ("reply", "stored"),
    [
        ('{"said": "M"}', '{"said": "M"}'),
        (r'{"said": "\u00fc"}', r'{"said": "\u00fc"}'),
        ('{"said": "ü"}', '{"said": "ü"}'),
        (PAIR, PAIR),
        (HALF, json.dumps(HALF)),
        (f"ü {HALF}", json.dumps(f"ü {HALF}")),
        ('{"said": "\ud83d"}', json.dumps('{"said": "?"}')),
    ],
)
def test_an_answer_is_stored_as_it_came_unless_it_holds_half_a_surrogate_pair(reply, stored):
    row = call_row(("t", "s"), REQUEST, Attempt(1, "ok", 200, reply=reply), cached=True)
    assert row[REPLY] == stored
