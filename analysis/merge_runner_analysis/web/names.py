"""Meanings of the names on a page: programs, servers, pairs, settings, sample sets."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from inspect import getdoc
from typing import Any

from merge_runner.driver_names import without_endpoint
from merge_runner.drivers.registry import EMULATOR, PROGRAMS
from merge_runner.records import SIDES

# The programs that drove in the trials of a database, as their specs have them.
PLAYED = """
SELECT DISTINCT side->>'$.program' AS program, side->>'$.based_on' AS based_on,
    (SELECT list(DISTINCT config->>'$.study.plugins') FROM sweeps) AS plugins
FROM (SELECT unnest([spec->'$.left', spec->'$.right']) AS side FROM specs SEMI JOIN listed
    USING (spec_hash))
WHERE program IS NOT NULL ORDER BY ALL
"""
PARTS = (
    (re.compile(r" (at [^\s+]+?)(?=/set\d+(?: |$)|[\s+]|$)"), "the server that the model ran on"),
    (re.compile(r"(/set\d+)"), "another sample set: independent replies of the same driver"),
    (re.compile(r" (\[[0-9a-f]{8}\])"), "with other settings of the task than its other trials"),
    (
        re.compile(rf"\b({EMULATOR})\b"),
        "the mock model that comes with this program; it draws who goes first as people do",
    ),
    (re.compile(r"\b(random)\b"), "a mock model that answers by chance, whatever it reads"),
)


def programs_of(specs: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the programs that drive in trials of these specs, as ``PLAYED`` has them."""
    sides = (spec.get(side) or {} for spec in specs for side in SIDES)
    return [side for side in sides if "program" in side]


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return each name as it is shown: without its server where that stays unique."""
    short = [*map(without_endpoint, names)]
    return {
        name: brief if short.count(brief) == 1 else name
        for name, brief in zip(names, short, strict=True)
    }


def opponents_text(names: Iterable[str]) -> str:
    """Return the opponents of the drivers with these names."""
    is_pair = {"+" in name for name in names}
    if is_pair == {False}:
        return "Each driver here met a copy of itself."
    alone = " A driver named alone met a copy of itself."
    return "A+B: driver A met driver B." + alone * (False in is_pair) if is_pair else ""


def names_mean(programs: Iterable[Mapping[str, Any]], drivers: Iterable[str]) -> dict[str, str]:
    """Return the meanings of programs, and of the parts of drivers' names."""
    meanings = {
        of["program"]: program_text(of["program"], of.get("based_on"), of.get("plugins") or ())
        for of in programs
    }
    for name in drivers:
        for pattern, meaning in PARTS:
            meanings |= dict.fromkeys(pattern.findall(name), meaning)
    return dict(sorted(meanings.items()))


def program_text(name: str, based_on: str | None = None, plugins: Iterable[str] = ()) -> str:
    """Describe a program by its loaded class, else by the source of a run's ``plugins``."""
    if (program := PROGRAMS.get(name)) is not None:
        doc = (getdoc(program.driver) or "").partition("\n")[0].rstrip(".")
        text = program.meaning or doc or "a driver of a plug-in, which does not say what it does"
        return f"a program: {text}"
    if based_on and based_on in PROGRAMS:
        return f"a program, otherwise set than usual: {PROGRAMS[based_on].meaning}"
    if based_on:
        return f"{based_on} otherwise set"
    known = re.compile(rf'register\(\s*"{re.escape(name)}",\s*Program\(\s*\w+,\s*"([^"]+)"')
    texts = (text for files in plugins if files for text in json.loads(files).values())
    match = next(filter(None, map(known.search, texts)), None)
    return f"a program{f': {match[1]}' if match else ', defined in this study'}"
