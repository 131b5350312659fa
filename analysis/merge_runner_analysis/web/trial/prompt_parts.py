"""A prompt in its named blocks, with what changed since the one before."""

from __future__ import annotations

import re
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

    Those that are only in the one before come last. Without one before, nothing is marked.
    """
    if before is None:
        return [Part(name, (("same", text),)) for name, text in _blocks(prompt)]
    earlier, now = dict(_blocks(before)), _blocks(prompt)
    gone = [(name, "") for name in earlier if name not in dict(now)]
    return [Part(name, _compared(earlier.get(name, ""), text)) for name, text in (*now, *gone)]


@lru_cache(KEPT)
def _blocks(prompt: str) -> list[tuple[str, str]]:
    """Name and text of each block; what belongs to none that is known here has no name.

    Of the blocks whose paragraphs begin like the next ones the one with the longest beginnings is
    meant.
    """
    known = [
        (name, _begun(template))
        for name, block in BLOCKS.items()
        for template in filter(None, (block.merge, block.straight))
    ]
    found: list[tuple[str, str]] = []
    paragraphs = prompt.rstrip("\n").split("\n\n")
    while paragraphs:
        alike = (
            (sum(map(len, begun)), name, len(begun))
            for name, begun in known
            if begun[0] and all(map(str.startswith, paragraphs, begun))
        )
        _, name, length = max(alike, default=(0, "", 1))
        text = "\n\n".join(paragraphs[:length])
        if found and name == found[-1][0] == "":
            text = f"{found.pop()[1]}\n\n{text}"
        found.append((name, text))
        del paragraphs[:length]
    return found


@cache
def _begun(template: str) -> list[str]:
    """The text of each paragraph up to its first value, by which it is known."""
    return [paragraph.partition("{")[0] for paragraph in template.split("\n\n")]


def _compared(before: str, now: str) -> tuple[tuple[Change, str], ...]:
    """The text of a block, word by word, with what is gone from the one before."""
    if before == now:
        return (("same", now),)
    old, new = _WORDS.findall(before), _WORDS.findall(now)
    # Most of a prompt is as before: its beginning need not be searched.
    pairs = enumerate(zip(old, new, strict=False))
    begin = next((i for i, (a, b) in pairs if a != b), min(len(old), len(new)))
    pieces: list[tuple[Change, str]] = [("same", "".join(new[:begin]))] if begin else []
    old, new = old[begin:], new[begin:]
    for kind, i1, i2, j1, j2 in SequenceMatcher(None, old, new).get_opcodes():
        if kind != "equal" and i1 < i2:
            pieces.append(("gone", "".join(old[i1:i2]).strip()))
        if j1 < j2:
            pieces.append(("same" if kind == "equal" else "new", "".join(new[j1:j2])))
    return tuple(pieces)
