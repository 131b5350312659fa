"""Turns the files of a download into trials in the database."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import PurePath

from merge_runner.records import TrialRecord
from merge_runner.results.store import Store, query
from merge_runner.text_safety import quoted
from merge_runner_analysis.data.reference_data import PAIRS
from merge_runner_analysis.human.archive import File, Unreadable, refuse_bombs
from merge_runner_analysis.human.record import (
    PAGE_SPEC,
    PAGE_SPEC_HASH,
    SPEC,
    SPEC_HASH,
    trial_record,
)
from merge_runner_analysis.human.trace import parse_csv
from merge_runner_analysis.human.velocity_pages import condition_of, trace_of, trials_of

CHUNK = 100
# The recorder wrote a CSV, a MAT and a PKL of each trial; unpickling would run code in the file.
NAME = re.compile(
    r"(?P<what>experiment|simulation)_(?P<experiment>[0-9]{1,6})"
    r"_(?P<phase>iter|training)_(?P<number>[0-9]{1,6})\.(?P<suffix>csv|mat|pkl)",
    re.IGNORECASE,
)


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
    of trials already stored with other values. ``unreadable`` holds file and reason.
    """

    added: int = 0
    there: int = 0
    differing: list[str] = field(default_factory=list)
    unreadable: list[tuple[str, str]] = field(default_factory=list)


def sort_files(files: Iterable[File]) -> Download:
    """Tell trials, training and simulated runs by their names; raises UsageError for a bomb."""
    trials: list[tuple[int, int, File]] = []
    skipped: set[tuple[str, ...]] = set()
    pages: list[tuple[File, str]] = []
    for file in files:
        if (condition := condition_of(file.name)) is not None:
            pages.append((file, condition))
        name = NAME.fullmatch(PurePath(file.name).name)
        if name is None:
            continue
        *run, suffix = name.group("what", "phase", "experiment", "number", "suffix")
        if [part.lower() for part in run[:2]] != ["experiment", "iter"]:
            skipped.add(tuple(run))
        elif suffix.lower() == "csv":
            trials.append((int(run[2]), int(run[3]), file))
    refuse_bombs(file for _, _, file in trials)
    refuse_bombs(file for file, _ in pages)
    trials.sort(key=lambda trial: trial[:2])
    return Download(trials, len(skipped), sorted(pages, key=lambda page: page[0].name))


def import_trials(trials: Iterable[tuple[int, int, File]], store: Store) -> Report:
    """Store the trials chunk by chunk; an error does not undo earlier ones. Raises StoreError."""
    report, remaining = Report(), iter(trials)
    while chunk := list(islice(remaining, CHUNK)):
        records = []
        for experiment, iteration, file in chunk:
            try:
                records.append(trial_record(parse_csv(file.read()), experiment, iteration))
            except Unreadable as exc:
                report.unreadable.append((file.name, str(exc)))
        _add(records, store, (SPEC_HASH, SPEC), report)
    return report


def import_pages(pages: Iterable[tuple[File, str]], store: Store, report: Report) -> None:
    """Store the trials of the velocity pages, page by page. Raises StoreError."""
    for file, condition in pages:
        records = list(_read_page(file, condition, report))
        _add(records, store, (PAGE_SPEC_HASH, PAGE_SPEC), report)


def _add(
    records: Sequence[TrialRecord], store: Store, spec: tuple[str, str], report: Report
) -> None:
    """Store trials, but those that were imported from the other kind of file: they are there."""
    names = ", ".join(quoted(record.spec.trial_id) for record in records) or "''"
    _, rows = query(
        store.path,
        f"SELECT trial_id FROM trials WHERE source = 'human' AND spec_hash <> {quoted(spec[0])} "  # noqa: S608 # quoted
        f"AND trial_id IN ({names})",
    )
    elsewhere = {trial_id for (trial_id,) in rows}
    new = [record for record in records if record.spec.trial_id not in elsewhere]
    added, there, differing = store.add_recorded(new, dict([spec]) if new else {})
    report.added += added
    report.there += there + len(records) - len(new)
    report.differing += differing


def _read_page(file: File, condition: str, report: Report) -> Iterator[TrialRecord]:
    """The trials of a page; what cannot be read is reported."""
    try:
        for experiment, iteration, trial in trials_of(file.read(), condition):
            name = f"{file.name}: {PAIRS[experiment]}, trial {iteration}"
            try:
                trace = trace_of(trial, condition)
                record = trial_record(trace, experiment, iteration, PAGE_SPEC_HASH)
                if record.spec.condition != condition:
                    raise Unreadable(f"its speeds are not those of {condition}")
                yield record
            except Unreadable as exc:
                report.unreadable.append((name, str(exc)))
    except Unreadable as exc:
        report.unreadable.append((file.name, str(exc)))
