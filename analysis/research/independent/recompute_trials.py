"""The trials of a results database, measured anew from states and decisions.

Nothing of the project is imported, nor are its views of measures read: the definitions are those of
the paper (arXiv 2604.09609) and of docs/numbers.md. Lengths in m, times in s, speeds in m/s.
"""

from __future__ import annotations

import json

import duckdb
import numpy as np
import pandas as pd

LENGTH, WIDTH = 4.5, 1.8
MERGE = 100.0
COPIED = ("status", "source", "pair", "scripted", "variant")
# Each branch leaves the centre line by 12.5 m in its 100 m.
SINE = 12.5 / 100
COSINE = np.sqrt(1 - SINE**2)
# The published human outcomes by projected headway and relative velocity, left minus right: left
# first, right first, collided (Siebinga et al., doi 10.4121/19550377).
OUTCOMES = {
    (-4, -0.8): (8, 79, 3),
    (-4, 0): (0, 89, 1),
    (-4, 0.8): (0, 87, 3),
    (-2, 0.8): (0, 88, 2),
    (0, 0.8): (8, 78, 4),
    (0, 0): (37, 48, 5),
    (0, -0.8): (80, 7, 3),
    (2, -0.8): (87, 1, 2),
    (4, -0.8): (89, 0, 1),
    (4, 0): (88, 0, 2),
    (4, 0.8): (68, 20, 2),
}
SIDES = ("left", "right")
KEYS = ["trial_id", "spec_hash"]


def published_humans() -> pd.DataFrame:
    """The 990 human outcomes, a row each."""
    fates = [("finished", "left"), ("finished", "right"), ("collided", None)]
    rows = [
        (*cell, status, first, status == "collided")
        for cell, counts in OUTCOMES.items()
        for (status, first), n in zip(fates, counts, strict=True)
        for _ in range(n)
    ]
    return _with_cells(pd.DataFrame(rows, columns=["h", "dv", "status", "first", "boxes"]))


def read(db: str, study: str = "") -> pd.DataFrame:
    """Every trial with its driver, levels and measures; ``study`` keeps those played for it."""
    with duckdb.connect(db, read_only=True) as connection:
        trials = connection.sql("FROM trials WHERE source <> 'first_decision'").df()
        specs = dict(connection.sql("SELECT spec_hash, spec::TEXT FROM specs").fetchall())
        states = connection.sql("FROM states ORDER BY trial_id, spec_hash, side, step").df()
        decisions = connection.sql(
            "SELECT trial_id, spec_hash, side, valid, call_key IS NOT NULL AS asked FROM decisions"
        ).df()
        factors = connection.sql("FROM trial_factors").df()
        played = connection.sql(
            "SELECT trial_id, spec_hash, name, config->>'$.levels' AS levels, started_at "
            "FROM sweep_trials JOIN sweeps USING (sweep_id) ORDER BY started_at DESC"
        ).df()
    orders = _orders(played)
    samples = {key: _samples(rows) for key, rows in states.groupby(KEYS)}
    decided = dict(list(decisions.groupby(KEYS)))
    levels = {
        key: {row.factor: (row.value, row.words) for row in rows.itertuples()}
        for key, rows in factors.groupby(KEYS)
    }
    studies = {key: frozenset(rows["study"]) for key, rows in played.groupby(KEYS)}
    rows = []
    for trial in trials.itertuples():
        key = (trial.trial_id, trial.spec_hash)
        spec = json.loads(specs.get(trial.spec_hash, "{}"))
        of_trial = decided.get(key, decisions.iloc[:0])
        named = _named(trial, spec, levels.get(key, {}), of_trial)
        named["studies"] = studies.get(key, frozenset())
        rows.append(named | _driven(trial, named, samples.get(key)))
    every = _with_cells(pd.DataFrame(rows))
    # Mock models sample: of theirs that went alike the first is one, and so is the second.
    again = every.groupby(["driver", "variant", "cell", "way"]).cumcount()
    posing = every["scripted"].astype(bool) & ~every["programs"]
    ways = [(*way, n) for way, n in zip(every["way"], again, strict=True)]
    every["way"] = every["way"].mask(posing, pd.Series(ways, every.index, dtype=object))
    if study:
        kept = every["studies"].map(lambda names: any(study == name[0] for name in names))
        every = every[kept | (every["source"] == "human")]
        orders = {name: order for name, order in orders.items() if name[0] == study}
    every.attrs["orders"] = orders
    return every


def _orders(played: pd.DataFrame) -> dict[tuple[str, ...], dict]:
    """The levels of each study as its newest run has them; adds the column ``study``."""
    played["study"] = [
        (name, *sorted(json.loads(levels) if levels else {}))
        for name, levels in zip(played["name"], played["levels"], strict=True)
    ]
    orders = {}
    for row in played.itertuples():
        orders.setdefault(row.study, json.loads(row.levels) if row.levels else {})
    return orders


