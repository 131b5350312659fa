"""One call: asked once, kept, tried again where that helps, given up where nobody waits."""

import asyncio
import json
from collections import Counter

import diskcache
import pytest

from merge_runner.drivers.language_model import Question
from merge_runner.errors import EndpointRefused, QuotaExhausted, TrialSuspended, UsageError
from merge_runner.llm.cache import ResponseCache
from merge_runner.llm.call import Calls
from merge_runner.llm.http_outcome import TransportFailure
from merge_runner.llm.ledger import CallLabel
from merge_runner.llm.limiter import Limiter, Pause
from merge_runner.llm.store import CachedCall
from merge_runner.records import Attempt, CallFailed, ReplayMiss, Usage
from tests.support.clients import PRICE, answer, begun, error, raw, reply_to, slot, ticks
from tests.support.virtual_time import now_s

pytestmark = pytest.mark.usefixtures("virtual_time")


def gemini(*texts):
    parts = {"parts": [{"text": text} for text in texts]} if texts else {}
    return raw({"candidates": [{"content": parts, "finishReason": "STOP"}]})


def outcomes(attempts):
    return [attempt.outcome for attempt in attempts]


async def held(client):
    """A call that is sent, and answered once ``client.direct.transport.open`` is set."""
    client.direct.transport.open.clear()
    return await begun(reply_to(client, "prompt", slot()))


def paused():
    """A limiter that gives no turn for five minutes."""
    limiter = Limiter()
    limiter.pause(300)
    return limiter


async def test_a_second_ask_is_answered_from_the_cache(make):
    client = make(answer("first"), answer("second"))
    first, second = [await reply_to(client, "prompt", slot()) for _ in range(2)]
    assert (first.text, second.text) == ("first", "first")
    assert (first.cached_attempts, second.cached_attempts) == (0, 1)
    assert first.attempts == second.attempts
    meter = client.meter
    assert (meter.calls_live, meter.calls_cached, meter.calls_shared) == (1, 1, 1)
    later = make(answer("second"))
    assert (await reply_to(later, "prompt", slot())).text == "first"
    assert later.direct.transport.sent == []
    assert (later.meter.calls_cached, later.meter.calls_shared) == (1, 0)


async def test_all_who_ask_the_same_at_once_share_one_call_whose_attempts_count_once(make):
    calls = Calls()
    client, twin = (make(answer(f"from {n}"), calls=calls) for n in range(2))
    replies = await asyncio.gather(
        *(reply_to(asker, "prompt", slot()) for asker in (client, client, twin))
    )
    assert [reply.text for reply in replies] == ["from 0"] * 3
    assert [reply.cached_attempts for reply in replies] == [0, 1, 1]
    meter = client.meter
    assert (meter.calls_live, meter.calls_cached, meter.calls_shared) == (1, 1, 1)
    failing = make(error(400))
    asked = [reply_to(failing, "another", slot()) for _ in range(2)]
    failed = await asyncio.gather(*asked, return_exceptions=True)
    assert [(len(call.attempts), call.cached_attempts) for call in failed] == [(1, 0), (1, 1)]


async def test_who_finds_a_reply_that_was_just_stored_shares_it(make, monkeypatch):
    """It is in the cache a moment before the call that brought it goes on."""
    client = make(answer())
    store, key = client.budget.ledger.store, client.replies.request("prompt", slot()).key
    write = store.write

    async def then_ask(operation):
        stored = await write(operation)
        if client.cache.look_up(key)[0]:
            await reply_to(client, "prompt", slot())
        return stored

    monkeypatch.setattr(store, "write", then_ask)
    await reply_to(client, "prompt", slot())
    assert (client.meter.calls_cached, client.meter.calls_shared) == (1, 1)


async def test_a_reply_that_an_import_has_stored_first_is_no_attempt_of_this_run(make, cache):
    client = make(answer("late"))
    asked = await held(client)
    request = client.replies.request("prompt", slot())
    imported = Attempt(1, "ok", 200, reply=answer("imported").body)
    cache.put_now([CachedCall(request, (imported,))])
    client.direct.transport.open.set()
    reply = await asked
    assert (reply.text, reply.cached_attempts) == ("imported", 1)


