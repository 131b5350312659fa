"""Prompts: how each differs from the baseline, and the effect on each driver."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection, Mapping
from functools import partial
from typing import Any

from merge_runner.planted_effect import PARAMETERS as PLANTED
from merge_runner.prompts.blocks import BASELINE, blocks_of
from merge_runner.records import ROADS, SIDES
from merge_runner_analysis.metrics import COLLISIONS
from merge_runner_analysis.tables.formats import printed
from merge_runner_analysis.tables.model import Table
from merge_runner_analysis.web.effect_rows import difference_mark, ends_of, rows_of
from merge_runner_analysis.web.phrases import UNKNOWN, block_meaning
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.scope import carried, scope_of, unmarked
from merge_runner_analysis.web.site import NotThere, Site
from merge_runner_analysis.web.trial.prompt_parts import digests_of, level_of, parts_of
from merge_runner_analysis.web.trial_index import TrialFilter, where_of

# The blocks of a prompt, as its specs name them; a program has none.
STORED = """
SELECT any_value(names) AS names FROM listed JOIN (
    SELECT spec_hash, json_keys(spec, '$.prompt_blocks') AS names FROM specs
) USING (spec_hash) WHERE variant = ? AND len(names) > 0
"""
# The first prompt of each variant on each road, how many were ``sent``, and the baseline's on the
# same side: all of the same condition, as far as that was played. The ego's and the other driver's
# apart, where their words may differ.
FIRST = """
WITH firsts AS (
    SELECT variant, reader, road, count(*) AS sent,
        arg_min(place, (decision, condition, side, trial_id)) AS place
    FROM {sent} GROUP BY ALL
), baselines AS (
    SELECT side, road, arg_min(place, (decision, condition, trial_id)) AS base
    FROM sent WHERE variant = ? GROUP BY ALL
), texts AS (SELECT rowid AS place, prompt FROM decisions)
SELECT firsts.*, sent.side, sent.blocks, texts.prompt, bases.prompt AS baseline
FROM firsts JOIN sent USING (place) JOIN texts USING (place) LEFT JOIN baselines
    ON baselines.side = sent.side AND baselines.road = firsts.road
LEFT JOIN texts AS bases ON bases.place = baselines.base
ORDER BY firsts.variant <> ?, firsts.variant, firsts.road, firsts.reader
"""
IN_SCOPE = "(FROM sent SEMI JOIN (FROM listed WHERE {}) USING (trial_id, spec_hash))"
ON_ROADS = {"merge": "Before the merge point", "straight": "After the merge point"}
VALUES = re.compile(r"[-\d.,\[\] ]+")
# Trials of a variant and of its driver's baseline in equal conditions and repetitions, whose specs
# differ in nothing but the prompt, and what it plants in the emulator.
PAIRS = """
WITH tasks AS (
    SELECT spec_hash, json_merge_patch(spec, ?) AS task FROM specs
), tasked AS (FROM listed JOIN tasks USING (spec_hash) WHERE source <> 'human')
SELECT one.condition, one.rep, one.trial_id, one.spec_hash, one.outcome,
    base.trial_id AS base_id, base.spec_hash AS base_hash, base.outcome AS base_outcome