def _driven(trial, named: dict, samples) -> dict:
    """The situation of a trial as its ego sees it, and its measures."""
    sign = -1 if named["ego"] == "right" else 1
    row = {
        **{name: getattr(trial, name) for name in COPIED},
        "h": sign * trial.projected_headway_m,
        "dv": sign * trial.relative_velocity_mps,
        "way": ((trial.trial_id, trial.spec_hash), trial.status),  # like no other's
    }
    if samples is not None and trial.status != "failed":
        row |= _measured(trial, named["ego"], samples)
        if named["programs"] or trial.scripted:
            row["way"] = (_as_seen(named["ego"], samples), trial.status)
    return row


def who_first_data(trials: pd.DataFrame) -> tuple[np.ndarray, np.ndarray, pd.DataFrame]:
    """Design of intercept, h and dv; left first as 0 or 1; their trials."""
    used = trials[(trials["status"] == "finished") & trials["first"].notna()]
    x = np.column_stack([np.ones(len(used)), used[["h", "dv"]].to_numpy(float)])
    return x, (used["first"] == "left").to_numpy(float), used


def gap_design(trials: pd.DataFrame) -> np.ndarray:
    """Intercept, |h|, |dv| and h dv."""
    h, dv = trials["h"].to_numpy(float), trials["dv"].to_numpy(float)
    return np.column_stack([np.ones(len(h)), np.abs(h), np.abs(dv), h * dv])


def gap_data(
    trials: pd.DataFrame, measure: str = "gap"
) -> tuple[np.ndarray, np.ndarray, pd.DataFrame]:
    """Their design; the gaps in m; their trials."""
    used = trials[(trials["status"] == "finished") & trials[measure].notna()]
    return gap_design(used), used[measure].to_numpy(float), used


def _with_cells(trials: pd.DataFrame) -> pd.DataFrame:
    cells = zip(trials["h"].round(6) + 0.0, trials["dv"].round(6) + 0.0, strict=True)
    return trials.assign(cell=pd.Series(list(cells), trials.index, dtype=object))


def _named(trial, spec, stored, decisions) -> dict:
    """The driver's name, the ego's side, and the levels of the trial."""
    factors = {name: level for name, (level, _) in stored.items()}
    if trial.source == "human":
        return {"driver": "human", "ego": "left", "levels": {}, "programs": False, "asked": {}}
    models = {"left": trial.model_left, "right": trial.model_right}
    asking = {side: "body" in spec[side] for side in SIDES}
    ego, opponent = "left", factors.get("opponent")
    if models["left"] != models["right"]:
        if opponent in models.values():
            ego = "left" if opponent == models["right"] else "right"
        elif asking["left"] != asking["right"]:
            ego = "left" if asking["left"] else "right"
        else:
            ego = min(SIDES, key=models.get)
    ego = trial.focal or ego
    driver_model, other_model = models[ego], models["right" if ego == "left" else "left"]
    varied = {n: v for n, v in factors.items() if n != "prompt"}
    shown = {n: v for n, v in varied.items() if n != "opponent" and not stored[n][1]}
    driver = driver_model if driver_model == other_model else f"{driver_model}+{other_model}"
    driver += f" [{', '.join(f'{n}={v}' for n, v in sorted(shown.items()))}]" if shown else ""
    model = (
        driver_model
        if driver_model == other_model or opponent not in (None, "self")
        else f"{driver_model}+{other_model}"
    )
    asked = decisions[decisions["asked"]].groupby("side")["valid"].agg(["size", "sum"])
    return {
        "driver": driver,
        "ego": ego,
        "levels": {"model": model, "prompt": factors.get("prompt", trial.variant)} | varied,
        "programs": not any(asking.values()),
        "asked": {models[side]: (int(n), int(n - valid)) for side, n, valid in asked.itertuples()},
    }


def _samples(rows: pd.DataFrame) -> dict:
    """Times, and by side positions, speeds and accelerations."""
    sides = dict([*rows.groupby("side")])
    names = {"s": "position_m", "v": "velocity_mps", "a": "acceleration_mps2"}
    series = {n: {side: sides[side][c].to_numpy(float) for side in SIDES} for n, c in names.items()}
    return {"t": sides["left"]["time_s"].to_numpy(float), **series}


def _as_seen(ego: str, at: dict) -> bytes:
    """All positions and speeds of a trial, those of the ego first."""
    sides = sorted(SIDES, key=lambda side: side != ego)
    # Nothing is added to -0.0 to make it 0.0 but here.
    return b"".join((at[name][side] + 0.0).tobytes() for name in "sv" for side in sides)


def _passed(t: np.ndarray, s: np.ndarray, level: float) -> float:
    """Return the time at which a vehicle passes a level, linear within the step; NaN: never."""
    steps = np.flatnonzero((s[:-1] < level) & (s[1:] >= level))
    if not len(steps):
        return np.nan
    k = steps[0]
    return t[k] + (t[k + 1] - t[k]) * (level - s[k]) / (s[k + 1] - s[k])


