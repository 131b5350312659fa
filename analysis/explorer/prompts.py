"""A prompt in its named blocks, with what changed since the one before."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import cache
from typing import Literal

from merge_runner.prompts.blocks import BLOCKS

Change = Literal["same", "new", "gone"]
_WORDS = re.compile(r"[^\s\[\](),]+\s*|[\[\](),]\s*|\s+")


@dataclass(frozen=True, slots=True)
class Part:
    """One block of a prompt: its name, empty where no block of ours begins like it, and its text.

    ``pieces`` are the text in order, with what was in the prompt before and is no more.
    """

    name: str
    pieces: tuple[tuple[Change, str], ...]

    @property
    def changed(self) -> bool:
        """Whether anything in it is new, or gone."""
        return any(change != "same" for change, _ in self.pieces)


def parts_of(prompt: str, before: str | None) -> list[Part]:
    """The parts of a prompt, each compared with the same block of the one before.

    Without one before, nothing is marked.
    """
    earlier = dict(_blocks(before)) if before is not None else {}
    return [
        Part(name, _compared(earlier.get(name, "") if before is not None else text, text))
        for name, text in _blocks(prompt)
    ]


def _blocks(prompt: str) -> list[tuple[str, str]]:
    """Name and text of each block; what belongs to none that is known here has no name."""
    found: list[tuple[str, str]] = []
    paragraphs_to_come = 0
    paragraphs = prompt.rstrip("\n").split("\n\n")
    for place, paragraph in enumerate(paragraphs):
        begun = _begun(paragraphs[place:])
        if begun is not None:
            name, paragraphs_to_come = begun
            found.append((name, paragraph))
        elif found and (paragraphs_to_come > 0 or not found[-1][0]):
            paragraphs_to_come -= 1
            found[-1] = (found[-1][0], f"{found[-1][1]}\n\n{paragraph}")
        else:
            found.append(("", paragraph))
    return found


def _begun(paragraphs: Sequence[str]) -> tuple[str, int] | None:
    """The block whose first paragraph begins like this one, and how many of its own follow.

    A paragraph is known by its text up to its first value. One block may begin with another one's
    words: the one that agrees farthest, and in the most of its paragraphs, is meant.
    """
    agreeing = []
    for name, block in BLOCKS.items():
        for template in filter(None, (block.merge, block.straight)):
            beginnings = _beginnings(template)
            if beginnings[0] and paragraphs[0].startswith(beginnings[0]):
                pairs = zip(beginnings, paragraphs, strict=False)
                agree = sum(paragraph.startswith(beginning) for beginning, paragraph in pairs)
                agreeing.append((len(beginnings[0]), agree, name, len(beginnings) - 1))
    return max(agreeing)[2:] if agreeing else None


@cache
def _beginnings(template: str) -> list[str]:
    """What each paragraph of a block begins with, up to its first value."""
    return [part.partition("{")[0] for part in template.split("\n\n")]


def _compared(before: str, now: str) -> tuple[tuple[Change, str], ...]:
    """Line by line where there are as many: the values change, and hardly the words."""
    old, new = before.splitlines(keepends=True), now.splitlines(keepends=True)
    if len(old) != len(new):
        old, new = [before], [now]
    pieces: list[tuple[Change, str]] = []
    for line_before, line in zip(old, new, strict=True):
        if line_before == line:
            pieces.append(("same", line))
            continue
        words_before, words = _WORDS.findall(line_before), _WORDS.findall(line)
        for i1, i2, j1, j2, changed in _runs(words_before, words):
            if changed and i1 < i2:
                pieces.append(("gone", "".join(words_before[i1:i2]).strip()))
            if j1 < j2:
                pieces.append(("new" if changed else "same", "".join(words[j1:j2])))
    return tuple(pieces)


def _runs(old: list[str], new: list[str]) -> list[tuple[int, int, int, int, bool]]:
    """Where two lines are equal and where not; a comma between two changes is changed as well."""
    runs: list[tuple[int, int, int, int, bool]] = []
    for kind, i1, i2, j1, j2 in _opcodes(old, new):
        changed = kind != "equal"
        if changed and len(runs) > 1 and "".join(new[slice(*runs[-1][2:4])]).strip() in {"", ","}:
            start = runs[-2]
            runs[-2:] = [(start[0], i2, start[2], j2, True)]
        else:
            runs.append((i1, i2, j1, j2, changed))
    return runs


def _opcodes(old: list[str], new: list[str]) -> Iterator[tuple[str, int, int, int, int]]:
    """How a line becomes another; matching takes long, and most lines begin and end alike."""
    begin = _alike(old, new)
    end = _alike(old[begin:][::-1], new[begin:][::-1])
    last_old, last_new = len(old) - end, len(new) - end
    if begin:
        yield "equal", 0, begin, 0, begin
    matcher = SequenceMatcher(None, old[begin:last_old], new[begin:last_new], autojunk=False)
    for kind, i1, i2, j1, j2 in matcher.get_opcodes():
        yield kind, begin + i1, begin + i2, begin + j1, begin + j2
    if end:
        yield "equal", last_old, len(old), last_new, len(new)


def _alike(old: Sequence[str], new: Sequence[str]) -> int:
    """How many words both begin with."""
    pairs = enumerate(zip(old, new, strict=False))
    return next((i for i, (a, b) in pairs if a != b), min(len(old), len(new)))
