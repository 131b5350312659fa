"""The players of trials that may ask models: this process, or the workers of a cluster."""

from __future__ import annotations

import secrets
from contextlib import AsyncExitStack

from merge_runner.llm.batch.rounds import Rounds
from merge_runner.llm.call import Calls
from merge_runner.providers import base_urls
from merge_runner.results.store import Store
from merge_runner.run.clients import live_clients
from merge_runner.run.cluster import ClusterRunner
from merge_runner.run.cluster_connection import connected
from merge_runner.run.cluster_worker import Chunk
from merge_runner.run.estimate import earlier_answers
from merge_runner.run.guard import MOST_INVALID, FirstDecisions
from merge_runner.run.local_runner import LocalRunner
from merge_runner.run.replay import Replay
from merge_runner.run.session import Session

Player = LocalRunner | ClusterRunner | Replay

# Trials under way in a batch run: one that waits for a round takes no time, but memory.
MOST_IN_ROUNDS = 10_000


async def open_player(
    session: Session, store: Store, rounds: Rounds | None, stack: AsyncExitStack
) -> Player:
    """Return the player of a live run, closed with ``stack``; raises UsageError."""
    plan, options, ledger = session.plan, session.options, session.ledger
    usage = earlier_answers(plan, session.cache)
    first = FirstDecisions()
    if not options.keep_going:
        first = FirstDecisions(MOST_INVALID, one_by_one=rounds is None)
        labels = plan.by_label()
        arms = {spec.spec_hash: labels[spec.arm] for spec in session.stored}
        for spec_hash, side, *decisions in store.decisions_by_spec(arms) if arms else ():
            if (model := arms[spec_hash].full_names[side]) in plan.entries:
                first.add(model, *decisions)
    if options.dask is not None:
        client = await stack.enter_async_context(connected(options.dask))
        urls = base_urls(plan.entries)
        whole = Chunk(secrets.token_hex(), plan, options, usage, first, urls)
        return ClusterRunner(client, plan, whole, session.cache, ledger)
    calls = Calls()
    clients = live_clients(
        plan, options, usage, session.cache, ledger, calls=calls, stack=stack, rounds=rounds
    )
    if rounds is not None:
        stack.push_async_callback(rounds.close)
    in_flight = MOST_IN_ROUNDS if options.batch else options.in_flight
    return LocalRunner(plan, clients, in_flight, first, rounds, calls)
