"""Cases that are data: tables of the files in tests/cases, whose keys are the ids of tests."""

import tomllib

import pytest

from tests.support.harness import PROJECT


def table(file, *names):
    """A table of a file, or all of it, by name of its cases."""
    found = tomllib.loads((PROJECT / f"tests/cases/{file}.toml").read_text())
    for name in names:
        found = found[name]
    return found


def cases(file, *names):
    """The cases of a table, a parameter each."""
    return [pytest.param(case, id=key) for key, case in table(file, *names).items()]


def by_format(file, name):
    """The cases of a table for each wire format, two parameters each."""
    return [
        pytest.param(wire, case, id=f"{wire} {key}")
        for wire, named in table(file, name).items()
        for key, case in named.items()
    ]