FROM tasked AS one JOIN tasked AS base USING (model, model_left, condition, rep, task)
WHERE one.model = ? AND one.variant = ? AND base.variant = ?
ORDER BY one.trial_id, one.spec_hash, base.spec_hash
"""
_UNPLANTED = {"body": dict.fromkeys(PLANTED)}
WITHOUT_PROMPT = json.dumps({"prompt_blocks": None, **dict.fromkeys(SIDES, _UNPLANTED)})


def prompts_page(site: Site, params: Mapping[str, str]) -> str:
    """Return all prompts side by side, and the differences that they make."""
    bar = scope_of(site, params)
    chosen = bar.scope.drivers or bar.drivers
    job, contrasts = site.table("contrasts", bar.scope.sweep, bar.scope.condition)
    drivers, ends = differences(contrasts, chosen) if contrasts else ({}, {})
    filters = {**bar.scope.filters, "variant": "", "who": ["drivers", "mocks"]}
    played: dict[str, list[str]] = {}
    for row in site.trial_index.counts(filters, "model", "variant"):
        played.setdefault(row["model"], []).append(row["variant"])
    several = {name: prompts for name, prompts in played.items() if len(prompts) > 1}
    otherwise = []  # k of n trials that ended otherwise than with the baseline
    for name, prompts in () if drivers else several.items():
        for prompt in prompts:
            pairs, differing = pairs_of(site, name, prompt)
            if differing:
                otherwise.append((name, prompt, len(differing), len(pairs)))
    return site.render(
        "prompts.html",
        view="prompts",
        bar=bar,
        carried=carried(params),
        job=job,
        contrasts=contrasts,
        prompts=_prompts(site, {**bar.scope.trials(), "model": bar.scope.drivers}),
        on_roads=ON_ROADS,
        left_out=partial(left_out, site),
        drivers=drivers,
        ends=ends,
        collisions=COLLISIONS.name,
        reworded=any(prompts != [BASELINE] for prompts in played.values()),
        several=several,
        otherwise=otherwise,
    )


def _prompts(site: Site, filters: TrialFilter) -> dict[str, list[dict[str, Any]]]:
    """Return each variant's texts, by road and reader: two readers where theirs differ.

    Each has its ``parts`` and ``changes``, and the number of decisions for which it was ``sent``.
    After the merge point the values of two prompts differ, so that these have no ``changes``, but
    the names of the blocks ``without`` which they are.
    """
    where, values = where_of(filters)
    source = IN_SCOPE.format(where) if values else "sent"
    rows = site.trial_index.ask(FIRST.format(sent=source), *values, BASELINE, BASELINE)
    by_variant: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        texts = by_variant.setdefault(row["variant"], [])
        is_before = row["road"] == ROADS[0]
        baseline = row["baseline"] if is_before else None
        digests = digests_of(json.loads(row["blocks"]), row["side"])
        parts = parts_of(row["prompt"], baseline, digests)
        changes = [part for part in parts if part.changed or row["baseline"] is None]
        words = [(part.name, VALUES.sub(" ", "".join(t for _, t in part.pieces))) for part in parts]
        gist = changes if is_before else words
        same = [text for text in texts if (text["road"], text["gist"]) == (row["road"], gist)]
        if same:
            same[0]["sent"] += row["sent"]
            continue
        earlier = [text for text in texts if text["reader"] == row["reader"]]
        names = {part.name for text in earlier for part in text["parts"]}
        without = [_named(name) for name in sorted(names - {part.name for part in parts} - {""})]
        changed = [part for part in parts if part.changed]
        made = {"parts": parts, "changes": changed, "gist": gist, "without": without}
        texts.append(row | made)
    return by_variant


def differences(
    table: Table, chosen: Collection[str]
) -> tuple[dict[str, dict[str, dict[str, Any]]], dict[str, float]]:
    """Return each prompt's differences by driver, pair of prompts and measure, and axis ends.

    Each difference has its printed text, its mark and the names for a link to its trials. An axis
    ends at the same distance on both sides.
    """
    # A driver that is not judged has none.
    rows = [row for row in rows_of(table) if row.values.get("difference") is not None]
    ends = ends_of(rows)
    drivers: dict[str, dict[str, dict[str, Any]]] = {}
    for row in rows:
        driver, _, prompt = row.groups[0].rpartition("/")
        if unmarked(driver) not in chosen:
            continue
        compared = f"{prompt} against {row.values['reference']}"
        of_driver = drivers.setdefault(str(row.values["driver"]), {})
        of_driver.setdefault(compared, {})[row.metric] = {
            **printed(table, row),
            "row": row.id,
            "driver": driver,
            "prompt": prompt,
            "mark": difference_mark(row, ends[row.metric]),
        }
    return drivers, ends


def left_out(site: Site, variant: str) -> str:
    """Describe the blocks that a variant's prompt leaves out and adds, by name and meaning."""
    ((names,),) = map(dict.values, site.trial_index.ask(STORED, variant))
    if names is None:
        return f"of which {UNKNOWN}"
    baseline = frozenset(blocks_of(BASELINE))
    # A block of one driver's prompt alone has its side behind its name; a baseline's block is then
    # left out of the other driver's.
    blocks = frozenset(level_of(name.partition("@")[0]) for name in names) - baseline
    blocks |= baseline & frozenset(names)
    # The levels of words are in the variant's name already.
    changes = {"without": baseline - blocks, "with": blocks - baseline - {*variant.split(" ")}}
    texts = [f"{word} {', '.join(map(_named, sorted(of)))}" for word, of in changes.items() if of]
    return " and ".join(texts) or ("the whole prompt" if blocks == baseline else "")


def _named(block: str) -> str:
    """Return a block's name, with its meaning if that is known here."""
    meaning = block_meaning(block)
    return block if meaning == UNKNOWN else f"{block}: {meaning}"


def pairs_of(site: Site, driver: str, variant: str) -> tuple[list[Row], list[Row]]:
    """Return a variant's pairs of trials with the baseline, and those that ended otherwise."""
    pairs = site.trial_index.ask(PAIRS, WITHOUT_PROMPT, unmarked(driver), variant, BASELINE)
    return pairs, [pair for pair in pairs if pair["outcome"] != pair["base_outcome"]]


def discordant_page(site: Site, params: Mapping[str, str]) -> str:
    """Return the pairs of trials that ended otherwise with a variant than with the baseline."""
    driver, variant = params.get("model", ""), params.get("variant", "")
    if not driver or not variant:
        raise NotThere("/discordant needs model=MODEL and variant=VARIANT")
    pairs, differing = pairs_of(site, driver, variant)
    kinds = Counter((pair["base_outcome"], pair["outcome"]) for pair in differing)
    return site.render(
        "discordant.html",
        view="prompts",
        model=driver,
        variant=variant,
        left_out=left_out(site, variant),
        pairs=pairs,
        differing=differing,
        kinds=kinds.most_common(),
    )
