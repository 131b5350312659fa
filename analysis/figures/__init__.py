"""The paper's figures, and further ones."""

# What each shows, for lists: to draw them takes Matplotlib.
SHOWS = {
    "figure2": (
        "the paper's Figure 2 for the baselines: speeds, who is first, gap and RMSE by condition"
    ),
    "figure2-variants": (
        "the same with a row for every driver and variant; relative velocities as colours and "
        "markers"
    ),
    "ablation-matrix": "I1 to I5 of every driver and variant",
    "distributions": "gaps, RMSE and every other metric that is not a share, trial by trial",
    "factors": "the values of the table of this name, a panel for each metric",
    "first-action": "means of the first action by own relative velocity",
}
