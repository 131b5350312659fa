"""Turns the files of a download into trials in the database."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import PurePath

from merge_runner.results.store import Store, query
from merge_runner.trial_records import TrialRecord
from merge_runner_analysis.humans.archive import File, Unreadable, check_sizes
from merge_runner_analysis.humans.record import (
    SPECS,
    condition_of,
    parse_csv,
    trace_of,
    trial_record,
    trials_of,
)
from merge_runner_analysis.published import PAIRS

CHUNK = 100
# The recorder wrote a PKL of each trial, too; unpickling it would run code in the file.
NAME = re.compile(r"experiment_([0-9]{1,6})_iter_([0-9]{1,6})\.csv", re.IGNORECASE)
IMPORTED = "SELECT trial_id, spec_hash FROM trials WHERE source = 'human'"
# The condition of a velocity page, or experiment and iteration of a recording; and the file.
Source = tuple[str, int, int, File]


@dataclass(slots=True)
class Report:
    """Counts of new and ``stored`` trials, ids of ``differing`` ones, files with reasons."""

    added: int = 0
    stored: int = 0
    differing: list[str] = field(default_factory=list)
    unreadable: list[tuple[str, str]] = field(default_factory=list)


def sort_files(files: Iterable[File]) -> list[Source]:
    """Return the files with trials, recordings first; raises UsageError for a bomb."""
    sources: list[Source] = []
    for file in files:
        if name := NAME.fullmatch(PurePath(file.name).name):
            sources.append(("", int(name[1]), int(name[2]), file))
        elif condition := condition_of(file.name):
            sources.append((condition, 0, 0, file))
    check_sizes(file for *_, file in sources)
    return sorted(sources, key=lambda source: source[:3])


def import_trials(sources: Iterable[Source], store: Store) -> Report:
    """Store trials, some at a time; an error does not undo earlier ones. Raises StoreError."""
    report = Report()
    records = (record for source in sources for record in _records(*source, report))
    while chunk := list(islice(records, CHUNK)):
        # A trial that was imported from the other kind of file is there.
        known = dict(query(store.path, IMPORTED)[1])
        new = [
            record
            for record in chunk
            if known.setdefault(record.spec.trial_id, record.spec.spec_hash)
            == record.spec.spec_hash
        ]
        used = {name: SPECS[name] for name in {record.spec.spec_hash for record in new}}
        added, stored, differing = store.add_recorded(new, used)
        report.added += added
        report.stored += stored + len(chunk) - len(new)
        report.differing += differing
    return report


def _records(
    condition: str, experiment: int, iteration: int, file: File, report: Report
) -> Iterator[TrialRecord]:
    try:
        if not condition:
            yield trial_record(parse_csv(file.read()), experiment, iteration)
            return
        for experiment, iteration, lines in trials_of(file.read(), condition):  # noqa: PLR1704 # of the page
            try:
                yield trial_record(trace_of(lines, condition), experiment, iteration, condition)
            except Unreadable as exc:
                trial = f"{file.name}: {PAIRS[experiment]}, trial {iteration}"
                report.unreadable.append((trial, str(exc)))
    except Unreadable as exc:
        report.unreadable.append((file.name, str(exc)))
