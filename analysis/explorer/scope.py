"""What the numbers of a page are of: a sweep, drivers, a prompt and conditions, in its address."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from starlette.datastructures import QueryParams

from merge_runner.prompts.blocks import title_of
from merge_runner_analysis.explorer.catalogue import Filter
from merge_runner_analysis.explorer.conditions import ordered
from merge_runner_analysis.explorer.site import NotThere, Site
from merge_runner_analysis.names import BASELINE

# The number of trials of each run, driver, prompt and condition; each once for its prompt.
OFFERED = """
SELECT DISTINCT model, variant, condition FROM listed WHERE who <> 'humans' ORDER BY ALL
"""
# What the analysis adds to the names of drivers that have several tasks, prompts or stand-ins.
MARKS = re.compile(r"( \[([0-9a-f]{8}|scripted)\])+$")
SWEEPS = "SELECT sweep_id, name, started_at FROM sweeps ORDER BY started_at DESC"


@dataclass(frozen=True, slots=True)
class Scope:
    """A part of the trials; what is empty leaves nothing out, and there is always one prompt."""

    sweep: str = ""
    drivers: tuple[str, ...] = ()
    prompt: str = BASELINE
    condition: str = ""

    @property
    def state(self) -> dict[str, str]:
        """Sweep and condition as an address has them."""
        return {"sweep": self.sweep, "condition": self.condition}

    def filter(self, driver: str = "", prompt: str = "", outcome: str = "") -> Filter:
        """Its trials of a driver and a prompt, or of all."""
        return Filter(
            sweep=self.sweep,
            condition=self.condition,
            model=unmarked(driver),
            variant=prompt,
            outcome=outcome,
        )

    def trials(self, driver: str, prompt: str) -> dict[str, str]:
        """A driver's trials with a prompt, as the list of trials filters them."""
        return {"model": unmarked(driver), "variant": prompt, **self.state}


@dataclass(frozen=True, slots=True)
class Bar:
    """The form that sets a scope: (value, text) of each choice."""

    scope: Scope
    sweeps: list[tuple[str, str]]
    drivers: list[str]
    prompts: list[tuple[str, str]]
    conditions: list[tuple[str, str]]


def scope_of(site: Site, asked: Mapping[str, str], driver: str = "") -> Bar:
    """The scope that an address names, with what may be chosen; raises NotThere.

    ``driver``: of this one alone.
    """
    rows = site.catalogue.ask(OFFERED)
    drivers = list(dict.fromkeys(row["model"] for row in rows))
    own = [row for row in rows if not driver or row["model"] == unmarked(driver)]
    prompts = list(dict.fromkeys(row["variant"] for row in own))
    conditions = ordered({row["condition"] for row in own})
    sweeps = {
        row["sweep_id"]: f"{row['name']}, {row['started_at']:%Y-%m-%d %H:%M} UTC"
        for row in site.catalogue.ask(SWEEPS)
    }
    usual = BASELINE if BASELINE in prompts else next(iter(prompts), BASELINE)
    scope = Scope(
        _known("sweep", asked.get("sweep", ""), sweeps),
        tuple(_known("driver", name, drivers) for name in _every(asked, "driver")),
        _known("prompt", asked.get("prompt", "") or usual, [*prompts, usual]),
        _known("condition", asked.get("condition", ""), conditions),
    )
    return Bar(
        scope,
        list(sweeps.items()),
        drivers,
        [(name, title_of(name)) for name in prompts],
        [(name, f"{name}: {site.in_words(name)}") for name in conditions],
    )


def unmarked(driver: str) -> str:
    """The name by which the list of trials knows a driver, without the marks of a group.

    The levels of a study's factors, which stand in brackets too, are part of both names.
    """
    return MARKS.sub("", driver)


def _every(asked: Mapping[str, str], name: str) -> list[str]:
    """All values of one name in an address."""
    several = asked.getlist(name) if isinstance(asked, QueryParams) else [asked.get(name, "")]
    return [value for value in several if value]


def _known(what: str, value: str, known: Collection[str]) -> str:
    if value and value not in known:
        raise NotThere(f"there is no {what} {value!r} here")
    return value
