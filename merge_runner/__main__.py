"""Runs the command line as ``python -m merge_runner``."""

from merge_runner.cli import main

main()
