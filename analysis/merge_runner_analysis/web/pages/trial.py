"""One trial with its decisions and notes, and others to compare: a search by words, or an offer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from operator import itemgetter
from typing import Any

from markupsafe import Markup

from merge_runner.llm.formats import reasoning_of
from merge_runner.records import DAMAGED, reply_object
from merge_runner.text_safety import quoted
from merge_runner_analysis.web.display_text import shortened, visible
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.site import REPLAY, NotThere, Site
from merge_runner_analysis.web.trial.account import TICK_S
from merge_runner_analysis.web.trial.prompt_parts import parts_of
from merge_runner_analysis.web.trial.reader import Trial, read_trials
from merge_runner_analysis.web.trial.replay import VIEW_BOX, account_of, plan_chart, replay_data
from merge_runner_analysis.web.trial.sentences import (
    by_peoples_rule,
    facts,
    judged_text,
    outcome_text,
    study_words,
    summary,
)
from merge_runner_analysis.web.urls import whole

# Offers of a trial to compare with, and their rules.
HUMAN, REPETITION = "nearest human", "next repetition"
OFFERS = {
    HUMAN: "the human trial of this condition, at such speeds, in which the left "
    "vehicle stays as far ahead as here until the first has merged (least root mean square)",
    REPETITION: "the next repetition with the same driver, prompt and condition",
}
REPLY = "select max_by(reply, attempt) as reply from calls where call_key = '{}'"
SAMPLES = "from states where trial_id = {} and spec_hash = {} order by step, side"
FOUND, READ_AT_ONCE = 12, 20
# An address calls a trial by its name, and by its spec where that name has several.
NAMED = """
SELECT trial_id || if(count(*) OVER (PARTITION BY trial_id) = 1, '', '@' || spec_hash) AS key,
    outcome, coalesce(stand_in, '') AS note, condition, trial_id, spec_hash,
    lower(concat_ws(' ', trial_id, model, variant, outcome)) AS words
