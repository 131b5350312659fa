"""The explorer of a small study, served to a real browser."""

from __future__ import annotations

import os
import shutil

import pytest

from merge_runner.results.store import Store
from tests.support.harness import RECORDING
from tests.support.hostile import hostile_trial
from tests.support.serving import served
from tests.support.studies import Drive, Said, as_humans, played

HERE = ("http://127.0.0.1:", "file:", "data:", "blob:")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


def pytest_collection_modifyitems(items):
    """Tests in a browser are slow: each waits for its pages, and every module starts one."""
    for item in items:
        if "browser" in item.fixturenames:
            item.add_marker(pytest.mark.slow)


def pytest_runtest_setup(item):
    """Without a browser the tests of pages are skipped, but not where they are required."""
    if "page" in item.fixturenames and CHROMIUM is None:
        if os.environ.get("MERGE_RUNNER_BROWSER") == "required":
            pytest.fail("no chromium is installed")
        pytest.skip("needs chromium: apt install chromium")


@pytest.fixture(scope="session")
def study(prepare, tmp_path_factory):
    """Recorded trials, one of which collides, and a hostile, a failed and a human one."""
    folder = tmp_path_factory.mktemp("study")
    sweep = ("replay", "baseline", "--recording", RECORDING, "--db", "study.duckdb")
    run = prepare(folder, *sweep, "--reps", 3, "--conditions", "L_4_0,N_0_0")
    assert run.code == 0, run.err
    lost = Drive("o4", "baseline", "L_4_0", 1, (0.4,), (-0.4,), {2: Said(("timeout",), lost=True)})
    human = Drive("human", "baseline", "N_0_0", 1, (0.4, 0.4), (-0.4, -0.4))
    made = [hostile_trial(), played(lost), played(human)]
    Store(folder / "study.duckdb").write("hostile", made, patience_s=5)
    as_humans(folder / "study.duckdb")
    return folder / "study.duckdb"


@pytest.fixture(scope="session")
def site(study):
    """The address of the explorer."""
    with served(study) as address:
        yield address


@pytest.fixture(scope="module")
def browser():
    """Chromium without a window; while it is there an event loop runs, and no other test's can."""
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=60_000)  # ms: a busy machine is slow, not wrong
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser, site):
    """A page that may ask the explorer alone, and on which no script may fail."""
    context = browser.new_context(base_url=site, viewport={"width": 1500, "height": 1000})
    page = context.new_page()
    asked, wrong = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    yield page
    context.close()
    # A filter that is changed before its list is there gives the first one up.
    assert [said for said in wrong if not said.startswith("htmx:")] == []
    assert [url for url in asked if not url.startswith(HERE)] == []
