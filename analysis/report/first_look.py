"""In plain words: what a driver does first, beside the humans."""

from __future__ import annotations

from collections.abc import Iterator

from analysis.data.study import Group, Study
from analysis.stats.first_look import Humans, Seat, acts, cue, faults, humans, seats
from analysis.tables.notes import listed


def first_look(study: Study, group: Group) -> Iterator[str]:
    """Of each of its drivers the slope on the relative velocity, and the faults that are shown."""
    known = humans(study)
    for seat in seats(group):
        yield from _slope(study, seat, known)
        shown = [one.said for one in faults(acts(study, seat), known) if one.shown]
        if shown:
            yield (
                f"In its first action {seat.name} differs from the humans, after Holm's "
                f"correction: {listed(shown)}."
            )


def _slope(study: Study, seat: Seat, known: Humans) -> Iterator[str]:
    slope, _ = cue(acts(study, seat).within(known.velocities))
    own, human = slope and slope.bounds(), known.slope.bounds()
    if slope is not None and own and human:
        yield (
            f"{seat.name} changes its first acceleration by {slope.value:+.2f} m/s² for each m/s "
            "by which it is faster than the other vehicle (95 % CI "
            f"{own[0]:+.2f} to {own[1]:+.2f}), humans by {known.slope.value:+.2f} "
            f"({human[0]:+.2f} to {human[1]:+.2f}; {known.source})."
        )
