"""The messages that docs/troubleshooting.md quotes are those of the program."""

import ast
import re

from tests.support.harness import PROJECT

PAGE = (PROJECT / "docs/troubleshooting.md").read_text("utf-8")
QUOTED = re.findall(r"^\| `+ ?(.+?) ?`+ \|", PAGE, re.MULTILINE)
GAP = "…"


def texts():
    """Every text of the program, with a gap where it names something."""
    for file in (PROJECT / "merge_runner").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.JoinedStr):
                yield "".join(v.value if isinstance(v, ast.Constant) else GAP for v in node.values)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield re.sub(r"\{[a-z!]+\}", GAP, node.value)


def test_each_quoted_message_is_one_of_the_program():
    assert len(QUOTED) >= 20
    whole = "\n".join(texts())
    for message in QUOTED:
        assert message.strip(GAP) in whole, message
