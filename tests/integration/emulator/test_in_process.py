"""A sweep of the emulator: answered within the process, through the whole client."""

from __future__ import annotations

import asyncio
import json
import socket

import pytest

from merge_runner import Study
from merge_runner.config import ModelEntry, resolve_endpoint
from merge_runner.llm.http import HttpTransport
from merge_runner.llm.http_outcome import TransportFailure
from tests.support.harness import RECORDING
from tests.support.mock_server import FaultPlan, FaultyEmulator

ENTRY = ModelEntry(provider="emulator", format="openai-chat", id="m", max_output_tokens=1)


@pytest.fixture
async def carried():
    """A function that returns a client's transport to an emulator with the given faults."""
    transports = []

    def make(**rates):
        carrier = FaultyEmulator(FaultPlan(rates=rates)).transport()
        endpoint = resolve_endpoint("emulator", ENTRY, {})
        transports.append(HttpTransport(endpoint, connections=1, carrier=carrier))
        return transports[-1]

    yield make
    for transport in transports:
        await transport.close()


async def post(transport, prompt):
    body = json.dumps({"model": "m", "messages": [{"role": "user", "content": prompt}]}).encode()
    return await transport.ask("POST", "/chat/completions", {}, body, timeout_s=5)


async def test_no_process_is_started_and_nothing_is_connected(tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("a socket or a process")

    for name in ("bind", "listen", "connect"):
        monkeypatch.setattr(socket.socket, name, refuse, raising=False)
    monkeypatch.setattr(asyncio, "create_subprocess_exec", refuse)
    monkeypatch.delenv("EMULATOR_BASE_URL", raising=False)
    monkeypatch.chdir(tmp_path)
    outcome = await Study("baseline", repetitions=1, conditions=["N_0_0"]).arun()
    assert outcome.ok
    assert outcome.facts["calls"]["live"] > 0


async def test_it_answers_as_the_server_does(carried, emulator, driving_prompt):
    served = HttpTransport(
        resolve_endpoint("emulator", ENTRY, {"EMULATOR_BASE_URL": f"{await emulator()}/v1"}),
        connections=1,
    )
    try:
        one, other = [await post(each, driving_prompt) for each in (carried(), served)]
    finally:
        await served.close()
    assert (one.status, one.body) == (other.status, other.body)
    assert "x-merge-runner-scripted" in one.headers
    assert {name: one.headers[name] for name in one.headers if name != "x-request-id"}.items() <= (
        other.headers.items()
    )


@pytest.mark.parametrize("fault", ["reset", "truncated_body"])
async def test_a_connection_that_breaks_off_is_lost(carried, driving_prompt, fault):
    with pytest.raises(TransportFailure) as failed:
        await post(carried(**{fault: 1.0}), driving_prompt)
    assert failed.value.outcome == "connection_lost"
    assert failed.value.sent


async def test_what_is_not_there_is_not_found(carried):
    assert (await carried().ask("GET", "/nothing", {}, timeout_s=5)).status == 404


async def test_its_replies_are_byte_for_byte_those_of_the_shipped_recording(merge_runner):
    part = ("baseline", "--model", "emulator", "--reps", 1, "--conditions", "N_0_0")
    assert (await merge_runner("sweep", *part)).code == 0
    replay = await merge_runner("replay", *part, "--recording", RECORDING)
    assert replay.code == 0, replay.err
