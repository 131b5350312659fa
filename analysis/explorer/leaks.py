"""What must not leave this machine: its keys, and paths that name its folders."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterable
from pathlib import Path

from merge_runner.errors import UsageError
from merge_runner.paths import PROJECT

# What looks like a key, wherever it is from, by what it begins with; the values of this machine's
# keys are looked for too.
_KEYS = {
    "sk-": r"[A-Za-z0-9_-]{16}",
    "AIza": r"[A-Za-z0-9_-]{30}",
    "Bearer ": r"[A-Za-z0-9._-]{16}",
    **dict.fromkeys(("gho_", "ghp_", "ghs_", "ghu_", "hf_"), r"[A-Za-z0-9]{30}"),
    "github_pat_": r"[A-Za-z0-9_]{30}",
    **dict.fromkeys(("xoxa-", "xoxb-", "xoxp-"), r"[A-Za-z0-9-]{16}"),
    **dict.fromkeys(("AKIA", "ASIA"), r"[A-Z0-9]{16}"),
}
_SECRET_NAMES = ("_KEY", "_TOKEN", "_SECRET", "_PASSWORD")
# A folder in anybody's home.
_HOMES = re.compile(r"(?<![\w.])(?:/home|/Users|[A-Z]:\\+Users)[/\\]+[\w.-]+[/\\]")
_HOMES_BEGIN = ("/home", "Users")
SHORTEST_SECRET = 8
# Between texts that are searched as one: no key goes on beyond it.
_GAP = "\n"


class Leaks:
    """Finds in texts what must not leave this machine."""

    def __init__(self, db: Path) -> None:
        folders = (Path.home(), Path.cwd(), db.resolve().parent, PROJECT, tempfile.gettempdir())
        # In a container the home may be "/".
        self._paths = sorted({f"{folder}/" for folder in folders} - {"//"})
        self._secrets = {
            value: name
            for name, value in os.environ.items()
            if name.endswith(_SECRET_NAMES) and len(value) >= SHORTEST_SECRET
        }

    def refuse(self, where: str, texts: Iterable[str]) -> None:
        """Raises UsageError where a text holds a key, or a path of this machine."""
        text = _GAP.join(texts)  # few long texts are searched far quicker than many short ones
        for value, name in self._secrets.items():
            if value in text:
                raise UsageError(f"nothing was written: {where} holds the value of {name}")
        if key := _key_in(text):
            raise UsageError(
                f"nothing was written: {where} holds what looks like a key: {key[:6]}..."
            )
        named = [path for path in self._paths if path in text]
        if any(begin in text for begin in _HOMES_BEGIN):
            named += [found[0] for found in _HOMES.finditer(text)]
        if named:
            raise UsageError(f"nothing was written: {where} names the path {named[0]}")


def _key_in(text: str) -> str | None:
    """What looks like a key; to look for words is far quicker than to look for a pattern."""
    for begin, rest in _KEYS.items():
        if begin in text and (found := re.search(rf"\b{begin}{rest}", text)):
            return found[0]
    return None
