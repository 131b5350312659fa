"""Count the mutants that the tests kill: ``python -m tests.weekly.mutants [PART]``.

Each mutant is applied to a copy of the repository, and the tests named for its folder run there
until one fails. A mutant that survives is printed. PART restricts the run to paths that have it.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
LONGEST_S = 900  # a mutant that never ends is killed, too
TESTS = {
    "prompts": ("tests/prompts",),
    "merge": (
        "tests/scenarios",
        "tests/integration/test_trial.py",
        "tests/integration/drivers/test_reference.py",
    ),
    "llm": ("tests/integration/llm/test_cache.py",),
    "stats": ("tests/analysis/stats", "tests/analysis/tables"),
    "analysis": (
        "tests/unit/analysis/test_metrics.py",
        "tests/analysis/stats",
        "tests/analysis/tables",
    ),
}


def main() -> None:
    """Print the survivors, and the share of mutants killed in each file."""
    part = sys.argv[1] if len(sys.argv) > 1 else ""
    with (Path(__file__).parent / "mutants.toml").open("rb") as file:
        mutants = [each for each in tomllib.load(file)["mutant"] if part in each["file"]]
    killed: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        tracked = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).splitlines()
        for name in filter(lambda name: (ROOT / name).exists(), tracked):
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name, follow_symlinks=False)
        for room in {Path(each["file"]).parent.name for each in mutants}:
            if fails(room, copy):
                sys.exit(f"the tests of {room} fail without a mutant")
        for mutant in mutants:
            if is_killed(mutant, copy):
                killed[mutant["file"]] += 1
            else:
                print(f"survives: {mutant['file']}: {mutant['becomes'].strip()}", flush=True)
    for name, count in Counter(each["file"] for each in mutants).items():
        print(f"{killed[name]} of {count} killed: {name}")
    print(f"{killed.total()} of {len(mutants)} killed")


def is_killed(mutant: dict[str, str | int], copy: Path) -> bool:
    """Return whether a test fails while the mutant is in place; the file is restored."""
    path = copy / str(mutant["file"])
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    places = [number for number, line in enumerate(lines) if line == mutant["line"]]
    lines[places[int(mutant.get("nth", 0))]] = str(mutant["becomes"])
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    try:
        return fails(path.parent.name, copy)
    finally:
        path.write_text(text, encoding="utf-8")


def fails(room: str, copy: Path) -> bool:
    """Return whether the tests of a room fail, or never end."""
    command = [sys.executable, "-m", "pytest", "-x", "-n", "0", "-m", "not long", *TESTS[room]]
    try:
        done = subprocess.run(
            command, cwd=copy, check=False, capture_output=True, timeout=LONGEST_S
        )
    except subprocess.TimeoutExpired:
        return True
    if done.returncode not in (0, 1, 2):
        sys.exit(done.stdout.decode() + done.stderr.decode())
    return done.returncode != 0


if __name__ == "__main__":
    main()
