"""Sentences that compare drivers with people, of finished tables.

Nothing here computes: a page, a report and a terminal say the same. pandas is not needed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from merge_runner.prompts.blocks import BASELINE
from merge_runner_analysis.wording import (
    DIFFERS,
    ENOUGH,
    FEW,
    HEADINGS,
    HUMANS,
    IN_ANOTHER,
    LANGUAGE_MODEL,
    MEASURES,
    OPEN,
    PLAYED_RULES,
    PROGRAM,
    SHOWN,
    Values,
    by_group,
    capital,
    differs,
    distance,
    ends_of,
    has_verdict,
    joined,
    number,
    shown_state,
    suffice,
    with_interval,
)

TOO_FEW = f"Too few finished trials for a verdict (at least {ENOUGH}, and half of all, are needed)"
# The vehicle whose first mergers are counted, by measure.
FIRST = {"headway": "the one ahead", "velocity": "side by side, the slower one"}
# Measures that a person sees at once come first in a headline, fitted ones last.
SEEN_FIRST = (*HEADINGS, "gap-headway", "gap-velocity", "held")


def sentences(rows: Iterable[Any]) -> list[str]:
    """Return the headline of a table's rows, then a sentence on each driver and prompt."""
    groups = by_group(rows)
    suffix = f"/{BASELINE}"
    drivers = {name: of for name, of in groups.items() if _kind(of) != HUMANS}
    answering = _models(drivers) or drivers
    # A study may call its first prompt otherwise.
    shown = {n.removesuffix(suffix): of for n, of in answering.items() if n.endswith(suffix)}
    return [
        " ".join(filter(None, headline(shown or answering))),
        *(f"{name}: {sentence(of)}" for name, of in drivers.items()),
    ]


def _kind(verdicts: Mapping[str, Values]) -> str:
    return str(next(iter(verdicts.values()))["kind"])


def _models(drivers: Mapping[str, Mapping[str, Values]]) -> dict[str, Mapping[str, Values]]:
    """Return the language models that are judged."""
    return {n: of for n, of in drivers.items() if _kind(of) == LANGUAGE_MODEL and "" not in of}


def sentence(verdicts: Mapping[str, Values]) -> str:
    """Return a few sentences that compare a driver with people: crashes, then measures."""
    if "" in verdicts:
        return f"{capital(verdicts['']['note'])}."
    parts = [crashes(verdicts["collisions"]), *map(clause, verdicts.values())]
    unclear, unjudged = list[str](), list[str]()
    for name, of in verdicts.items():
        if of.get("state") and not has_verdict(of):
            unjudged.append(MEASURES[name].label)
        elif shown_state(of) == OPEN:
            unclear.append(MEASURES[name].label)
    for what, names in {"cannot tell": unclear, "no verdict": unjudged}.items():
        if names:
            parts.append(f"{what}: {'; '.join(names)}")
    text = ". ".join(capital(part) for part in parts if part)
    return f"{text or 'Nothing can be compared with people'}."


def clause(values: Values) -> str:
    """Return the sentence part on a measure's state; empty where there is none."""
    says = MEASURES[str(values["measure"])].says.get(shown_state(values), "")
    of, humans = (number(values.get(name)) for name in ("estimate", "human"))
    counted, people = values.get("counted"), values.get("human_counted")
    says = says.format(of=of, humans=humans, more=_more(values))
    if not (says and counted and people):
        return says
    return f"{says} ({FIRST[str(values['measure'])]} in {counted} trials, people in {people})"


def _more(values: Values) -> str:
    return "more" if distance(values) > 0 else "less"


def crashes(values: Values) -> str:
    """Return the crashes by the rule that was played, then by the humans' where they differ.

    ``crashed in 15 of 22 trials; people in 28 of 990``, or empty where no trial ended.
    """
    k, undecided = values.get("k") or 0, values.get("undecided") or 0
    if not (ended := _ended(values)):
        return ""
    seen = values.get("counted") or f"{k} of {ended}"
    text = f"crashed in {seen} trials"
    if undecided:
        rule = values.get("counted_by") or PLAYED_RULES["shared_lane"]
        text += f" by {rule}, in {k} to {k + undecided} by people's rule"
    people = values.get("human_counted")
    if shown_state(values) in DIFFERS:
        than = f" ({people})" if people else ""
        return f"{text}, {_more(values)} often than people{than}"
    return f"{text}; people in {people}" if people else text


def share(collisions: Values) -> str:
    """Return a rate in percent, or ``13.64 to 68.18`` where trials are undecided."""
    ended, k = _ended(collisions), collisions.get("k") or 0
    least, most = (
        number(100 * count / ended if ended else 0.0)
        for count in (k, k + (collisions.get("undecided") or 0))
    )
    return f"{least} to {most}" if collisions.get("undecided") else least


