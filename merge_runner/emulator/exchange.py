"""A request to the emulator and its response, whatever carries them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from merge_runner.emulator.formats import ServedFormat
from merge_runner.emulator.replies import dumps, marked

JSON = "application/json"


@dataclass(frozen=True, slots=True)
class Request:
    """An HTTP request; ``named`` are the parts of its path that a route names."""

    method: str
    path: str
    host: str
    headers: Mapping[str, str]
    query: Mapping[str, str]
    body: bytes
    named: Mapping[str, str] = field(default_factory=dict)

    def json(self) -> Any:  # noqa: ANN401 # whatever the client sent
        """The body; raises ValueError."""
        return json.loads(self.body)

    def form(self) -> dict[str, bytes]:
        """The fields of a multipart body by name; raises ValueError."""
        boundary = re.search('boundary="?([^";]+)', self.headers.get("content-type", ""))
        if boundary is None:
            raise ValueError("no form")
        fields = {}
        for part in self.body.split(b"--" + boundary[1].encode()):
            head, _, content = part.partition(b"\r\n\r\n")
            if name := re.search(rb'[; ]name="?([^";\r]+)', head):
                fields[name[1].decode()] = content.removesuffix(b"\r\n")
        return fields


@dataclass(frozen=True, slots=True)
class Response:
    """An HTTP response."""

    body: bytes
    status: int = 200
    headers: dict[str, str] = field(default_factory=lambda: {"content-type": JSON})


class BrokenOff(Exception):  # nobody made an error: it is a fault on purpose
    """The connection ends before, or within, the response; ``fault`` says how."""

    def __init__(self, fault: str) -> None:
        super().__init__(f"the emulator broke off: {fault}")
        self.fault = fault


def as_json(
    body: dict[str, Any], headers: Mapping[str, str] | None = None, status: int = 200
) -> Response:
    """Return a response of JSON."""
    return Response(dumps(body), status, {"content-type": JSON, **(headers or {})})


def as_error(wire: ServedFormat, status: int, message: str, delay_s: float = 0.0) -> Response:
    """Return an error in a provider's form."""
    body, headers = wire.error(status, message, delay_s)
    return as_json(marked(body), headers, status)
