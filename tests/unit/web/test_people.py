"""The sentence on likeness says what is told, and of which measures nothing can be."""

from types import SimpleNamespace

import pytest

from merge_runner_analysis.web.people import tally


def driver(n=40, **states):
    cells = {
        name: SimpleNamespace(values={"measure": name, "state": state, "n": n})
        for name, state in states.items()
    }
    return SimpleNamespace(cells=cells)


@pytest.mark.parametrize(
    ("drivers", "says"),
    [
        ([], ""),
        (
            [
                driver(headway="shown", gap="inconclusive"),
                driver(headway="unlike", velocity="shown"),
            ],
            "Of 2 drivers, like people: 1 (the one ahead goes first), 1 (side by side, the slower "
            "goes first); cannot be told yet: crashes, gap at the merge point.",
        ),
        (
            [driver(19, headway="shown"), driver(gap="inconclusive")],
            "Whether 2 drivers are like people cannot be told yet.",
        ),
        (
            [driver(collisions="unlike"), driver(collisions="inconclusive")],
            "Of 2 drivers, like people: none (crashes); cannot be told yet: the one ahead goes "
            "first, side by side, the slower goes first, gap at the merge point.",
        ),
    ],
)
def test_the_tally_counts_what_is_told_of_each_measure(drivers, says):
    assert tally(drivers) == says
