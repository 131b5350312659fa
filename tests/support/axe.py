"""What keeps people out who read with other eyes, as axe-core finds it on a page."""

from __future__ import annotations

from importlib.resources import files

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
