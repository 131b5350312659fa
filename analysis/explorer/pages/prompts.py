"""Prompts: what each says otherwise than the baseline, and what that does, driver by driver."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from merge_runner.prompts.blocks import VARIANTS, Variant, blocks_of
from merge_runner_analysis.explorer import views
from merge_runner_analysis.explorer.marks import Mark
from merge_runner_analysis.explorer.pages.computed import computed_table
from merge_runner_analysis.explorer.pages.home import (
    Driver,
    drivers_of,
    humans_of,
    verdicts_of,
)
from merge_runner_analysis.explorer.prompts import Part, parts_of
from merge_runner_analysis.explorer.reading import Row, reading, records
from merge_runner_analysis.explorer.scope import carried, scope_of, unmarked
from merge_runner_analysis.explorer.site import NotThere, Site
from merge_runner_analysis.metrics import COLLISIONS
from merge_runner_analysis.names import BASELINE
from merge_runner_analysis.tables import model
from merge_runner_analysis.tables.formats import printed
from merge_runner_analysis.verdict_words import MEASURES

# The blocks of each prompt, as its spec names them; a program has none.
STORED = """
SELECT variant, any_value(names) AS names FROM listed JOIN (
    SELECT spec_hash, json_keys(spec, '$.prompt_blocks') AS names FROM specs
) USING (spec_hash) WHERE len(names) > 0 GROUP BY ALL
"""
# What each variant asks first: of all of them in the same condition, as far as that was played.
FIRST = """
SELECT variant, arg_min(prompt, (condition, decisions.side, trial_id)) AS prompt
FROM decisions JOIN trials USING (trial_id, spec_hash)
WHERE decision = 0 AND prompt IS NOT NULL GROUP BY variant ORDER BY variant <> ?, variant
"""


@dataclass(frozen=True, slots=True)
class Prompt:
    """A variant's first prompt in parts, each beside the baseline's; ``gone`` are only in that."""

    name: str
    parts: list[Part]
    gone: list[Part]


@dataclass(frozen=True, slots=True)
class PromptDifference:
    """A difference from the reference: its row in the table, as printed there, and its mark."""

    row: str
    driver: str
    prompt: str
    printed: Mapping[str, str]
    mark: Mark


def prompts_page(site: Site, asked: Mapping[str, str]) -> str:
    """All prompts side by side, and the differences that they make."""
    bar = scope_of(site, asked)
    found, table = computed_table(site, "contrasts", asked, bar.scope.sweep, bar.scope.condition)
    chosen = bar.scope.drivers or bar.drivers
    judged, verdicts = verdicts_of(site, bar.scope, asked)
    driven = [one for one in drivers_of(site, verdicts, bar.scope) if unmarked(one.name) in chosen]
    return site.render(
        "prompts.html",
        here="prompts",
        bar=bar,
        carried=carried(asked),
        computed=found,
        prompts=_prompts(site),
        left_out=partial(left_out, site),
        drivers=differences(table, chosen) if table else {},
        widest=_widest(table.rows) if table else {},
        collisions=COLLISIONS.name,
        table=table,
        judged=judged,
        verdicts=verdicts,
        measures=MEASURES,
        human=humans_of(verdicts),
        slopes=_with_several_prompts(driven),
    )


def _with_several_prompts(driven: Iterable[Driver]) -> dict[str, list[Driver]]:
    """Drivers that were played with several prompts, each with all of them, the baseline first."""
    by_name: dict[str, list[Driver]] = {}
    for one in sorted(driven, key=lambda one: one.prompt != BASELINE):
        by_name.setdefault(one.name, []).append(one)
    return {name: of for name, of in sorted(by_name.items()) if len(of) > 1}


def differences(
    table: model.Table, chosen: Collection[str]
) -> dict[str, dict[str, dict[str, PromptDifference]]]:
    """What each prompt changes, by driver of these, by both prompts, and by measure."""
    widest = _widest(table.rows)
    drivers: dict[str, dict[str, dict[str, PromptDifference]]] = {}
    for row in filter(_is_compared, table.rows):
        prompt = str(row.values["setting"])
        shown = PromptDifference(
            row.id,
            row.groups[0].removesuffix(f"/{prompt}"),
            prompt,
            printed(table, row),
            _mark(row, widest[_measure(row)]),
        )
        if unmarked(shown.driver) not in chosen:
            continue
        of_driver = drivers.setdefault(str(row.values["driver"]), {})
        compared = f"{prompt} against {row.values['reference']}"
        of_driver.setdefault(compared, {})[_measure(row)] = shown
    return drivers


def _is_compared(row: model.Row) -> bool:
    return row.values.get("difference") is not None  # a driver that is not judged has none


def _prompts(site: Site) -> list[Prompt]:
    with reading(site.db) as connection:
        texts = {row["variant"]: row["prompt"] for row in records(connection, FIRST, [BASELINE])}
    baseline = texts.get(BASELINE)
    whole = parts_of(baseline, None) if baseline else []
    prompts = []
    for name, text in texts.items():
        parts = parts_of(text, baseline)
        own = {part.name for part in parts}
        prompts.append(Prompt(name, parts, [part for part in whole if part.name not in own]))
    return prompts


def _measure(row: model.Row) -> str:
    return row.id.rpartition("/")[2]


def _widest(rows: Iterable[model.Row]) -> dict[str, float]:
    """The end of each measure's axis, on both sides of 0, in its unit."""
    found: dict[str, float] = {}
    for row in filter(_is_compared, rows):
        ends = map(abs, (_number(row.values["difference"]), *_interval(row)))
        found[_measure(row)] = max(found.get(_measure(row), 0.0), *ends)
    return found


