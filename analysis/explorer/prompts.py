"""A prompt in its named blocks, with what changed since the one before."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import cache, lru_cache
from typing import Literal

from merge_runner.prompts.blocks import BLOCKS

Change = Literal["same", "new", "gone"]
_WORDS = re.compile(r"[^\s\[\](),]+\s*|[\[\](),]\s*|\s+")
# Prompts are taken apart once: each is first the later and then the earlier one.
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
    paragraphs = prompt.rstrip("\n").split("\n\n")
    while paragraphs:
        _, name, length = max(_beginning(paragraphs), default=(0, "", 1))
        text = "\n\n".join(paragraphs[:length])
        if found and name == found[-1][0] == "":
            text = f"{found.pop()[1]}\n\n{text}"
        found.append((name, text))
        del paragraphs[:length]
    return found


def _beginning(paragraphs: Sequence[str]) -> Iterator[tuple[int, str, int]]:
    """The blocks whose paragraphs begin like these: characters that agree, name, paragraphs."""
    for name, block in BLOCKS.items():
        for template in filter(None, (block.merge, block.straight)):
            begun = _begun(template)
            pairs = zip(paragraphs, begun, strict=False)
            if begun[0] and all(text.startswith(beginning) for text, beginning in pairs):
                yield sum(map(len, begun)), name, len(begun)


@cache
def _begun(template: str) -> list[str]:
    """The text of each paragraph up to its first value, by which it is known."""
    return [paragraph.partition("{")[0] for paragraph in template.split("\n\n")]


def _compared(before: str, now: str) -> tuple[tuple[Change, str], ...]:
    """The text of a block, word by word, with what is gone from the one before."""
    if before == now:
        return (("same", now),)
    old, new = _WORDS.findall(before), _WORDS.findall(now)
    pieces: list[tuple[Change, str]] = []
    for kind, i1, i2, j1, j2 in SequenceMatcher(None, old, new, autojunk=False).get_opcodes():
        if kind != "equal" and i1 < i2:
            pieces.append(("gone", "".join(old[i1:i2]).strip()))
        if j1 < j2:
            pieces.append(("same" if kind == "equal" else "new", "".join(new[j1:j2])))
    return tuple(pieces)
