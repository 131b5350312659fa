"""What the summary says where the arms of a study ask the same."""

from __future__ import annotations


def test_what_many_arms_share_is_one_note(played):
    (note,) = [line for line in played.out.splitlines() if " share " in line]
    assert note.startswith("note: 12 pairs of arms share ")
    assert played.run("audit").out.count(" share ") >= 12