FROM listed
"""
# Times are compared in ms: drivers and recordings have steps of their own. A human trial counts
# that is as fast on average, and lasts as long as what it is compared with.
NEAREST = """
WITH near AS (
    SELECT trial_id, spec_hash, (trial_id, spec_hash) = ($trial, $spec) AS own,
        coalesce((spec->>'$.mean_speed_mps')::DOUBLE, mean_speed_mps()) AS mean_mps
    FROM trials LEFT JOIN specs USING (spec_hash)
    WHERE condition = $condition AND (source = 'human' OR own)
), told AS (
    SELECT trial_id, spec_hash, own, mean_mps, round(1000 * time_s)::INTEGER AS ms,
        sum(if(side = 'left', position_m, -position_m)) AS headway_m, max(position_m) AS first_m
    FROM states JOIN near USING (trial_id, spec_hash)
    WHERE time_s >= 0 GROUP BY ALL HAVING count(*) = 2
), mine AS (FROM told WHERE own AND first_m < merge_point_m())
SELECT told.trial_id, told.spec_hash FROM told JOIN mine USING (mean_mps, ms) WHERE NOT told.own
GROUP BY ALL HAVING max(ms) = (SELECT max(ms) FROM mine)
ORDER BY avg((told.headway_m - mine.headway_m) ** 2), told.trial_id, told.spec_hash LIMIT 1
"""


def trial_page(site: Site, trial_id: str, params: Mapping[str, str]) -> str:
    """Return a trial with all of its decisions."""
    (page,) = trial_pages(site, [site.trial(trial_id, params.get("spec", ""))])
    return page


def trial_pages(site: Site, rows: Sequence[Row], template: str = "trial.html") -> Iterator[str]:
    """Return the pages of trials, read READ_AT_ONCE at a time."""
    for begin in range(0, len(rows), READ_AT_ONCE):
        some = rows[begin : begin + READ_AT_ONCE]
        for row, trial in zip(some, read(site, some), strict=True):
            yield _page(site, row, trial, template)


def _page(site: Site, row: Row, trial: Trial, template: str) -> str:
    account = account_of(row, trial)
    return site.render(
        template,
        view="trials",
        scripts=REPLAY,
        panels=panels(site, row, trial),
        row=row,
        outcome=outcome_text(row),
        by_peoples_rule=by_peoples_rule(row, trial),
        facts=facts(row),
        study_words=study_words(row, trial),
        judged=judged_text(trial.scenario),
        view_box=VIEW_BOX,
        data=replay_data(row, trial, account) if trial.states else None,
        account=account,
        samples=SAMPLES.format(quoted(row["trial_id"]), quoted(row["spec_hash"])),
        lines=summary(trial),
        trial_decisions=trial.by_side,
        offers=OFFERS,
        human_offer=HUMAN,
        has_humans=site.at.served and site.trial_index.has_humans,
    )


def read(site: Site, rows: Sequence[Row]) -> list[Trial]:
    """Read the stored trials of these rows."""
    with site.trial_index.cursor() as connection:
        return read_trials(connection, [(row["trial_id"], row["spec_hash"]) for row in rows])


def panels(site: Site, row: Row, trial: Trial) -> list[Markup]:
    """Return the panels of all decisions of a trial, in the order of its ribbons."""
    decisions = chain.from_iterable(trial.by_side.values())
    return [_panel(site, row, trial, decision) for decision in decisions]


def _panel(site: Site, row: Row, trial: Trial, decision: Row) -> Markup:
    named = {"side": decision["side"], "decision": decision["decision"]}
    query = REPLY.format(decision["call_key"])
    before = decision["before"]
    thoughts = ""
    with suppress(*DAMAGED):  # a reply of a server that failed is any text
        thoughts = reasoning_of(reply_object(decision["reply"]))
    panel = site.render(
        "_decision.html",
        d=decision | {"older_s": _older_s(decision, trial)},
        driver=row[f"model_{decision['side']}"],
        page=site.at.trial(row, **named),
        before=before,
        parts=parts_of(
            decision["prompt"] or "",
            before["prompt"] if before else None,
            trial.blocks[decision["side"]],
        ),
        others=site.trial_index.listing.others,
        reply=shortened(decision["reply"]) if decision["reply"] else None,
        reasoning=shortened(thoughts) if thoughts else None,
        raw=site.at.to("sql.csv", q=query) if site.at.served else "",
        chart=plan_chart(decision, trial),
    )
    return Markup(panel)  # noqa: S704 # rendered by a template of ours, which escapes


def _older_s(decision: Row, trial: Trial) -> float | None:
    """Return the time of the older plan that a fallback drove on; None where none was left."""
    pace, before = trial.paces[decision["side"]], decision["before"]
    while before and not before["plan"]:
        before = before["before"]
    if not before:
        return None
    lasts_s = len(before["plan"]) * pace.action_steps * trial.scenario.step_s
    is_left = decision["time_s"] < before["time_s"] + lasts_s - TICK_S
    return before["time_s"] if is_left or trial.scenario.fallback == "restart" else None


def others(site: Site, trial_id: str, params: Mapping[str, str]) -> dict[str, Any] | str | None:
    """Return other trials for a trial's page: one to compare, one on offer, or several.

    ``compare=KEY`` gives that trial's drawing, ``offer=KIND`` a key or None. A key without a spec
    stands for the first trial of its name.
    ``q=WORDS`` gives the first trials that have the words, in the same condition before
    others. Raises NotThere.
    """
    row = site.trial(trial_id, params.get("spec", ""))
    if "compare" in params:
        name, _, spec = (key := params["compare"]).rpartition("@")
        find = site.trial_index.find
        other = find(key) or (find(name, spec) if name else None)
        return None if other is None else _laid(site, other)
    if "offer" in params:
        offers = {HUMAN: _nearest_human, REPETITION: _next_repetition}
        if params["offer"] not in offers:
            raise NotThere(f"there are no other offers than {', '.join(OFFERS)}")
        offered = offers[params["offer"]](site, row)
        sql = f"SELECT key FROM ({NAMED}) WHERE trial_id = ? AND spec_hash = ?"  # noqa: S608 # constants
        return site.trial_index.ask(sql, *offered)[0]["key"] if offered else None
    words = params.get("q", "").lower().split()
    fits = " AND contains(words, ?)" * len(words)
    rows = site.trial_index.ask(
        f"SELECT key, outcome, note FROM ({NAMED}) WHERE (trial_id, spec_hash) <> (?, ?){fits} "  # noqa: S608 # constants
        f"ORDER BY condition <> ?, trial_id, spec_hash LIMIT {FOUND}",
        *(row["trial_id"], row["spec_hash"], *words, row["condition"]),
    )
    return {"found": [other | {"note": visible(other["note"])} for other in rows]}


def _laid(site: Site, row: Row) -> dict[str, Any] | None:
    (trial,) = read(site, [row])
    if not trial.states:
        return None
    return {
        **replay_data(row, trial, account_of(row, trial)),
        "page": site.at.trial(row),
        "ribbons": site.render("_ribbons.html", row=row, trial_decisions=trial.by_side),
        "panels": "".join(panels(site, row, trial)),
    }


def _nearest_human(site: Site, row: Row) -> tuple[str, str] | None:
    given = {"trial": row["trial_id"], "spec": row["spec_hash"], "condition": row["condition"]}
    with site.trial_index.cursor() as connection:
        return connection.execute(NEAREST, given).fetchone()


def _next_repetition(site: Site, row: Row) -> tuple[str, str] | None:
    same = {name: row[name] for name in ("condition", "model", "variant", "pair", "spec_hash")}
    rows = sorted(site.trial_index.every(same), key=itemgetter("rep", "trial_id"))
    alike = [(other["trial_id"], other["spec_hash"]) for other in rows]
    place = alike.index((row["trial_id"], row["spec_hash"]))
    return (alike * 2)[place + 1] if len(alike) > 1 else None


def notes_page(site: Site, _: Mapping[str, str]) -> str:
    """Return all notes, the latest first, each with the address of its trial or decision.

    It has none where the trial is not in this database.
    """
    stored, shown = site.notes.read(), []
    for note in reversed(stored.notes):
        row = site.trial_index.find(note.trial_id, note.spec_hash)
        at = {"side": note.side, "decision": note.decision}
        shown.append((note, row and site.at.trial(row, **at)))
    return site.render("notes.html", view="notes", stored=stored, shown=shown)


def add_note(site: Site, given: Mapping[str, str]) -> Row:
    """Note what a form gives; returns the trial. Raises NotThere and UsageError."""
    row = site.trial(given.get("trial", ""), given.get("spec", ""))
    side, number = given.get("side", ""), whole(given.get("decision", ""))
    text = given.get("text", "").replace("\r\n", "\n").strip()
    site.notes.add(row["trial_id"], row["spec_hash"], side, number, text)
    return row
