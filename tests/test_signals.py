"""What Ctrl-C sets off."""

import signal
import threading

import pytest

from merge_runner.signals import at_signals


@pytest.fixture
def unmoved():
    """A main thread that a signal does not end, as if it were not in Python."""
    before = signal.signal(signal.SIGINT, lambda *_: None)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("unmoved")
def test_what_a_signal_is_to_end_is_told_until_it_has_ended():
    told = threading.Semaphore(0)
    with at_signals(told.release):
        assert not told.acquire(timeout=0.2)
        signal.raise_signal(signal.SIGINT)
        assert all(told.acquire(timeout=60) for _ in range(3))
