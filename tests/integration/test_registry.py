"""What is registered is found by name, also from outside the package."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from merge_runner import registry
from merge_runner.errors import UsageError
from merge_runner.registry import Catalogue, Registry, collecting, using
from tests.support.harness import plugin


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


def test_a_plug_in_that_fails_is_told_at_each_look(monkeypatch):
    class Point:
        name, value = "mine", "mine.drivers"

        def load(self):
            raise ImportError("no such thing")

    monkeypatch.setattr(registry, "plugins", lambda: [Point()])
    monkeypatch.setattr(registry, "_loaded", [])
    colours = Registry[int]("colour")
    said = "the plug-in mine = 'mine.drivers' fails: no such thing"
    for look in (lambda: colours.require("red"), lambda: list(colours), lambda: len(colours)):
        for _ in range(2):
            with pytest.raises(UsageError, match=said):
                look()


def test_a_plug_in_of_an_installed_package_may_look_and_register_and_nobody_afterwards(monkeypatch):
    colours, kinds = Registry[int]("colour"), Registry[int]("kind")

    class Point:
        name, value = "mine", "mine.drivers"

        def load(self):
            assert list(colours) == ["red"]
            colours.register("blue", 2)

    colours.register("red", 1)
    monkeypatch.setattr(registry, "plugins", lambda: [Point()])
    monkeypatch.setattr(registry, "_loaded", [])
    assert dict(colours) == {"red": 1, "blue": 2}
    for complete in (colours, kinds):
        with pytest.raises(UsageError, match="'green' comes too late"):
            complete.register("green", 3)
    with collecting(Catalogue()) as own:
        colours.register("green", 3)
        assert len(colours) == 3
    assert (own.parts, len(colours)) == ({"colour": {"green": 3}}, 2)


def test_a_study_is_shown_to_what_runs_within_alone():
    colours = Registry[int]("colour")
    with ThreadPoolExecutor(1) as thread, using(Catalogue(parts={"colour": {"red": 1}})):
        assert list(colours) == ["red"]
        assert thread.submit(list, colours).result() == []
    assert list(colours) == []
