"""A metric of each trial."""

from merge_runner_analysis.metrics import Metric, register

register(
    Metric(
        name="mean_abs_acceleration_mps2",
        label="mean |a|",
        unit="m/s²",
        meaning="mean absolute acceleration of both vehicles under the drivers' control",
        value="""(
            SELECT avg(abs(acceleration_mps2)) FROM states
            WHERE states.trial_id = trials.trial_id AND states.spec_hash = trials.spec_hash
                AND time_s > 0
        )""",
    )
)
