"""Pages as they open without a server: what needs one is left out, and links lead to files."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable, Iterable, Sequence
from html import escape, unescape
from urllib.parse import parse_qsl, unquote, urlsplit

from markupsafe import Markup

from merge_runner_analysis.web.display_text import visible
from merge_runner_analysis.web.leaks import refuse_leaks
from merge_runner_analysis.web.pages.trial import trial_page
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.site import STATIC, Site
from merge_runner_analysis.web.urls import query_of

# What a template marks, and forms but these.
_SERVED = re.compile(r"<(\w+)\b[^>]*\sdata-served\b[^>]*>.*?</\1>|<form\b.*?</form>", re.DOTALL)
# What htmx and our scripts would ask a server for.
_ASKED = re.compile(r'\s(?:hx-[a-z-]+|data-others)="[^"]*"')
_LINK = re.compile(r'<a\b([^>]*?)\shref="([^"]*)"([^>]*)>(.*?)</a>', re.DOTALL)
_BACK = re.compile(r'\sdata-back="([^"]*)"')
_HEAD, _FOOT = '<meta charset="utf-8">', '<dialog id="help"'
_POLICY = '\n<meta http-equiv="Content-Security-Policy" content="{}">'
_NOTE = (
    '<footer class="quiet small">{}, written by <code>merge-runner view</code>. Search, filters, '
    "SQL and new notes need its server.</footer>\n"
)
_MAIN = re.compile(r'(<main id="main"[^>]*>)(.*)(</main>)', re.DOTALL)
_STYLE = re.compile(r'<link rel="stylesheet" href="/static/([^"]+)">\n')
_SCRIPT = re.compile(r'<script src="/static/([^"]+)" defer></script>\n?')
_ICON = re.compile(r'<link rel="icon"[^>]*>\n')


def offline(text: str, study: str, policy: str, address: Callable[[str], str]) -> str:
    """Return a served page as one without a server.

    ``address`` returns where a link leads then. What leads nowhere is text, or nothing where it
    only names another page (``data-page``).
    """

    def link(found: re.Match[str]) -> str:
        before, href, after, words = found.groups()
        leads = href if href.startswith("#") else escape(address(unescape(href)))
        if not leads:
            return "" if "data-page" in before else words
        return f'<a{before} href="{leads}"{after}>{words}</a>'

    def back(found: re.Match[str]) -> str:
        return f' data-back="{escape(address(unescape(found[1])))}"'

    text = _ASKED.sub("", _SERVED.sub("", text))
    text = _LINK.sub(link, _BACK.sub(back, text))
    text = text.replace(_HEAD, _HEAD + _POLICY.format(policy), 1)
    return text.replace(_FOOT, _NOTE.format(escape(visible(study))) + _FOOT, 1)


def page_of_trials(site: Site, rows: Sequence[Row]) -> str:
    """Return one page with trials, its styles and scripts within; raises UsageError."""
    held = {(row["trial_id"], row["spec_hash"]): row for row in rows}

    def address(served: str) -> str:
        parts = urlsplit(served)
        trial, asked = unquote(parts.path.removeprefix("/trials/")), dict(parse_qsl(parts.query))
        there = (trial, asked.get("spec")) in held
        return query_of({"trial": trial, **asked}) if there else ""

    pages = []
    for trial_id, spec_hash in held:
        served = trial_page(site, trial_id, {"spec": spec_hash})
        pages.append(offline(served, site.db.name, "POLICY", address))
    page = pages[0]
    if len(pages) > 1:
        parts = [found[2] for each in pages if (found := _MAIN.search(each))]
        # Rendered by templates of ours.
        trials = zip(held.values(), map(Markup, parts), strict=True)
        several = site.render("_several.html", held=list(trials))
        page = _MAIN.sub(lambda found: found[1] + several + found[3], page)
    refuse_leaks(site.db, "the page", page)
    return _inlined(page)


def _inlined(page: str) -> str:
    """Return a page with the texts of its styles and scripts, which alone its policy lets run."""

    def texts(names: Iterable[str]) -> list[str]:
        return [(STATIC / name).read_text(encoding="utf-8") for name in names]

    styles, scripts = texts(_STYLE.findall(page)), texts(_SCRIPT.findall(page))
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
        for text in (*styles, *scripts)
    )
    policy = (
        f"default-src 'none'; img-src data:; script-src {hashes}; style-src {hashes}; "
        "base-uri 'none'; form-action 'none'"
    )
    for pattern in (_STYLE, _SCRIPT, _ICON):
        page = pattern.sub("", page)
    page = page.replace('content="POLICY"', f'content="{policy}"', 1)
    head = "".join(f"<style>{text}</style>\n" for text in styles)
    foot = "".join(f"<script>{text}</script>\n" for text in scripts)
    return page.replace("</head>", f"{head}</head>", 1).replace("</body>", f"{foot}</body>")
