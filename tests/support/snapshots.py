"""The progress of a sweep of the emulator, as far as a display asks for it."""

from types import SimpleNamespace

from merge_runner.llm.ledger import Cap, Spending
from merge_runner.run.plan import make_plan
from merge_runner.run.progress import Progress

SPENDING = Spending(spent_usd=4.0, reserved_usd=0.25)
LEDGER = SimpleNamespace(spending=SPENDING, committed_usd=SPENDING.committed_usd, cap=Cap(20))


def runner(*meters, running_trials=0, waits=(), waiting_for_money=0):
    """Plays nothing, and has counted this."""
    named = dict(zip(("emulator", "another"), meters, strict=False))
    return SimpleNamespace(
        meters=named,
        waits=waits,
        running_trials=running_trials,
        waiting_for_money=waiting_for_money,
        place="",
    )


def progress(runner, todo=None, **changes):
    """Of ten trials where nothing else is said, so that about 210 calls are expected."""
    plan = make_plan("baseline", "emulator")
    return Progress(session(plan, LEDGER, todo or {"baseline": 10}), runner, **changes)


def session(plan, ledger, todo):
    """Of a plan whose missing trials are so many by arm."""
    missing = [SimpleNamespace(arm=arm) for arm, number in todo.items() for _ in range(number)]
    return SimpleNamespace(plan=plan, ledger=ledger, todo=missing, stored=[])