def headline(drivers: Mapping[str, Mapping[str, Values]]) -> tuple[str, str]:
    """Return how drivers compare with people: the claim, and what else is seen at once.

    It is of the language models that are judged or, without one, of all ``drivers``, by name.
    Drivers with too few outcomes get only counts.
    """
    models = _models(drivers)
    if not models:
        return _without_models(drivers)
    compared = {name: of for name, of in models.items() if any(v.get("state") for v in of.values())}
    if not compared:
        return "No language model can be compared with people yet.", ""
    enough = {name: of for name, of in compared.items() if _enough(of)}
    few = {name: of for name, of in compared.items() if name not in enough}
    is_one = len(models) == 1
    counts = [
        f"{'' if is_one else name} {_finished(of)} of {_ended(of['collisions'])}".strip()
        for name, of in few.items()
    ]
    too_few = [f"{TOO_FEW}: {joined(counts)}."] if few else []
    untold = [f"{name} {crashes(of['collisions'])}." for name, of in few.items()]
    if not enough:
        return " ".join(too_few), " ".join(untold)
    claim, because = _likeness(enough, every=len(enough) == len(models))
    return claim, " ".join(filter(None, [because, *too_few, *untold]))


def _without_models(drivers: Mapping[str, Mapping[str, Values]]) -> tuple[str, str]:
    """Return how many drivers are like people in each measure, and the extremes of several."""
    kinds = {_kind(of) for of in drivers.values()}
    who = f"No language model {'is judged' if LANGUAGE_MODEL in kinds else 'drove'} here."
    compared = {name: of for name, of in drivers.items() if "" not in of}
    if len(compared) < 2:
        return who, ""
    claims = [_tally([*compared.values()]), _extremes(compared), _few_trials(compared), who]
    if kinds == {PROGRAM}:
        claims.insert(0, _most_alike(compared))
    claim, *others = filter(None, claims)
    return claim, " ".join(others)


def _most_alike(drivers: Mapping[str, Mapping[str, Values]]) -> str:
    """Return which of several programs are most like people, and which one crashes most."""
    ranks = {
        name: (
            sum(shown_state(of[measure]) == SHOWN for measure in HEADINGS if measure in of),
            -sum(shown_state(of[measure]) in DIFFERS for measure in HEADINGS if measure in of),
        )
        for name, of in drivers.items()
        if any(map(has_verdict, of.values()))
    }
    like, unlike = best = max(ranks.values(), default=(0, 0))
    names = [name for name, rank in ranks.items() if rank == best]
    if not like or len(names) == len(ranks):
        return ""
    some = f"the {len(ranks)} programs with enough trials"
    which = some if len(ranks) < len(drivers) else f"{len(drivers)} programs"
    is_one = len(names) == 1
    of_humans = " (it was made from the human data)"
    named = [
        name + of_humans * any(values.get("from_humans") for values in drivers[name].values())
        for name in names
    ]
    claim = (
        f"Of {which} {joined(named)} {'is' if is_one else 'are'} most like people: "
        f"{'it agrees' if is_one else 'each agrees'} with them in {like} of {len(HEADINGS)} "
        f"measures, and is shown to differ in {-unlike or 'none'}."
    )
    rates = _crash_rates({name: of for name, of in drivers.items() if _are_crashes_judged(of)})
    most = [name for name, rate in rates.items() if rate == max(rates.values()) > 0]
    if len(most) != 1:
        return claim
    return f"{claim} Most crashes: {most[0]} {crashes(drivers[most[0]]['collisions'])}."


def _are_crashes_judged(verdicts: Mapping[str, Values]) -> bool:
    return "collisions" in verdicts and has_verdict(verdicts["collisions"])


def _few_trials(drivers: Mapping[str, Mapping[str, Values]]) -> str:
    """Return the counts of crashes of drivers without a verdict on them, beside others with one."""
    counts = [
        f"{name} crashed in {of['collisions']['counted']} trials"
        for name, of in drivers.items()
        if not _are_crashes_judged(of) and of.get("collisions", {}).get("counted")
    ]
    return f"Without a verdict: {'; '.join(counts)}." if 0 < len(counts) < len(drivers) else ""


def _crash_rates(drivers: Mapping[str, Mapping[str, Values]]) -> dict[str, float]:
    """Return the share of trials with a crash, of drivers of which both are counted."""
    counts = {name: of.get("collisions", {}).get("counted") for name, of in drivers.items()}
    parts = {name: text.split(" of ") for name, text in counts.items() if text}
    return {name: int(k) / int(n) for name, (k, n) in parts.items()}


def _tally(drivers: Sequence[Mapping[str, Values]]) -> str:
    """Return how many of the drivers with a verdict are like people, by measure."""
    like, unclear, unjudged = list[str](), list[str](), list[str]()
    for name in HEADINGS:
        does, what = MEASURES[name].alike, MEASURES[name].topic
        states = [shown_state(of[name]) for of in drivers if name in of and has_verdict(of[name])]
        if not states:
            unjudged.append(what)
        elif {*states} == {OPEN}:
            unclear.append(what)
        else:
            who = " drivers" * (not like)
            few = " with enough trials" * (not like and len(states) < len(drivers))
            alike, open_ = states.count(SHOWN), states.count(OPEN)
            differing = len(states) - alike - open_
            says = f"{alike or 'none'} of {len(states)}{who}{few} {does}"
            if open_ and not alike:
                differ = "differ" if differing > 1 else "differs"
                says = f"{differing} of {len(states)}{who}{few} {differ} from people in {what}"
            like.append(f"{says} (cannot tell: {open_})" if open_ else says)
    if not (like or unclear):
        return f"For {len(drivers)} drivers no verdict on likeness to people is possible."
    parts = [f"{'; '.join(like)}."] if like else []
    parts += [f"cannot tell: {joined(unclear)}."] if unclear else []
    parts += [f"no verdict on {joined(unjudged)}."] if unjudged else []
    return " ".join(map(capital, parts))


