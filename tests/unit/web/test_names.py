"""What the names on a page mean."""

import json

import pytest

from merge_runner.drivers.registry import PROGRAMS, Program
from merge_runner.registry import Catalogue, collecting, using
from merge_runner_analysis.web.names import (
    names_mean,
    opponents_text,
    program_text,
    programs_of,
    short_names,
)


class Hesitant:
    """Brakes a little.

    And then more.
    """

    async def decide(self, observation, number):
        return observation


class Silent:
    __doc__ = None
    decide = Hesitant.decide


def test_a_program_says_what_it_does_as_far_as_it_is_loaded():
    assert program_text("constant") == "a program: keeps its speed"
    assert (
        program_text("fast", "constant") == "a program, otherwise set than usual: keeps its speed"
    )
    assert program_text("hesitant") == "a program, defined in this study"
    text = 'PROGRAMS.register("hesitant", Program(Hesitant, "brakes a little"))'
    assert program_text(
        "hesitant", plugins=[json.dumps({"a.py": "", "plugin.py": text}), None]
    ) == ("a program: brakes a little")
    assert program_text("strong", "hesitant") == "hesitant otherwise set"
    with collecting(Catalogue()) as own:
        PROGRAMS.register("hesitant", Program(Hesitant, ""))
        PROGRAMS.register("silent", Program(Silent, ""))
    with using(own):
        assert program_text("hesitant") == "a program: Brakes a little"
        assert "does not say" in program_text("silent")


def test_programs_are_those_of_the_specs():
    left = {"program": "idm"}
    assert programs_of([{"left": left, "right": {"body": {}}}, {}]) == [left]


def test_the_parts_of_names_are_explained_once():
    drivers = ["bold at localhost:8123/set1", "bold at localhost:8123+idm [12ab34cd]", "emulator"]
    meanings = names_mean([{"program": "idm", "based_on": None}], drivers)
    assert [*meanings] == ["/set1", "[12ab34cd]", "at localhost:8123", "emulator", "idm"]


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        (["bold at a:1", "idm"], ["bold", "idm"]),
        (["bold at a:1", "bold at b:1"], ["bold at a:1", "bold at b:1"]),
    ],
)
def test_a_server_is_named_only_where_it_tells_two_drivers_apart(names, shown):
    assert [*short_names(names).values()] == shown


@pytest.mark.parametrize(
    ("names", "says"),
    [
        ([], ""),
        (["o3", "idm"], "Each driver here met a copy of itself."),
        (["o3+idm"], "A+B: driver A met driver B."),
        (
            ["o3", "o3+idm"],
            "A+B: driver A met driver B. A driver named alone met a copy of itself.",
        ),
    ],
)
def test_the_page_says_whom_a_driver_meets(names, says):
    assert opponents_text(names) == says
