"""Nothing on the pages keeps anybody out who reads with other eyes."""

from __future__ import annotations

import pytest

from tests.explorer.axe import serious

PAGES = (
    "/sweeps",
    "/",
    "/tables",
    "/tables/attempts",
    "/ablations",
    "/discordant?model=emulator&variant=A1",
    "/trials/o4/baseline/L_4_0/rep01?side=left&decision=2",
    "/humans",
    "/sql?q=select+1",
    "/trials",
    "/trials/emulator/baseline/N_0_0/rep01?side=left&decision=2"
    "&compare=emulator/baseline/N_0_0/rep02",
)


@pytest.mark.parametrize("address", PAGES)
def test_axe_finds_nothing_serious(page, address):
    page.goto(address)
    page.wait_for_load_state("networkidle")
    assert serious(page) == []
