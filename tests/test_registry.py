"""What is registered is found by name, also from outside the package."""

from __future__ import annotations

import pytest

from merge_runner.errors import UsageError
from merge_runner.registry import Registry
from tests.harness import plugin


def test_what_is_registered_is_found_in_its_order():
    colours = Registry[int]("colour")
    assert colours.register("red", 1) == 1
    colours.register("blue", 2)
    assert list(colours.items()) == [("red", 1), ("blue", 2)]
    assert colours.require("blue") == 2


def test_an_unknown_name_is_answered_with_the_valid_ones():
    colours = Registry[int]("colour")
    colours.register("red", 1)
    with pytest.raises(UsageError, match=r"^unknown colour 'rot'; valid: red \(or mix them\)$"):
        colours.require("rot", "or mix them")


def test_a_name_is_taken_once():
    colours = Registry[int]("colour")
    colours.register("red", 1)
    with pytest.raises(UsageError, match="there is a colour 'red' already"):
        colours.register("red", 2)


async def test_a_plug_in_that_fails_is_told_in_one_line(merge_runner, tmp_path):
    env = plugin(tmp_path / "installed", "import no_such_module")
    process = await merge_runner.start(
        "sweep", "baseline", "--model", "constant", "--dry-run", **env
    )
    _, err = await process.communicate()
    assert process.returncode == 2
    assert err.decode() == (
        "error: the plug-in dummies = 'dummies' fails: No module named 'no_such_module'\n"
    )
