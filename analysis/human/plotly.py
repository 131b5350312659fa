"""The traces of a Plotly page, as ``write_html`` writes them; nothing of the page is run."""

from __future__ import annotations

import base64
import binascii
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_runner_analysis.human.archive import Unreadable

BEGIN = b"Plotly.newPlot("
# The types that Plotly names; the bytes of base64 are little-endian.
DTYPES = {"f8": "<f8", "f4": "<f4", "i4": "<i4", "i2": "<i2", "i1": "i1", "u4": "<u4", "u2": "<u2",
          "u1": "u1"}  # fmt: skip


def traces(page: bytes) -> list[dict[str, Any]]:
    """The traces of the last plot of a page; raises Unreadable."""
    try:
        # The page holds all of Plotly before the call, and the traces are its first list.
        call = page[page.rindex(BEGIN) + len(BEGIN) :].decode("utf-8")
        found, _ = json.JSONDecoder().raw_decode(call, call.index("["))
    except (ValueError, RecursionError) as exc:
        raise Unreadable("it is no page that Plotly wrote, or is cut off") from exc
    if not all(isinstance(trace, dict) for trace in found):
        raise Unreadable("its plot has no traces")
    return list(found)


def numbers(trace: dict[str, Any], axis: str) -> NDArray[np.float64]:
    """The finite numbers of a trace's ``x`` or ``y``: a list, or base64; raises Unreadable."""
    values = trace.get(axis)
    try:
        if isinstance(values, dict):
            content = base64.b64decode(values["bdata"], validate=True)
            found = np.frombuffer(content, DTYPES[values["dtype"]]).astype(float)
        else:
            found = np.array(values, dtype=float)
    except (KeyError, TypeError, ValueError, binascii.Error) as exc:
        raise Unreadable(f"the {axis} of a trace is no list of numbers") from exc
    if found.ndim != 1 or not np.isfinite(found).all():
        raise Unreadable(f"the {axis} of a trace is no list of finite numbers")
    return found
