"""Trials to lay beside another one: found by words, or offered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from merge_runner_analysis.explorer.details import read_trial
from merge_runner_analysis.explorer.display_text import visible
from merge_runner_analysis.explorer.pages.trial import (
    HUMAN,
    OFFERS,
    REPETITION,
    find,
    panels,
    replayed,
)
from merge_runner_analysis.explorer.reading import Row, reading, records
from merge_runner_analysis.explorer.site import NotThere, Site
from merge_runner_analysis.explorer.views import account_of

At = tuple[str, str]
"""A trial: its name and its spec."""
FOUND = 12
# An address calls a trial by its name, and by its spec where that name has several.
NAMED = """(SELECT *, if(count(*) OVER (PARTITION BY trial_id) = 1, trial_id,
    trial_id || '@' || spec_hash) AS key FROM listed)"""
WORDS = "lower(concat_ws(' ', trial_id, model, variant, outcome))"
# Of some trials of a condition, by the numbers that they have in the list.
BESIDE = f"""
WITH near AS (
    SELECT *, (trial_id, spec_hash) IN (SELECT unnest($2), unnest($3)) AS wanted
    FROM listed WHERE condition = $1
), beside AS (
    SELECT number, '{REPETITION}' AS kind,
        coalesce(lead(number) OVER alike, first_value(number) OVER alike) AS other
    FROM near
    WINDOW alike AS (PARTITION BY model, variant, pair, spec_hash ORDER BY rep, trial_id)
)
SELECT one.trial_id, one.spec_hash, kind, two.trial_id AS other_id, two.spec_hash AS other_hash
FROM beside JOIN near AS one USING (number) JOIN near AS two ON two.number = beside.other
WHERE one.number <> two.number AND one.wanted
"""  # noqa: S608 # constants
# Times are compared in ms: drivers and recordings have steps of their own. A human trial counts
# whose task is the same, and that lasts as long as what it is compared with.
NEAREST = f"""
WITH near AS (
    SELECT row_number() OVER (ORDER BY trial_id, spec_hash) AS number, trial_id, spec_hash,
        source = 'human' AS human,
        dense_rank() OVER (ORDER BY projected_headway_m, relative_velocity_mps,
            coalesce((spec->>'$.mean_speed_mps')::DOUBLE, mean_speed_mps())) AS task,
        (trial_id, spec_hash) IN (SELECT unnest($trials), unnest($specs)) AS wanted
    FROM trials LEFT JOIN specs USING (spec_hash)
    WHERE condition = $condition AND (human OR wanted)
), told AS (
    SELECT number, human, task, wanted, round(1000 * time_s)::INTEGER AS ms,
        sum(if(side = 'left', position_m, -position_m)) AS headway_m, max(position_m) AS first_m
    FROM states JOIN near USING (trial_id, spec_hash)
    WHERE time_s >= 0 GROUP BY ALL HAVING count(*) = 2
), one AS (
    SELECT *, max(ms) OVER (PARTITION BY number) AS last_ms FROM told
    WHERE wanted AND first_m < merge_point_m()
), other AS (SELECT *, max(ms) OVER (PARTITION BY number) AS last_ms FROM told WHERE human),
nearest AS (
    SELECT one.number AS number, other.number AS other FROM one JOIN other
        USING (task, ms) WHERE other.last_ms >= one.last_ms AND one.number <> other.number
    GROUP BY one.number, other.number QUALIFY row_number() OVER (PARTITION BY one.number
        ORDER BY avg((one.headway_m - other.headway_m) ** 2), other.number) = 1
)
SELECT one.trial_id, one.spec_hash, '{HUMAN}' AS kind, two.trial_id AS other_id,
    two.spec_hash AS other_hash
FROM nearest JOIN near AS one USING (number) JOIN near AS two ON two.number = nearest.other
"""  # noqa: S608 # constants


def others(site: Site, trial_id: str, asked: Mapping[str, str]) -> dict[str, Any] | str | None:
    """What a trial's page asks about others: one to lay beside it, one that is offered, or several.

    ``compare=KEY`` gives what a replay draws of it, ``offer=KIND`` a key; None where there is none.
    ``q=WORDS`` gives the first trials that have the words. Raises NotThere.
    """
    row = find(site, trial_id, asked)
    if "compare" in asked:
        other = named(site, asked["compare"])
        return None if other is None else _laid(site, other)
    if (kind := asked.get("offer")) is not None:
        return _offer(site, (row["trial_id"], row["spec_hash"]), row["condition"], kind)
    return searched(site, row, asked.get("q", ""))


def _laid(site: Site, other: Row) -> dict[str, Any] | None:
    trial = read_trial(site.db, other["trial_id"], other["spec_hash"])
    if not trial.states:
        return None
    account = account_of(other, trial)
    return {
        **replayed(site, other, trial, account),
        "ribbons": site.render("_ribbons.html", row=other, trial_decisions=trial.by_side),
        "panels": "".join(panels(site, other, trial)),
    }


def _offer(site: Site, at: At, condition: str, kind: str) -> str | None:
    if kind not in OFFERS:
        raise NotThere(f"there are no other offers than {', '.join(OFFERS)}")
    other = offered(site, condition, [at]).get(at, {}).get(kind)
    return None if other is None else key_of(site, other)


def named(site: Site, key: str) -> Row | None:
    """The trial that a key stands for; a name with several specs stands for the first of them."""
    name, _, spec = key.rpartition("@")
    return site.catalogue.find(key) or (site.catalogue.find(name, spec) if name else None)


def key_of(site: Site, at: At) -> str:
    """What an address calls a trial that is listed."""
    (row,) = site.catalogue.ask(
        f"SELECT key FROM {NAMED} WHERE trial_id = ? AND spec_hash = ?",  # noqa: S608 # constants
        *at,
    )
    return str(row["key"])


def searched(site: Site, row: Row, text: str) -> dict[str, Any]:
    """The first trials that have all words of a text; those of the same condition come first."""
    words = text.lower().split()
    fits = "".join(f" AND contains({WORDS}, ?)" for _ in words)
    found = site.catalogue.ask(
        f"SELECT key, outcome, stand_in FROM {NAMED} "  # noqa: S608 # constants
        f"WHERE (trial_id, spec_hash) <> (?, ?){fits} "
        f"ORDER BY condition <> ?, trial_id, spec_hash LIMIT {FOUND}",
        *(row["trial_id"], row["spec_hash"], *words, row["condition"]),
    )
    return {
        "found": [
            {"key": one["key"], "outcome": one["outcome"], "note": visible(one["stand_in"] or "")}
            for one in found
        ]
    }


def offered(site: Site, condition: str, beside: Sequence[At]) -> dict[At, dict[str, At]]:
    """What is offered beside some trials of a condition, by kind."""
    trials, specs = [trial for trial, _ in beside], [spec for _, spec in beside]
    told = {"condition": condition, "trials": trials, "specs": specs}
    with reading(site.db) as connection:
        rows = records(connection, NEAREST, told)
    found: dict[At, dict[str, At]] = {}
    for row in (*site.catalogue.ask(BESIDE, condition, trials, specs), *rows):
        others_of = found.setdefault((row["trial_id"], row["spec_hash"]), {})
        others_of[row["kind"]] = row["other_id"], row["other_hash"]
    return found
