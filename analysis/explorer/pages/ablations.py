"""What leaving out a part of the prompt does: variants beside the baseline, measure by measure."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from analysis.explorer import views
from analysis.explorer.catalogue import Filter
from analysis.explorer.pages.computed import computed
from analysis.explorer.pictures import Scale, marker
from analysis.explorer.site import NotThere, Site
from analysis.metrics import COLLISIONS
from analysis.metrics import JOINT as JOINT_RATE
from analysis.tables.formats import shown_value
from analysis.tables.model import Column, Row, Table, Value, from_text
from merge_runner.prompts.blocks import VARIANTS, Variant, blocks_of

BASELINE = "baseline"
# The blocks of each prompt, as its spec names them; a program has none.
STORED = """
SELECT variant, any_value(names) AS names FROM listed JOIN (
    SELECT spec_hash, json_keys(spec, '$.prompt_blocks') AS names FROM specs
) USING (spec_hash) WHERE len(names) > 0 GROUP BY ALL
"""
# Rates are decided trial by trial, so that single trials differ: by these columns.
FATES = {COLLISIONS.name: "outcome", JOINT_RATE.name: "joint"}
JOINT = {True: "joint", False: "not joint"}
# The value of the column that a rate counts.
COUNTED: dict[str, str | bool] = {"outcome": "collided", "joint": True}
# The width of the picture of a difference.
WIDTH = 120.0


@dataclass(frozen=True, slots=True)
class BaselineDifference:
    """A variant's difference from the baseline: texts, and numbers for its picture."""

    value: float
    low: float | None
    high: float | None
    text: str
    interval: str
    p_holm: str
    p_bh: str

    @property
    def apart(self) -> bool:
        """Whether the interval leaves out 0."""
        return self.low is not None and self.high is not None and (self.low > 0 or self.high < 0)


@dataclass(frozen=True, slots=True)
class Estimate:
    """One measure of a variant: its estimate with interval and n, and its difference."""

    measure: str
    row: str
    estimate: str
    interval: str
    n: int | None
    difference: BaselineDifference | None


@dataclass(frozen=True, slots=True)
class DriverVariants:
    """A driver's variants, the baseline first; ``widest`` by measure: the picture's half range.

    ``label`` is how the driver is shown.
    """

    name: str
    label: str
    variants: dict[str, list[Estimate]]
    widest: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RateTrials:
    """The trials of a variant, those of them that count in the rate, and those in no pair."""

    variant: str
    trials: int
    counted: int
    alone: int
    counted_alone: list[dict[str, Any]]


def ablations_page(site: Site, asked: Mapping[str, str]) -> str:
    """All drivers with their variants."""
    found = computed(site, ("tables", "ablation-quantitative", "contrasts"), asked)
    values: dict[str, Any] = {"drivers": [], "alone": [], "measures": [], "notes": ()}
    if found.result is not None:
        quantitative, contrasts = map(from_text, found.result.content["tables"])
        drivers = ablations(quantitative, contrasts)
        values = {
            "drivers": [d for d in drivers if set(d.variants) - {BASELINE}],
            "alone": [d.label for d in drivers if not set(d.variants) - {BASELINE}],
            "measures": measures(quantitative),
            "notes": contrasts.notes,
        }
    return site.render(
        "ablations.html",
        here="ablations",
        computed=found,
        left_out=partial(left_out, site),
        fates=FATES,
        bar=bar,
        path=marker,
        width=WIDTH,
        **values,
    )


def left_out(site: Site, variant: str) -> str:
    """What a variant's prompt leaves out and adds, by name and meaning."""
    known = VARIANTS.get(variant) or _as_stored(site, variant)
    if known is None:
        return f"of which {views.UNKNOWN}"
    changes = views.changes_text(known, lambda name: f"{name}: {views.block_meaning(name)}")
    return changes or "the whole prompt"


def _as_stored(site: Site, variant: str) -> Variant | None:
    """What a variant that is not registered here changes, by the blocks that its specs name."""
    stored = {row["variant"]: row["names"] for row in site.catalogue.ask(STORED)}
    if variant not in stored:
        return None
    own, baseline = frozenset(stored[variant]), frozenset(blocks_of(BASELINE))
    return Variant(removes=baseline - own, adds=own - baseline)


def measures(quantitative: Table) -> list[Column]:
    """The columns of Table VII that are measures: those with an interval beside them."""
    names = {column.name for column in quantitative.columns}
    return [column for column in quantitative.columns if f"{column.name}_ci" in names]


def ablations(quantitative: Table, contrasts: Table) -> list[DriverVariants]:
    """Every driver's variants, from the two tables that say what there is to say of them."""
    compared = {row.id: row for row in contrasts.rows}
    # The baseline's n stands beside every difference from it.
    of_baseline = {
        (row.groups[1], row.id.rpartition("/")[2]): row.values["n_reference"]
        for row in contrasts.rows
        if row.values["reference"] == BASELINE
    }
    drivers: dict[str, DriverVariants] = {}
    for row in quantitative.rows:
        setting = str(row.values["setting"])
        name = row.groups[0].removesuffix(f"/{setting}")
        if setting:
            variants = drivers.setdefault(
                name, DriverVariants(name, str(row.values["driver"]), {})
            ).variants
            variants[setting] = [
                _cell(quantitative, contrasts, row, column, compared, of_baseline)
                for column in measures(quantitative)
            ]
    for driver in drivers.values():
        _reach(driver)
    return list(drivers.values())


