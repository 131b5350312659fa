"""The first live call of a run goes alone, and ends it where no other one would fare better."""

import asyncio
from functools import partial

import pytest

from merge_runner.errors import EndpointRefused, ProviderDown
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.http_outcome import TransportFailure
from merge_runner.records import CallFailed
from tests.support.cases import cases
from tests.support.clients import PRICE, answer, begun, error, raw, reply_to, slot, ticks
from tests.support.virtual_time import now_s

pytestmark = pytest.mark.usefixtures("virtual_time")
WEB_PAGE = raw("\n<!DOCTYPE html><html>Welcome</html>")
PROXY_407 = TransportFailure("proxy_refused", "the proxy says 407", sent=False, action="rejected")
REFUSED = TransportFailure("no_connection", "refused", sent=False)


@pytest.fixture
def cache(tmp_path):
    """Opened anew in each loop: many write at once."""
    opened = ResponseCache(tmp_path)
    yield opened
    opened.close()


@pytest.fixture
def begin(make):
    """A client whose run begins."""
    return partial(make, verified=False)


def reply_of(case):
    if "failure" in case:
        return TransportFailure(**case["failure"])
    return raw(case["body"], case.get("status", 200), **case.get("headers", {}))


def ask_all(client, number=5):
    return [asyncio.create_task(reply_to(client, "prompt", slot(n))) for n in range(1, number + 1)]


async def test_the_others_wait_until_the_first_call_is_answered(begin):
    client = begin(answer())
    client.direct.transport.open.clear()
    asked = ask_all(client)
    await ticks()
    assert len(client.direct.transport.sent) == 1
    assert [wait.what for wait in client.calls.waits] == ["for the first reply of my-model"] * 4
    client.direct.transport.open.set()
    await asyncio.gather(*asked)
    assert len(client.direct.transport.sent) == 5
    assert set(client.direct.transport.times) == {0}, "they then go at once"


async def test_what_passes_is_tried_again_by_one_call_alone(begin):
    client = begin(error(503), error(429), TransportFailure("timeout", "no reply"), answer())
    await asyncio.gather(*ask_all(client))
    assert len(client.direct.transport.sent) == 3 + 5
    first_three = client.direct.transport.times[:4]
    assert first_three == sorted(set(first_three)), "one at a time"


@pytest.mark.parametrize("case", cases("rejections", "at_once"))
async def test_a_wrong_configuration_is_told_by_one_call(begin, case):
    client = begin(reply_of(case))
    tasks = ask_all(client)
    with pytest.raises(EndpointRefused, match=case["told"]) as caught:
        await tasks[0]
    await client.calls.drain()
    assert (len(client.direct.transport.sent), "\n" in str(caught.value)) == (1, False)
    results = await asyncio.gather(*tasks, return_exceptions=True)
    assert all(isinstance(result, BaseException) for result in results)


@pytest.mark.parametrize("case", cases("rejections", "after_three"))
async def test_what_may_pass_is_told_after_three_of_them_within_seconds(begin, case):
    client, reply = begin(reply_of(case)), reply_of(case)
    with pytest.raises(EndpointRefused, match=case["told"]):
        await reply_to(client, "prompt", slot())
    assert len(client.direct.transport.sent) == 3
    assert now_s() < 5
    passing = begin(reply, reply, answer())
    assert (await reply_to(passing, "prompt", slot())).outcome == "ok"


@pytest.mark.parametrize("body", ["data: {}", "<html>", "", {"status": "up"}, {"error": "m"}])
async def test_in_the_midst_of_a_run_what_is_not_understood_is_asked_again(begin, body):
    client = begin(answer(), *[raw(body)] * 4, answer())
    await reply_to(client, "prompt", slot())
    assert (await reply_to(client, "prompt", slot(2))).outcome == "ok"
    assert len(client.direct.transport.sent) == 6


async def test_an_endpoint_that_has_answered_before_is_given_three_tries_and_may_think_alone(begin):
    client = begin(raw("data: {}", content_type="text/event-stream"), has_answered=True)
    with pytest.raises(EndpointRefused, match="SSE"):
        await reply_to(client, "prompt", slot())
    assert len(client.direct.transport.sent) == 3
    client = begin(answer(None, reasoning_content="hm"), has_answered=True)
    assert (await reply_to(client, "prompt", slot())).outcome == "empty"


