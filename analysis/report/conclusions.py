"""In plain words: what the results of a study show, and what they cannot show.

Each sentence is built from the numbers that it reports. None includes scripted stand-ins.
"""

from __future__ import annotations

from merge_runner.records import SIDES
from merge_runner.scenarios.merge.conditions import HUMAN_CONDITIONS
from merge_runner_analysis.data.provenance import Provenance
from merge_runner_analysis.data.reference_data import HUMAN_TRIALS, PAIRS
from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.metrics import BOXES, Metric, shown_in
from merge_runner_analysis.names import BASELINE
from merge_runner_analysis.report.ablated import ablation_sentences
from merge_runner_analysis.report.alarms import mismatch
from merge_runner_analysis.report.unlike import unlike
from merge_runner_analysis.stats.against_humans import by_known_pairs, contrast_with_humans
from merge_runner_analysis.stats.group_scores import Score, fits, score, unjudged
from merge_runner_analysis.stats.indicators import (
    ALPHA,
    GAP_MARGIN_M,
    INDICATORS,
    TESTED,
    Verdict,
    furthest_apart,
)
from merge_runner_analysis.stats.intervals import interval
from merge_runner_analysis.stats.likeness import difference, held, mean_gain
from merge_runner_analysis.stats.measures import (
    estimate,
    human_reference,
    known,
    no_human_value,
    undecided_note,
)
from merge_runner_analysis.stats.regressions import MIN_PAIRS, Regression
from merge_runner_analysis.tables.notes import one_sided_note, replayed_notes

NAMES = {
    "I1": "going first becomes likelier with a projected headway advantage",
    "I2": "going first becomes less likely with a relative velocity advantage",
    "I3": "the gap grows with the projected headway",
    "I4": "the gap does not depend on the relative velocity",
    "I5": "the acceleration is piecewise constant",
}
# That a driver lacks an indicator is strong evidence against it where at least the first share of
# human data sets of the study's size show this indicator, weak where fewer than the second do, and
# none where fewer than the third do.
STRONG, WEAK, NONE = 0.95, 0.8, 0.05


def shown(study: Study) -> list[str]:
    """What each driver's baseline shows, then what the prompt variants change."""
    texts = [text for group in _concluded(study) for text in _shown(study, group)]
    return texts + ablation_sentences(study)


def not_shown(study: Study, origin: Provenance) -> list[str]:
    """What cannot be concluded, and why."""
    texts = [text for group in _concluded(study) for text in _limits(study, group)]
    texts += [
        f"{group.id}: {group.posing}: its rows say nothing about a language model."
        for group in study.baselines
        if group.scripted
    ]
    texts += [f"{note}." for note in replayed_notes(study)]
    texts += [f"{group.id}: {group.unjudged}." for group in study.unjudged]
    texts += [f"Another model answered: {mismatch(one)}" for one in origin.mismatches]
    if not _concluded(study):
        texts.append("There is no baseline trial of a driver to judge: nothing can be concluded.")
    texts += _human_limits(study)
    texts += [text for group in study.baselines for text in _asked(group, origin)]
    return texts


def nothing(study: Study) -> str:
    """Why nothing can be concluded; for use where ``shown`` is empty."""
    if any(group.setting == BASELINE for group in study.unjudged):
        return "Nothing: of the drivers with the baseline prompt too many decisions are invalid."
    if study.chosen is not None:
        return "Nothing: no driver that was played with the baseline prompt is chosen."
    if study.empty:
        return (
            "Nothing yet: there is no trial of a driver. `merge-runner sweep baseline` plays some."
        )
    if any(group.setting and group.scripted for group in study.baselines):
        return "Nothing: with the baseline prompt only scripted stand-ins drove."
    if replayed_notes(study):
        return "Nothing: with the baseline prompt only replayed humans were played."
    return "Nothing yet: no driver was played with the baseline prompt."


def _concluded(study: Study) -> list[Group]:
    """The baselines that conclusions are drawn about: no humans, also replayed, no stand-ins."""
    return [group for group in study.compared if not group.scripted]


