"""Trials of an exported page, packed: each by itself, and once what they have in common."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Collection, Iterable, Sequence
from typing import Any

from analysis.explorer.details import Decision, Trial, read_whole
from analysis.explorer.leaks import Leaks
from analysis.explorer.pages.trial import panel_values, shown
from analysis.explorer.reading import Row
from analysis.explorer.site import Site

# Shorter texts are repeated: to name them takes as much.
SHARED = 16
# A higher one takes half as long again for 2 % less.
LEVEL = 6

Pieces = list[str | int]


def packed(value: object, leaks: Leaks, where: str) -> str:
    """Anything that JSON holds as a short text, which ``unpacked.js`` reads.

    Raises UsageError where a text in it holds a key or a path of this machine: afterwards its
    letters may spell one.
    """
    leaks.refuse(where, _texts_in(value))
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False)
    return base64.b64encode(zlib.compress(text.encode(errors="replace"), LEVEL)).decode()


def _texts_in(value: object) -> list[str]:
    found, waiting = [], [value]
    while waiting:
        one = waiting.pop()
        if isinstance(one, str):
            found.append(one)
        elif isinstance(one, dict):
            waiting += [*one, *one.values()]
        elif isinstance(one, list | tuple):
            waiting += one
    return found


class SharedTexts:
    """The long texts that come more than once, each once.

    The first time a text stays where it is: most of what is long comes only once.
    """

    def __init__(self) -> None:
        self._seen: set[int] = set()
        self._numbers: dict[str, int] = {}

    def pieces(self, texts: Iterable[str]) -> Pieces:
        """Texts one after another, with the number of each that was there before in its place."""
        found: Pieces = []
        own: list[str] = []
        for text in texts:
            number = self._number(text) if len(text) >= SHARED else None
            if number is None:
                own.append(text)
                continue
            if own:
                found.append("".join(own))
                own.clear()
            found.append(number)
        return [*found, "".join(own)] if own else found

    def _number(self, text: str) -> int | None:
        if text not in self._numbers:
            if (seen := hash(text)) not in self._seen:
                self._seen.add(seen)
                return None
            self._numbers[text] = len(self._numbers)
        return self._numbers[text]

    @property
    def texts(self) -> list[str]:
        """The shared texts by number."""
        return list(self._numbers)


def pack_trials(
    site: Site, rows: Sequence[Row], others: Collection[tuple[str, str]]
) -> dict[str, Any]:
    """Some ``trials`` as their page needs them, in their order, and the texts they have ``shared``.

    ``others`` are the models that answered in another one's place. Raises UsageError where a trial
    holds a key or a path of this machine.
    """
    leaks, shared = Leaks(site.db), SharedTexts()
    keys = [(row["trial_id"], row["spec_hash"]) for row in rows]
    whole = zip(rows, read_whole(site.db, keys), strict=True)
    trials = [
        packed(_trial(site, shared, row, trial, decisions, others), leaks, row["trial_id"])
        for row, (trial, decisions) in whole
    ]
    return {"shared": packed(shared.texts, leaks, "what trials share"), "trials": trials}


def _trial(
    site: Site,
    shared: SharedTexts,
    row: Row,
    trial: Trial,
    decisions: dict[tuple[str, int], Decision],
    others: Collection[tuple[str, str]],
) -> dict[str, Any]:
    """A trial and its decisions in pieces."""
    values = {**shown(site, row, trial), "panel": ""}
    return {
        "html": shared.pieces(site.pieces("_trial.html", here="trials", **values)),
        "panels": {
            f"{side}/{number}": shared.pieces(
                site.pieces("_decision.html", **panel_values(site, row, trial, found, others))
            )
            for (side, number), found in decisions.items()
        },
    }