async def test_a_call_whose_wait_for_money_times_out_is_no_call_that_was_given_up(
    make, monkeypatch
):
    """A timeout cancels its own task for a moment, in which others may ask the same."""
    client, expire = make(answer(), price=PRICE, cap=0.0015), asyncio.Timeout._on_timeout
    client.budget.trial_usd = lambda _: 0.0014
    await client.budget.admit([1])
    calls, shared = client.calls.under_way, []

    def expires(timeout):
        expire(timeout)
        asking = reply_to(client, "prompt", slot(), order=6)
        before = [*calls.values()]
        asking.send(None)
        shared.append([*calls.values()] == before)
        asking.close()

    monkeypatch.setattr(asyncio.Timeout, "_on_timeout", expires)
    asked = await begun(reply_to(client, "prompt", slot(), order=5))
    await asyncio.sleep(100)
    assert shared == [True]
    asked.cancel()
    await ticks()


async def test_what_is_sent_is_what_is_kept(make, cache):
    client = make(answer())
    reply = await reply_to(client, "Où?", slot(3, "right"))
    (sent,) = client.direct.transport.sent
    assert sent == reply.request == cache.get(sent.key).request
    assert json.loads(sent.body)["messages"] == [{"role": "user", "content": "Où?"}]
    assert sent.slot == slot(3, "right")
    assert (sent.endpoint, sent.model, sent.path) == ("openai", "m-1", "/chat/completions")
    assert cache.get(sent.key).attempts == reply.attempts
    assert reply.attempts[0].reply == client.direct.transport.replies[0].body


async def test_passing_failures_are_tried_again_and_all_attempts_are_kept(make, cache):
    late, lost = TransportFailure("timeout", "no reply within 600 s"), "connection_lost"
    page, cut = raw("<html>", 502), raw('{"choices": [', 200)
    client = make(late, error(503), page, cut, TransportFailure(lost, "reset"), answer("M"))
    reply = await reply_to(client, "prompt", slot())
    names = ("timeout", "overloaded", "server_error", "bad_body", lost, "ok")
    told = enumerate(zip(names, (None, 503, 502, 200, None, 200), strict=True), 1)
    assert [(a.number, (a.outcome, a.http_status)) for a in reply.attempts] == list(told)
    assert [a.reply for a in reply.attempts][:3] == [None, error(503).body, "<html>"]
    assert reply.attempts[0].error == "no reply within 600 s"
    assert all(a.started_at and a.latency_s is not None for a in reply.attempts)
    assert cache.get(reply.request.key).attempts == reply.attempts
    assert client.meter.outcomes == Counter(outcomes(reply.attempts))
    assert reply.text == "M"


async def test_words_that_no_file_can_hold_lose_no_reply(make, cache):
    """JSON can spell half a surrogate pair; a file cannot."""
    odd = json.dumps({"error": {"message": "\ud800"}, "model": "\udfff"})
    reply = await reply_to(
        make(raw(odd, 500), answer("\ud800M", "\ud800", "\ud800")), "prompt", slot()
    )
    assert outcomes(reply.attempts) == ["server_error", "ok"]
    assert reply.text.endswith("M")
    assert cache.get(reply.request.key).attempts == reply.attempts


def question(prompt="prompt", older=None, **repetition):
    return Question("my-model", slot(**repetition), prompt, older, lambda *answered: answered)


async def test_a_damaged_reply_is_told_set_aside_and_asked_again(make, cache):
    key = (await reply_to(make(answer("old")), "prompt", slot())).request.key
    with diskcache.Cache(str(cache.folder)) as stock:
        # One character of the answer differs, and all else is as it was.
        damaged = stock[key] = stock[key].replace("old", "odd")
    client = make(answer("new"))
    with pytest.raises(CallFailed, match=key) as caught:  # a replay asks nothing again
        client.replies.answer(question())
    assert caught.value.request.key == key
    assert (await reply_to(client, "prompt", slot())).text == "new"
    assert client.meter.damaged == [key]
    assert any(key in note and "damaged" in note for note in client.meter.notes)
    with diskcache.Cache(str(cache.folder)) as stock:
        assert stock[f"damaged {key}"] == damaged
    assert (await reply_to(make(answer("third")), "prompt", slot())).text == "new"


