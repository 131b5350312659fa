"""One id may stand under several specs: a trial is known by both."""

from __future__ import annotations

from types import SimpleNamespace

import pandas as pd

from merge_runner_analysis.data.study import Group, Study
from merge_runner_analysis.stats.indicators import gains

TRIALS = pd.DataFrame(
    {
        "trial_id": ["a", "a"],
        "spec_hash": ["x", "y"],
        "condition": "N_0_0",
        "pair": None,
        "status": "finished",
    }
)
GROUP = Group("o3", "baseline", "x", TRIALS, "o3", models=("o3",), name="o3")


def test_a_gain_is_that_of_the_trial_under_its_spec():
    profiles = TRIALS[["trial_id", "spec_hash"]].assign(side="left", steady=False, gain=[1.0, 2.0])
    study = SimpleNamespace(profiles_of=lambda _: profiles)
    assert gains(study, GROUP)["gain"].tolist() == [1.0, 2.0]


def test_a_fallback_leaves_out_the_trial_under_its_spec_alone():
    calls = TRIALS[["trial_id", "spec_hash"]].assign(fallback=[1, 0])
    study = SimpleNamespace(without_fallbacks=True, calls=calls)
    assert Study._kept_trials(study, GROUP).trials["spec_hash"].tolist() == ["y"]
