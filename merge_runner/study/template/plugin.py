"""Parts of this study. Raise a driver's revision when you edit its rule: it is played anew."""

from merge_runner.plugin import PROGRAMS, Decision, DriverContext, Observation, Program
from merge_runner_analysis.metrics import Metric, register


class HesitantDriver:
    """Brakes gently up to the merge point, then keeps its speed."""

    revision = 1

    def __init__(self, context: DriverContext) -> None:
        self.context = context

    async def decide(self, observation: Observation, number: int) -> Decision:
        """Hold an acceleration, from -1 to 1, until the next decision."""
        return self.context.held(0.0 if observation.distance_to_merge_m is None else -0.1)


PROGRAMS.register("hesitant", Program(HesitantDriver, "brakes gently up to the merge point"))
register(
    Metric(
        name="lowest_speed_mps",
        label="lowest speed",
        unit="m/s",
        meaning="the lowest speed of either vehicle",
        value="""(SELECT min(velocity_mps) FROM states WHERE states.trial_id = trials.trial_id
            AND states.spec_hash = trials.spec_hash AND time_s >= 0)""",
    )
)
