"""What leaving out a part of the prompt does: variants beside the baseline, measure by measure."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from merge_runner.prompts.blocks import VARIANTS, Variant, blocks_of
from merge_runner_analysis.explorer import views
from merge_runner_analysis.explorer.catalogue import Filter
from merge_runner_analysis.explorer.pages.computed import computed
from merge_runner_analysis.explorer.pictures import Scale, marker
from merge_runner_analysis.explorer.site import NotThere, Site
from merge_runner_analysis.metrics import COLLISIONS
from merge_runner_analysis.metrics import JOINT as JOINT_RATE
from merge_runner_analysis.names import BASELINE
from merge_runner_analysis.tables.formats import printed, shown_value
from merge_runner_analysis.tables.model import Column, Row, Table, Value, from_text

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
    """A variant's difference from the baseline, for its picture, and its row as printed."""

    value: float
    limits: tuple[float, float] | None
    printed: Mapping[str, str]

    @property
    def ends(self) -> tuple[float, float]:
        """Those of its interval; without one, itself."""
        return self.limits or (self.value, self.value)

    @property
    def apart(self) -> bool:
        """Whether the interval leaves out 0."""
        return self.limits is not None and (self.limits[0] > 0 or self.limits[1] < 0)

    @property
    def text(self) -> str:
        """As printed, with its sign."""
        text = self.printed["difference"]
        return f"+{text}" if self.value > 0 and float(text) != 0 else text


@dataclass(frozen=True, slots=True)
class Estimate:
    """One measure of a variant: its estimate with interval and n, and its difference."""

    measure: str
    row: str
    estimate: str
    interval: str
    n: Value
    difference: BaselineDifference | None


@dataclass(frozen=True, slots=True)
class DriverVariants:
    """A driver's variants, the baseline first; ``label`` is how the driver is shown."""

    name: str
    label: str
    variants: dict[str, list[Estimate]]

    def place(self, cell: Estimate) -> list[float]:
        """Where a difference and its ends lie in a picture of WIDTH, 0 in its middle."""
        assert cell.difference is not None
        drawn = [
            abs(end)
            for cells in self.variants.values()
            for other in cells
            if other.measure == cell.measure and other.difference is not None
            for end in (other.difference.value, *other.difference.ends)
        ]
        widest = max(drawn) or 1.0  # where all are 0 any range shows them
        x = Scale(-widest, widest, 0.03 * WIDTH, 0.97 * WIDTH)
        low, high = cell.difference.ends
        return [round(x(value), 1) for value in (low, cell.difference.value, high)]


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
            "notes": [*dict.fromkeys((*quantitative.notes, *contrasts.notes))],
        }
    return site.render(
        "ablations.html",
        here="ablations",
        computed=found,
        left_out=partial(left_out, site),
        fates=FATES,
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
        if row.values.get("reference") == BASELINE  # a driver that is not judged has none
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
    n = row.values.get("n") if column.name == COLLISIONS.name else n
    return Estimate(
        column.name,
        row.id,
        shown_value(column, row.values.get(column.name)),
        shown_value(interval, limits) if limits is not None else "",
        n,
        _difference(contrasts, found) if found is not None else None,
    )


def _difference(contrasts: Table, row: Row) -> BaselineDifference:
    value, limits = row.values["difference"], row.values.get("ci")
    assert isinstance(value, float)
    return BaselineDifference(
        value, limits if isinstance(limits, tuple) else None, printed(contrasts, row)
    )


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