async def test_a_rejected_request_fails_this_call_alone(make, cache):
    client = make(error(500), error(400, "bad temperature"), answer())
    with pytest.raises(CallFailed, match="bad temperature") as caught:
        await reply_to(client, "prompt", slot())
    assert outcomes(caught.value.attempts) == ["server_error", "bad_request"]
    assert caught.value.request == client.direct.transport.sent[0]
    assert list(cache.entries()) == []
    assert cache.look_up(caught.value.request.key)[1] == caught.value.attempts
    reply = await reply_to(make(answer()), "prompt", slot())
    assert [each.number for each in reply.attempts] == [1, 2, 3], "an earlier run's count too"
    assert (await reply_to(client, "prompt", slot(2))).outcome == "ok"
    unknown = make(error(404, code="model_not_found"))  # which no other request would mend
    with pytest.raises(EndpointRefused, match="'m-1'"):
        await reply_to(unknown, "prompt", slot(3))
    assert len(unknown.direct.transport.sent) == 1


@pytest.mark.parametrize(
    ("replies", "expected"),
    [
        ([gemini(), gemini(), gemini("M")], "empty empty ok"),
        ([gemini(), gemini(), gemini(), gemini("M")], "empty empty empty"),
        ([raw({"usageMetadata": {"promptTokenCount": 9}}), gemini("M")], "empty ok"),
        # Other failures in between do not use up the two.
        ([gemini(), error(500), gemini(), gemini("M")], "empty server_error empty ok"),
    ],
)
async def test_an_empty_answer_of_gemini_is_asked_at_most_twice_again(make, replies, expected):
    client = make(*replies, format="gemini")
    reply = await reply_to(client, "prompt", slot())
    assert outcomes(reply.attempts) == expected.split()
    assert reply.outcome == expected.split()[-1]
    assert len(client.direct.transport.sent) == len(expected.split())


@pytest.mark.parametrize("told", [{"prompt_tokens": 0}, {}, {"prompt_tokens": "many"}], ids=str)
async def test_more_output_than_there_can_be_is_paid_whatever_is_said_of_the_input(make, told):
    choice = {"message": {"content": "M"}, "finish_reason": "stop"}
    usage = {**told, "completion_tokens": 5_000_000.0}
    client = make(raw({"choices": [choice], "usage": usage}), price=PRICE, cap=100)
    await reply_to(client, "prompt", slot())
    spent = client.budget.ledger.read()
    assert spent.spent_usd >= 40
    assert (spent.overrun_usd > 39, spent.reserved_usd) == (True, 0)


async def test_who_gives_up_does_not_lose_the_call_in_flight(make, cache):
    client = make(answer("paid for"))
    asked = await held(client)
    assert client.calls.calls_in_flight == 1
    asked.cancel()
    drained = await begun(client.calls.drain())
    assert (asked.cancelled(), drained.done()) == (True, False)
    client.direct.transport.open.set()
    await drained
    assert client.calls.calls_in_flight == 0
    (kept,) = cache.entries()
    assert kept.request == client.direct.transport.sent[0]
    assert outcomes(kept.attempts) == ["ok"]


async def test_one_of_two_who_gives_up_does_not_take_the_answer_from_the_other(make):
    client = make(answer("shared"))
    first, second = [await held(client) for _ in range(2)]
    first.cancel()
    await ticks()
    client.direct.transport.open.set()
    assert (await second).text == "shared"
    assert len(client.direct.transport.sent) == 1


async def test_a_call_that_nobody_waits_for_any_more_takes_neither_a_turn_nor_money(make):
    client = make(answer(), limiter=paused(), cap=1.0, price=PRICE)
    asked = await begun(reply_to(client, "prompt", slot()))
    asked.cancel()
    await ticks()
    assert (client.calls.waits, client.budget.queued_usd) == ([], 0)
    assert (await reply_to(client, "prompt", slot())).text == "M", "it can be asked anew"
    assert (now_s(), len(client.direct.transport.sent)) == (300, 1)


