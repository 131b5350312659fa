"""Turns the files of a download into trials in the database."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import PurePath

from rich.console import Console
from rich.progress import track

from merge_runner.records import TrialRecord
from merge_runner.results.store import Store, query
from merge_runner_analysis.data.reference_data import PAIRS
from merge_runner_analysis.human.archive import File, Unreadable, refuse_bombs
from merge_runner_analysis.human.record import (
    PAGE_SPEC,
    PAGE_SPEC_HASH,
    SPEC,
    SPEC_HASH,
    parse_csv,
    trial_record,
)
from merge_runner_analysis.human.velocity_pages import condition_of, trace_of, trials_of

CHUNK = 100
# The recorder wrote a CSV, a MAT and a PKL of each trial; unpickling would run code in the file.
NAME = re.compile(
    r"(?P<what>experiment|simulation)_(?P<experiment>[0-9]{1,6})"
    r"_(?P<phase>iter|training)_(?P<number>[0-9]{1,6})\.(?P<suffix>csv|mat|pkl)",
    re.IGNORECASE,
)
Unread = list[tuple[str, str]]  # file and reason


@dataclass(frozen=True, slots=True)
class Download:
    """A download's contents.

    ``trials`` are experiment, iteration and CSV file of each, in order; ``skipped`` counts the runs
    that were training or simulated. ``pages`` are its velocity pages, each with its condition.
    """

    trials: list[tuple[int, int, File]]
    skipped: int
    pages: list[tuple[File, str]]


@dataclass(slots=True)
class Report:
    """The outcome of an import.

    ``added`` and ``there`` count the trials added and those already stored; ``differing`` are ids
    of trials already stored with other values.
    """

    added: int = 0
    there: int = 0
    differing: list[str] = field(default_factory=list)
    unreadable: Unread = field(default_factory=list)


def sort_files(files: Iterable[File]) -> Download:
    """Tell trials, training and simulated runs by their names; raises UsageError for a bomb."""
    trials: list[tuple[int, int, File]] = []
    skipped: set[tuple[str, ...]] = set()
    pages: list[tuple[File, str]] = []
    for file in files:
        if (condition := condition_of(file.name)) is not None:
            pages.append((file, condition))
        elif name := NAME.fullmatch(PurePath(file.name).name):
            *run, suffix = name.group("what", "phase", "experiment", "number", "suffix")
            if [part.lower() for part in run[:2]] != ["experiment", "iter"]:
                skipped.add(tuple(run))
            elif suffix.lower() == "csv":
                trials.append((int(run[2]), int(run[3]), file))
    refuse_bombs([file for _, _, file in trials] + [file for file, _ in pages])
    trials.sort(key=lambda trial: trial[:2])
    return Download(trials, len(skipped), sorted(pages, key=lambda page: page[0].name))


def import_trials(download: Download, store: Store) -> Report:
    """Store a download, chunk by chunk; an error does not undo earlier ones. Raises StoreError."""
    report = Report()
    for spec_hash, spec, records in (
        (SPEC_HASH, SPEC, _recorded(download, report.unreadable)),
        (PAGE_SPEC_HASH, PAGE_SPEC, _on_pages(download, report.unreadable)),
    ):
        while chunk := list(islice(records, CHUNK)):
            # What was imported from the other kind of file is there.
            rows = query(
                store.path, "SELECT trial_id, spec_hash FROM trials WHERE source = 'human'"
            )
            elsewhere = {trial_id for trial_id, other in rows[1] if other != spec_hash}
            new = [record for record in chunk if record.spec.trial_id not in elsewhere]
            added, there, differing = store.add_recorded(new, {spec_hash: spec} if new else {})
            report.added += added
            report.there += there + len(chunk) - len(new)
            report.differing += differing
    return report


def _recorded(download: Download, unreadable: Unread) -> Iterator[TrialRecord]:
    shown = track(
        download.trials,
        "importing",
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
    )
    for experiment, iteration, file in shown:
        try:
            yield trial_record(parse_csv(file.read()), experiment, iteration)
        except Unreadable as exc:
            unreadable.append((file.name, str(exc)))


def _on_pages(download: Download, unreadable: Unread) -> Iterator[TrialRecord]:
    for file, condition in download.pages:
        try:
            trials = list(trials_of(file.read(), condition))
        except Unreadable as exc:
            unreadable.append((file.name, str(exc)))
            continue
        for experiment, iteration, lines in trials:
            try:
                trace = trace_of(lines, condition)
                record = trial_record(trace, experiment, iteration, PAGE_SPEC_HASH)
                if record.spec.condition != condition:
                    raise Unreadable(f"its speeds are not those of {condition}")
                yield record
            except Unreadable as exc:
                name = f"{file.name}: {PAIRS[experiment]}, trial {iteration}"
                unreadable.append((name, str(exc)))
