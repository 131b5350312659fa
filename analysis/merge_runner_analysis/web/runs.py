"""Runs of a database: their progress, whether they can be trusted, and their counts."""

from __future__ import annotations

import json
import shlex
from argparse import ArgumentParser
from collections import defaultdict
from collections.abc import Mapping, Sequence
from datetime import UTC
from pathlib import Path
from typing import Any

from merge_runner.audit.checks import not_judged
from merge_runner.driver_names import both_sides, pair_name
from merge_runner.paths import DEFAULT_DB, command_at, db_words
from merge_runner.run.progress_file import ProgressSnapshot, read_snapshot
from merge_runner_analysis.task import leaves
from merge_runner_analysis.web.phrases import called, duration, local_server
from merge_runner_analysis.web.reading import Row
from merge_runner_analysis.web.trial_index import TrialFilter, TrialIndex

REFUSED = 2
# Options of a sweep that a replay refuses or has no use for: without a value, and with one.
UNREPLAYED = ("--batch", "--strict-model", "--keep-going", "--replay")
UNREPLAYED_VALUES = ("--dask", "--max-cost", "--in-flight", "--rpm", "--tpm")
# Reasons for an early end of a run, by exit code: in a sentence, and in a list.
REASONS = {
    REFUSED: (
        "the service refused the key or the model, or a setting was wrong",
        "refused: key, model or setting",
    ),
    3: ("the account's quota or --max-cost was used up", "cap or quota reached"),
    4: ("a replay makes no calls, and some replies are not recorded", "replies not recorded"),
    130: ("it was interrupted (Ctrl-C)", "interrupted (Ctrl-C)"),
}


def list_runs(trial_index: TrialIndex) -> list[Row]:
    """Return all runs, the newest first. Raises what ``TrialIndex.refresh`` does."""
    runs: list[Row] = []
    # A run notes its end in the database before its file goes: one that seems to be lost may have
    # ended since the rows were read, by whoever refreshed the index since.
    for is_sure in (False, True):
        trial_index.refresh(at_once=is_sure)
        counted, newest, runs = numbers_of(trial_index, {}), dict[Any, str](), []
        for row in trial_index.ask("FROM sweeps ORDER BY started_at DESC, sweep_id DESC"):
            sweep_id, config = row["sweep_id"], json.loads(row["config"])
            snapshot = None if row["ended_at"] else read_snapshot(trial_index.db, sweep_id)
            # The newest run of the same trials went on with those before it.
            same = row["name"], config.get("model"), config.get("sample_set")
            later = newest.setdefault(same, sweep_id).replace(sweep_id, "")
            row_of = {**row, **counted[sweep_id], "db": trial_index.db}
            runs.append(run_of(row_of, config, snapshot, later))
        if all(run["state"] != "lost" for run in runs):
            break
    return runs


def numbers_of(trial_index: TrialIndex, filters: TrialFilter) -> Mapping[str, Row]:
    """Return counts of a filter's trials by run; the empty id has the total.

    Whatever several runs or trials share counts once. A run may have begun since: it has none.
    """
    (total,) = trial_index.counts({**filters, "who": ["drivers", "mocks"]})
    counted = {row["sweep"]: row for row in trial_index.counts(filters, "sweep")}
    return defaultdict(lambda: dict.fromkeys(total, 0), {"": total} | counted)


def standing_of(trial_index: TrialIndex) -> list[Row]:
    """Return the runs that go on, or ended early without a later run; else the newest one.

    One that was refused is no news once its models were asked in a later run of its study. The
    newest come first. Raises what ``TrialIndex.refresh`` does.
    """
    runs, answered = list_runs(trial_index), dict[str, set[str]]()
    news = []
    for run in runs:
        of_study = answered.setdefault(run["study"], set())
        models = {*run["config"].get("model", "").split(",")}
        if run["state"] == "finished":
            of_study |= models
        elif not run["later"] and not (run["row"]["exit_code"] == REFUSED and models <= of_study):
            news.append(run)
    return news or runs[:1]