def _extremes(drivers: Mapping[str, Mapping[str, Values]]) -> str:
    """Return the fewest and most crashes, and the smallest and largest gap, of many drivers.

    Drivers without a verdict are left out.
    """
    drivers = {name: of for name, of in drivers.items() if _are_crashes_judged(of)}
    crashed = {
        f"{drivers[name]['collisions']['counted']} trials ({name})": rate
        for name, rate in _crash_rates(drivers).items()
    }
    gaps = {
        f"{number(of['gap']['estimate'])} m ({name})": of["gap"]["estimate"]
        for name, of in drivers.items()
        if has_verdict(of.get("gap", {})) and of["gap"].get("estimate") is not None
    }
    parts = [
        f"{what} from {min(of, key=lambda text: of[text])} to {max(of, key=lambda text: of[text])}"
        for what, of in (("crashes range", crashed), ("mean gaps", gaps))
        if len(of) > FEW and len({*of.values()}) > 1
    ]
    return f"{capital(', '.join(parts))}." if parts else ""


def _likeness(drivers: Mapping[str, Mapping[str, Values]], *, every: bool) -> tuple[str, str]:
    """Return both parts of a headline on drivers with enough trials; ``every``: on all drivers."""
    unlike = {name: differences for name, of in drivers.items() if (differences := _differing(of))}
    undecided = {n: of for n, of in drivers.items() if of["collisions"].get("undecided")}
    untold = [f"{name} {crashes(of['collisions'])}." for name, of in undecided.items()]
    alike = [name for name in drivers if name not in unlike]
    if not unlike:
        return f"No difference from people is shown for {joined(alike)}.", " ".join(untold)
    names = sorted(unlike, key=lambda name: _seen_first(unlike[name][0]))
    if len(names) == 1:
        claim = f"{names[0]} differs from people: {difference_sentence(unlike[names[0]][0], 'it')}."
    else:
        is_all = every and not alike
        count = "Both" if len(names) == 2 else f"All {len(names)}"
        who = f"{count} language models here" if is_all else joined(names)
        reasons = [difference_sentence(unlike[name][0], name) for name in names[:FEW]]
        most = " most visibly" * (len(names) > FEW)
        claim = f"{who} differ from people:{most} {'; '.join(reasons)}."
    if alike:
        untold.insert(0, f"No difference from people is shown for {joined(alike)}.")
    return claim, " ".join(untold)


def _seen_first(values: Values) -> tuple[int, float]:
    """Return the place of a difference among others: what is seen at once, then what is surest."""
    return SEEN_FIRST.index(str(values["measure"])), values["p_holm"]


def _differing(verdicts: Mapping[str, Values]) -> list[Values]:
    """Return the differing measures with enough trials, what is seen at once first."""
    ended = _ended(verdicts["collisions"])
    unlike = [of for of in verdicts.values() if differs(of) and suffice(of["n"] or 0, ended)]
    return sorted(unlike, key=_seen_first)


def _ended(collisions: Values) -> int:
    """Return the number of trials that ended, also undecided ones."""
    return (collisions["n"] or 0) + (collisions.get("undecided") or 0)


def _finished(verdicts: Mapping[str, Values]) -> int:
    return verdicts["gap"]["n"] or 0


def _enough(verdicts: Mapping[str, Values]) -> bool:
    """Return whether enough trials finished, or collided by the humans' rule, for a headline.

    A driver that differs only in measures with too few trials is not called like people.
    """
    outcomes = _finished(verdicts) + (verdicts["collisions"].get("k") or 0)
    if not suffice(outcomes, _ended(verdicts["collisions"])):
        return False
    return bool(_differing(verdicts)) or not any(map(differs, verdicts.values()))


def difference_sentence(values: Values, it: str) -> str:
    """Return a difference as ``it crashed in 24 of 110 trials, people in 28 of 990``.

    Without counts of who goes first it is the sentence part of the state.
    """
    measure = MEASURES[str(values["measure"])]
    driver, people = values.get("counted"), values.get("human_counted")
    if driver is None or people is None:
        if measure.name in {"headway", "velocity"}:
            return clause(values)
        driver = f"{number(values['estimate'])} {ends_of(values)}".rstrip()
        people = with_interval(values["human"], values["human_ci"])
        if measure.name == "collisions":
            driver, people = f"{driver} % of its", f"{people} %"
    says = measure.difference.format(it=it, driver=driver, people=people)
    return says if measure.name in HEADINGS else f"{IN_ANOTHER.format(measure.label)}, {says}"
