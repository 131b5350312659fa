"""Nothing on the pages keeps anybody out who reads with other eyes."""

from __future__ import annotations

from importlib.resources import files

import pytest

PAGES = (
    "/sweeps",
    "/",
    "/tables",
    "/tables/attempts",
    "/ablations",
    "/humans",
    "/sql?q=select+1",
    "/trials",
    "/trials?outcome=collided",
    "/trials/emulator/baseline/N_0_0/rep01?side=left&decision=2",
    "/trials/emulator/baseline/N_0_0/rep01?compare=emulator/baseline/N_0_0/rep02",
)
AXE = files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8")


@pytest.mark.parametrize("address", PAGES)
def test_axe_finds_nothing_serious(page, address):
    page.goto(address)
    page.wait_for_load_state("networkidle")
    page.evaluate(AXE)
    found = page.evaluate("axe.run()")
    serious = [
        (finding["id"], [node["html"][:200] for node in finding["nodes"][:3]])
        for finding in found["violations"]
        if finding["impact"] in {"serious", "critical"}
    ]
    assert serious == []