def run_of(row: Row, config: Row, snapshot: ProgressSnapshot | None, later: str = "") -> Row:
    """Return a run of a sweep: its progress, and in a ``text`` whether it can be trusted.

    ``row`` has its stored values and its counts, ``config`` its plan, and ``snapshot`` the report
    of its process, None without a file. It is ``running``, ``checking`` what is
    stored, ``lost``, ``finished`` or ``stopped``. ``command`` goes on with it, unless a
    ``later`` run already did. One that is ``followed`` may have news: it may have slept,
    and go on.
    """
    study = row["name"]
    row = {**row, "name": called(row["name"], config)}
    state, last_word = "stopped" if row["exit_code"] else "finished", row["ended_at"]
    if last_word is None:
        state = "lost"
        if snapshot:
            # As the database has it: UTC, without saying so.
            last_word = snapshot.updated_at.astimezone(UTC).replace(tzinfo=None)
            if snapshot.alive:
                state = "running" if snapshot.doing == "playing" else "checking"
    live = snapshot if state in {"running", "checking"} else None
    drivers, endpoints = config.get("model", "").split(","), config.get("endpoints", {})
    part = f", in {row['scripted']} of {row['trials']} trials"
    run = {
        "row": row,
        "study": study,
        "config": config,
        "sweep_id": row["sweep_id"],
        "driver": ", ".join(pair_name(both_sides(name).values(), endpoints) for name in drivers),
        "local": "; ".join(sorted(set(filter(None, map(local_server, endpoints.values()))))),
        "stand_in": row["scripted"]
        and f"{row['stand_in']}{part if row['scripted'] < row['trials'] else ''}",
        "state": state,
        "live": live,
        "followed": row["ended_at"] is None and snapshot is not None,
        "planned": sum(arm["repetitions"] for arm in config.get("arms", ()))
        * len(config.get("conditions", ())),
        "ended": live.ended if live else row["ended"],
        "failed": live.failed if live else row["failed"],
        "last_word": last_word,
        "lasted_s": last_word and (last_word - row["started_at"]).total_seconds(),
        "later": later,
    }
    kind, text = assessment_of(run)
    code = row["exit_code"]
    goes_on = state in {"lost", "stopped"} and code != 4 and run["ended"] != run["planned"]
    typed = config.get("typed") if goes_on and not later else None  # a notebook types none
    command = shlex.join(["merge-runner", *words_here(typed, row["db"])]) if typed else ""
    return {**run, "kind": kind, "text": text, "command": command, "ended_as": ended_as(run)}


def repeats(run: Row) -> list[tuple[str, str, str]]:
    """Return commands that audit, replay and repeat a run: a name, the command, what it does."""
    row, typed = run["row"], run["config"].get("typed")
    db = row["db"]
    given = [("audit", audit_command(run["sweep_id"], db), "replays each trial from its replies")]
    if not typed:  # a notebook types none
        return given
    played = [word for word in without("--db", words_here(typed, db)) if word != "--yes"]
    again = [word for word in played if word not in UNREPLAYED]
    for option in UNREPLAYED_VALUES:
        again = without(option, again)
    other = db.with_name(f"{db.stem}-replayed{db.suffix}")
    before, after = (
        command_at("merge-runner digest", "--db", place, DEFAULT_DB) for place in (db, other)
    )
    words = ["merge-runner", "replay", *again[1:], "--db", str(other)]
    given += [
        ("replay", shlex.join(words), "plays it anew from the replies in the cache: no network"),
        ("digests", before, "of this run's database, and"),
        ("", after, "of the replay's are equal if both hold the same trials"),
    ]
    if typed[0] == "sweep" and "--replay" not in typed:
        number = str(run["config"].get("sample_set", 0) + 1)
        words = [*without("--sample-set", played), "--sample-set", number]
        command = shlex.join(["merge-runner", *words, *db_words(db, study_in(words))])
        given.append(("new replies", command, "asks the models anew, in another sample set"))
    return given


def audit_command(sweep_id: str, db: Path) -> str:
    """Return the command that audits a run."""
    audit = shlex.join(["merge-runner", "audit", "--sweep", sweep_id])
    return command_at(audit, "--db", db, DEFAULT_DB)


