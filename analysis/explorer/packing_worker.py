"""Packs the trials that it is asked for, in a process of its own: a page of them takes seconds."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from analysis.explorer.child import Answer, adopt_given, serve
from analysis.explorer.packing import pack_trials
from analysis.explorer.site import Site
from analysis.explorer.urls import StaticLinks


def answer(site: Site, request: dict[str, Any]) -> Answer:
    """The packed trials, as JSON."""
    others = {(requested, served) for requested, served in request["others"]}
    return {}, json.dumps(pack_trials(site, request["rows"], others)).encode()


if __name__ == "__main__":
    file, links = sys.argv[1:]
    adopt_given()
    of_files = Site(Path(file), StaticLinks(**json.loads(links)))
    serve(lambda request: answer(of_files, request))
