"""Remarks of the statistics on their numbers, as codes with values that print as sentences."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from merge_runner_analysis.wording import number


class Why(Enum):
    """Remarks on numbers, such as why one is missing, with placeholders for values."""

    # Fits; ``s`` makes a plural of the first value.
    NO_FIRST = "no finished trial in which one went first"
    NO_GAP = "no trial with a gap"
    FEW_FIRST = (
        "{} finished trial{s} in which one went first: too few, or in too few situations, to "
        "estimate effects of headway and speed"
    )
    FEW_GAPS = (
        "{} trial{s} with a gap: too few, or in too few situations, to estimate effects of headway "
        "and speed"
    )
    SAME_FIRST = "who merged first is the same in all {} trials: nothing to explain"
    SEPARATION = "separation: no finite estimate of {}; see Firth's fit"
    NO_LIKELIHOOD = "the maximum likelihood fit does not converge"
    NO_FIRTH = "Firth's penalised fit does not converge"
    NO_PROFILE = "no profile of Firth's likelihood converges"
    INFINITE_GAP = "a gap is not finite"
    STEADY_GAP = "the gaps vary by less than 1 cm: there is nothing to test"
    ONE_DECIDES = "a single trial decides a coefficient: no standard errors"
    FEW_PAIRS = "{} pairs are too few for errors by pair"
    WITHOUT_PAIR = "without {}: {}"
    BY_PAIRS = "errors by jackknife over {} pairs"
    NONE_APART = "no two played conditions differ in relative velocity alone"
    # Indicators.
    NO_ACTION = "no finished trial with control action"
    ONE_ACTION = "a single trial, or a single human pair, with control action"
    NO_TRACES = "as published, no human traces are imported"
    BY_EYE = "by eye, the paper"
    CAUTION = "{}"
    # Measures.
    CITED = "published, no human traces are imported ({})"
    PUBLISHED = "humans as published"
    NOT_PUBLISHED = "{}: no human value is published, and none is imported"
    OTHER_RULE = "{}: published human collisions are boxes that overlap"
    OUTCOMES = (
        "who merged first and {}: the {} published outcomes; the rest: {} imported trials, {} "
        "finished"
    )
    UNDECIDED = (
        "{}: {} of {} trials are undecided, since another collision rule ended them; between {} "
        "and {} %"
    )
    UNDECIDED_BOXES = (
        "by people's rule {0} to {1} of {2} trials crashed: in {0} the outlines overlapped, and of "
        "{3} that another crash rule ended before it is not known. A study played by people's rule "
        '(collision_rule = "rectangle") decides them'
    )
    # Comparisons with humans.
    OF_HUMANS = "humans: {}"
    NONE_ENDED = "no trial ended: {}"
    ONE_GAP = "a single trial has no error"
    NO_GAP_THERE = "humans: no gap in {} of its conditions"
    NOBODY_THERE = "no human drove its conditions"
    NONE_ACTED = "accelerations held (I5) are not compared: no trial acted"
    FEW_HUMANS = (
        "accelerations held (I5) are not compared: no human recordings, or too few, are imported"
    )


class Fact(NamedTuple):
    """Remark of the statistics as a code with its values; as a text it is the sentence."""

    why: Why
    values: tuple[object, ...] = ()

    def __str__(self) -> str:
        texts = (number(v) if isinstance(v, float) else v for v in self.values)
        return self.why.value.format(*texts, s="" if self.values[:1] == (1,) else "s")
