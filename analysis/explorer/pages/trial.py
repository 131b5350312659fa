"""One trial, and one decision of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from merge_runner.records import SIDES
from merge_runner.text_safety import quoted
from merge_runner_analysis.accounts import Account
from merge_runner_analysis.explorer import views
from merge_runner_analysis.explorer.details import Trial, read_trial
from merge_runner_analysis.explorer.display_text import clamped, shortened
from merge_runner_analysis.explorer.pictures import step_points
from merge_runner_analysis.explorer.prompts import parts_of
from merge_runner_analysis.explorer.reading import Row
from merge_runner_analysis.explorer.site import REPLAY, NotThere, Site
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
    panel = Markup()
    if asked.get("side") in SIDES and whole(asked.get("decision", "")) is not None:
        try:
            panel = decision_panel(site, row, trial, decision_at(trial, asked))
        except NotThere as exc:
            panel = Markup("<p>{}</p>").format(exc)
    account = views.account_of(row, trial)
    return site.render(
        "trial.html",
        here="trials",
        scripts=REPLAY,
        panel=panel,
        panels=panels,
        row=row,
        outcome=views.outcome_text(row, trial.scenario),
        facts=views.facts(row),
        judged=views.judged_text(trial.scenario),
        view_box=views.view_box(),
        data=embedded(replayed(site, row, trial, account)) if trial.states else None,
        account=account,
        samples=SAMPLES.format(quoted(row["trial_id"]), quoted(row["spec_hash"])),
        lines=views.summary(row, trial),
        trial_decisions=trial.by_side,
        offers=OFFERS,
        clamped=clamped,
        last_words=[
            said[-1]
            for mine in trial.by_side.values()
            if (said := [d for d in mine if d["tactical"]])
        ],
    )


def whole_panels(site: Site, row: Row, trial: Trial) -> dict[str, Markup]:
    """Return the panels of all decisions of a trial, by side and number."""
    return {
        f"{d['side']}/{d['decision']}": decision_panel(site, row, trial, d) for d in trial.decisions
    }


def replayed(site: Site, row: Row, trial: Trial, account: Account | None) -> dict[str, Any]:
    """What a replay draws of a trial, with the address of its page."""
    return {**views.replay_data(row, trial, account), "page": site.at.trial(row)}


def ribbons(site: Site, row: Row, trial: Trial) -> str:
    """The ribbons of a trial's decisions."""
    return site.render("_ribbons.html", row=row, trial_decisions=trial.by_side)


def decision_fragment(site: Site, trial_id: str, asked: Mapping[str, str]) -> str:
    """The panel of one decision; raises NotThere."""
    row = find(site, trial_id, asked)
    trial = read_trial(site.db, row["trial_id"], row["spec_hash"])
    return decision_panel(site, row, trial, decision_at(trial, asked))


def decision_at(trial: Trial, asked: Mapping[str, str]) -> Row:
    """The decision that an address names; raises NotThere."""
    side, number = asked.get("side", ""), whole(asked.get("decision", ""))
    if side not in SIDES or number is None:
        raise NotThere("a decision is named by side=left or side=right, and decision=NUMBER")
    found = [d for d in trial.decisions if (d["side"], d["decision"]) == (side, number)]
    if not found:
        raise NotThere(f"the trial has no decision {number} of the {side} driver")
    return found[0]


def decision_panel(site: Site, row: Row, trial: Trial, decision: Row) -> Markup:
    """What a driver was told, said, planned and did."""
    body, before = _reply(decision), decision["before"]
    text, more = shortened(body or "")
    panel = site.render(
        "_decision.html",
        d=decision,
        driver=row[f"model_{decision['side']}"],
        clamped=clamped,
        went_on=views.older_plan(trial, decision) if decision["fallback"] else "",
        before=before,
        parts=parts_of(decision["prompt"] or "", before["prompt"] if before else None),
        meaning=views.block_meaning,
        others=site.catalogue.others,
        reply=None if body is None else {"text": text, "more": more},
        raw=site.at.raw(row, decision["side"], decision["decision"]),
        chart=views.plan_chart(decision, trial),
        points=step_points,
        aftermath=views.aftermath(trial, decision),
    )
    return Markup(panel)  # noqa: S704 # rendered by a template of ours, which escapes


def raw_reply(site: Site, trial_id: str, asked: Mapping[str, str]) -> str:
    """The body of the last reply to a call, whole; raises NotThere."""
    row = find(site, trial_id, asked)
    trial = read_trial(site.db, row["trial_id"], row["spec_hash"])
    body = _reply(decision_at(trial, asked))
    if body is None:
        raise NotThere(f"{trial_id} has no reply to this decision")
    return body


def _reply(decision: Row) -> str | None:
    bodies: list[str] = [a["reply"] for a in decision["attempts"] if a["reply"]]
    return bodies[-1] if bodies else None


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
