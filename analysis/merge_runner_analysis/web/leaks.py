"""Refusal of files that hold keys of this machine, or paths that name its folders."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

from merge_runner.errors import UsageError
from merge_runner.paths import PROJECT

# Texts that look like a key, by their beginnings: a search for words is far quicker than one for a
# pattern. The values of this machine's keys are looked for too.
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
SHORTEST_SECRET = 8
# A folder in anybody's home.
_HOMES = re.compile(r"(?<![\w.])(?:/home|/Users|[A-Z]:\\+Users)[/\\]+[\w.-]+[/\\]")


def check_leaks(db: Path, where: str, text: str) -> None:
    """Raise UsageError where a text holds a key, or a path of this machine."""
    for name in filter(lambda name: name.endswith(_SECRET_NAMES), os.environ):
        if len(os.environ[name]) >= SHORTEST_SECRET and os.environ[name] in text:
            raise UsageError(f"nothing was written: {where} holds the value of {name}")
    for begin, rest in _KEYS.items():
        if begin in text and (key := re.search(rf"{begin}(?<!\w{begin}){rest}", text)):
            raise UsageError(
                f"nothing was written: {where} holds what looks like a key: {key[0][:6]}..."
            )
    folders = (Path.home(), Path.cwd(), db.resolve().parent, PROJECT, tempfile.gettempdir())
    # In a container the home may be "/".
    paths = [path for path in sorted({f"{folder}/" for folder in folders} - {"//"}) if path in text]
    if "/home" in text or "Users" in text:
        paths += [home[0] for home in _HOMES.finditer(text)]
    if paths:
        raise UsageError(f"nothing was written: {where} names the path {paths[0]}")
