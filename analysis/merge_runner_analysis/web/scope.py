"""What the numbers of a page are of: a sweep, drivers, a prompt and conditions, in its address."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from starlette.datastructures import QueryParams

from merge_runner.prompts.blocks import BASELINE, title_of
from merge_runner_analysis.web.catalogue import Facets
from merge_runner_analysis.web.phrases import called, ordered
from merge_runner_analysis.web.site import SCOPE, NotThere, Site

# What the analysis adds to the names of drivers that have several tasks, prompts or stand-ins.
MARKS = re.compile(r"( \[([0-9a-f]{8}|scripted)\])+$")

# Of each study that a database holds, the question that it asks.
DESCRIPTIONS = """
SELECT config->>'$.description' AS description FROM sweeps
WHERE description <> '' GROUP BY ALL ORDER BY min(started_at)
"""


def descriptions_of(site: Site) -> list[str]:
    """What the studies that were played ask, each once, the first one first."""
    return [row["description"] for row in site.catalogue.ask(DESCRIPTIONS)]


@dataclass(frozen=True, slots=True)
class Scope:
    """A part of the trials; what is empty leaves nothing out."""

    sweep: str = ""
    drivers: tuple[str, ...] = ()
    prompt: str = BASELINE
    condition: str = ""

    @property
    def wanted(self) -> dict[str, Any]:
        """The trials of all its drivers, as a filter."""
        return {**self.trials(prompt=self.prompt), "model": self.drivers}

    @property
    def part(self) -> dict[str, str]:
        """The run and the condition that tables are of, as addresses of their cells have them."""
        part = {"of_run": self.sweep, "of_condition": self.condition}
        return {name: value for name, value in part.items() if value}

    def trials(self, driver: str = "", prompt: str = "") -> dict[str, Any]:
        """Its trials of a driver and a prompt, or of all: a filter, and the address of a list."""
        return {"model": unmarked(driver), "variant": prompt,
                "sweep": self.sweep, "condition": self.condition}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Bar:
    """The form that sets a scope: (value, text) of each choice.

    ``any_prompt``: trials of all prompts may be seen together.
    """

    scope: Scope
    any_prompt: bool
    sweeps: list[tuple[str, str]]
    drivers: list[str]
    prompts: list[tuple[str, str]]
    conditions: list[tuple[str, str]]


def scope_of(
    site: Site, asked: Mapping[str, str], driver: str = "", *, any_prompt: bool = False
) -> Bar:
    """The scope that an address names, with what may be chosen; raises NotThere.

    ``driver``: of this one alone. Unless it may be of ``any_prompt``, it has one.
    """
    rows = site.catalogue.ask(
        "SELECT DISTINCT model, variant, condition FROM listed WHERE who <> 'humans' ORDER BY ALL"
    )
    drivers = list(dict.fromkeys(row["model"] for row in rows))
    own = [row for row in rows if not driver or row["model"] == unmarked(driver)]
    prompts = list(dict.fromkeys(row["variant"] for row in own))
    conditions = ordered({row["condition"] for row in own})
    sweeps = runs_of(site)
    usual = "" if any_prompt else next(iter(prompts), BASELINE)
    usual = BASELINE if usual and BASELINE in prompts else usual
    scope = Scope(
        _known("sweep", asked.get("sweep", ""), sweeps),
        tuple(_known("driver", name, drivers) for name in every(asked, "model")),
        _known("prompt", asked.get("variant", "") or usual, [*prompts, usual]),
        _known("condition", asked.get("condition", ""), conditions),
    )
    return Bar(
        scope,
        any_prompt,
        list(sweeps.items()),
        drivers,
        [(name, title_of(name)) for name in prompts],
        [(name, f"{name}: {site.in_words(name)}") for name in conditions],
    )


def runs_of(site: Site) -> dict[str, str]:
    """What each run is called in a list to choose from, the newest first."""
    return {
        row["sweep_id"]: f"{called(row['name'], json.loads(row['config']))}, "
        f"{row['started_at']:%Y-%m-%d %H:%M} UTC"
        for row in site.catalogue.ask("FROM sweeps ORDER BY started_at DESC")
    }


def facets_shown(site: Site, facets: Facets) -> dict[str, list[tuple[str, Any]]]:
    """The values of facets to choose from, of which runs have their names."""
    times = dict(facets["sweep"])
    runs = [(run, f"{text} ({times[run]})") for run, text in runs_of(site).items() if run in times]
    return {**facets, "sweep": runs}


def carried(asked: Mapping[str, str]) -> dict[str, list[str]]:
    """The scope in an address, as the addresses of other pages take it on."""
    return {name: values for name in SCOPE if (values := every(asked, name))}


def unmarked(driver: str) -> str:
    """The name by which the list of trials knows a driver, without the marks of a group.

    The levels of a study's factors, which stand in brackets too, are part of both names.
    """
    return MARKS.sub("", driver)


def every(asked: Mapping[str, str], name: str) -> list[str]:
    """All values of one name in an address."""
    several = asked.getlist(name) if isinstance(asked, QueryParams) else [asked.get(name, "")]
    return [value for value in several if value]


def _known(what: str, value: str, known: Collection[str]) -> str:
    if value and value not in known:
        raise NotThere(f"there is no {what} {value!r} here")
    return value
