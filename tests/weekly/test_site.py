"""The docs as a site: built without a warning, and readable from its folder without a network."""

import re
import subprocess
from functools import partial

from tests.support.harness import PROJECT


def test_the_site_is_built_without_a_warning_and_loads_nothing_from_elsewhere():
    make = partial(subprocess.run, cwd=PROJECT, capture_output=True, text=True, check=True)
    make(["make", ".venv-site/installed"])
    built = make(["make", "--no-print-directory", "site"])
    assert (built.stdout, built.stderr) == ("", "")
    pages = {page.stem: page.read_text() for page in (PROJECT / "site").glob("*.html")}
    written = {page.stem for page in (PROJECT / "docs").glob("*.md")}
    assert {*pages} == written - {"README"} | {"index", "404"}
    assert "register_driver" in pages["python"]
    for name, text in pages.items():
        loaded = re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="(https?://[^"]+)"', text)
        assert loaded == [], name