async def test_a_first_call_that_waits_says_so_once_with_what_came_last_and_until_when(begin):
    client = begin(*[error(503, "warming up")] * 5, answer(), deadline_s=600)
    await reply_to(client, "prompt", slot())
    told = [note for note in client.meter.notes if "first call" in note]
    assert len(told) == 1
    assert "UTC, after HTTP 503: warming up" in told[0]
    silent = begin(answer(), deadline_s=600)
    silent.direct.transport.open.clear()
    asked = await begun(reply_to(silent, "prompt", slot(2)))
    await asyncio.sleep(6)
    assert ["nothing has come yet" in note for note in silent.meter.notes] == [True]
    silent.direct.transport.open.set()
    await asked
    await reply_to(silent, "prompt", slot(3))
    await asyncio.sleep(9)
    assert len(silent.meter.notes) == 1


async def test_where_nobody_listens_the_run_ends_within_seconds(begin):
    client = begin(REFUSED)
    tasks = ask_all(client)
    with pytest.raises(ProviderDown, match=r"refused: check the network, or set OPENAI_BASE_URL"):
        await tasks[0]
    assert 5 <= now_s() < 12
    sent = len(client.direct.transport.sent)
    await asyncio.sleep(60)
    assert len(client.direct.transport.sent) == sent, "no other call would fare better"
    await client.calls.drain()
    await asyncio.gather(*tasks, return_exceptions=True)


async def test_a_server_that_has_answered_is_waited_for_as_long_as_a_call_may_take(begin):
    client = begin(REFUSED, REFUSED, answer(), *[REFUSED] * 9, answer())
    assert (await reply_to(client, "prompt", slot())).outcome == "ok", "a server that just starts"
    assert (await reply_to(client, "prompt", slot(2))).outcome == "ok"
    assert now_s() > 60


async def test_no_answer_to_the_first_call_within_its_deadline_ends_the_run(begin):
    client = begin(error(503, "down"), deadline_s=60)
    tasks = ask_all(client)
    with pytest.raises(
        ProviderDown, match=r"the first call of this run: no reply within 60 s.*down"
    ):
        await tasks[0]
    sent = len(client.direct.transport.sent)
    await client.calls.drain()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert len(client.direct.transport.sent) == sent


async def test_a_prompt_that_is_refused_for_its_content_fails_alone(begin):
    flagged = raw({"error": {"message": "flagged", "code": "invalid_prompt"}}, 400)
    client = begin(flagged, answer())
    tasks = ask_all(client, 3)
    first, *others = await asyncio.gather(*tasks, return_exceptions=True)
    assert isinstance(first, CallFailed)
    assert [reply.outcome for reply in others] == ["ok", "ok"]


async def test_a_first_call_that_is_given_up_lets_the_next_one_go(begin):
    client = begin(answer())
    client.direct.transport.open.clear()
    asked = ask_all(client, 2)
    await ticks()
    next(iter(client.calls.under_way.values())).task.cancel()
    await ticks()
    assert len(client.direct.transport.sent) == 2
    client.direct.transport.open.set()
    await asyncio.gather(*asked, return_exceptions=True)


async def test_a_web_page_is_free_where_no_model_ever_answered_and_may_be_charged_elsewhere(begin):
    for free in (WEB_PAGE, PROXY_407):
        stray = begin(free, price=PRICE, cap=1.0)
        with pytest.raises(EndpointRefused):
            await reply_to(stray, "prompt", slot())
        assert stray.budget.ledger.read().committed_usd == 0
    gateway = begin(WEB_PAGE, answer(), price=PRICE, cap=1.0, has_answered=True)
    assert (await reply_to(gateway, "prompt", slot())).outcome == "ok"
    assert gateway.budget.ledger.read().open_attempts == 1


async def test_where_a_model_has_answered_before_one_refused_prompt_does_not_end_every_run(begin):
    client = begin(error(400), error(400), answer(), has_answered=True)
    first, second, *others = await asyncio.gather(*ask_all(client), return_exceptions=True)
    assert isinstance(first, CallFailed)
    assert isinstance(second, CallFailed)
    assert [reply.outcome for reply in others] == ["ok"] * 3
    changed = begin(error(400, "unknown parameter"), has_answered=True)
    tasks = [asyncio.create_task(reply_to(changed, "another", slot(n))) for n in range(9)]
    with pytest.raises(EndpointRefused, match="unknown parameter"):
        await tasks[2]
    await changed.calls.drain()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert len(changed.direct.transport.sent) == 3


async def test_a_first_call_takes_the_money_that_is_kept_for_a_trial_that_waits_for_it(begin):
    """Two attempts of unknown cost leave no money beside that of the older trial."""
    lost = TransportFailure("timeout", "no reply")
    client = begin(lost, lost, answer(), price=PRICE, cap=0.0032)
    client.budget.trial_usd = lambda _: 0.001
    await client.budget.admit([0])
    first = await begun(reply_to(client, "prompt", slot(), order=1))
    older = await begun(reply_to(client, "prompt", slot(2), order=0))
    assert [reply.text for reply in await asyncio.gather(first, older)] == ["M", "M"]
    assert now_s() < 60
