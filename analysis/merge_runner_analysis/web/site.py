"""State that all pages share: the database, the list of its trials, templates, addresses."""

from __future__ import annotations

import contextlib
import hashlib
import shlex
import threading
from collections.abc import Mapping
from contextvars import copy_context
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starlette.responses import Response

from merge_runner.errors import MergeRunnerError, StoreError
from merge_runner.paths import db_words
from merge_runner_analysis.cache import stamp_of
from merge_runner_analysis.metrics import METRICS
from merge_runner_analysis.tables.model import Table, from_text
from merge_runner_analysis.web.answers import Request
from merge_runner_analysis.web.computing import Computing, Job
from merge_runner_analysis.web.note_file import LONGEST_TEXT, Notes
from merge_runner_analysis.web.phrases import clock, condition_text
from merge_runner_analysis.web.queries import Queries
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.rendering import environment
from merge_runner_analysis.web.trial_index import TrialIndex
from merge_runner_analysis.web.urls import HOME, Links
from merge_runner_analysis.wording import MEASURES, TABLE

# Scripts that draw and move a trial, in the order of loading.
_PARTS = "moment track charts ribbons panel clock comparison start"
REPLAY = [f"replay/{part}.js" for part in _PARTS.split()]
PAGES = {"Study": HOME, "Drivers": "drivers", "Trials": "trials", "Words": "words",
         "Prompts": "prompts", "Runs": "sweeps", "SQL": "sql"}  # fmt: skip
PLAYED = """
SELECT count(*) AS runs, min(started_at) AS first, max(coalesce(ended_at, started_at)) AS last,
    count(ended_at) AS ended FROM results.sweeps
"""
# The parts of a scope in an address; the list of trials filters by the same names.
SCOPE = ("sweep", "model", "variant", "condition")
# Pages with one list of all their entries.
LISTS = {"Tables and figures": "tables", "Notes": "notes", "Glossary": "glossary"}
# Cached answers come within the first time; a page asks again for others, a file waits.
AT_ONCE_S, FILE_WAIT_S = 0.3, 300.0


class NotThere(Exception):
    """An address of something that is not there; the text says what is."""


class TooMuch(Exception):
    """An address asks for more than a query may hold; the text says how much it may."""


class NothingNew(Exception):
    """The page is as the reader saw it last."""


def download(text: str, name: str) -> Response:
    """Return a file that a browser saves under this name."""
    kind = {".csv": "text/csv", ".tex": "application/x-tex"}[Path(name).suffix]
    headers = {"content-disposition": f'attachment; filename="{name}"'}
    return Response(text, headers=headers, media_type=f"{kind}; charset=utf-8")


def news_of(shown: object, seen: str, state: str = "all") -> str:
    """Return a digest of the shown content; raises NothingNew where it is the one ``seen``."""
    now = f"{state}-{hashlib.sha256(repr(shown).encode()).hexdigest()[:16]}"
    if now == seen:
        raise NothingNew
    return now


@dataclass
class Site:
    """The explorer of one database."""

    db: Path
    at: Links = field(default_factory=Links)
    program: str = "merge-runner"
    """Command that runs this program."""
    reader: str = "reader"
    """Name of the reader who writes notes."""
    study: str = ""
    """The file of the study whose names and parts are known, as it was typed."""
    is_still: bool = False
    """True: no news is taken in."""
    policy: str = ""
    """Content security policy of a page without a server."""
    inlined: Mapping[str, str] = field(default_factory=dict)
    """The styles and scripts of a page that holds them itself, by name."""
    beginning = False
    """True while the trials are read for the first time."""

    def __post_init__(self) -> None:
        self.trial_index = TrialIndex(self.db)
        self.queries = Queries(self.trial_index.copies)
        self.computing = Computing(self.db)
        self.notes = Notes(self.db, self.reader)
        self._environment = environment(
            self.at,
            self.policy,
            self.inlined,
            metrics=METRICS,
            notes=self.notes,
            longest_note=LONGEST_TEXT,
            measures=MEASURES,
            pages=PAGES,
            lists=LISTS,
            share=self.share,
            played=self.played,
            program=self.program,
            study=str(self.db) if self.at.served else self.db.name,
            carried={},
            clock=clock,
            condition_text=condition_text,
            in_words=self.trial_index.in_words,
        )

    def begin(self) -> None:
        """Read the trials and make the first page's table, before anything is asked."""
        self.beginning = True
        self.computing.ask(("table", TABLE, "", ""), stamp_of(self.db))

        def read() -> None:
            try:
                with contextlib.suppress(MergeRunnerError):  # the first page says what is wrong
                    self.refresh()
            finally:
                self.beginning = False

        threading.Thread(target=copy_context().run, args=(read,), daemon=True).start()

    def refresh(self) -> None:
        """Take in what is new: in the database, and in the notes beside it."""
        if self.is_still:
            return
        self.trial_index.refresh()
        self.trial_index.tag(self.notes.read().tags)

    def trial(self, trial_id: str, spec_hash: str) -> Row:
        """Return the trial of this name, of several specs of this one; raises NotThere."""
        row = self.trial_index.find(trial_id, spec_hash)
        if row is None:
            raise NotThere(f"the database holds no trial {trial_id}")
        return row

    def computed(self, request: Request, wait_s: float = AT_ONCE_S) -> Job:
        """Ask for an answer, and wait for it for a moment; raises NotThere where there is none."""
        # An export waits for every answer: its pages are written once.
        job = self.computing.ask(request, stamp_of(self.db), None if self.is_still else wait_s)
        if job.content is not None and "absent" in job.content:
            raise NotThere(job.content["absent"])
        return job

    def table(self, name: str, sweep: str = "", condition: str = "") -> tuple[Job, Table | None]:
        """Return the job of a table, of all trials or of a part, and the table once it is there."""
        job = self.computed(("table", name, sweep, condition))
        return job, from_text(job.content["table"]) if job.content else None

    def awaited(self, request: Request) -> dict[str, Any]:
        """Return the answer of a computation in FILE_WAIT_S; raises NotThere and StoreError."""
        job = self.computed(request, FILE_WAIT_S)
        if job.content is None:
            raise StoreError(job.failure or "it is still being computed: ask again in a minute")
        return job.content

    def played(self) -> str:
        """Return when the database's runs were played; empty without one."""
        ((runs, first, last, ended),) = map(dict.values, self.trial_index.ask(PLAYED))
        if not runs:
            return ""
        times = [f"{time:%Y-%m-%d %H:%M}" for time in (first, last)]
        end = f" to {times[1]}" if times[1] != times[0] else ""
        going = "" if ended == runs else ", not all ended"
        return f"{f'in {runs} runs ' if runs > 1 else ''}{times[0]}{end} UTC{going}"

    def share(self, *options: str, of_study: bool = True) -> str:
        """Return the command that exports the shown pages; ``of_study``: it takes --study."""
        study = self.study if of_study else ""
        words = [*db_words(self.db, study), *(["--study", study] if study else [])]
        return shlex.join([self.program, "view", *words, *options])

    def render(self, template: str, **values: object) -> str:
        """Return a page, or a part of one."""
        values = {"is_locked": self.trial_index.copies.is_locked, **values}
        return self._environment.get_template(template).render(values)
