"""Count the mutants that tests kill: ``python tests/weekly/mutants ROOT RESULTS PART LANE...``.

Tests of the lanes run in a copy of the commit at ROOT, and RESULTS keeps what each calls. Then the
tests of the function of each mutant with PART in its path run, quickest first. A rerun goes on.
Needs Python 3.12 or newer.
"""

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
from collections import Counter
from itertools import accumulate, chain
from pathlib import Path

import pytest

HEAVY = "duckdb httpx hypothesis matplotlib.figure pandas pydantic scipy.stats statsmodels.api"
OPTIONS = "-n0 -p no:cacheprovider -o faulthandler_timeout=400 -o faulthandler_exit_on_timeout=1"
SECONDS, TOGETHER = 20, 300  # of the tests of a mutant; so many are collected together
ROOT, RESULTS, PART, *LANES = sys.argv[1:]
MONITORING, TOOL = sys.monitoring, sys.monitoring.COVERAGE_ID
OURS = re.compile("merge_runner|analysis/research/")
NOTES, COPY, RAN = [Path(f"{RESULTS}{end}").resolve() for end in ("", ".copy", ".ran")]


class Watch:
    """Runs tests in a process with heavy libraries, and notes what each calls."""

    def __init__(self, notes, names, *arguments, done=frozenset()) -> None:
        self.notes, self.names, self.done, self.codes, self.of_fixture = notes, names, done, {}, {}
        if (child := os.fork()) == 0:
            os.setpgrp()
            os.chdir(COPY)
            sys.path[:1] = [str(COPY), f"{COPY}/analysis"]
            os.environ["PYTHONPATH"] = ":".join(sys.path[:2])
            os.dup2(os.open(f"{COPY}.out", os.O_CREAT | os.O_WRONLY | os.O_TRUNC), 1)
            if "-x" not in arguments:
                MONITORING.use_tool_id(TOOL, "mutants")
                MONITORING.register_callback(TOOL, MONITORING.events.PY_START, self.called)
                MONITORING.set_events(TOOL, MONITORING.events.PY_START)
            options = [*OPTIONS.split(), f"--basetemp={COPY}.tmp", *arguments]
            os._exit(pytest.main(options, plugins=[self]))
        self.status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        os.system(f"kill -9 -{child} 2> {os.devnull}")

    def called(self, code, _):
        self.codes[id(code)] = code
        return MONITORING.DISABLE  # until the next test

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        there = {item.nodeid: item for item in items}
        left = there.keys() - self.done
        items[:] = [there[name] for name in self.names or there if name in left]

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        outer, self.codes = self.codes, {}
        MONITORING.restart_events()
        made = yield
        self.of_fixture[fixturedef], self.codes = self.codes, outer | self.codes
        return made

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        self.codes, failed, before_s = {}, item.session.testsfailed, sum(os.times()[:4])
        MONITORING.restart_events()
        done, s = (yield), sum(os.times()[:4]) - before_s
        for fixture in chain(*item._fixtureinfo.name2fixturedefs.values()):
            self.codes |= self.of_fixture.get(fixture, {})
        found = {f"{code.co_filename}:{code.co_firstlineno}:" for code in [*self.codes.values()]}
        calls = [name.removeprefix(f"{COPY}/") for name in sorted(found) if OURS.search(name)]
        passed = failed == item.session.testsfailed
        note(self.notes, test=item.nodeid, passed=passed, s=s, calls=calls)
        return done


def note(path, **facts):
    with path.open("a") as file:
        file.write(json.dumps(facts) + "\n")


def kept(path, name):
    return [facts for facts in map(json.loads, path.open()) if name in facts]


def killer(tests):
    """The first of these tests that fails, if one does."""
    for first in range(0, len(tests), TOGETHER):
        chosen = sorted(tests[first : first + TOGETHER], key=lambda name: name.split("::")[0])
        modules = dict.fromkeys(name.split("::")[0] for name in chosen)
        RAN.write_text("")
        if (status := Watch(RAN, chosen, "-x", *modules).status) not in (0, 5):
            failed = [test["test"] for test in kept(RAN, "test") if not test["passed"]]
            return [f"status {status}", *failed][-1]
    return ""


def score(mutant, tests):
    """Which test kills a mutant, of those that call its function, or any of its file or folder."""
    file, line, starts = COPY / (path := mutant["file"]), re.escape(mutant["line"]), [0]
    places = re.finditer(f"^{line}$", text := file.read_text(), re.M)
    start, end = [*places][mutant.get("nth", 0)].span()
    for node in ast.walk(ast.parse(text)):
        is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        if is_function and node.lineno <= text.count("\n", 0, start) + 1 <= node.end_lineno:
            starts.append(min(each.lineno for each in [node, *node.decorator_list]))
    for near in (f"{path}:{max(starts)}:", f"{path}:", f"{os.path.dirname(path)}/"):
        found = [test for test in tests if any(call.startswith(near) for call in test["calls"])]
        if found:
            break
    found.sort(key=lambda test: test["s"])
    times = accumulate(test["s"] for test in found)
    chosen = [test["test"] for test, s in zip(found, times, strict=True) if s < SECONDS]
    while True:
        file.write_text(text[:start] + mutant["becomes"] + text[end:])
        by = killer(chosen)
        file.write_text(text)
        if "::" not in by or not killer([by]):
            return by
        chosen.remove(by)  # it fails without the mutant


list(map(__import__, HEAVY.split()))
if not COPY.exists():
    subprocess.run(["git", "clone", "-q", ROOT, COPY], check=True)
subprocess.run(["git", "checkout", "-q", "."], cwd=COPY, check=True)
NOTES.touch()
if not kept(NOTES, "recorded"):
    done = {test["test"] for test in kept(NOTES, "test")}
    if (status := Watch(NOTES, None, *LANES, done=done).status) not in (0, 1, 5):
        sys.exit(f"status {status}: {COPY}.out")
    note(NOTES, recorded=status)
tests = [test for test in kept(NOTES, "test") if test["passed"]]
scored = {json.dumps(each["mutant"]): each["by"] for each in kept(NOTES, "mutant")}
killed, of = Counter(), Counter()
for mutant in tomllib.loads(Path(__file__).with_name("mutants.toml").read_text())["mutant"]:
    key, folder = json.dumps(mutant), os.path.dirname(mutant["file"])
    is_there = mutant["line"] in (COPY / mutant["file"]).read_text()
    if PART in mutant["file"] and key not in scored and is_there:
        scored[key] = score(mutant, tests)
        note(NOTES, mutant=mutant, by=scored[key])
    of[folder] += key in scored
    killed[folder] += bool(scored.get(key))
    if scored.get(key) == "":
        print(f"survives in {mutant['file']}:\n{mutant['line']}\n{mutant['becomes']}", flush=True)
print(*(f"{killed[each]:5} of {of[each]:4} killed in {each}" for each in sorted(of)), sep="\n")
