"""One trial, and one decision of it."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
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
    """Return a trial with all of its decisions."""
    row = find(site, trial_id, asked)
    trial = read_trial(site.db, row["trial_id"], row["spec_hash"])
    account = views.account_of(row, trial)
    return site.render(
        "trial.html",
        here="trials",
        scripts=REPLAY,
        panels=panels(site, row, trial),
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


def panels(site: Site, row: Row, trial: Trial) -> list[Markup]:
    """Return the panels of all decisions of a trial, in the order of its ribbons."""
    others = site.catalogue.others
    decisions = (d for mine in trial.by_side.values() for d in mine)
    return [decision_panel(site, row, trial, d, others) for d in decisions]


def replayed(site: Site, row: Row, trial: Trial, account: Account | None) -> dict[str, Any]:
    """What a replay draws of a trial, with the address of its page."""
    return {**views.replay_data(row, trial, account), "page": site.at.trial(row)}


def decision_at(trial: Trial, asked: Mapping[str, str]) -> Row:
    """The decision that an address names; raises NotThere."""
    side, number = asked.get("side", ""), whole(asked.get("decision", ""))
    if side not in SIDES or number is None:
        raise NotThere("a decision is named by side=left or side=right, and decision=NUMBER")
    found = [d for d in trial.decisions if (d["side"], d["decision"]) == (side, number)]
    if not found:
        raise NotThere(f"the trial has no decision {number} of the {side} driver")
    return found[0]


def decision_panel(
    site: Site, row: Row, trial: Trial, decision: Row, others: Collection[tuple[str, str]]
) -> Markup:
    """What a driver was told, said, planned and did; ``others`` are answers of another model."""
    body, before = _reply(decision), decision["before"]
    text, more = shortened(body or "")
    named = {"side": decision["side"], "decision": decision["decision"]}
    panel = site.render(
        "_decision.html",
        d=decision,
        driver=row[f"model_{decision['side']}"],
        page=site.at.trial(row, **named),
        clamped=clamped,
        went_on=views.older_plan(trial, decision) if decision["fallback"] else "",
        before=before,
        parts=parts_of(decision["prompt"] or "", before["prompt"] if before else None),
        meaning=views.block_meaning,
        others=others,
        reply=None if body is None else {"text": text, "more": more},
        raw=site.at.raw(row, **named),
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
