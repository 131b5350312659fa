"""Parts of the trials in an address: the scope of a page's numbers, and a list's filter."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from starlette.datastructures import QueryParams

from merge_runner.prompts.blocks import BASELINE, title_of
from merge_runner_analysis.web.listing import FACTOR
from merge_runner_analysis.web.phrases import called, ordered
from merge_runner_analysis.web.search import LONGEST_QUERY, MOST_TERMS
from merge_runner_analysis.web.site import SCOPE, NotThere, Site, TooMuch
from merge_runner_analysis.web.trial_index import FACETS, SORTS, Facets

# Marks that the analysis adds to names of drivers with several tasks, prompts or mock models.
MARKS = re.compile(r"( \[([0-9a-f]{8}|scripted)\])+$")

# Facets that may be chosen at once, and characters of their values. A longer filter is a fault
# within DuckDB, or the end of the process.
MOST_CHOSEN, LONGEST_VALUE = 30, 1_000
# Labels of facets that have another name in an address.
HEADINGS = {
    "sweep": "run",
    "run": "name of run",
    "who": "kind of driver",
    "model": "driver",
    "variant": "prompt",
    "condition": "start",
    "account": "why",
    "validity": "replies",
    "cause": "error",
}
# The question of each study in a database.
DESCRIPTIONS = """
SELECT config->>'$.description' AS description FROM sweeps
WHERE description <> '' GROUP BY ALL ORDER BY min(started_at)
"""


def descriptions_of(site: Site) -> list[str]:
    """Return the questions of the studies that were played, each once, the first one first."""
    return [row["description"] for row in site.trial_index.ask(DESCRIPTIONS)]


@dataclass(frozen=True, slots=True)
class Scope:
    """A part of the trials; what is empty leaves nothing out."""

    sweep: str = ""
    drivers: tuple[str, ...] = ()
    prompt: str = BASELINE
    condition: str = ""

    @property
    def filters(self) -> dict[str, Any]:
        """The trials of all its drivers, as a filter."""
        return {**self.trials(prompt=self.prompt), "model": self.drivers}

    @property
    def part(self) -> dict[str, str]:
        """The run and the condition that tables are of, as addresses of their cells have them."""
        return {"of_run": self.sweep, "of_condition": self.condition}

    def trials(self, driver: str = "", prompt: str = "") -> dict[str, Any]:
        """Return the filter of its trials, of a driver and a prompt or of all."""
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
    site: Site, params: Mapping[str, str], driver: str = "", *, any_prompt: bool = False
) -> Bar:
    """Return the scope in an address, with the choices of its form; raises NotThere.

    ``driver``: of this one alone. Unless it may be of ``any_prompt``, it has one.
    """
    rows = site.trial_index.ask(
        "SELECT DISTINCT model, variant, condition FROM listed WHERE who <> 'humans' ORDER BY ALL"
    )
    drivers = list(dict.fromkeys(row["model"] for row in rows))
    of_driver = [row for row in rows if not driver or row["model"] == unmarked(driver)]
    prompts = list(dict.fromkeys(row["variant"] for row in of_driver))
    conditions = ordered({row["condition"] for row in of_driver})
    sweeps = runs_of(site)
    usual = "" if any_prompt else next(iter(prompts), BASELINE)
    usual = BASELINE if usual and BASELINE in prompts else usual
    scope = Scope(
        _known("sweep", params.get("sweep", ""), sweeps),
        tuple(_known("driver", name, drivers) for name in every(params, "model")),
        _known("prompt", params.get("variant", "") or usual, [*prompts, usual]),
        _known("condition", params.get("condition", ""), conditions),
    )
    return Bar(
        scope,
        any_prompt,
        list(sweeps.items()),
        drivers,
        [(name, title_of(name)) for name in prompts],
        [(name, f"{name}: {site.trial_index.in_words(name)}") for name in conditions],
    )


def runs_of(site: Site) -> dict[str, str]:
    """Return the title of each run in a list to choose from, the newest first."""
    return {
        row["sweep_id"]: f"{called(row['name'], json.loads(row['config']))}, "
        f"{row['started_at']:%Y-%m-%d %H:%M} UTC"
        for row in site.trial_index.ask("FROM sweeps ORDER BY started_at DESC")
    }


def facets_shown(site: Site, facets: Facets) -> dict[str, list[tuple[str, Any]]]:
    """Return the values of facets to choose from, runs with their titles."""
    times = dict(facets["sweep"])
    runs = [(run, f"{text} ({times[run]})") for run, text in runs_of(site).items() if run in times]
    return {**facets, "sweep": runs}


def carried(params: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the scope in an address, as the addresses of other pages take it on."""
    return {name: values for name in SCOPE if (values := every(params, name))}


def filter_of(params: Mapping[str, str]) -> dict[str, str]:
    """Return the filter in an address; raises TooMuch."""
    filters = {
        name: value
        for name, value in params.items()
        if value and (name in {*FACETS, "q"} or name.startswith(FACTOR))
    }
    words = filters.get("q", "")
    if len(words) > LONGEST_QUERY or len(words.split()) > MOST_TERMS:
        raise TooMuch(
            f"a search has up to {MOST_TERMS} words and {LONGEST_QUERY} characters, this one "
            f"{len(words.split()):,} and {len(words):,}"
        )
    longest = max(map(len, params.values()), default=0)
    if len(filters) > MOST_CHOSEN or longest > LONGEST_VALUE:
        raise TooMuch(
            f"a filter has up to {MOST_CHOSEN} parts of up to {LONGEST_VALUE:,} characters, this "
            f"one {len(filters):,} of up to {longest:,}"
        )
    return filters


def sort_of(params: Mapping[str, str]) -> str:
    """Return the order in an address; by name, if it is unknown."""
    sort = params.get("sort", "trial")
    return sort if sort.removeprefix("-") in SORTS else "trial"


def unmarked(driver: str) -> str:
    """Return a driver's name in the list of trials, without the marks of a group.

    The levels of a study's factors, which stand in brackets too, are part of both names.
    """
    return MARKS.sub("", driver)


def every(params: Mapping[str, str], name: str) -> list[str]:
    """Return all values of one name in an address."""
    several = params.getlist(name) if isinstance(params, QueryParams) else [params.get(name, "")]
    return [value for value in several if value]


def _known(what: str, value: str, known: Collection[str]) -> str:
    if value and value not in known:
        raise NotThere(f"there is no {what} {value!r} here")
    return value