def _cell(
    quantitative: Table,
    contrasts: Table,
    row: Row,
    column: Column,
    compared: Mapping[str, Row],
    of_baseline: Mapping[tuple[str, str], Value],
) -> Estimate:
    found = compared.get(f"{row.id}/baseline/{column.name}")
    interval = next(c for c in quantitative.columns if c.name == f"{column.name}_ci")
    limits = row.values.get(interval.name)
    n = of_baseline.get((row.id, column.name)) if found is None else found.values["n"]
    # Collisions are counted over all that ended, which is the n of the row.
    n = row.values["n"] if column.name == COLLISIONS.name else n
    return Estimate(
        column.name,
        row.id,
        shown_value(column, row.values.get(column.name)),
        shown_value(interval, limits) if limits is not None else "",
        n if isinstance(n, int) else None,
        _difference(contrasts, found) if found is not None else None,
    )


def _reach(driver: DriverVariants) -> None:
    """How far the differences of each measure reach, with their intervals."""
    for i, measure in enumerate(cell.measure for cell in next(iter(driver.variants.values()))):
        found = [cells[i].difference for cells in driver.variants.values()]
        reach = [
            abs(limit)
            for difference in found
            if difference is not None
            for limit in (difference.value, difference.low, difference.high)
            if limit is not None
        ]
        # Where all differences are 0 any range shows them.
        driver.widest[measure] = max(reach, default=0.0) or 1.0


def _difference(contrasts: Table, row: Row) -> BaselineDifference:
    columns = {column.name: column for column in contrasts.columns}
    value, limits = row.values["difference"], row.values.get("ci")
    assert isinstance(value, float)
    low, high = limits if isinstance(limits, tuple) else (None, None)
    text = shown_value(columns["difference"], value)
    return BaselineDifference(
        value,
        low,
        high,
        f"+{text}" if value > 0 and float(text) != 0 else text,
        shown_value(columns["ci"], limits) if limits is not None else "",
        shown_value(columns["p_holm"], row.values["p_holm"]),
        shown_value(columns["p_bh"], row.values["p_bh"]),
    )


def bar(difference: BaselineDifference, widest: float) -> dict[str, float]:
    """Where a difference and its ends lie in a picture of ``WIDTH``, 0 in its middle."""
    margin = 0.03 * WIDTH
    x = Scale(-widest, widest, margin, WIDTH - margin)
    low = difference.value if difference.low is None else difference.low
    high = difference.value if difference.high is None else difference.high
    return {
        name: round(x(value), 1)
        for name, value in (("low", low), ("at", difference.value), ("high", high))
    }


def discordant_page(site: Site, asked: Mapping[str, str]) -> str:
    """The pairs of trials that ended otherwise with a variant than with the baseline."""
    model, variant = asked.get("model", ""), asked.get("variant", "")
    fate = asked.get("by", "outcome")
    if fate not in FATES.values():
        raise NotThere(f"pairs differ by {' or '.join(FATES.values())}")
    if not model or not variant:
        raise NotThere("/discordant needs model=MODEL and variant=VARIANT")
    # Tables mark the name of a driver that ran under several settings; its trials have no mark.
    name, found = model, site.catalogue.pairs(model, variant, fate)
    if not found:
        name = model.partition(" [")[0]
        found = site.catalogue.pairs(name, variant, fate)
    pairs = of_equal_tasks(site, found)
    own = {(pair["trial_id"], pair["spec_hash"]) for pair in pairs}
    base = {(pair["base_id"], pair["base_hash"]) for pair in pairs}
    differing = [pair for pair in pairs if pair["fate"] != pair["base_fate"]]
    kinds = Counter((_fate(pair["base_fate"]), _fate(pair["fate"])) for pair in differing)
    return site.render(
        "discordant.html",
        here="ablations",
        model=model,
        name=name,
        variant=variant,
        left_out=left_out(site, variant),
        by=fate,
        said=_fate,
        pairs=pairs,
        differing=differing,
        counted=_fate(COUNTED[fate]),
        sides=[side_of(site, name, BASELINE, fate, base), side_of(site, name, variant, fate, own)],
        kinds=sorted(kinds.items(), key=lambda item: (-item[1], item[0])),
        settings=sorted({(pair["spec_hash"], pair["base_hash"]) for pair in pairs}),
    )


def side_of(
    site: Site, model: str, variant: str, fate: str, paired: Collection[tuple[str, str]]
) -> RateTrials:
    """What a rate counts on one side, and what of it is in none of the pairs."""
    trials = [
        row
        for row in site.catalogue.every(Filter(model=model, variant=variant))
        if row["status"] != "failed" and row[fate] is not None
    ]
    alone = [row for row in trials if (row["trial_id"], row["spec_hash"]) not in paired]
    counted, counted_alone = (
        [row for row in rows if row[fate] == COUNTED[fate]] for rows in (trials, alone)
    )
    return RateTrials(variant, len(trials), len(counted), len(alone), counted_alone)


def of_equal_tasks(site: Site, pairs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The pairs whose two specs differ in nothing but the prompt."""
    specs = site.catalogue.ask("SELECT spec_hash, spec FROM specs")
    tasks = {row["spec_hash"]: _task(row["spec"]) for row in specs}
    return [pair for pair in pairs if tasks.get(pair["spec_hash"]) == tasks.get(pair["base_hash"])]


def _task(spec: str) -> str:
    told = json.loads(spec)
    told.pop("prompt_blocks", None)
    return json.dumps(told, sort_keys=True)


def _fate(value: str | bool) -> str:
    return JOINT[value] if isinstance(value, bool) else value
