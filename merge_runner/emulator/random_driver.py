"""A model that understands nothing: for any prompt M or Y and a plan, both drawn at random.

It rehearses a study whose prompts the scripted driver cannot read. The draws are a function of the
prompt and the slot.
"""

from __future__ import annotations

import re

from merge_runner.chance import draw, draw_between
from merge_runner.records import Slot

MODEL = "random-driver"
MOST_ACTIONS = 200
# The parser takes the list of the right length, whatever others stand beside it.
USUAL_LENGTHS = range(1, 31)


def answer(prompt: str, slot: Slot | None) -> str:
    """The reply's text for a prompt; without a slot it depends on the prompt alone."""
    drawn_for = (prompt, *(() if slot is None else slot.as_dict().values()))
    word = "M" if draw("word", *drawn_for) < 0.5 else "Y"
    action = f"{round(draw_between(-1, 1, 'action', *drawn_for), 2) + 0.0:.2f}"
    plans = "\n".join(f"[{', '.join([action] * length)}]" for length in _lengths(prompt))
    return f"{word}\n\nI draw lots and hold what I draw.\n\n```python\n{plans}\n```"


def _lengths(prompt: str) -> list[int]:
    """How many actions the plan has, or may have where the prompt says it in its own words."""
    asked = {int(number) for number in re.findall(r"exactly (\d+) numbers", prompt)}
    if asked:
        return sorted(asked)
    mentioned = {int(number) for number in re.findall(r"(?<![\d.])\d{1,3}(?!\.?\d)", prompt)}
    return sorted({*USUAL_LENGTHS, *(n for n in mentioned if 0 < n <= MOST_ACTIONS)})