def origin_of(run: Row) -> list[tuple[str, str]]:
    """Return the program, the versions of packages and the models of a run."""
    row, config = run["row"], run["config"]
    changes = "with uncommitted changes" if row["git_dirty"] else "no uncommitted changes"
    commit = row["git_commit"] or "unknown"
    installed = commit if row["git_dirty"] is None else f"commit {commit}, {changes}"
    versions = json.loads(row["versions"]).items()
    models = []
    for name, entry in config.get("models", {}).items():
        url = config.get("endpoints", {}).get(name) or entry.get("base_url")
        sent = dict(entry.get("parameters") or {}) | {
            key: entry[key] for key in ("max_output_tokens",) if key in entry
        }
        place = local_server(url) or url or entry.get("provider")
        texts = (entry.get("id"), place, *leaves(sent))
        models.append((name, ", ".join(filter(None, texts))))
    packages = ", ".join(f"{name} {version}" for name, version in versions)
    return [("program", installed), *[("packages", packages)] * bool(packages), *models]


def words_here(typed: Sequence[str], db: Path) -> list[str]:
    """Return the words that play a study, with its file and database as they are found from here.

    They may have been typed elsewhere: by default the database is below the study's folder.
    """
    words, home = without("--db", typed), db.parent.parent
    is_default = len(words) == len(typed)
    for place, word in enumerate(words):
        if word.endswith(".toml"):
            known = [folder / Path(word).name for folder in (home, home / "experiments")]
            files = [*known, Path(word)] if is_default else [Path(word), *known]
            words[place] = str(next((file for file in files if file.is_file()), word))
    return [*words, *db_words(db, study_in(words))]


def study_in(words: Sequence[str]) -> str:
    """Return the first file of a study among the words of a command; empty without one."""
    return next((word for word in words if word.endswith(".toml")), "")


def without(option: str, words: Sequence[str]) -> list[str]:
    """Return the words of a command without an option and its values."""
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(option)
    return parser.parse_known_args(words)[1]


def ended_as(run: Row) -> str:
    """Return how a run ended, in a word or two."""
    if run["state"] == "lost":
        return "cut off"
    if run["state"] != "stopped":
        return "checking what is stored" if run["state"] == "checking" else str(run["state"])
    failed = f"{run['failed']} trials failed" if run["failed"] else "ended by an error"
    return REASONS.get(run["row"]["exit_code"], ("", failed))[1]


def assessment_of(run: Row) -> tuple[str, str]:
    """Say whether a run is finished, and can be trusted: of what kind that is, and a sentence."""
    ended, planned, state, row = (run[name] for name in ("ended", "planned", "state", "row"))
    counted = f"{ended} of {planned} trials" if planned else f"{ended} trials"
    failures = f", {run['failed']} failed" if run["failed"] else ""
    if state == "checking":
        return "running", f"Nearly done: {counted} ended{failures}; the audit runs."
    if state == "running":
        left_s = run["live"].left_s
        left = f", about {duration(left_s)} left" if left_s is not None else ""
        return "running", f"Running: {counted} ended{failures}{left}."
    if state == "finished":
        if ended < planned:
            text = f"It had finished, but the database holds only {ended} of its {planned} trials."
            return "stopped", text
        text = f"Complete: all {ended} trials ended"
        if why := not_judged(run["driver"], row["invalid"], row["asked"]):
            return "doubtful", f"{text}; {why}."
        troubles = {"failed requests (retried)": row["faults"], "invalid replies": row["invalid"]}
        met = ", ".join(f"{name} {times:,}" for name, times in troubles.items() if times)
        fine = ", every request was answered, and every reply has a valid plan"
        text += f"; on the way: {met}" if met else fine * bool(row["asked"])
        if others := row["others"]:
            return "doubtful", f"{text}; but another model gave {others} answers."
        return "finished", f"{text}."
    if state == "lost":
        gone = "The run was cut off: its process stopped or hangs."
        return "stopped", f"{gone} {counted} are stored{failures}."
    if reason := REASONS.get(row["exit_code"]):
        return "stopped", f"Stopped: {reason[0]}. {counted} have an outcome{failures}."
    if ended == planned:
        text = f"Ended with faults: {counted} have an outcome, but what is stored does not hold "
        return "stopped", f"{text}together. See: {audit_command(run['sweep_id'], row['db'])}"
    if run["failed"]:
        return "stopped", f"Ended: {counted} have an outcome{failures}."
    return "stopped", f"Stopped by an error that it printed: {counted} have an outcome."
