"""The key under which a call is kept: every part of a request, and its slot."""

import hashlib
import json
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from merge_runner import records
from merge_runner.config import ModelEntry
from merge_runner.llm.formats import FORMATS
from merge_runner.records import Slot, call_key, canonical_json, make_request
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


# A recording made today must be found by every later version: these never change.
@pytest.mark.parametrize(
    ("wire", "parameters", "golden"),
    [
        (
            "openai-chat",
            {"reasoning_effort": "medium"},
            "183440a71555bb1b12e4465754ee2fb79a441520ad88bbd7ae09ec84767b1e13",
        ),
        (
            "openai-responses",
            {"reasoning": {"effort": "medium"}},
            "7b22f0497cf9ad648032234e467c718a0e03c3b5620a76766773562513e2dc39",
        ),
        (
            "gemini",
            {"temperature": 1.0, "thinkingConfig": {"thinkingBudget": -1}},
            "6aa82e929487f3261444871e83f33a2bab58c338dc3bdb9cfa9af526066b707c",
        ),
        ("anthropic", {}, "1e316d951d608d61bd406d75d1ca4a05c637805695f4cfe1f0c1112a932d7896"),
    ],
)
def test_the_key_of_a_known_request_never_changes(wire, parameters, golden):
    provider = wire.partition("-")[0]
    entry = ModelEntry(
        provider=provider, format=wire, id="model-1", parameters=parameters, max_output_tokens=100
    )
    sent = FORMATS[wire].request(entry, "Où allez-vous?\n你好")
    named = {"provider": provider, "endpoint": provider, "model": "model-1", "slot": SLOT}
    assert make_request(path=sent.path, headers=sent.headers, body=sent.body, **named).key == golden


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


@pytest.mark.parametrize(
    "changes",
    [
        {"endpoint": "https://example.com/v1"},
        {"path": "/chat/completions?api-version=1"},
        {"headers": {}},
        {"headers": {"anthropic-version": "2026-10-21"}},
        {"headers": {"anthropic-beta": "2023-06-01"}},
        {"headers": {"anthropic-version": "2023-06-01", "more": ""}},
        {"body": {**BASE["body"], "seed": None}},
        {"slot": replace(SLOT, condition="A2")},
        {"slot": replace(SLOT, repetition=2)},
        {"slot": replace(SLOT, side="right")},
        {"slot": replace(SLOT, decision=1)},
        {"slot": replace(SLOT, sample_set=1)},
    ],
    ids=str,
)
def test_any_other_part_is_another_key(changes):
    assert key(**changes) != key()


@pytest.mark.parametrize("path", list(paths(BASE["body"])), ids=str)
def test_any_other_value_in_the_body_is_another_key(path):
    values = ("other", 2, 1.5, True, {}, ["other"])
    bodies = [replaced(BASE["body"], path), *(replaced(BASE["body"], path, v) for v in values)]
    assert len({key(), *(key(body=body) for body in bodies)}) == 8


def test_numbers_that_are_equal_but_spelt_differently_are_different_requests():
    assert len({key(body={"t": value}) for value in (1, 1.0, True, "1")}) == 4


def test_another_key_version_is_another_key(monkeypatch):
    before = key()
    monkeypatch.setattr(records, "KEY_VERSION", records.KEY_VERSION + 1)
    assert key() != before


def test_labels_and_the_order_of_fields_do_not_matter():
    turned = dict(reversed(BASE["body"].items()))
    turned["nested"] = dict(reversed(turned["nested"].items()))
    assert make_request(**{**BASE, "body": turned}) == make_request(**BASE)
    assert key(provider="other", model="other") == key()


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
def test_a_number_that_json_does_not_have_is_refused(number):
    with pytest.raises(ValueError, match="not JSON compliant"):
        key(body={"nested": {"temperature": number}})


@st.composite
def two_cuts(draw):
    """One text cut into five parts, in two ways: whatever joins the parts must tell them apart."""
    text = draw(st.text('",:{}[]\\/ab\n', min_size=1, max_size=12))
    place = st.integers(0, len(text))
    cuts = [
        [0, *sorted(draw(st.lists(place, min_size=4, max_size=4))), len(text)] for _ in range(2)
    ]
    return [tuple(text[a:b] for a, b in pairwise(cut)) for cut in cuts]


def key_of_parts(endpoint, path, header, prompt, condition):
    slot = replace(SLOT, condition=condition)
    return key(endpoint=endpoint, path=path, headers={"h": header}, body={"p": prompt}, slot=slot)


@settings(max_examples=50)
@given(two_cuts())
def test_no_two_tuples_of_parts_share_a_key(two):
    one, other = two
    assert (key_of_parts(*one) == key_of_parts(*other)) == (one == other)


@settings(max_examples=50)
@given(prompt=st.text(), other=st.text())
def test_a_prompt_cannot_pretend_to_be_another_part(prompt, other):
    spelt = f'{prompt}"}},"endpoint":{canonical_json(other)}'
    assert key(body={"p": spelt}) != key(body={"p": prompt}, endpoint=other)