def _shown(study: Study, group: Group) -> list[str]:
    if not len(group.ended):
        return [f"{group.driver}: no trial ended ({group.left_out})."]
    # Comparisons with humans use only conditions that humans drove: another mix of conditions would
    # pass for another behaviour.
    alike = group.part(lambda trials: trials["condition"].isin(HUMAN_CONDITIONS))
    own = len(group.ended) - len(alike.ended)
    texts = _marks(study, group) if len(group.finished) else []
    if own:
        texts.append(
            f"{group.driver}: {_trials(own)} of {len(group.ended)} "
            f"{'is' if own == 1 else 'are'} of conditions that no human drove, and not compared "
            "with humans in what follows."
        )
    if not len(alike.ended):
        return texts
    if not len(alike.finished):
        return [
            *texts,
            f"{group.driver}: no trial finished ({alike.left_out}).",
            _collisions(study, alike),
        ]
    return [
        *texts,
        _collisions(study, alike),
        *(_told(study, alike, metric) for metric in shown_in("conclusions")),
        *unlike(study, alike),
    ]


def _marks(study: Study, group: Group) -> list[str]:
    """Which indicators hold, which do not, and how strong the evidence of a missing one is."""
    found = score(study, group)
    both = {name: (found.paper[name].passed, found.robust[name].passed) for name in TESTED}
    agreed = [NAMES[name] for name, verdicts in both.items() if verdicts == (True, True)]
    # Passed is None where a rule cannot judge: that is no failure, and the other rule decides.
    failed = [name for name, verdicts in both.items() if False in verdicts and True not in verdicts]
    mixed = [
        f"{NAMES[name]} (paper's rule: {_word(found.paper[name])}, "
        f"robust: {_word(found.robust[name])})"
        for name, verdicts in both.items()
        if True in verdicts and verdicts != (True, True)
    ]
    texts = [f"{group.driver} shows, by both rules: {_listed(agreed)}."] if agreed else []
    texts += [
        f"{group.driver} does not show that {NAMES[name]}: {_weight(group, found, name)}."
        for name in failed
    ]
    if mixed:
        texts.append(f"{group.driver}, by one rule alone: {_listed(mixed)}.")
    if found.robust["I4"].passed is not None:
        texts.append(_velocity(group, fits(group).hc3))
    if found.robust["I5"].passed is not None:
        texts.append(_intermittency(study, group, found.robust["I5"]))
    return texts


def _velocity(group: Group, fit: Regression) -> str:
    """How far relative velocity alone moves the gap at most, which the robust test of I4 judges."""
    pair = furthest_apart(fit)
    headway, more, less = pair
    term = fit.apart[pair]
    low, high = interval(term.b, term.se, fit.freedom, 1 - 2 * ALPHA)
    joint = "" if fit.velocity_p is None else f"; all terms with it jointly: p {_p(fit.velocity_p)}"
    verdict = (
        f"it is less than {GAP_MARGIN_M:g} m, as of all of them"
        if max(-low, high) < GAP_MARGIN_M
        else f"a difference of {GAP_MARGIN_M:g} m is shown"
        if max(low, -high) > GAP_MARGIN_M
        else f"a difference of {GAP_MARGIN_M:g} m is not excluded"
    )
    return (
        f"{group.driver}: at {headway:g} m of projected headway its gap changes, by the "
        f"regression, by {term.b:+.2f} m from a relative velocity of {less:g} to one of {more:g} "
        f"m/s (90 % CI {low:+.2f} to {high:+.2f}{joint}). Of the conditions that differ in "
        f"relative velocity alone these two decide: {verdict}."
    )


def _intermittency(study: Study, group: Group, verdict: Verdict) -> str:
    """I5 in numbers: what it says of this driver, of its clock, and beside the humans."""
    found, share = mean_gain(study, group), held(study, group)
    clock, beside = mean_gain(study, group, "clocked_gain"), difference(study, group)
    assert share.value is not None
    humans = ""
    if beside is not None and beside.value is not None:
        bounds = beside.bounds()
        ends = f" (95 % CI {bounds[0]:+.2f} to {bounds[1]:+.2f})" if bounds else ""
        humans = f" Its mean gain is {beside.value:+.2f} human SD from that of the humans{ends}."
    return (
        f"{group.driver}: {NAMES['I5']} rather than moving in {100 * share.value:.0f} % of "
        f"{_trials(share.n)} with control action; mean gain {found.value:.2f} (95 % CI "
        f"{found.low:.2f} to {found.high:.2f}), so that this is "
        f"{'shown' if verdict.passed else 'not shown'}. With one acceleration from each full "
        "second to the next, as any driver has that decides once a second and holds, the same "
        f"speeds have a mean gain of {clock.value:.2f}.{humans}"
    )


