"""The paper's figures, and further ones: what each shows, without Matplotlib."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class About:
    """Title of a figure, its caption, and the table with its numbers, if one has them."""

    shows: str
    caption: str
    table: str = ""


OF_FIGURE_2 = (
    "Collisions are left out. (A, B) Speed of the left vehicle from the start of control, where it "
    "merges first and second. (C) How often the left vehicle merges first by projected headway, "
    "with Wilson intervals. (D) Mean gap at the merge point and (E) mean RMSE of the speed from "
    "the initial speed, two values a trial, with intervals of Student's t. Where sides are "
    "counterbalanced the left vehicle is the ego's, on whichever side it drove. The ego is "
    "the driver that is named first, or reads the texts. Colours and markers tell the "
    "relative velocities apart, dotted lines are the humans (in C as published until all are "
    "imported); few very wide intervals of D and E are cut at the frame."
)
FIGURES = {
    "effects": About(
        "each level of each factor in every measure, a mark for each driver",
        "Each level of each factor by driver, over all of its trials: shares with Wilson "
        "intervals, means with Student's t intervals. Dotted: neither driver is favoured. How far "
        "levels are apart, within equal conditions, is in the table effects.",
        "levels",
    ),
    "figure2": About(
        "the paper's Figure 2 for the baselines: speeds, who is first, gap and RMSE by condition",
        f"Baseline behaviour. {OF_FIGURE_2}",
    ),
    "figure2-variants": About(
        "the same with a row for every driver and prompt",
        f"Behaviour by prompt, a row for each driver and prompt. {OF_FIGURE_2}",
    ),
    "first-action": About(
        "means of the first action by own relative velocity",
        "Mean net acceleration of the first step under control by own relative velocity, own minus "
        "other, with 95 % intervals clustered by trial; of humans before an import as published.",
        "first-action",
    ),
}
