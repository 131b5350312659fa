"""A trial in which a model says what nobody should, and an object that acts when it is read."""

import json
import os
from dataclasses import replace

from tests.support.studies import Drive, Said, played

# What a model may write; none of it may run, hide, or turn the page around.
HOSTILE = (
    "<script>document.title='owned'</script><img src=x onerror=\"document.title='owned'\">"
    "{{ 7*7 }}{% raw %} \u202etxet\u202c \x00\x1b[2J </pre></script> "
)
LONG = 1_000_000


class Bomb:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


def hostile_trial():
    """A trial whose left driver says what nobody should."""
    said = {1: Said(failure="no_array")}
    drive = Drive("<b>o3</b>", "baseline", "L_4_0", 1, (0.4, 0.4), (-0.4, -0.4), said)
    record = played(drive)
    decisions = [row._replace(decision=_hostile(row.decision)) for row in record.decisions]
    return record._replace(decisions=tuple(decisions))


def _hostile(decision):
    reply = decision.reply
    text = HOSTILE + "x" * LONG
    attempts = [replace(a, reply=json.dumps({"text": text}), error=HOSTILE) for a in reply.attempts]
    return replace(
        decision,
        rationale=HOSTILE,
        prompt=f"You drive a car.\n\n{HOSTILE}",
        reply=reply._replace(attempts=tuple(attempts)),
    )
