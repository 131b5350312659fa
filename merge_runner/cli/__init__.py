"""The command line. Results go to stdout, progress and messages to stderr."""

from merge_runner.cli.app import app, complete_app, main

__all__ = ["app", "complete_app", "main"]
