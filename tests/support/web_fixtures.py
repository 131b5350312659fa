"""A real browser at the explorer that a module of tests serves as its ``site``."""

import os
import shutil
from importlib.resources import files

import pytest

HERE = ("http://127.0.0.1:", "file:", "data:", "blob:")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
# All rules are run; only of what violates one are the places described, which takes longest.
RUN = "axe.run({preload: false, resultTypes: ['violations']})"
AXE = files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8")


def serious(page):
    """The findings that are serious or critical: rule, and the beginning of three elements."""
    page.evaluate(AXE)
    return [
        (finding["id"], [node["html"][:200] for node in finding["nodes"][:3]])
        for finding in page.evaluate(RUN)["violations"]
        if finding["impact"] in {"serious", "critical"}
    ]


@pytest.fixture(scope="module")
def browser():
    """Chromium without a window; while it is there an event loop runs, and no other test's can."""
    if CHROMIUM is None:
        missing = "no chromium is installed"
        if os.environ.get("MERGE_RUNNER_BROWSER") == "required":
            pytest.fail(missing)
        pytest.skip(missing)
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=60_000)  # ms: a busy machine is slow, not wrong
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser, site):
    """A page that asks the explorer alone, where no script fails and axe finds nothing serious."""
    context = browser.new_context(base_url=site, viewport={"width": 1500, "height": 1000})
    context.set_default_timeout(60_000)
    page = context.new_page()
    asked, wrong = [], []
    context.on("request", lambda request: asked.append(request.url))
    context.on("weberror", lambda error: wrong.append(str(error.error)))
    context.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    yield page
    found = serious(page)
    context.close()
    assert wrong == []
    assert [url for url in asked if not url.startswith(HERE)] == []
    assert found == []
