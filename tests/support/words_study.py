"""The study of text factors that the page about them shows."""

import re

from tests.support.harness import PROJECT

PAGE = (PROJECT / "docs/run-a-study.md").read_text("utf-8")
EXAMPLE = re.search(r"## Text factors\n+```toml\n(.*?)```", PAGE, re.DOTALL)[1]