async def test_who_asks_anew_for_a_call_that_is_just_given_up_gets_an_answer(make):
    client = make(answer(), limiter=paused())
    asked = await begun(reply_to(client, "prompt", slot()))
    (call,) = client.calls.under_way.values()
    asked.cancel()
    for _ in range(20):
        if not call.task.cancelling():
            await asyncio.sleep(0)
    assert not call.task.done()
    assert (await reply_to(client, "prompt", slot())).text == "M"
    assert client.calls.under_way == {}


async def test_a_call_in_flight_that_nobody_waits_for_any_more_is_not_tried_again(make, cache):
    client = make(error(503), answer())
    asked = await held(client)
    (call,) = client.calls.under_way.values()
    asked.cancel()
    await ticks()
    client.direct.transport.open.set()
    await asyncio.wait([call.task])
    assert len(client.direct.transport.sent) == 1
    assert cache.names("attempts ") == [f"attempts {call.request.key}"]
    entry, attempts = cache.look_up(call.request.key)
    assert entry is None
    assert outcomes(attempts) == ["overloaded"]


async def test_drain_gives_up_calls_that_wait_for_their_turn(make):
    client = make(answer(), price=PRICE, cap=0.0015, limiter=paused())
    asked = [await begun(reply_to(client, "prompt", slot(n))) for n in (1, 2)]
    await client.calls.drain()
    results = await asyncio.gather(*asked, return_exceptions=True)
    assert not any(hasattr(result, "text") for result in results)
    assert (client.direct.transport.sent, now_s()) == ([], 0)
    # Their money is given back.
    await client.budget.reserve([0], "key", CallLabel("", "", 0.0015))
    assert client.budget.ledger.read().committed_usd == 0
    with pytest.raises(CallFailed, match="stopped"):
        await reply_to(client, "prompt", slot(3))


@pytest.mark.parametrize("in_flight", [False, True])
async def test_drain_does_not_wait_for_another_attempt(make, in_flight):
    client = make(error(503, retry_after="300"), answer())
    asked = await (held(client) if in_flight else begun(reply_to(client, "prompt", slot())))
    drained = await begun(client.calls.drain())
    client.direct.transport.open.set()
    await drained
    await asyncio.gather(asked, return_exceptions=True)
    assert (len(client.direct.transport.sent), now_s()) == (1, 0)


async def test_drain_does_not_lose_an_answer_that_is_just_being_saved(make, tmp_path):
    own = ResponseCache(tmp_path)
    client = make(answer("paid for"), cache=own)
    asked = [asyncio.create_task(reply_to(client, "prompt", slot(n))) for n in (1, 2)]
    while client.direct.transport.answered < 2:
        await asyncio.sleep(0)
    await client.calls.drain()
    assert len(list(own.entries())) == 2
    assert [(await each).text for each in asked] == ["paid for", "paid for"]
    own.close()


async def test_a_call_knows_itself_whether_it_is_in_flight(make):
    client = make(error(503, retry_after="300"), answer("paid for"))
    retrying = await begun(reply_to(client, "prompt", slot(1)))
    client.direct.transport.open.clear()
    flying = asyncio.create_task(reply_to(client, "prompt", slot(2)))
    while client.calls.calls_in_flight != 1 or len(client.direct.transport.sent) < 2:
        await asyncio.sleep(0)
    assert [wait.what for wait in client.calls.waits] == ["after HTTP 503: m"]
    drained = await begun(client.calls.drain())
    client.direct.transport.open.set()
    await drained
    results = await asyncio.gather(retrying, flying, return_exceptions=True)
    assert [getattr(result, "text", None) for result in results] == [None, "paid for"]
    assert (client.calls.waits, client.calls.calls_in_flight) == ([], 0)


async def test_a_model_that_was_not_asked_for_is_counted(make):
    for number, served in enumerate(("m-1", "m", None, "m-2"), 1):
        client = make(answer(model=served), aliases=("m",))
        reply = await reply_to(client, "prompt", slot(number))
        assert reply.attempts[0].model_served == served
        assert client.meter.mismatches == ({"m-1 -> m-2": 1} if served == "m-2" else {})


