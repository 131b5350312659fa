"""A prompt in its named blocks, with what changed since the one before."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import cache, lru_cache
from itertools import product
from typing import Literal

from merge_runner.prompts.blocks import BLOCKS, LAST, digest_of
from merge_runner.records import Side

Change = Literal["same", "new", "gone"]
_WORDS = re.compile(r"[^\s\[\](),]+\s*|[\[\](),]\s*|\s+")
# Prompts are taken apart once: each is first the later and then the earlier one.
CACHED = 256


@dataclass(frozen=True, slots=True)
class Part:
    """One block of a prompt: its name, empty where it is not known, and its text.

    Words of a study are named by the level that adds them: ``hurry=yes``. ``pieces`` are
    the text in order, with what was in the prompt before and is no more.
    """

    name: str
    pieces: tuple[tuple[Change, str], ...]

    @property
    def changed(self) -> bool:
        """Return whether any piece is new, or gone."""
        return any(change != "same" for change, _ in self.pieces)


def parts_of(
    prompt: str, before: str | None, digests: Mapping[str, str] | None = None
) -> list[Part]:
    """Return the parts of a prompt, each compared with the same block of the one before.

    Those that are only in the one before come last. Without one before, nothing is marked. The
    ``digests`` of its blocks, as its spec has them, name the words of a study.
    """
    named = tuple((digests or {}).items())
    if before is None:
        return [Part(name, (("same", text),)) for name, text in _blocks(prompt, named)]
    earlier, now = dict(_blocks(before, named)), _blocks(prompt, named)
    gone = [(name, "") for name in earlier if name not in dict(now)]
    return [Part(name, _compared(earlier.get(name, ""), text)) for name, text in (*now, *gone)]


def digests_of(blocks: Mapping[str, str], side: Side) -> dict[str, str]:
    """Return the digests of a spec's blocks, without blocks that only the other side reads."""
    named = ((name.partition("@"), digest) for name, digest in blocks.items())
    return {name: digest for (name, _, of), digest in named if of in ("", side)}


def words_of(prompt: str, digests: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the words of a study in a prompt: the level or prompt that adds them, their text."""
    return [
        (name, text)
        for name, text in _blocks(prompt, tuple(digests.items()))
        if name and text and name not in BLOCKS
    ]


@lru_cache(CACHED)
def _blocks(prompt: str, digests: tuple[tuple[str, str], ...]) -> list[tuple[str, str]]:
    """Return the name and text of each block; text of an unknown block has no name.

    If several blocks begin like the next paragraphs, the one with the longest beginnings is
    chosen. ``digests`` are name and digest of all that the prompt has.
    """
    known = [
        (name, _begun(template))
        for name, block in BLOCKS.items()
        for template in filter(None, (block.merge, block.straight))
    ]
    blocks: list[tuple[str, str]] = []
    paragraphs = prompt.rstrip("\n").split("\n\n")
    while paragraphs:
        alike = (
            (sum(map(len, begun)), name, len(begun))
            for name, begun in known
            if begun[0] and all(map(str.startswith, paragraphs, begun))
        )
        _, name, length = max(alike, default=(0, "", 1))
        if not name:
            name, length = _own_block(paragraphs, digests)
        text = "\n\n".join(paragraphs[:length])
        if blocks and name == blocks[-1][0]:
            text = f"{blocks.pop()[1]}\n\n{text}"
        blocks.append((name, text))
        del paragraphs[:length]
    # Words with values in them are not known by their digest: those that are left are meant.
    levels = {level_of(name) for name, _ in digests if name not in BLOCKS}
    left = levels - {name for name, _ in blocks}
    return [(name or ", ".join(sorted(left)), text) for name, text in blocks]


def _own_block(paragraphs: Sequence[str], digests: Iterable[tuple[str, str]]) -> tuple[str, int]:
    """Return the name of the next block, known by the digest of its text, and its length.

    The digest covers what the block stands before, too.
    """
    names = {digest: name for name, digest in digests}
    for length in range(len(paragraphs) if names else 0, 0, -1):
        text = "\n\n".join(paragraphs[:length])
        roads = ((text, text), (text, None), (None, text))
        for (merge, straight), place in product(roads, (None, LAST, *names.values())):
            if name := names.get(digest_of(merge, straight, place)):
                return level_of(name), length
    return "", 1


def level_of(block: str) -> str:
    """Return the level or prompt that adds a block: ``hurry=yes`` of ``hurry=yes.1``."""
    name, _, number = block.rpartition(".")
    return name if number.isdigit() and block not in BLOCKS else block


@cache
def _begun(template: str) -> list[str]:
    """Return the text of each paragraph up to its first value, by which it is known."""
    return [paragraph.partition("{")[0] for paragraph in template.split("\n\n")]


@lru_cache(CACHED)
def _words(text: str) -> list[str]:
    return _WORDS.findall(text)


def _compared(before: str, now: str) -> tuple[tuple[Change, str], ...]:
    """Return the text of a block, word by word, with the words gone since the one before."""
    if before == now:
        return (("same", now),)
    old, new = _words(before), _words(now)
    # Most of a prompt is as before: its beginning need not be searched.
    shorter = range(min(len(old), len(new)))
    begin = bisect_left(shorter, True, key=lambda last: old[: last + 1] != new[: last + 1])
    pieces: list[tuple[Change, str]] = [("same", "".join(new[:begin]))] if begin else []
    old, new = old[begin:], new[begin:]
    for kind, i1, i2, j1, j2 in SequenceMatcher(None, old, new).get_opcodes():
        if kind != "equal" and i1 < i2:
            pieces.append(("gone", "".join(old[i1:i2]).strip()))
        if j1 < j2:
            pieces.append(("same" if kind == "equal" else "new", "".join(new[j1:j2])))
    return tuple(pieces)
