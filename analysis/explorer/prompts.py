"""A prompt in its named blocks, with what changed since the one before."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import lru_cache
from itertools import compress, count
from operator import ne
from typing import Literal

from merge_runner.prompts.blocks import BLOCKS

Change = Literal["same", "new", "gone"]
_WORDS = re.compile(r"[^\s\[\](),]+\s*|[\[\](),]\s*|\s+")
# Prompts, or lines of them, are taken apart once: each is first the later and then the earlier one.
KEPT = 256


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


@lru_cache(KEPT)
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

    One block may begin with another one's words: the one that agrees farthest, and in the most of
    its paragraphs, is meant.
    """
    agreeing = []
    for name, beginnings in _like(paragraphs[0]):
        pairs = zip(beginnings, paragraphs, strict=False)
        agree = sum(paragraph.startswith(beginning) for beginning, paragraph in pairs)
        agreeing.append((len(beginnings[0]), agree, name, len(beginnings) - 1))
    return max(agreeing)[2:] if agreeing else None


@lru_cache(KEPT)
def _like(paragraph: str) -> list[tuple[str, list[str]]]:
    """The blocks that begin like a paragraph, each with what its paragraphs begin with.

    A paragraph is known by its text up to its first value.
    """
    begun = [
        (name, [part.partition("{")[0] for part in template.split("\n\n")])
        for name, block in BLOCKS.items()
        for template in filter(None, (block.merge, block.straight))
    ]
    return [(name, texts) for name, texts in begun if texts[0] and paragraph.startswith(texts[0])]


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
        words_before, words = _words(line_before), _words(line)
        for i1, i2, j1, j2, changed in _runs(words_before, words):
            if changed and i1 < i2:
                pieces.append(("gone", "".join(words_before[i1:i2]).strip()))
            if j1 < j2:
                pieces.append(("new" if changed else "same", "".join(words[j1:j2])))
    return tuple(pieces)


@lru_cache(KEPT)
def _words(line: str) -> list[str]:
    return _WORDS.findall(line)


def _runs(old: list[str], new: list[str]) -> list[tuple[int, int, int, int, bool]]:
    """Where two lines are equal and where not; a comma between two changes is changed as well."""
    runs: list[tuple[int, int, int, int, bool]] = []
    for i1, i2, j1, j2, changed in _matched(old, new):
        if changed and len(runs) > 1 and "".join(new[slice(*runs[-1][2:4])]).strip() in {"", ","}:
            start = runs[-2]
            runs[-2:] = [(start[0], i2, start[2], j2, True)]
        else:
            runs.append((i1, i2, j1, j2, changed))
    return runs


def _matched(old: list[str], new: list[str]) -> Iterator[tuple[int, int, int, int, bool]]:
    """How a line becomes another; matching takes long, and most lines begin and end alike."""
    begin = _alike(old, new)
    end = _alike(old[begin:][::-1], new[begin:][::-1])
    last_old, last_new = len(old) - end, len(new) - end
    if begin:
        yield 0, begin, 0, begin, False
    gone, come = old[begin:last_old], new[begin:last_new]
    if not set(gone).isdisjoint(come):
        for kind, i1, i2, j1, j2 in SequenceMatcher(None, gone, come, autojunk=False).get_opcodes():
            yield begin + i1, begin + i2, begin + j1, begin + j2, kind != "equal"
    elif gone or come:
        yield begin, last_old, begin, last_new, True
    if end:
        yield last_old, len(old), last_new, len(new), False


def _alike(old: Sequence[str], new: Sequence[str]) -> int:
    """How many words both begin with."""
    differing = compress(count(), map(ne, old, new))
    return next(differing, min(len(old), len(new)))
