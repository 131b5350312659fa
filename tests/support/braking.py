"""Plug-ins with a program: of 20 Hz that brakes by a parameter, and of a test's lines."""

from textwrap import indent

HEAD = 'repetitions = 1\nconditions = ["N_0_0"]\n'
BRAKING = """
from merge_runner.plugin import PROGRAMS, Program

class Braking:
    def __init__(self, context):
        self.context = context

    async def decide(self, observation, number):
        return self.context.held(-self.context.number("strength"))

def check(parameters):
    from merge_runner.plugin import UsageError
    if parameters["strength"] > 1:
        raise UsageError("strength is at most 1")

SETS = {"mild": {"strength": 0.1, "unused": 1.0}, "hard": {"strength": 0.9, "unused": 2.0}}
PROGRAMS.register(
    "braking",
    Program(Braking, "brakes", {"set": "mild"}, 20.0, settable=True, sets=SETS, check=check),
)
"""


def deciding(lines: str, name: str = "braking", *, within: str = "") -> str:
    """A plug-in whose program decides by these lines; ``within`` is what else its class has."""
    return f"""
from merge_runner.plugin import PROGRAMS, Program

class Driver:
{indent(within, "    ")}
    def __init__(self, context):
        self.context = context

    async def decide(self, observation, number):
{indent(lines, "        ")}

PROGRAMS.register("{name}", Program(Driver, "brakes"))
"""
