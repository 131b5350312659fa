"""One trial, and one decision of it."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any

from markupsafe import Markup, escape

from merge_runner.records import SIDES
from merge_runner.text_safety import quoted
from merge_runner_analysis.accounts.account import Account
from merge_runner_analysis.explorer import views
from merge_runner_analysis.explorer.assets import REPLAY
from merge_runner_analysis.explorer.details import (
    Decision,
    Trial,
    read_decisions,
    read_trial,
)
from merge_runner_analysis.explorer.display_text import clamped, shortened
from merge_runner_analysis.explorer.pictures import step_points
from merge_runner_analysis.explorer.reading import Row
from merge_runner_analysis.explorer.site import NotThere, Site
from merge_runner_analysis.explorer.urls import whole

# What is offered to lay beside a trial, and by what rule.
HUMAN, REPETITION = "nearest human", "next repetition"
OFFERS = {
    HUMAN: "the human trial of this condition, at such speeds, whose headway "
    "stays closest to this one's until its first vehicle has merged (root mean square)",
    REPETITION: "the next repetition with the same driver, prompt and condition",
}

SAMPLES = "from states where trial_id = {} and spec_hash = {} order by step, side"


def trial_page(site: Site, trial_id: str, asked: Mapping[str, str]) -> str:
    """Return a trial, with the decision that the address names.

    With ``as=whole`` it has the panels of all of its decisions, and needs no server for them.
    """
    row = find(site, trial_id, asked)
    trial = read_trial(site.db, row["trial_id"], row["spec_hash"])
    panels = whole_panels(site, row, trial) if asked.get("as") == "whole" else {}
    panel, number = "", whole(asked.get("decision", ""))
    if asked.get("side") in SIDES and number is not None:
        try:
            panel = decision_panel(site, row, trial, asked["side"], number)
        except NotThere as exc:
            panel = f"<p>{escape(exc)}</p>"
    return site.render(
        "trial.html",
        here="trials",
        **shown(site, row, trial),
        scripts=REPLAY,
        panel=Markup(panel),  # noqa: S704 # rendered by a template of ours, which escapes
        panels=panels,
    )


def whole_panels(site: Site, row: Row, trial: Trial) -> dict[str, Markup]:
    """Return the panels of all decisions of a trial, by side and number."""
    others = site.catalogue.others
    return {
        f"{side}/{number}": Markup(  # noqa: S704 # as above
            site.render("_decision.html", **panel_values(site, row, trial, found, others))
        )
        for (side, number), found in read_decisions(
            site.db, row["trial_id"], row["spec_hash"]
        ).items()
    }


def shown(site: Site, row: Row, trial: Trial) -> dict[str, Any]:
    """What the template shows of a trial."""
    decided, account = decisions_by_side(trial), views.account_of(row, trial)
    return {
        "row": row,
        "outcome": views.outcome_text(row, trial.scenario),
        "facts": views.facts(row),
        "judged": views.judged_text(trial.scenario),
        "view_box": views.view_box(),
        "data": embedded(replayed(site, row, trial, account)) if trial.states else None,
        "account": account,
        "samples": SAMPLES.format(quoted(row["trial_id"]), quoted(row["spec_hash"])),
        "lines": views.summary(row, trial),
        "actions": {} if decided else views.actions(trial),
        "trial_decisions": decided,
        "offers": OFFERS,
        "clamped": clamped,
        "last_words": [
            said[-1] for mine in decided.values() if (said := [d for d in mine if d["tactical"]])
        ],
    }


def replayed(site: Site, row: Row, trial: Trial, account: Account | None) -> dict[str, Any]:
    """What a replay draws of a trial, with the address of its page."""
    return {**views.replay_data(row, trial, account), "page": site.at.trial(row)}


def ribbons(site: Site, row: Row, trial: Trial) -> str:
    """The ribbons of a trial's decisions."""
    return site.render("_ribbons.html", row=row, trial_decisions=decisions_by_side(trial))


def decisions_by_side(trial: Trial) -> dict[str, list[Row]]:
    """The decisions of each side that has any."""
    decided = {side: [d for d in trial.decisions if d["side"] == side] for side in SIDES}
    return {side: mine for side, mine in decided.items() if mine}


def decision_fragment(site: Site, trial_id: str, asked: Mapping[str, str]) -> str:
    """The panel of one decision."""
    row = find(site, trial_id, asked)
    side, number = _decision_of(asked)
    trial = read_trial(site.db, row["trial_id"], row["spec_hash"])
    return decision_panel(site, row, trial, side, number)


def decision_panel(site: Site, row: Row, trial: Trial, side: str, number: int) -> str:
    """What a driver was told, said, planned and did; raises NotThere."""
    found = read_decisions(site.db, row["trial_id"], row["spec_hash"]).get((side, number))
    if found is None:
        raise NotThere(f"{row['trial_id']} has no decision {number} of the {side} driver")
    values = panel_values(site, row, trial, found, site.catalogue.others)
    return site.render("_decision.html", **values)


def panel_values(
    site: Site, row: Row, trial: Trial, found: Decision, others: Collection[tuple[str, str]]
) -> dict[str, Any]:
    """What the template shows of a decision; ``others`` are the catalogue's."""
    body = next((a["reply"] for a in reversed(found.attempts) if a["reply"]), None)
    text, more = shortened(body or "")
    return {
        "d": found.row,
        "clamped": clamped,
        "went_on": views.older_plan(trial, found.row) if found.row.get("fallback") else "",
        "before": found.before,
        "parts": found.parts,
        "meaning": views.block_meaning,
        "attempts": found.attempts,
        "others": others,
        "reply": None if body is None else {"text": text, "more": more},
        "raw": site.at.raw(row, found.row["side"], found.row["decision"]),
        "chart": views.plan_chart(found, trial),
        "points": step_points,
        "aftermath": views.aftermath(trial, found),
        "perceived": views.perceived(trial, found),
    }


def raw_reply(site: Site, trial_id: str, asked: Mapping[str, str]) -> str:
    """The body of the last reply to a call, whole."""
    row = find(site, trial_id, asked)
    side, number = _decision_of(asked)
    found = read_decisions(site.db, row["trial_id"], row["spec_hash"]).get((side, number))
    bodies = [a["reply"] for a in found.attempts if a["reply"]] if found else []
    if not bodies:
        raise NotThere(f"{trial_id} has no reply to decision {number} of the {side} driver")
    body: str = bodies[-1]
    return body


def find(site: Site, trial_id: str, asked: Mapping[str, str]) -> Row:
    """The trial that an address names; raises NotThere."""
    row = site.catalogue.find(trial_id, asked.get("spec") or None)
    if row is None:
        raise NotThere(f"the database holds no trial {trial_id}")
    return row


def embedded(data: dict[str, Any] | str) -> Markup:
    """Data for a script, as JSON that no HTML can end."""
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)  # noqa: S704 # it holds no character of HTML


def _decision_of(asked: Mapping[str, str]) -> tuple[str, int]:
    side, number = asked.get("side", ""), whole(asked.get("decision", ""))
    if side not in SIDES or number is None:
        raise NotThere("a decision is named by side=left or side=right, and decision=NUMBER")
    return side, number
