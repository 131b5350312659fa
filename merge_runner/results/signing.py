"""Signatures of recordings, by the user's own tool: ssh-keygen, or minisign for a minisign key.

A hash reveals accidental damage. Anyone who changes a file on purpose can compute its hash anew,
but not its signature. Only these tools read keys; they ask for a passphrase themselves.
"""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from merge_runner.errors import RecordingError, UsageError
from merge_runner.text_safety import one_line

NAMESPACE = "merge-runner"
"""What a signature by ssh-keygen is for, so that none for another purpose is taken."""
SSH, MINISIGN = "ssh-keygen", "minisign"
SUFFIXES = {SSH: ".sig", MINISIGN: ".minisig"}


def tool_for(key: Path) -> str:
    """The tool that this key belongs to; raises UsageError if there is no such file."""
    try:
        with key.open("rb") as file:
            return MINISIGN if file.readline(1000).startswith(b"untrusted comment:") else SSH
    except OSError as exc:
        raise UsageError(f"the key {key} cannot be read: {exc.strerror}") from exc


def sign(file: Path, key: Path) -> Path:
    """Sign a file with a private key, or with the agent that holds it; returns the signature."""
    tool = tool_for(key)
    signature = _signature(file, tool)
    if tool == SSH:
        options = ["-Y", "sign", "-q", "-n", NAMESPACE, "-f", key.resolve()]
        signature.write_bytes(_run(tool, options, file, asks=True))
    else:
        _run(tool, ["-S", "-s", key.resolve(), "-m", file.resolve(), "-x", signature], asks=True)
    return file.with_name(signature.name)


def verified(file: Path, signers: Path) -> str:
    """Who signed a file, as a line of text; raises RecordingError unless one of ``signers`` did.

    That is a file of allowed signers for ssh-keygen, or a public key of minisign.
    """
    tool = tool_for(signers)
    signature, allowed = _signature(file, tool), signers.resolve()
    if not signature.is_file():
        raise RecordingError(f"{file} is not signed: there is no {signature.name} beside it")
    if tool == MINISIGN:
        _run(tool, ["-V", "-p", allowed, "-m", file.resolve(), "-x", signature])
        return f"signed by the key {signers}"
    of = ["-s", signature, "-f", allowed]
    who = _run(tool, ["-Y", "find-principals", *of]).decode(errors="replace").splitlines()[0]
    _run(tool, ["-Y", "verify", "-n", NAMESPACE, "-I", who, *of], file)
    return f"signed by {who}"


def _signature(file: Path, tool: str) -> Path:
    return file.resolve().with_name(file.name + SUFFIXES[tool])


def _run(
    tool: str, options: Sequence[object], file: Path | None = None, *, asks: bool = False
) -> bytes:
    """Run a tool on a file; if it ``asks`` for a passphrase, it does so at the terminal.

    Raises RecordingError.
    """
    try:
        with file.open("rb") if file else nullcontext() as content:
            done = subprocess.run(  # noqa: S603 # the user's own tool
                [tool, *map(str, options)],
                stdin=content,
                stdout=subprocess.PIPE,
                stderr=None if asks else subprocess.PIPE,
                check=False,
            )
    except FileNotFoundError:
        raise UsageError(f"there is no {tool} on this machine: install it") from None
    if done.returncode != 0:
        said = one_line((done.stderr or done.stdout or b"").decode(errors="replace").strip())
        raise RecordingError(f"{tool} refuses the signature: {said or 'as it says above'}")
    return done.stdout
