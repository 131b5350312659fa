"""What drivers said, searched: decisions whose words hold those of a query."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from analysis.explorer.display_text import visible
from analysis.explorer.pages.trial import embedded
from analysis.explorer.pages.trials import filter_of
from analysis.explorer.reading import Row
from analysis.explorer.search import KINDS, LONGEST, OWN_FACETS, TRIAL_FACETS, Wanted
from analysis.explorer.site import Site
from analysis.explorer.snippets import LONGEST_QUERY, MOST_TERMS, terms_of
from analysis.explorer.urls import whole

HEADINGS = {
    "tactical": "said",
    "switch": "change of mind",
    "failure": "invalid",
    "model": "driver",
    "variant": "prompt",
}


def words_page(site: Site, asked: Mapping[str, str]) -> str:
    """A page of the decisions that an address asks for."""
    wanted = wanted_of(asked)
    found = site.words.search(wanted, whole(asked.get("page", "")) or 1)
    chosen = {**wanted.trials.chosen, **wanted.own, "q": asked.get("q", "")}
    return _rendered(
        site,
        found=found,
        facets=found.facets,
        chosen=chosen,
        kind=wanted.kind,
        kept={**chosen, "in": wanted.kind},
    )


def wanted_of(asked: Mapping[str, str]) -> Wanted:
    """What an address asks for; a kind of words that is unknown is the first."""
    own = {name: asked[name] for name in OWN_FACETS if asked.get(name)}
    kind = asked.get("in", "")
    return Wanted(
        kind if kind in KINDS else next(iter(KINDS)),
        tuple(terms_of(asked.get("q", ""))),
        replace(filter_of(asked), q=""),
        own,
    )


def exported_words(site: Site, trials: Sequence[Row], pack: Callable[[object], str]) -> str:
    """A page that searches the rationales of these trials by itself; ``pack`` makes them small."""
    rows = {row["number"]: row for row in trials}
    said = [one for one in site.words.every("rationales") if one["number"] in rows]
    places = {number: place for place, number in enumerate(rows)}
    tags: dict[tuple[str, str], list[str]] = {}
    for trial_id, spec_hash, tag in site.notes.kept().tags:
        tags.setdefault((trial_id, spec_hash), []).append(tag)
    of_trial = [
        {
            "href": site.at.trial(row),
            "name": visible(row["trial_id"]),
            **{name: [row[name]] for name in TRIAL_FACETS if name in row},
            "tag": tags.get((row["trial_id"], row["spec_hash"]), []),
        }
        for row in rows.values()
    ]
    decided = [
        {
            "of": places[one["number"]],
            "at": f"{one['side']}, decision {one['decision']} at {one['time_s']:.1f} s",
            "query": f"side={one['side']}&decision={one['decision']}",
            **{name: one[name] for name in OWN_FACETS},
            "text": visible(one["text"] or ""),
        }
        for one in said
    ]
    counts = {name: Counter(one[name] for one in decided if one[name]) for name in OWN_FACETS}
    counts |= {name: Counter[str]() for name in TRIAL_FACETS}
    for place, times in Counter(one["of"] for one in decided).items():
        for name in TRIAL_FACETS:
            counts[name].update(dict.fromkeys(filter(None, of_trial[place][name]), times))
    return _rendered(
        site,
        found=None,
        facets={name: sorted(count.items()) for name, count in counts.items()},
        chosen={},
        kind="rationales",
        kept={},
        data=embedded(pack({"trials": of_trial, "said": decided})),
    )


def _rendered(site: Site, **values: object) -> str:
    return site.render(
        "words.html",
        here="words",
        headings=HEADINGS,
        kinds=KINDS,
        longest=LONGEST,
        longest_query=LONGEST_QUERY,
        most_terms=MOST_TERMS,
        **values,
    )