async def test_what_an_attempt_costs_comes_from_its_tokens(make):
    client = make(error(500), answer(usage=(1000, 500)), answer(usage=None), price=PRICE)
    reply = await reply_to(client, "prompt", slot())
    assert [a.cost_usd for a in reply.attempts] == [0.0, pytest.approx(0.006)]
    assert (await reply_to(client, "prompt", slot(2))).attempts[0].cost_usd is None
    assert client.meter.cost_usd == pytest.approx(0.006)
    # A price that nobody knows is counted and not guessed.
    client = make(answer(), id="no-such-model", price="genai-prices")
    assert (await reply_to(client, "prompt", slot())).attempts[0].cost_usd is None
    assert (client.meter.cost_usd, client.meter.cost_unknown) == (0.0, 1)


def worst_case_usd(client):
    """A token for each byte that is sent, and the whole cap."""
    return len(client.direct.transport.sent[0].body.encode()) * 2e-6 + 100 * 8e-6


async def test_no_call_is_made_that_could_pass_the_cap(make):
    client = make(answer(usage=(10, 5)), price=PRICE)
    await reply_to(client, "prompt", slot())
    worst = worst_case_usd(client)
    spent = client.budget.ledger.read().spent_usd
    enough = make(answer(usage=(10, 5)), price=PRICE, cap=spent + worst * 1.001)
    assert (await reply_to(enough, "prompt", slot(2))).outcome == "ok"
    too_little = make(answer(), price=PRICE, cap=2 * spent + worst * 0.999)
    with pytest.raises(TrialSuspended):
        await reply_to(too_little, "prompt", slot(3))
    assert too_little.direct.transport.sent == []
    # Calls in flight are waited for, and what they cost counts.
    client = make(answer(usage=(10, 5)), price=PRICE, cap=worst * 1.5)
    await asyncio.gather(*(reply_to(client, "prompt", slot(n)) for n in range(4, 9)))
    assert len(client.direct.transport.sent) == 5


async def test_a_call_above_the_token_limit_gives_its_money_back(make):
    client = make(answer(), price=PRICE, cap=0.0015, limiter=Limiter(tpm=50))
    for repetition in (1, 2):
        with pytest.raises(UsageError, match="--tpm"):
            await reply_to(client, "prompt", slot(repetition))


async def test_an_attempt_that_is_refused_or_never_sent_is_not_charged(make):
    free = TransportFailure("no_connection", "refused", sent=False), error(500)
    client = make(*free, answer(), price=PRICE, cap=0.0015)
    assert (await reply_to(client, "prompt", slot())).outcome == "ok"
    client = make(TransportFailure("timeout", "no reply"), answer(), price=PRICE, cap=0.0015)
    with pytest.raises(TrialSuspended):
        await reply_to(client, "prompt", slot(2))
    assert len(client.direct.transport.sent) == 1


async def test_a_rate_limit_makes_all_calls_of_the_key_wait(make):
    shared = Pause()
    client = make(error(429, retry_after="30"), answer(), limiter=Limiter(pause=shared))
    other = make(answer(), limiter=Limiter(pause=shared), id="m-2")
    first = await begun(reply_to(client, "prompt", slot()))
    await asyncio.gather(
        first, reply_to(client, "prompt", slot(2)), reply_to(other, "prompt", slot())
    )
    assert client.direct.transport.times == [0, 30, 30]
    assert other.direct.transport.times == [30]


async def test_a_rate_limit_without_a_delay_makes_all_calls_wait_as_long_as_its_own(make):
    client = make(error(429), error(429), error(429), answer())
    asked = [await begun(reply_to(client, "prompt", slot(n))) for n in (1, 2)]
    assert client.direct.transport.times == [0]
    await asyncio.gather(*asked)
    assert client.direct.transport.times[1] >= 0.5


async def test_a_failing_server_makes_only_its_own_call_wait(make):
    client = make(error(503, retry_after="30"), answer())
    first = await begun(reply_to(client, "prompt", slot()))
    await asyncio.gather(first, reply_to(client, "prompt", slot(2)))
    assert client.direct.transport.times == [0, 0, 30]