def _number(value: model.Value) -> float:
    assert isinstance(value, float | int)
    return float(value)


def _interval(row: model.Row) -> tuple[float, ...]:
    limits = row.values.get("ci")
    return limits if isinstance(limits, tuple) else ()


def _mark(row: model.Row, widest: float) -> Mark:
    """Where a difference lies, 0 in the middle; filled where its interval leaves out 0."""

    def place(value: float) -> float:
        return round(50 + 48 * value / (widest or 1.0), 2)

    limits = _interval(row)
    apart = bool(limits) and (limits[0] > 0 or limits[1] < 0)
    ends = (place(limits[0]), place(limits[1])) if limits else None
    return Mark("like" if apart else "open", place(_number(row.values["difference"])), ends)


def left_out(site: Site, variant: str) -> str:
    """What a variant's prompt leaves out and adds, by name and meaning."""
    known = VARIANTS.get(variant) or _as_stored(site, variant)
    if known is None:
        return f"of which {views.UNKNOWN}"
    return views.changes_text(known, _named) or "the whole prompt"


def _named(block: str) -> str:
    """A block with what it means, if that is known here."""
    meaning = views.block_meaning(block)
    return block if meaning == views.UNKNOWN else f"{block}: {meaning}"


def _as_stored(site: Site, variant: str) -> Variant | None:
    """What a variant that is not registered here changes, by the blocks that its specs name."""
    stored = {row["variant"]: row["names"] for row in site.catalogue.ask(STORED)}
    if variant not in stored:
        return None
    own, baseline = frozenset(stored[variant]), frozenset(blocks_of(BASELINE))
    return Variant(removes=baseline - own, adds=own - baseline)


def discordant_page(site: Site, asked: Mapping[str, str]) -> str:
    """The pairs of trials that ended otherwise with a variant than with the baseline."""
    driver, variant = asked.get("model", ""), asked.get("variant", "")
    if not driver or not variant:
        raise NotThere("/discordant needs model=MODEL and variant=VARIANT")
    pairs = of_equal_tasks(site, site.catalogue.pairs(unmarked(driver), variant))
    differing = [pair for pair in pairs if pair["outcome"] != pair["base_outcome"]]
    kinds = Counter((pair["base_outcome"], pair["outcome"]) for pair in differing)
    return site.render(
        "discordant.html",
        here="prompts",
        model=driver,
        variant=variant,
        left_out=left_out(site, variant),
        pairs=pairs,
        differing=differing,
        kinds=kinds.most_common(),
    )


def of_equal_tasks(site: Site, pairs: list[Row]) -> list[Row]:
    """The pairs whose two specs differ in nothing but the prompt."""
    specs = site.catalogue.ask("SELECT spec_hash, spec FROM specs")
    tasks = {row["spec_hash"]: _task(row["spec"]) for row in specs}
    return [pair for pair in pairs if tasks.get(pair["spec_hash"]) == tasks.get(pair["base_hash"])]


def _task(spec: str) -> str:
    told: dict[str, Any] = json.loads(spec)
    told.pop("prompt_blocks", None)
    return json.dumps(told, sort_keys=True)
