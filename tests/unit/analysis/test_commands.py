"""What a terminal shows while tables and figures are made."""

import io
import sys
from types import SimpleNamespace

import pytest

from merge_runner_analysis import commands


@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_terminal_alone_shows_what_is_made_just_now(is_terminal, monkeypatch):
    shown = io.StringIO()
    monkeypatch.setattr(shown, "isatty", lambda: is_terminal)
    monkeypatch.setattr(sys, "stderr", shown)
    monkeypatch.setenv("TERM", "xterm")
    study = SimpleNamespace(frames=SimpleNamespace(trials=range(30)))
    with commands._while_computed(study, "tables") as say_now:
        say_now("drawing [figure2]")
    text = shown.getvalue()
    assert text.startswith("computing the tables of 30 trials; a thousand take about a minute")
    assert ("drawing [figure2]" in text) is is_terminal