def _measured(trial, ego: str, at: dict) -> dict:
    t, s, v = at["t"], at["s"], at["v"]
    boxes = _boxes(trial, at)
    near = [_apart(x, y) < LENGTH for x, y in zip(s["left"], s["right"], strict=True)]
    outcomes = {"boxes": boxes, "collided": None if trial.source == "human" else any(near)}
    if trial.status != "finished":
        return outcomes
    merges = {side: _passed(t, s[side], MERGE) for side in SIDES}
    first = min(SIDES, key=lambda side: np.nan_to_num(merges[side], nan=np.inf))
    second = "right" if first == "left" else "left"
    begins = merges[first]
    until = (t >= 0) & (np.r_[-np.inf, t[:-1]] < begins)
    rmse = {}
    for side in SIDES:
        sign = 1 if side == "left" else -1
        human = 10 + sign * trial.relative_velocity_mps / 2
        start = human if trial.source == "human" else v[side][0]
        rmse[side] = np.sqrt(np.mean((v[side][until] - start) ** 2))
    lead = s["left"] - s["right"]
    after = np.maximum(s["left"], s["right"]) >= MERGE
    closing = np.where(lead > 0, v["right"] - v["left"], v["left"] - v["right"])
    conflict = after & (closing > 0.01) & (np.abs(lead) > LENGTH)
    mean_there = np.flatnonzero(s["left"] + s["right"] >= 2 * MERGE)
    left_rear = _passed(t, s[first], MERGE + LENGTH / 2)
    return outcomes | {
        # As the ego saw it: where it sat on the right, left is right.
        "first": "left" if first == ego else "right",
        "left_first": first == ego,
        "gap": abs(np.interp(begins, t, lead)) - LENGTH,
        "gap_mean100": abs(lead[mean_there[0]]) - LENGTH if len(mean_there) else np.nan,
        "rmse": (rmse["left"] + rmse["right"]) / 2,
        "joint": min(rmse.values()) >= 0.5,
        "time_to_merge": begins,
        "pet": _passed(t, s[second], MERGE - LENGTH / 2) - left_rear,
        "ttc": ((np.abs(lead) - LENGTH)[conflict] / closing[conflict]).min()
        if conflict.any()
        else np.nan,
        "hardest": max(np.abs(at["a"][side][t > 0]).max() for side in SIDES),
    }


def _place(side: str, s: float) -> np.ndarray:
    """The centre in the plane, the merge point at the origin, y along the common road."""
    before = min(s - MERGE, 0.0)
    sign = 1 if side == "left" else -1
    return np.array([sign * SINE * before, COSINE * before + max(s - MERGE, 0.0)])


def _apart(left: float, right: float) -> float:
    return float(np.hypot(*(_place("left", left) - _place("right", right))))


def overlap(left: float, right: float) -> bool:
    """Return whether the boxes of two vehicles overlap, by separating axes."""
    boxes = []
    for side, s in zip(SIDES, (left, right), strict=True):
        sine = (1 if side == "left" else -1) * SINE if s < MERGE else 0.0
        along = np.array([sine, np.sqrt(1 - sine**2)])
        boxes.append((_place(side, s), along, np.array([along[1], -along[0]])))
    (first_centre, *first), (second_centre, *second) = boxes
    return all(
        abs((first_centre - second_centre) @ axis)
        < sum(
            LENGTH / 2 * abs(along @ axis) + WIDTH / 2 * abs(across @ axis)
            for along, across in (first, second)
        )
        for axis in (*first, *second)
    )


def _moved(s: float, v: float, a: float, dt: float) -> tuple[float, float]:
    """A constant acceleration later; who brakes to a stop stays there."""
    if v + a * dt >= 0:
        return s + v * dt + a * dt**2 / 2, v + a * dt
    return s - v**2 / (2 * a), 0.0


def _boxes(trial, at: dict) -> bool | None:
    """Return whether boxes overlapped at 20 Hz; None where another rule ended the trial before."""
    if trial.source == "human":
        return trial.status == "collided"
    t, s, v = at["t"], at["s"], at["v"]
    if any(_apart(*p) < 8 and overlap(*p) for p in zip(s["left"], s["right"], strict=True)):
        return True
    for k in range(len(t) - 1):
        if _apart(s["left"][k], s["right"][k]) > 8:  # far beyond what a step can bring together
            continue
        dt = t[k + 1] - t[k]
        looks = round(dt / 0.05)
        a = {side: (v[side][k + 1] - v[side][k]) / dt for side in SIDES}
        for look in range(1, looks):
            places = [_moved(s[x][k], v[x][k], a[x], dt * look / looks)[0] for x in SIDES]
            if overlap(*places):
                return True
    return None if trial.status == "collided" else False
