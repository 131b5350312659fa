"""What is registered is found by name."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from merge_runner.errors import UsageError
from merge_runner.registry import Catalogue, Registry, collecting, using


@pytest.fixture
def colours():
    return Registry[int]("colour")


def test_what_is_registered_is_found_in_its_order_and_taken_once(colours):
    assert colours.register("red", 1) == 1
    colours.register("blue", 2)
    with pytest.raises(UsageError, match="there is a colour 'red' already"):
        colours.register("red", 2)
    with pytest.raises(UsageError, match="the colour 'a b' needs a name of letters"):
        colours.register("a b", 2)
    assert list(colours.items()) == [("red", 1), ("blue", 2)]
    assert colours.require("blue") == 2
    with pytest.raises(UsageError, match=r"^unknown colour 'rot'; valid: red, blue \(or mix\)"):
        colours.require("rot", "or mix")


def test_after_the_first_look_a_study_alone_may_register(colours):
    colours.register("red", 1)
    assert len(colours) == 1
    with pytest.raises(UsageError, match="'green' comes too late"):
        colours.register("green", 3)
    with collecting(Catalogue()) as own:
        colours.register("green", 3)
        assert list(colours) == ["red", "green"]
        with pytest.raises(UsageError, match="there is a colour 'green' already"):
            colours.register("green", 4)
    assert (own.parts, len(colours)) == ({"colour": {"green": 3}}, 1)


def test_a_study_is_shown_to_what_runs_within_alone(colours):
    with ThreadPoolExecutor(1) as thread, using(Catalogue(parts={"colour": {"red": 1}})):
        assert list(colours) == ["red"]
        assert thread.submit(list, colours).result() == []
    assert list(colours) == []
