"""The key under which a call is kept: every part of a request, and its slot."""

import hashlib
import json
from copy import deepcopy
from dataclasses import replace

import pytest

from merge_runner.llm.formats import FORMATS
from merge_runner.providers import ModelEntry
from merge_runner.records import Slot, call_key, canonical_json, make_request
from tests.support.cases import table
from tests.support.json_values import paths, replaced

SLOT = Slot(condition="A1", repetition=1, side="left", decision=0, sample_set=0)
BASE = {
    "provider": "openai",
    "endpoint": "openai",
    "model": "o3-2025-04-16",
    "path": "/chat/completions",
    "headers": {"anthropic-version": "2023-06-01"},
    "body": {
        "messages": [{"role": "user", "content": "Où? 你好"}],
        "cap": 100,
        "stream": False,
        "nested": {"budget": -1, "temperature": 1.0, "stop": None},
    },
    "slot": SLOT,
}


def key(**changes):
    return make_request(**{**deepcopy(BASE), **changes}).key


@pytest.mark.parametrize(("wire", "case"), table("keys", "golden").items())
def test_the_key_of_a_known_request_never_changes(wire, case):
    provider = wire.partition("-")[0]
    named = {"provider": provider, "format": wire, "id": "model-1", "max_output_tokens": 100}
    entry = ModelEntry(parameters=case["parameters"], **named)
    sent = FORMATS[wire].request(entry, "Où allez-vous?\n你好")
    named = {"provider": provider, "endpoint": provider, "model": "model-1", "slot": SLOT}
    made = make_request(path=sent.path, headers=sent.headers, body=sent.body, **named)
    assert made.key == case["key"]


def test_the_key_is_sha256_of_one_canonical_json_object_with_the_body_that_is_sent():
    request = make_request(**BASE)
    assert request.body == canonical_json(BASE["body"])
    slot = {"condition": "A1", "repetition": 1, "side": "left", "decision": 0, "sample_set": 0}
    whole = {
        "body": json.loads(request.body),
        "endpoint": request.endpoint,
        "headers": request.headers,
        "key_version": 1,
        "path": request.path,
        "slot": slot,
    }
    assert request.key == hashlib.sha256(canonical_json(whole).encode()).hexdigest()
    parts = {name: getattr(request, name) for name in ("endpoint", "path", "headers", "body")}
    assert request.key == call_key(slot=request.slot, **parts)


def test_canonical_json_has_sorted_keys_no_spaces_and_plain_letters():
    assert canonical_json({"b": [1, 1.0, None], "a": {"d": "é", "c": True}}) == (
        '{"a":{"c":true,"d":"é"},"b":[1,1.0,null]}'
    )


def test_any_other_part_is_another_key():
    version = {"anthropic-version": "2023-06-01"}
    headers = ({}, {"anthropic-version": "2026"}, {"anthropic-beta": "2023-06-01"})
    slots = ({"condition": "A2"}, {"repetition": 2}, {"side": "right"}, {"decision": 1})
    others = [
        {"endpoint": "https://example.com/v1"},
        {"path": "/chat/completions?api-version=1"},
        {"body": {**BASE["body"], "seed": None}},
        *({"headers": each} for each in (*headers, {**version, "more": ""})),
        *({"slot": replace(SLOT, **each)} for each in (*slots, {"sample_set": 1})),
    ]
    assert len({key(), *(key(**changes) for changes in others)}) == 13


@pytest.mark.parametrize("path", list(paths(BASE["body"])), ids=str)
def test_any_other_value_in_the_body_is_another_key(path):
    values = ("other", 2, 1.5, True, {}, ["other"])
    bodies = [replaced(BASE["body"], path), *(replaced(BASE["body"], path, v) for v in values)]
    assert len({key(), *(key(body=body) for body in bodies)}) == 8


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
def test_a_number_that_json_does_not_have_is_refused(number):
    with pytest.raises(ValueError, match="not JSON compliant"):
        key(body={"nested": {"temperature": number}})
