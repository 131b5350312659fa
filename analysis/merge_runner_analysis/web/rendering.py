"""The templates: of pages, of pages without a server, and of the report."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import jinja2
from jinja2.bccache import Bucket
from markupsafe import Markup

from merge_runner.llm.ledger import APART
from merge_runner_analysis.web.display_text import clamped, visible, with_minus, with_whole_names
from merge_runner_analysis.web.effect_rows import MIDDLE, ends_text
from merge_runner_analysis.web.glossary import used_terms
from merge_runner_analysis.web.marks import SHAPES
from merge_runner_analysis.web.phrases import block_meaning, duration, plain
from merge_runner_analysis.web.pictures import accelerations, sparkline, step_points
from merge_runner_analysis.web.urls import Links
from merge_runner_analysis.wording import (
    MINUS,
    PEOPLES_RULE,
    SHOWN,
    TENDENCY,
    UNLIKE,
    VERDICT_RULE,
    VERDICTS,
    capital,
    money,
    number,
    p_value,
)

TEMPLATES, STATIC = (Path(__file__).with_name(name) for name in ("templates", "static"))
STYLE = "style.css"
METHODS = frozenset(dir(dict))
# Templates whose macros every template may call, without an import.
MACROS = ("scope", "words", "computed", "mark", "conditions", "trust", "notes", "table")


class Environment(jinja2.Environment):
    """Templates that look up ``row.name`` of a dict as its item at once.

    Jinja tries the attribute first, and the exception that follows takes longer than the item.
    """

    def getattr(self, obj: Any, attribute: str) -> Any:  # noqa: ANN401 # as Jinja's
        """Return an attribute or, where there is none, an item."""
        if type(obj) is dict and attribute in obj and attribute not in METHODS:
            return obj[attribute]
        return super().getattr(obj, attribute)


class Compiled(jinja2.FileSystemBytecodeCache):
    """Compiled templates in a folder beside them, as Python keeps modules, if it can be written."""

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep a template."""
        with suppress(OSError):
            Path(self.directory).mkdir(exist_ok=True)
            super().dump_bytecode(bucket)


def environment(
    at: Links, policy: str = "", inlined: Mapping[str, str] | None = None, **shared: object
) -> jinja2.Environment:
    """Return the templates with what they share.

    Without a server, a page says its ``policy`` itself: what it may load. ``inlined`` has, by name,
    the styles and scripts of one that holds them.
    """
    made = Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        auto_reload=False,
        bytecode_cache=Compiled(str(TEMPLATES / "__pycache__")),
        # A misspelt name fails the page rather than leaving a blank in it.
        undefined=jinja2.StrictUndefined,
        # Whatever a page says shows itself; what a form sends back is escaped before.
        finalize=lambda value: visible(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Jinja's own format makes markup of its pattern, and escapes number by number.
    made.filters.update(
        format=lambda text, *values: (str(text) % values).replace("-", MINUS),
        num=number,
        usd=money,
        p=p_value,
        whole="{:,}".format,
        minus=lambda text: with_minus(str(text)),
        plain=plain,
        capitalised=capital,
        whole_names=with_whole_names,
        used_terms=used_terms,
    )
    verdicts = {SHAPES[state]: words for state, words in VERDICTS.items()}
    verdicts[SHAPES[SHOWN]] += f", or the {TENDENCY}"
    verdicts[SHAPES[UNLIKE]] += ", or opposite"
    made.globals.update(at=at, policy=policy, inlined=inlined or {}, style=STYLE, **shared)
    made.globals.update(verdict_shapes=verdicts, verdict_rule=capital(VERDICT_RULE))
    made.globals.update(peoples_rule=PEOPLES_RULE, sums_apart=APART, middle=MIDDLE)
    made.globals.update(ends_text=ends_text, duration=duration, clamped=clamped)
    made.globals.update(meaning=block_meaning, sparkline=sparkline, points=step_points)
    made.globals.update(accelerations=accelerations)
    for name in MACROS:
        macros = vars(made.get_template(f"_{name}.html").module)
        made.globals |= {k: v for k, v in macros.items() if k[0] != "_"}
    return made


def inlined_texts(names: Sequence[str]) -> dict[str, Markup]:
    """Return the texts of styles and scripts of ours, by name, for a page that holds them."""
    return {name: Markup((STATIC / name).read_text(encoding="utf-8")) for name in names}  # noqa: S704


def policy_of(inlined: Mapping[str, str]) -> str:
    """Return the policy of a page that lets these styles and scripts alone run."""
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
        for text in inlined.values()
    )
    return (
        f"default-src 'none'; img-src data:; script-src {hashes}; style-src {hashes}; "
        "base-uri 'none'; form-action 'none'"
    )
