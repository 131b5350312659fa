"""The study at a glance: the question, how its runs stand, and what its trials answer so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from merge_runner.audit.checks import not_judged
from merge_runner.study.crossing import PROMPT
from merge_runner_analysis.data.human_counts import human_counts, published_accounts
from merge_runner_analysis.data.studies import DESCRIPTIONS
from merge_runner_analysis.explorer.catalogue import FACTOR, Filter
from merge_runner_analysis.explorer.charts import Kind, drawn
from merge_runner_analysis.explorer.conditions import ordered
from merge_runner_analysis.explorer.pages.computed import Computed, computed
from merge_runner_analysis.explorer.pictures import marker
from merge_runner_analysis.explorer.reading import Row
from merge_runner_analysis.explorer.site import NotThere, Site, news_of
from merge_runner_analysis.explorer.sweeps import standing_of
from merge_runner_analysis.explorer.task_picture import task_picture
from merge_runner_analysis.explorer.urls import HOME
from merge_runner_analysis.metrics import GAP, LEFT_FIRST
from merge_runner_analysis.names import HUMAN
from merge_runner_analysis.tables.formats import notes_of, printed
from merge_runner_analysis.tables.model import Table, from_text

# More groups than these cannot be told apart in a picture.
DRAWN = 12
COUNTS = ("trials", "ended", "failed", "collided", "asked", "invalid", "cost_usd")
# What is published as one class of collisions, and the two that it holds.
SAME, SAME_ACTION = "same action", ("both insisted", "both gave way")
DRIVER_AND_PROMPT = "driver and prompt"
UNPRICED = "SELECT coalesce(sum(unpriced), 0)::BIGINT AS attempts FROM tried"


@dataclass(frozen=True, slots=True)
class Played:
    """What the trials of a group come to, by condition mostly; ``state`` is their filter."""

    label: str
    who: str
    state: dict[str, str]
    stand_in: str = ""
    cells: dict[str, Row] = field(default_factory=dict)

    @property
    def total(self) -> dict[str, Any]:
        """The counts over all conditions."""
        return {name: sum(cell[name] for cell in self.cells.values()) for name in COUNTS}

    @property
    def unjudged(self) -> str:
        """Why nothing is concluded from its trials; empty where something is."""
        total = self.total
        return not_judged(self.label, total["invalid"], total["asked"])

    def share(self, condition: str) -> float:
        """How many of the trials that ended collided; -1 where none ended."""
        cell = self.cells.get(condition)
        return cell["collided"] / cell["ended"] if cell and cell["ended"] else -1.0


def home_page(site: Site, asked: Mapping[str, str]) -> str:
    """The study; raises NotThere, and NothingNew where nothing is new since it was ``seen``."""
    standing = standing_of(site.catalogue)
    seen = news_of((standing, site.catalogue.state(), site.catalogue.held), asked.get("seen", ""))
    given = {name: value for name, value in asked.items() if name != "seen"}
    by, ways = asked.get("by", ""), groupings(site)
    if by not in ways:
        raise NotThere(f"trials are grouped by {', '.join([DRIVER_AND_PROMPT, *ways[1:]])}")
    groups = groups_of(site, by)
    humans = site.catalogue.counts(Filter(who="humans"), "condition")
    imported = sum(row["trials"] for row in humans)
    panels = computed(site, ("home", by, str(imported)), given, wait_s=0.0)
    verdicts = computed(site, ("tables", "indicators"), given, wait_s=0.0)
    (unpriced,) = site.catalogue.ask(UNPRICED)
    descriptions = site.catalogue.ask(DESCRIPTIONS)
    return site.render(
        "home.html",
        here="index",
        standing=standing,
        seen=seen,
        by=by,
        choices=[(way or DRIVER_AND_PROMPT, site.at.to(HOME, by=way), way == by) for way in ways],
        task=task_picture(site.catalogue),
        groups=groups,
        first=ranking(groups),
        humans=(published := human_cells(humans)),
        rows=(rows := worst_first(groups)),
        beside=_sum_of([published[row["name"]] for row in rows if row["name"] in published]),
        accounts=account_rows(
            _grouped(site, by, Filter(outcome="collided"), "account"), published_accounts()
        ),
        unpriced=unpriced["attempts"],
        description="; ".join(row["description"] for row in descriptions),
        panels=panels,
        charts=_charts(site, panels),
        verdicts=verdicts,
        indicators=_indicators(site, verdicts),
        path=marker,
    )


def groupings(site: Site) -> list[str]:
    """By what trials are grouped: driver and prompt (empty), or by a factor if anything varies."""
    factors = site.catalogue.factors()
    (prompts,) = site.catalogue.ask(
        "SELECT count(DISTINCT variant) AS n FROM listed WHERE who <> 'humans'"
    )
    return ["", PROMPT, *factors] if factors or prompts["n"] > 1 else [""]


def groups_of(site: Site, by: str) -> list[Played]:
    """Drivers and prompts, or the levels of a factor; before several their sum."""
    found = [group for group in _grouped(site, by, Filter()) if group.who != "humans"]
    # What is concluded from a part of them alone is no sum.
    whole = [] if any(group.unjudged for group in found) else _sums(site, found)
    return [*whole, *found]


def _grouped(site: Site, by: str, wanted: Filter, cell: str = "condition") -> list[Played]:
    """The trials of a filter in the groups ``by``, each by its conditions or another column."""
    factor = by if by not in {"", PROMPT} else ""
    names = ("level",) if factor else ("variant",) if by else ("model", "variant")
    found: dict[tuple[str, ...], Played] = {}
    for row in site.catalogue.counts(wanted, *names, "who", cell, factor=factor):
        levels = {name: row[name] or "" for name in names}
        state = {f"{FACTOR}{by}" if name == "level" else name: v for name, v in levels.items()}
        label = ", ".join(filter(None, levels.values()))
        new = Played(label, row["who"], {"who": row["who"], **state}, row["stand_in"] or "")
        found.setdefault((row["who"], *levels.values()), new).cells[row[cell]] = row
    return list(found.values())


def _sums(site: Site, groups: Sequence[Played]) -> list[Played]:
    """All trials of drivers, and all of stand-ins, where they are several groups."""
    sums = []
    for who in ("drivers", "stand-ins"):
        if sum(group.who == who for group in groups) > 1:
            rows = site.catalogue.counts(Filter(who=who), "condition")
            cells = {row["condition"]: row for row in rows}
            whole = Played(f"all {who}", who, {"who": who}, cells=cells)
            sums.append(whole)
    return sums


def human_cells(imported: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """The published human collisions by condition; ``there``: all of its trials are imported."""
    listed = {row["condition"]: row for row in imported}
    return {
        name: {
            "collided": of.collided,
            "ended": of.trials,
            "there": name in listed
            and (listed[name]["collided"], listed[name]["ended"]) == (of.collided, of.trials),
        }
        for name, of in human_counts().items()
    }


def _sum_of(cells: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """The humans of all conditions that were played."""
    return {name: sum(cell[name] for cell in cells) for name in ("collided", "ended")}


def ranking(groups: Sequence[Played]) -> Played | None:
    """The group by which conditions are ordered: the first that collided, if any did."""
    judged = [group for group in groups if not group.unjudged]
    return next((group for group in judged if group.total["collided"]), next(iter(judged), None))


def worst_first(groups: Sequence[Played]) -> list[dict[str, Any]]:
    """The conditions by the share of collisions of the ranking group."""
    first = ranking(groups)
    if first is None:
        return []
    names = ordered({name for group in groups for name in group.cells})
    names.sort(key=first.share, reverse=True)
    most = max(map(first.share, names), default=0.0)
    return [
        {
            "name": name,
            "share": first.share(name),
            "width": round(100 * first.share(name) / most, 1) if most > 0 else 0.0,
        }
        for name in names
    ]


def _charts(site: Site, found: Computed) -> dict[str, Any] | None:
    """Who goes first and the gap, beside the humans."""
    if found.result is None:
        return None
    content = found.result.content
    rest = {name: content[name] for name in ("caveat", "outcomes_from", "published_trials")}
    return rest | drawn(site.at, content, [Kind(LEFT_FIRST), Kind(GAP)], DRAWN)


def _indicators(site: Site, found: Computed) -> dict[str, Any] | None:
    """Table V by driver: each verdict with the share of human data sets that pass."""
    if found.result is None:
        return None
    table = from_text(found.result.content["tables"][0])
    return {**verdicts_of(site, table), "notes": notes_of(table)}


def verdicts_of(site: Site, table: Table) -> dict[str, Any]:
    """What Table V judges: its indicators, and by driver each verdict as printed.

    ``ceiling`` is the share of human data sets that pass, ``link`` leads to the trials.
    """
    drivers: dict[str, dict[str, Any]] = {}
    for row in table.rows:
        if row.values.get("paper") is None and row.values.get("robust") is None:
            continue
        said = printed(table, row)
        drivers.setdefault(str(row.values["driver"]), {})[str(row.values["indicator"])] = {
            "paper": said["paper"],
            "robust": said["robust"]
            if row.values.get("differ") or row.values.get("paper") is None
            else "",
            "ceiling": "" if row.values.get("ceiling_paper") is None else said["ceiling_paper"],
            "link": site.at.cell(table.name, row.id, "n") if row.groups != (HUMAN,) else "",
            "note": row.note,
        }
    names = dict.fromkeys(name for cells in drivers.values() for name in cells)
    return {"names": list(names), "drivers": drivers}


def account_rows(
    groups: Sequence[Played], published: Mapping[str, Mapping[str, int]]
) -> dict[str, Any] | None:
    """The classes of collisions of groups, which count them, and as published; None without any.

    What is published does not tell the first two apart: they are ``same``.
    """
    there = [group for group in groups if any(group.cells)]
    if not there:
        return None
    told = [name for of in published.values() for name in of if name != SAME]
    found = [name for group in there for name in group.cells if name]
    return {
        "groups": there,
        "classes": list(dict.fromkeys([*SAME_ACTION, *told, *found])),
        "published": published,
        "same": {who: of[SAME] for who, of in published.items()},
    }
