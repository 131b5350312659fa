"""Whoever gets a recording can tell who signed it, with the tools that he has."""

import os
import shutil
import subprocess

import pytest

from merge_runner.results import signing
from tests.harness import RECORDING

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="no ssh-keygen"),
]


def key(folder, name):
    """A new key, and the line of it in a file of allowed signers."""
    made = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(folder / name)]
    subprocess.run(made, check=True)
    return f"{name}@example.org {(folder / f'{name}.pub').read_text()}"


@pytest.fixture
def signed(tmp_path):
    """A recording that Ann has signed, and a file that allows her alone."""
    shutil.copy(RECORDING, tmp_path / "file.parquet")
    (tmp_path / "signers").write_text(key(tmp_path, "ann"))
    assert signing.sign(tmp_path / "file.parquet", tmp_path / "ann").name == "file.parquet.sig"
    return tmp_path


VERIFY = ("recording", "verify", "file.parquet", "--signers")


async def test_a_signed_recording_is_verified_with_the_name_of_who_signed(merge_runner, signed):
    run = await merge_runner(*VERIFY, "signers")
    assert (run.code, run.err.splitlines()[-1]) == (0, "signed by ann@example.org")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("bytes", "refuses the signature"),
        ("signature", "refuses the signature"),
        ("signer", "refuses the signature"),
        ("purpose", "refuses the signature"),
        ("gone", "is not signed: there is no file.parquet.sig beside it"),
    ],
)
async def test_any_other_signature_is_none(merge_runner, signed, change, says):
    file, signature = signed / "file.parquet", signed / "file.parquet.sig"
    if change == "bytes":  # beyond all that a reader of Parquet looks at
        raw = file.read_bytes()
        file.write_bytes(raw[:4] + raw[4:].replace(b"DuckDB", b"duckdb", 1))
        assert file.read_bytes() != raw
    elif change == "signature":
        signature.write_text(signature.read_text().replace("A", "B"))
    elif change == "signer":
        (signed / "signers").write_text(key(signed, "ben"))
    elif change == "purpose":
        made = ["ssh-keygen", "-Y", "sign", "-q", "-n", "git", "-f", str(signed / "ann")]
        with file.open("rb") as content:
            signature.write_bytes(
                subprocess.check_output(made, stdin=content, stderr=subprocess.DEVNULL)
            )
    else:
        signature.unlink()
    run = await merge_runner(*VERIFY, "signers")
    assert run.code == 1
    assert says in run.err.splitlines()[-1]
    assert "signed by" not in run.err


async def test_an_export_is_signed_and_a_key_that_is_not_there_is_told_before(
    merge_runner, tmp_path
):
    key(tmp_path, "ann")
    part = ("sweep", "baseline", "--reps", 1, "--conditions", "N_0_0")
    assert (await merge_runner(*part)).code == 0
    export = ("recording", "export", "a.parquet", "--sign")
    lacking = await merge_runner(*export, "no-key")
    assert lacking.code == 2
    assert "the key no-key cannot be read" in lacking.err
    assert not (tmp_path / "a.parquet").exists()
    assert (await merge_runner(*export, "ann")).code == 0
    # Signed anew without a question, as the file is written anew.
    assert (await merge_runner(*export, "ann")).code == 0
    (tmp_path / "signers").write_text(f"* {(tmp_path / 'ann.pub').read_text()}")
    verified = await merge_runner("recording", "verify", "a.parquet", "--signers", "signers")
    assert verified.code == 0, verified.err


MINISIGN = """#!/bin/sh
echo "$@" >> calls
case "$1" in -S) echo signature > "$7" ;; -V) [ -s "$7" ] ;; esac
"""


async def test_a_key_of_minisign_goes_to_minisign(merge_runner, tmp_path):
    """Nobody has it here: a stand-in tells what it would be asked."""
    shutil.copy(RECORDING, tmp_path / "file.parquet")
    tool = tmp_path / "bin/minisign"
    tool.parent.mkdir()
    tool.write_text(MINISIGN)
    tool.chmod(0o755)
    (tmp_path / "key").write_text("untrusted comment: minisign key\nRW...\n")
    path = {"PATH": f"{tool.parent}:{os.environ['PATH']}"}
    missing = await merge_runner(*VERIFY, "key", **path)
    assert "there is no file.parquet.minisig" in missing.err
    (tmp_path / "file.parquet.minisig").write_text("signature")
    run = await merge_runner(*VERIFY, "key", **path)
    assert run.code == 0, run.err
    file = (tmp_path / "file.parquet").resolve()
    told = (tmp_path / "calls").read_text()
    assert told == f"-V -p {tmp_path.resolve()}/key -m {file} -x {file}.minisig\n"
    absent = await merge_runner(*VERIFY, "key", PATH=os.path.dirname(shutil.which("git")) + "/no")
    assert absent.code == 2
    assert "there is no minisign on this machine" in absent.err