async def test_a_limit_longer_than_the_deadline_ends_the_run_and_an_outage_its_call(make):
    for status, wait_s, raised in (
        (503, 86400, CallFailed),
        (503, 1200, CallFailed),
        (429, 86400, QuotaExhausted),
    ):
        client = make(error(status, "come back tomorrow", retry_after=f"{wait_s}"), answer())
        with pytest.raises(raised, match=rf"wait {wait_s} s.*come back tomorrow"):
            await reply_to(client, "prompt", slot())
        assert (len(client.direct.transport.sent), now_s()) == (1, 0)


async def test_a_replay_misses_what_is_not_recorded(make):
    client = make(answer("recorded"))
    await reply_to(client, "prompt", slot())
    prompt, reply = client.replies.answer(question())
    assert (prompt, reply.text, reply.cached_attempts) == ("prompt", "recorded", 1)
    with pytest.raises(ReplayMiss) as caught:
        client.replies.answer(question(repetition=2))
    assert caught.value.request.slot == slot(2)
    assert (client.meter.calls_live, client.meter.calls_cached) == (1, 1)


@pytest.mark.parametrize(
    ("asked", "expected"), [(["older"], "older"), (["older", "new"], "new"), ([], "new")]
)
async def test_a_prompt_that_an_earlier_version_has_asked_stays_as_it_was(make, asked, expected):
    client = make(*map(answer, asked))
    for prompt in asked:
        await reply_to(client, prompt, slot())
    assert client.replies.request_of(question("new", older="older"))[0] == expected
    assert client.replies.request_of(question("new"))[0] == "new"


@pytest.mark.parametrize("body", [answer("<think>M [1"), answer("M", finish="MAX_TOKENS")])
def test_an_answer_that_an_earlier_version_kept_is_read_by_the_rules_of_now(make, cache, body):
    replies = make(None).replies
    kept = Attempt(1, "ok", http_status=200, reply=body.body)
    cache.put_now([CachedCall(replies.request("prompt", slot()), (kept,))], [])
    _, reply = replies.answer(question())
    assert (reply.outcome, reply.attempts[-1].outcome) == ("truncated", "truncated")
    assert reply.attempts[-1].usage == Usage(10, output_tokens=5), "it was kept without"


async def test_the_actual_tokens_take_the_place_of_the_estimate(make):
    """The estimate is the whole cap; the tokens that a reply tells free the rest at once."""
    client = make(answer(usage=(10, 5)), limiter=Limiter(tpm=200))
    for repetition in range(1, 4):
        await reply_to(client, "prompt", slot(repetition))
    assert client.direct.transport.times == [0, 0, 0]


async def test_the_call_with_the_lowest_order_is_sent_first(make):
    client = make(answer(), limiter=paused())
    await asyncio.gather(*(reply_to(client, "prompt", slot(n + 1), order=n) for n in (3, 1, 2, 0)))
    assert [request.slot.repetition for request in client.direct.transport.sent] == [1, 2, 3, 4]


async def test_a_dearer_service_tier_is_kept_priced_where_its_price_is_known_and_else_counted(make):
    paid = json.loads(answer(usage=(1_000_000, 0)).body) | {"service_tier": "priority"}
    plain = make(raw(paid), price=PRICE)
    reply = await reply_to(plain, "prompt", slot())
    assert json.loads(reply.attempts[-1].reply)["service_tier"] == "priority"
    assert plain.meter.cost_usd == pytest.approx(PRICE.input)
    assert plain.meter.underpriced == {"priority": 1}
    tiered = make(raw(paid), price=PRICE.model_copy(update={"tiers": {"priority": 2.0}}))
    await reply_to(tiered, "prompt", slot(2))
    assert tiered.meter.cost_usd == pytest.approx(2 * PRICE.input)
    assert not tiered.meter.underpriced


async def test_the_worst_case_of_a_dearer_tier_that_is_asked_for_is_its_own(make):
    price = PRICE.model_copy(update={"tiers": {"priority": 2.0}})
    worst = []
    for parameters in ({}, {"service_tier": "priority"}):
        client = make(answer(), price=price, cap=100.0, parameters=parameters)
        client.direct.transport.open.clear()
        asked = await begun(reply_to(client, "prompt", slot()))
        while not client.direct.transport.sent:
            await asyncio.sleep(0.01)
        worst.append(client.budget.ledger.read().reserved_usd)
        client.direct.transport.open.set()
        await asked
    assert worst[1] > 1.9 * worst[0]
