"""The emulator's answers in every wire format, carried within the process."""

import json
import re

import httpx
import pytest

from merge_runner.emulator.handler import Emulator
from merge_runner.llm.formats import FORMATS
from merge_runner.providers import ModelEntry
from merge_runner.records import ANSWERED_FIELD, SCRIPTED_FIELD, SCRIPTED_HEADER

PATHS = {
    "openai-chat": "/v1/chat/completions",
    "openai-responses": "/v1/responses",
    "gemini": "/v1beta/models/some-model:generateContent",
    "anthropic": "/v1/messages",
}
SLOT = {"condition": "L_4_8", "repetition": 1, "side": "left", "decision": 0, "sample_set": 0}
all_wires = pytest.mark.parametrize("wire", PATHS)


@pytest.fixture
async def client():
    async with httpx.AsyncClient(transport=Emulator().transport(), base_url="http://e") as client:
        yield client


def headers_for(slot=SLOT, attempt=None):
    headers = {"x-merge-runner-slot": json.dumps(slot)} if slot else {}
    return headers | ({"x-merge-runner-attempt": attempt} if attempt else {})


async def ask(client, wire, prompt, headers=None, **parameters):
    """The reply to a prompt, and its JSON."""
    named = {"provider": "emulator", "format": wire, "id": "some-model", "parameters": parameters}
    body = FORMATS[wire].request(ModelEntry(**named, max_output_tokens=4000), prompt).body
    reply = await client.post(PATHS[wire], json=body, headers=headers)
    return reply, reply.json()


def without_ids(body):
    """A reply without what tells it from the same one to another request."""
    alike = {name: value for name, value in body.items() if name != ANSWERED_FIELD}
    return json.loads(re.sub(r'"[a-z_-]*[0-9a-f]{24}"', '"ID"', json.dumps(alike)))


async def test_all_formats_give_the_same_answer_and_counts(client, driving_prompt):
    asked = [(wire, await ask(client, wire, driving_prompt, headers_for())) for wire in PATHS]
    readings = [FORMATS[wire].read(body) for wire, (_, body) in asked]
    ((model, text, *counts),) = {
        (r.model_served, r.text, u.input_tokens, u.output_tokens - u.reasoning_tokens)
        for r in readings
        for u in [r.usage]
    }
    assert model == "some-model"
    assert counts == [len(said.encode()) // 4 for said in (driving_prompt, text)]
    assert len({r.usage.reasoning_tokens for r in readings}) == 1


@pytest.mark.parametrize(
    ("wire", "body"),
    [
        ("openai-chat", {"messages": [{"content": "no"}, {"content": [{"text": "PROMPT"}]}]}),
        ("openai-responses", {"input": [{"content": "no"}, {"content": [{"text": "PROMPT"}]}]}),
        ("gemini", {"contents": [{"parts": []}, {"parts": [{"text": "PRO"}, {"text": "MPT"}]}]}),
        ("anthropic", {"messages": [{"content": "no"}, {"content": [{"text": "PROMPT"}]}]}),
    ],
)
async def test_the_prompt_is_the_text_of_the_last_message(client, driving_prompt, wire, body):
    filled = json.dumps(body).replace("PRO", driving_prompt.replace("\n", "\\n")).replace("MPT", "")
    listed = await client.post(PATHS[wire], content=filled)
    _, plain = await ask(client, wire, driving_prompt)
    model = {} if wire == "gemini" else {"model": "scripted-driver"}
    assert without_ids(listed.json()) == without_ids(plain | model)


@all_wires
async def test_the_slot_changes_nothing_but_what_is_chosen(client, driving_prompt, wire):
    texts, envelopes = set(), set()
    for slot in (None, *({**SLOT, "condition": "N_0_0", "repetition": n} for n in range(1, 6))):
        reply, body = await ask(client, wire, driving_prompt, headers_for(slot))
        reading = FORMATS[wire].read(body)
        texts.add(reading.text)
        # The visible tokens follow from the text; the others must not move.
        body.pop("usageMetadata" if wire == "gemini" else "usage")
        envelope = json.dumps(without_ids(body)).replace(json.dumps(reading.text), "TEXT")
        envelopes.add((reply.status_code, *reply.headers, reading.usage.reasoning_tokens, envelope))
    assert len(texts) > 2
    assert len(envelopes) == 1


@all_wires
async def test_a_reply_has_an_id_of_its_request_its_slot_and_its_attempt(
    client, driving_prompt, wire
):
    asked = [
        (driving_prompt, headers_for(attempt="1")),
        (driving_prompt, headers_for(attempt="2")),
        (driving_prompt, headers_for({**SLOT, "repetition": 2}, attempt="1")),
        ("another prompt", headers_for(attempt="1")),
        (driving_prompt, headers_for(None)),
        (driving_prompt, headers_for(None)),  # the second time it was asked
        (driving_prompt, headers_for(None, "no number")),  # the third time
    ]
    replies = [(await ask(client, wire, *each))[1] for each in asked]
    assert len({reply["responseId" if wire == "gemini" else "id"] for reply in replies}) == 7
    # No other member tells one from another, and the same attempt has the same one.
    assert without_ids(replies[0]) == without_ids(replies[1])
    assert (await ask(client, wire, *asked[0]))[1] == replies[0]


@pytest.mark.parametrize(
    "body",
    ["", "{", "[]", "null", '"text"', "17", b"\xff\xfe{}", "[" * 100_000],
    ids=["empty", "cut", "list", "null", "string", "number", "no UTF-8", "too deep"],
)
async def test_a_body_that_is_no_json_object_gives_400_in_every_format(client, body):
    for path in PATHS.values():
        reply = await client.post(path, content=body)
        assert (reply.status_code, reply.headers[SCRIPTED_HEADER]) == (400, "true")
        assert reply.json()["error"]["message"]
        assert reply.json()[SCRIPTED_FIELD] is True


@pytest.mark.parametrize("slot", ["{", "[]", "null", "5", "{}"])
async def test_a_slot_that_is_no_slot_gives_400(client, driving_prompt, slot):
    headers = {"x-merge-runner-slot": slot}
    assert (await ask(client, "openai-chat", driving_prompt, headers))[0].status_code == 400


@all_wires
async def test_an_answer_says_that_a_stand_in_made_it_and_what_it_answers(client, wire):
    reply, body = await ask(client, wire, "x", headers_for())
    assert (reply.headers[SCRIPTED_HEADER], body[SCRIPTED_FIELD]) == ("true", True)
    assert body[ANSWERED_FIELD]["slot"] == SLOT


@all_wires
async def test_every_wire_format_plants(client, driving_prompt, wire):
    for intercept, letter in ((1000, "M"), (-1000, "Y")):
        _, body = await ask(client, wire, driving_prompt, headers_for(), x_left_first=intercept)
        assert FORMATS[wire].read(body).text[0] == letter


async def test_the_models_are_listed_and_nothing_else_is_there(client):
    listed = (await client.get("/v1/models")).json()
    (model,) = listed["data"]
    assert (listed["object"], model["object"]) == ("list", "model")
    assert model["id"] == "scripted-driver"
    for path in ("/nothing", "/v1/chat/completions"):
        missing = await client.get(path)
        assert (missing.status_code, missing.headers[SCRIPTED_HEADER]) == (404, "true")