def _weight(group: Group, found: Score, name: str) -> str:
    """How strongly a missing indicator speaks against a driver.

    That follows from how often human data sets of this size show it. A driver that shows it by
    neither rule has also failed the rule that humans pass more often, so that rule counts.
    """
    robust, paper = found.ceiling.robust.get(name), found.ceiling.paper.get(name)
    if robust is None or paper is None:
        return "how often humans would in a study of this size is not known"
    judging = [
        share
        for share, verdicts in ((robust, found.robust), (paper, found.paper))
        if verdicts[name].passed is not None
    ]
    strength = _strength(max(judging))
    return (
        f"{100 * robust:.0f} % of human data sets of {_size(group)} do by the robust tests, "
        f"{100 * paper:.0f} % by the paper's, so that this is {strength} evidence against the "
        "driver"
    )


def _size(group: Group) -> str:
    """The size of the human data sets that a driver is compared with, in words."""
    alike = sum(group.sizes)
    if alike == len(group.ended):
        return "this size"
    return f"the size of its {_trials(alike)} in the humans' conditions"


def _strength(share: float) -> str:
    if share < NONE:
        return "no"
    return "strong" if share >= STRONG else "weak" if share < WEAK else "some"


def _collisions(study: Study, group: Group) -> str:
    humans = _alike(study.human, group)
    found, human = estimate(group, BOXES), estimate(humans, BOXES)
    if found.value is None:
        return (
            f"{group.driver} is not compared with humans by its collisions: "
            f"{undecided_note(group, BOXES)}."
        )
    sentence = (
        f"{group.driver} collided, by boxes that overlap, in {found.value:.1f} % of "
        f"{_trials(found.n)} (95 % CI {found.low:.1f} to {found.high:.1f}), humans in "
        f"{human.value:.1f} % of {human.n} in the same {_conditions(group)}"
    )
    # By the humans' own collision rule for both: the paper's rule for drivers is another one.
    contrast = contrast_with_humans(humans, group, BOXES)
    if isinstance(contrast, str):
        return f"{sentence}; the difference is not tested: {contrast}."
    assert contrast.low is not None
    assert contrast.high is not None
    verdict = (
        "a difference that chance alone seldom makes"
        if contrast.p < ALPHA
        else "no difference is shown, and one within this interval is compatible with these trials"
    )
    test = (
        f"errors clustered by {contrast.by}"
        if by_known_pairs(humans, BOXES)
        else "Fisher's exact test, all trials taken as independent"
    )
    return (
        f"{sentence}; within conditions the difference is {100 * contrast.value:+.1f} percentage "
        f"points (95 % CI {100 * contrast.low:+.1f} to {100 * contrast.high:+.1f}; {test}), p "
        f"{_p(contrast.p)}: {verdict}."
    )


def _told(study: Study, group: Group, metric: Metric) -> str:
    """A driver's value of a metric beside the humans'."""
    found, subject = estimate(group, metric), metric.in_sentences
    if found.value is None:
        return f"{group.driver}: no trial has {subject}."
    sentence = metric.told.format(
        value=_number(metric, found.value),
        subject=subject,
        estimator=metric.estimator,
        trials=_trials(found.n),
    )
    low_high = found.bounds()
    interval = f" (95 % CI {' to '.join(_digits(metric, x) for x in low_high)})" if low_high else ""
    return f"{group.driver} {sentence}{interval}; {_of_humans(study, group, metric)}."


def _of_humans(study: Study, group: Group, metric: Metric) -> str:
    if not known(study.human, metric):
        found = human_reference(metric)
        if found is None:
            return no_human_value(metric)
        value = _number(metric, found.value)
        return f"humans {value} as published, over all {len(HUMAN_CONDITIONS)} conditions"
    human = estimate(_alike(study.human, group), metric)
    published = metric.humans_from == "outcomes" and not study.complete
    origin = "published" if published else "imported"
    if human.value is None:
        return f"humans have none in the {origin} trials of these conditions"
    value, conditions = _number(metric, human.value), _conditions(group)
    return f"humans {value} in {human.n} {origin} trials of the same {conditions}"


def _number(metric: Metric, value: float) -> str:
    return f"{_digits(metric, value)} {metric.unit}"


def _digits(metric: Metric, value: float) -> str:
    return f"{value:.{metric.decimals}f}"


def _alike(human: Group, group: Group) -> Group:
    """The humans' trials in the conditions that the driver was played in."""
    return human.part(lambda trials: trials["condition"].isin(group.ended["condition"]))


