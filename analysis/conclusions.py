"""In plain words: what the results of a study show, and what they cannot show."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from analysis.contrasts import contrast_rates
from analysis.indicators import ALPHA, INDICATORS, TESTED, Verdict
from analysis.measures import BOXES, GAP, counts, estimate
from analysis.provenance import Mismatch, Provenance, tally
from analysis.study import Group, Study
from analysis.verdicts import Score, score

NAMES = {
    "I1": "going first becomes likelier with a projected headway advantage",
    "I2": "going first becomes less likely with a relative velocity advantage",
    "I3": "the gap grows with the projected headway",
    "I4": "the gap does not depend on the relative velocity",
    "I5": "speeds are piecewise linear",
}
LOW_POWER = 0.8
MANY_FALLBACKS = 0.05


@dataclass(frozen=True, slots=True)
class Alarm:
    """What a reader must know before any number."""

    title: str
    text: str


def alarms(study: Study, origin: Provenance) -> list[Alarm]:
    """What puts the results of a study in doubt, the worst first."""
    found = [Alarm("Another model answered", _mismatch(one)) for one in origin.mismatches]
    for title, parts, rest in (
        (
            "Trials failed",
            [_failed(group) for group in study.models if len(group.trials) > len(group.ended)],
            "They are in no measure; the same sweep again plays them anew.",
        ),
        (
            "Many fallbacks",
            _fallbacks(study),
            "There the older plan was driven, or none: the table fallbacks shows whether that "
            "changes the results.",
        ),
        (
            "Attempts of unknown fate",
            _unknown(study),
            "A run was killed before their reply was seen: they may have been paid for.",
        ),
        (
            "Several settings under one name",
            _mixed(study),
            "They are never pooled: all but the most frequent carry a mark.",
        ),
    ):
        if parts:
            found.append(Alarm(title, f"{'; '.join(parts)}. {rest}"))
    return found


def _mismatch(one: Mismatch) -> str:
    answers = f"{one.answers} answer{'s' * (one.answers != 1)}"
    sweeps = f"sweep{'s' * (len(one.sweeps) != 1)} {', '.join(one.sweeps) or 'unknown'}"
    return (
        f"{one.requested} was asked for, {one.served} answered: {answers}, {sweeps}. "
        "These trials are not what they claim to be."
    )


def _failed(group: Group) -> str:
    failed = group.trials[group.trials["status"] == "failed"]
    reasons = failed["error"].fillna("no reason is stored").value_counts()
    more = ", among other reasons" if len(reasons) > 1 else ""
    return f"{len(failed)} of {len(group.trials)} of {group.id} ({reasons.index[0]}{more})"


def _fallbacks(study: Study) -> list[str]:
    return [
        f"{found.fallbacks} of {found.decisions} decisions of {group.id} "
        f"({100 * found.fallbacks / found.decisions:.1f} %)"
        for group in study.models
        for found in [tally(study, group)]
        if found.fallbacks > MANY_FALLBACKS * found.decisions
    ]


def _unknown(study: Study) -> list[str]:
    return [
        f"{found.unknown} of {found.attempts} of {group.id}"
        for group in study.models
        for found in [tally(study, group)]
        if found.unknown
    ]


def _mixed(study: Study) -> list[str]:
    drivers = dict.fromkeys(group.driver for group in study.models)
    bare = Counter(driver.split(" [")[0] for driver in drivers)
    return [
        ", ".join(driver for driver in drivers if driver.split(" [")[0] == name)
        for name, count in bare.items()
        if count > 1
    ]


def shown(study: Study) -> list[str]:
    """What the baseline of each driver shows, one sentence or two a driver."""
    return [text for group in study.baselines if group.setting for text in _shown(study, group)]


def not_shown(study: Study, origin: Provenance) -> list[str]:
    """What cannot be concluded, and why."""
    models = [group for group in study.baselines if group.setting]
    texts = [text for group in models for text in _limits(study, group)]
    texts += [f"Another model answered: {_mismatch(one)}" for one in origin.mismatches]
    if not models:
        texts.append("There is no baseline trial of a driver to show: nothing can be concluded.")
    if not study.human.measured:
        texts.append(
            "The human recordings are not imported: human gaps, speed deviations and profiles are "
            "those that were published, I5 is not calibrated, and the human ceiling rests on a "
            "normal approximation of the gaps."
        )
    texts.append(
        "The prompt is a reconstruction, the original wording is not public; results hold for this "
        "wording, this scenario and the default sampling temperature."
    )
    texts.append(
        "Trials of humans come from nine pairs who differ: tests that pool them, as the paper's, "
        "understate the human uncertainty."
    )
    return texts


def _shown(study: Study, group: Group) -> list[str]:
    if not len(group.finished):
        return [
            f"{group.driver}: no trial finished ({group.left_out}).",
            _collisions(study, group),
        ]
    found = score(study, group)
    agreed = [NAMES[n] for n in INDICATORS if found.paper[n].passed and found.robust[n].passed]
    failed = [NAMES[n] for n in TESTED if found.paper[n].passed is False is found.robust[n].passed]
    mixed = [
        f"{NAMES[name]} (paper's rule: {_word(found.paper[name])}, "
        f"robust: {_word(found.robust[name])})"
        for name in TESTED
        if None not in {found.paper[name].passed, found.robust[name].passed}
        and found.paper[name].passed != found.robust[name].passed
    ]
    texts = [f"{group.driver} shows, by both rules: {_listed(agreed)}."] if agreed else []
    if failed:
        texts.append(f"{group.driver} does not show: {_listed(failed)}.")
    if mixed:
        texts.append(f"{group.driver}, by one rule alone: {_listed(mixed)}.")
    return [*texts, _collisions(study, group), _gap(study, group)]


def _collisions(study: Study, group: Group) -> str:
    found, human = estimate(group, BOXES), estimate(study.human, BOXES)
    contrast = contrast_rates(counts(group, BOXES), counts(study.human, BOXES))
    verdict = (
        "a difference that chance does not explain"
        if contrast.p < ALPHA
        else "no difference can be shown; a small one is not excluded"
    )
    return (
        f"{group.driver} collided, by boxes that overlap, in {found.value:.1f} % of "
        f"{found.n} trials (95 % CI {found.low:.1f} to {found.high:.1f}), humans in "
        f"{human.value:.1f} % ({human.low:.1f} to {human.high:.1f}); "
        f"Fisher's exact p {_p(contrast.p)}: {verdict}."
    )


def _gap(study: Study, group: Group) -> str:
    found = estimate(group, GAP)
    human = estimate(study.human, GAP) if study.human.measured else None
    if found.value is None:
        return f"{group.driver} has no gap at the merge point."
    interval = "" if found.low is None else f" (95 % CI {found.low:.2f} to {found.high:.2f})"
    reference = (
        f"{human.value:.2f} m in the recordings"
        if human is not None and human.value is not None
        else "3.85 m as published"
    )
    return f"{group.driver} leaves {found.value:.2f} m on average{interval}; humans {reference}."


def _limits(study: Study, group: Group) -> list[str]:
    found, texts = score(study, group), []
    if group.scripted:
        texts.append(
            f"{group.driver} is a scripted stand-in: its rows say nothing about a language model."
        )
    chance = found.ceiling.paper["I1-I4"]
    if chance < LOW_POWER and len(group.finished):
        texts.append(
            f"{group.driver}: with {len(group.ended)} trials a perfect copy of the humans would "
            f"pass I1 to I4 together in {100 * chance:.0f} % of studies by the paper's tests, in "
            f"{100 * found.ceiling.robust['I1-I4']:.0f} % by the robust ones. A missing mark is "
            "weak evidence against the driver."
        )
    if found.paper["I4"].passed and not found.robust["I4"].passed:
        texts.append(
            f"{group.driver}: that the gap does not depend on relative velocity is not shown; the "
            "effect is not significant, but one of 1 m is not excluded either."
        )
    texts += [
        f"{group.driver}: {name} cannot be judged by the paper's rule: {verdict.why}."
        for name in TESTED
        for verdict in [found.paper[name]]
        if verdict.why
    ]
    if Score.total(found.paper) is None:
        texts.append(f"{group.driver}: no score, as not all indicators can be judged.")
    return texts


def _p(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"= {p:.3f}"


def _word(verdict: Verdict) -> str:
    return "yes" if verdict.passed else "no"


def _listed(items: list[str]) -> str:
    return items[0] if len(items) == 1 else f"{'; '.join(items[:-1])}; and {items[-1]}"
