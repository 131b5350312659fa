"""The list of sweeps, and the page of one, which follows it while it runs."""

from __future__ import annotations

from merge_runner.prompts.blocks import VARIANTS
from merge_runner_analysis.explorer.conditions import ordered
from merge_runner_analysis.explorer.site import NothingNew, NotThere, Site, news_of
from merge_runner_analysis.explorer.sweeps import (
    Sweep,
    VariantCondition,
    duration,
    find_sweep,
    list_sweeps,
    total_of,
)
from merge_runner_analysis.explorer.views import prompt_text

KINDS = {
    "trial": "Trials that failed",
    "plan": "Replies without a valid plan",
    "attempt": "Attempts without a good reply",
}


def sweeps_page(site: Site, seen: str = "") -> str:
    """All sweeps; raises NothingNew where they are as they were ``seen``."""
    sweeps = list_sweeps(site.catalogue)
    return site.render(
        "sweeps.html", here="sweeps", sweeps=sweeps, duration=duration, seen=news_of(sweeps, seen)
    )


def sweep_page(site: Site, sweep_id: str, seen: str = "") -> str:
    """One sweep, and a newer one if there is; raises NotThere, and NothingNew as ``seen``."""
    sweep = find_sweep(site.catalogue, sweep_id)
    if sweep is None:
        raise NotThere(f"the database holds no sweep {sweep_id}")
    state = sweep.entry.state
    if seen and state == "lost" and site.catalogue.held:
        raise NothingNew  # how it ended cannot be read yet
    newer = sweep.newest if sweep.newest.sweep_id != sweep_id else None
    shown = (sweep, newer and (newer.sweep_id, newer.state))
    return site.render(
        "sweep.html",
        here="sweeps",
        newer=newer,
        seen=news_of(shown, seen, state),
        # A screen reader says the sentence once a state, and not every time that a number changes.
        quiet=seen.startswith(f"{state}-"),
        heard=bool(seen),
        **_values(site, sweep),
    )


def _values(site: Site, sweep: Sweep) -> dict[str, object]:
    """What the templates of a sweep show."""
    usual = sweep.entry.config.planned if sweep.entry.config.arms else VARIANTS
    variants = ordered({variant for variant, _ in sweep.cells}, usual)
    conditions = ordered({condition for _, condition in sweep.cells})
    rows = [
        (condition, [sweep.cells.get((variant, condition)) for variant in variants])
        for condition in conditions
    ]
    return {
        "sweep": sweep,
        "entry": sweep.entry,
        "assessment": sweep.assessment,
        "variants": variants,
        "states": {variant: cell.state for (variant, _), cell in sweep.cells.items()},
        "matrix": rows,
        "totals": list(map(total_of, zip(*[cells for _, cells in rows], strict=True))),
        "causes": {
            text: [row for row in sweep.causes if row["cause"].startswith(f"{kind}: ")]
            for kind, text in KINDS.items()
        },
        "bar": bar,
        "prompt_text": prompt_text,
        "duration": duration,
    }


def bar(cell: VariantCondition) -> list[tuple[str, float, float]]:
    """(what, from, width) of a bar of 100 units for the planned trials of a cell."""
    whole = max(cell.planned, cell.ended + cell.failed, 1)
    parts, begin = [], 0.0
    for name, count in (("ended", cell.ended), ("failed", cell.failed)):
        width = 100 * count / whole
        if count:
            parts.append((name, round(begin, 2), round(width, 2)))
        begin += width
    return parts
