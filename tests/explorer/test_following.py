"""A page follows a sweep that another process plays."""

from __future__ import annotations

import subprocess
import time

from conftest import served
from harness import PROGRAM, environment
from playwright.sync_api import expect


def test_a_sweep_is_followed_to_its_end_without_a_reload(page, tmp_path, emulator_url):
    db = tmp_path / "merge.duckdb"
    sweep = subprocess.Popen(
        [
            *(PROGRAM, "sweep", "baseline", "--reps", "1", "--conditions", "L_4_0,N_0_0"),
            *("--db", db, "--cache", tmp_path / "cache", "--rpm", "480"),
        ],
        env=environment(EMULATOR_BASE_URL=emulator_url),
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    while not (tmp_path / "merge.duckdb.progress").is_dir():
        assert sweep.poll() is None
        time.sleep(0.05)
    with served(db) as address:
        page.goto(address)
        verdict = page.locator(".sweep-verdict")
        expect(verdict).to_contain_text("Running")
        page.evaluate("window.stayed = true")
        expect(verdict).to_contain_text("Finished: all 2 trials ended", timeout=30_000)
        assert page.evaluate("window.stayed")
        page.get_by_role("link", name="Trials").first.click()
        expect(page.locator("tbody tr")).to_have_count(2)
    assert sweep.wait() == 0