def _conditions(group: Group) -> str:
    number = group.ended["condition"].nunique()
    return f"{number} condition{'s' * (number != 1)}"


def _limits(study: Study, group: Group) -> list[str]:
    found, texts = score(study, group), []
    if len(group.finished) and min(group.sizes):
        texts.append(
            f"{group.driver}: of human data sets with as many trials in each condition "
            f"({sum(group.sizes)} in all), {100 * found.ceiling.paper['I1-I4']:.0f} % pass I1 to "
            f"I4 together by the paper's tests, {100 * found.ceiling.robust['I1-I4']:.0f} % by the "
            "robust ones; one that a test cannot judge does not pass."
        )
    if group.one_sided:
        texts.append(f"{group.driver}: {one_sided_note(group)}.")
    return texts + [
        f"{group.driver}: {', '.join(names)} cannot be judged {' or '.join(rules)}: {why}."
        for why, (names, rules) in unjudged(found, *INDICATORS).items()
    ]


def _human_limits(study: Study) -> list[str]:
    """What the human side of each comparison rests on."""
    texts = []
    if study.imported is None:
        texts.append(
            "The human recordings are not imported: human gaps, speed deviations and profiles are "
            "those that were published, and the speed profiles have nothing to be compared with."
        )
    elif not study.complete:
        texts.append(
            f"{study.imported.trials} human trials are imported, of {study.imported.pairs} "
            f"pair{'s' * (study.imported.pairs != 1)}: gaps, speeds and profiles are theirs, "
            f"collisions and who merged first are those of the {HUMAN_TRIALS} published ones."
        )
        if study.imported.pairs < MIN_PAIRS:
            texts.append(
                f"With fewer than {MIN_PAIRS} human pairs a difference from the humans in the gap "
                "is tested against the published regression."
            )
    if study.imported is not None and study.imported.contradicting:
        texts.append(
            "The imported human trials contradict the published counts ("
            f"{'; '.join(study.imported.contradicting)}): they are another data set."
        )
    pairs = study.imported.pairs if study.complete and study.imported else len(PAIRS)
    texts.append(
        f"Trials of humans come from {pairs} pairs who differ: tests that pool them, as the "
        "paper's, understate the human uncertainty."
    )
    return texts


def _asked(group: Group, origin: Provenance) -> list[str]:
    """What a baseline's results depend on: its task, its wording, the parameters sent with it."""
    if not group.setting or group.scripted:
        return []
    changed = origin.tasks.get(group.spec_hash or "")
    task = [f"{group.driver}: its task is not the default one: {changed}."] if changed else []
    if (group.trials["source"] == "driver").all():
        what = "are programs: they read" if group.is_mixed else "is a program: it reads"
        return [*task, f"{group.driver} {what} no prompt; what is left to chance has a seed."]
    sent = origin.sent.get(group.spec_hash or "") or {"": {}}
    # Usually both sides are sent the same, and the sides need no naming.
    alike = len({str(parameters) for parameters in sent.values()}) == 1
    # The spec is one with the ego on the left, if there is any.
    sides = SIDES if group.seats[0] else SIDES[::-1]
    names: dict[str, str] = {}
    if group.is_mixed:
        names.update(zip(sides, group.models, strict=True))
    listed = [
        _parameters(parameters) if alike else f"{names.get(side, side)}: {_parameters(parameters)}"
        for side, parameters in sent.items()
    ]
    return [
        *task,
        f"{group.driver}: results hold for the wording of the prompt, which is a reconstruction "
        f"(the original is not public), and for what was sent with it: "
        f"{'; '.join(dict.fromkeys(listed))}.",
    ]


def _parameters(sent: dict[str, object]) -> str:
    if not sent:
        return "no parameter is on record"
    listed = ", ".join(f"{name} = {value}" for name, value in sent.items())
    return listed if "temperature" in sent else f"{listed}, and no temperature"


def _trials(n: int) -> str:
    return f"{n} trial" if n == 1 else f"{n} trials"


def _p(p: float) -> str:
    return "< 0.001" if p < 0.001 else f"= {p:.3f}"


def _word(verdict: Verdict) -> str:
    return "not judged" if verdict.passed is None else "yes" if verdict.passed else "no"


def _listed(items: list[str]) -> str:
    return items[0] if len(items) == 1 else f"{'; '.join(items[:-1])}; and {items[-1]}"
