"""The tables of a results database, recomputed: {table: {row: {column: number or None}}}.

Nothing of the project is imported. Rates are in percent. The corrected p of ``contrasts`` and
``factors`` are left to a test: their families are all tests of the table ``effects``.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from analysis.research.independent import recompute_statistics as statistics
from analysis.research.independent import recompute_trials as measured
from analysis.research.independent import recompute_verdicts

WHO_FIRST = ("intercept", "projected_headway", "relative_velocity")
GAP = ("intercept", "abs_projected_headway", "abs_relative_velocity", "headway_x_velocity")
# Name of the table's columns, column of the trials, what sums it up, in the paper's Table VII.
METRICS = (
    ("collided_percent", "collided", "rate", True),
    ("collided_boxes_percent", "boxes", "rate", True),
    ("left_first_percent", "left_first", "rate", False),
    ("gap_m", "gap", "mean", True),
    ("rmse_mps", "rmse", "mean", True),
    ("joint_percent", "joint", "rate", True),
    ("time_to_merge_s", "time_to_merge", "median", False),
    ("post_encroachment_s", "pet", "median", False),
    ("min_ttc_s", "ttc", "median", False),
    ("max_acceleration_mps2", "hardest", "median", False),
)
MOST_INVALID = 0.2


def tables(db: str, study: str = "", i5_p=None) -> dict[str, dict[str, dict]]:
    """The tables of a database, or of one of its studies.

    I5 is not recomputed: ``held`` has its p by row of the table ``verdicts``, which is corrected
    together with the others.
    """
    trials = measured.read(db, study)
    for _, column, *_ in METRICS:
        if column not in trials:
            trials[column] = None
    recorded = trials[trials["source"] == "human"]
    driven = trials[trials["source"] != "human"]
    groups = {k: distinct(rows) for k, rows in driven.groupby(["driver", "variant"])}
    judged = {key: rows for key, rows in groups.items() if _is_judged(rows)}
    baselines = {key: rows for key, rows in judged.items() if key[1] == "baseline"}
    humans = {} if recorded.empty else {("human", ""): recorded}
    # Who went first is published, trial by trial.
    who = humans or {("human", ""): measured.published_humans()}
    computed = {
        "who-first": _by_term(who | judged, WHO_FIRST, _who_first)
        | _clustered(recorded, "who-first"),
        "gap": _by_term(humans | judged, GAP, _gap) | _clustered(recorded, "gap"),
        "ablation-qualitative": {_id(k): _qualities(v) for k, v in (humans | judged).items()},
        "ablation-quantitative": {_id(k): _quantities(v) for k, v in (humans | judged).items()},
        "indicators": _indicators(who | baselines),
        "contrasts": _prompts(judged, trials.attrs["orders"]),
        "factors": _factors(judged, trials.attrs["orders"]),
        "verdicts": _beside_humans(judged, who, recorded, i5_p or {}),
    }
    for rows in computed.values():
        rows |= {_id(key): {} for key in groups.keys() - judged.keys()}
    return computed


def _id(key: tuple[str, str]) -> str:
    return "/".join(filter(None, key))


def _is_judged(rows: pd.DataFrame) -> bool:
    """Return whether at most a fifth of the decisions of each model are invalid."""
    counts: dict[str, np.ndarray] = {}
    for asked in rows.loc[rows["status"] != "failed", "asked"]:
        for model, pair in asked.items():
            counts[model] = counts.get(model, 0) + np.array(pair)
    return all(invalid <= MOST_INVALID * n for n, invalid in counts.values())


def _beside_humans(judged, who, recorded: pd.DataFrame, i5_p) -> dict[str, dict]:
    """The humans and every driver and prompt that is judged, by measure."""
    (human,) = who.values()
    humans = {"who": human, "recorded": None if recorded.empty else recorded}
    rows = {f"human/{name}": row for name, row in recompute_verdicts.of_humans(humans).items()}
    for key, trials in judged.items():
        alike = trials[trials["cell"].isin(measured.OUTCOMES)]  # where humans drove
        robust = {name: holds for name, (*_, holds) in _verdicts(alike).items()}
        p = i5_p.get(f"{_id(key)}/held")
        for name, row in recompute_verdicts.rows(alike, humans, robust, p).items():
            rows[f"{_id(key)}/{name}"] = row
    return rows


def _by_term(groups, terms, rows_of) -> dict[str, dict]:
    return {
        f"{_id(key)}/{term}": row
        for key, trials in groups.items()
        for term, row in zip(terms, rows_of(trials), strict=True)
    }


def _columns(names: str, rows: np.ndarray | None, k: int) -> dict:
    """The values of a term by column, None where there is no fit."""
    values = [None] * len(names.split()) if rows is None else rows[k]
    return dict(zip(names.split(), values, strict=True))


def _who_first(trials: pd.DataFrame) -> list[dict]:
    x, y, _ = measured.who_first_data(trials)
    plain, penalised = statistics.logit(x, y), statistics.firth(x, y)
    return [
        {"n": len(y)}
        | _columns("b se z p", plain, k)
        | _columns("firth_b firth_se firth_p", penalised, k)
        for k in range(x.shape[1])
    ]


def _gap(trials: pd.DataFrame) -> list[dict]:
    x, y, used = measured.gap_data(trials)
    plain, robust, covariance = statistics.least_squares(x, y)
    rows = []
    for k, term in enumerate(GAP):
        hc3 = _columns("b hc3_se t hc3_p", robust, k)
        row = {"n": len(y)} | _columns("b se t p", plain, k)
        row |= {"hc3_se": hc3["hc3_se"], "hc3_p": hc3["hc3_p"]}
        row |= {"equivalence_p": None, "velocity_p": None}
        if term == "abs_relative_velocity" and robust is not None:
            # Conditions that differ in relative velocity alone.
            played = dict(zip(used["cell"], x, strict=True))
            apart = [
                played[faster] - played[slower]
                for faster in played
                for slower in played
                if faster[0] == slower[0] and faster[1] > slower[1]
            ]
            b, freedom = robust[:, 0], len(y) - x.shape[1]
            if apart:
                p = statistics.equivalence_p(b, covariance, np.array(apart), freedom)
                row["equivalence_p"] = p
                row["velocity_p"] = statistics.joint_p(b[2:], covariance[2:, 2:], freedom)
        rows.append(row)
    return rows


def _clustered(recorded: pd.DataFrame, table: str) -> dict[str, dict]:
    """The humans with the errors of a jackknife over their pairs."""
    if recorded.empty:
        return {}
    if table == "who-first":
        data = {"clustered": (statistics.logit, measured.who_first_data(recorded))}
        terms, names, other = WHO_FIRST, "b se z p", ("firth_b", "firth_se", "firth_p")
    else:
        data = {
            "clustered": (statistics.ordinary, measured.gap_data(recorded)),
            "clustered-mean100": (statistics.ordinary, measured.gap_data(recorded, "gap_mean100")),
        }
        terms, names, other = GAP, "b se t p", ("hc3_se", "hc3_p", "equivalence_p", "velocity_p")
    by_row = {}
    for name, (fit, (x, y, used)) in data.items():
        pair = used["pair"].to_numpy()
        rows = statistics.by_pairs(fit, x, y, pair)
        if rows is not None:
            rows = statistics.wald(*rows.T, len(np.unique(pair)) - 1)
        for k, term in enumerate(terms):
            row = {"n": len(y)} | _columns(names, rows, k) | dict.fromkeys(other)
            by_row[f"human/{name}/{term}"] = row
    return by_row


def _values(trials: pd.DataFrame, column: str, kind: str) -> pd.Series:
    """The values that count; of a rate as 0 and 1."""
    return trials[column].dropna().astype(float)


def _estimate(trials: pd.DataFrame, column: str, kind: str) -> tuple:
    """Value, ends of its interval, n."""
    values = _values(trials, column, kind).to_numpy()
    cut_off = _undecided(trials, column)
    if not len(values) + cut_off:
        return None, None, None, 0
    if kind == "rate":
        # Both worst cases, where trials are undecided (Manski 1989).
        k, every = values.sum(), len(values) + cut_off
        low = statistics.wilson(k / every, every)[0]
        high = statistics.wilson((k + cut_off) / every, every)[1]
        value = None if cut_off else 100 * k / every
        return value, 100 * low, 100 * high, len(values)
    if kind == "mean":
        used = trials[trials[column].notna()]
        ends = statistics.mean_interval(values)
        if "pair" in used and used["pair"].notna().all():
            ends = statistics.by_pair_interval(used, column)
        return values.mean(), *ends, len(values)
    return np.median(values), *statistics.median_interval(values), len(values)


def _undecided(trials: pd.DataFrame, column: str) -> int:
    """Count the trials that another collision rule ended before this one decided."""
    if column not in ("collided", "boxes"):
        return 0
    if column == "collided" and (trials["source"] == "human").all():
        return 0  # humans did not drive under the rule of the drivers
    return int((trials[column].isna() & (trials["status"] != "failed")).sum())


def _quantities(trials: pd.DataFrame) -> dict:
    row = {"n": int((trials["status"] != "failed").sum())}
    for name, column, kind, shown in METRICS:
        if shown:
            value, low, high, _ = _estimate(trials, column, kind)
            row |= {name: value, f"{name}_ci_low": low, f"{name}_ci_high": high}
    return row


def distinct(trials: pd.DataFrame) -> pd.DataFrame:
    """The trials without those of programs that went as an earlier one in the same situation."""
    keys = pd.Series([*zip(trials["cell"], trials["way"], strict=True)], trials.index)
    return trials[~keys.duplicated()]


def _order(orders) -> dict[str, list[str]]:
    """The levels of each factor as the study lists them that lists most of them.

    Whoever lists one alone says nothing of where it stands, unless nobody else lists any.
    """
    ordered: dict[str, list[str]] = {}
    for factor in {name for order in orders.values() for name in order}:
        lists = [order[factor] for order in orders.values() if factor in order]
        if len(lists) > 1:
            lists = sorted((levels for levels in lists if len(levels) > 1), key=lambda x: -len(x))
        ordered[factor] = [*dict.fromkeys(level for levels in lists for level in levels)]
    return ordered


def _together(orders, *groups: pd.DataFrame) -> bool:
    """Return whether one study was played with all these trials."""
    every = [studies for trials in groups for studies in trials["studies"]]
    return len(orders) < 2 or bool(frozenset.intersection(*every))


def _otherwise(first: pd.DataFrame, second: pd.DataFrame) -> list[pd.DataFrame]:
    """The trials but for those of programs that do the same in both: all of one are the other's.

    A program is known by its other levels, and does the same only if it does so in every condition.
    """
    ways: list[dict] = [{}, {}]
    for known, trials in zip(ways, (first, second), strict=True):
        for cell, way, status in zip(trials["cell"], trials["way"], trials["status"], strict=True):
            if status != "failed":
                known.setdefault(cell, set()).add(way)
    by_others: dict = {}
    for cell in ways[0].keys() & ways[1].keys():
        by_others.setdefault(cell[1:] if isinstance(cell, tuple) else None, []).append(cell)
    same = set()
    for cells in by_others.values():
        of_first, of_second = ([known[cell] for cell in cells] for known in ways)
        if all(a <= b or b <= a for a, b in zip(of_first, of_second, strict=True)):
            same |= {*cells}
    return [trials[~trials["cell"].isin(same)] for trials in (first, second)]


def _compared(first: pd.DataFrame, second: pd.DataFrame, column: str, kind: str) -> dict:
    if _undecided(first, column) or _undecided(second, column):
        return {}
    frames = [trials[trials[column].notna()] for trials in _otherwise(first, second)]
    if not {*frames[0]["cell"]} & {*frames[1]["cell"]}:
        return {}
    values = [_values(trials, column, kind) for trials in frames]
    test = statistics.rates_within if kind == "rate" else statistics.means_within
    return test(*values, tuple(trials["cell"] for trials in frames))


def _indicators(groups) -> dict[str, dict]:
    """Table V: I1 to I4 by the paper's rule and by the robust one, and the measures."""
    rows: dict[str, dict] = {}
    for key, trials in groups.items():
        for name, (fit, paper, robust) in _verdicts(trials).items():
            rows[f"{_id(key)}/{name}"] = {"paper": paper, "robust": robust, "n": fit["n"]}
        for name, column, kind, shown in METRICS:
            if shown and "gap" in trials:
                value, low, high, n = _estimate(trials, column, kind)
                n = None if (_id(key), column) == ("human", "collided") else n
                row = {"value": value, "interval_low": low, "interval_high": high, "n": n}
                rows[f"{_id(key)}/{name}"] = row
    return rows


def _qualities(trials: pd.DataFrame) -> dict:
    """Table VI: I1 to I4 of a driver and prompt."""
    row = {"n": int((trials["status"] != "failed").sum())}
    for name, (_, paper, robust) in _verdicts(trials).items():
        row |= {f"{name.lower()}_paper": paper, f"{name.lower()}_robust": robust}
    return row


def _verdicts(trials: pd.DataFrame) -> dict[str, tuple]:
    """By indicator: the row of its fit, and whether it holds by the paper's and the robust rule."""
    _, headway, velocity = _who_first(trials)
    by_indicator = {
        "I1": (headway, *_both(headway, ("p", "firth_p"), ("b", "firth_b"), 1)),
        "I2": (velocity, *_both(velocity, ("p", "firth_p"), ("b", "firth_b"), -1)),
    }
    if "gap" in trials:
        _, slope, level, _ = _gap(trials)
        p, equivalence = level["p"], level["equivalence_p"]
        by_indicator["I3"] = (slope, *_both(slope, ("p", "hc3_p"), ("b", "b"), 1))
        by_indicator["I4"] = (
            level,
            None if p is None else p >= 0.05,
            None if equivalence is None else equivalence < 0.05,
        )
    return by_indicator


def _both(row: dict, p: tuple, b: tuple, sign: int) -> tuple[bool | None, bool | None]:
    """Return whether an effect of this sign is significant, by each test; None without a fit."""
    return tuple(
        None if row[p_name] is None else bool(sign * row[b_name] > 0 and row[p_name] < 0.05)
        for p_name, b_name in zip(p, b, strict=True)
    )


def _prompts(groups, orders) -> dict[str, dict]:
    """Every prompt of a driver against the first that its study lists."""
    listed = _order(orders).get("prompt", ["baseline"])
    rows = {}
    for (driver, variant), trials in groups.items():
        reference = groups.get((driver, listed[0]))
        if reference is None or variant == listed[0] or not _together(orders, trials, reference):
            continue
        for name, column, kind, shown in _measured(groups):
            compared = shown or column == "left_first"
            tested = _compared(trials, reference, column, kind) if compared else {}
            if tested:
                frames = [t[t[column].notna()] for t in _otherwise(trials, reference)]
                shared = {*frames[0]["cell"]} & {*frames[1]["cell"]}
                sizes = [int(frame["cell"].isin(shared).sum()) for frame in frames]
                tested |= {"n": sizes[0], "n_reference": sizes[1]}
                rows[f"{driver}/{variant}/{listed[0]}/{name}"] = tested
    return rows


def _factors(groups, orders) -> dict[str, dict]:
    """Every level of each factor, its differences from the first, pooled over other factors."""
    rows: dict[str, dict] = {}
    scripted = {bool(group["scripted"].any()) for group in groups.values()}
    order = _order(orders)
    for stand_in in sorted(scripted):
        chosen = [group for group in groups.values() if bool(group["scripted"].any()) == stand_in]
        mark = " [scripted]" if stand_in and len(scripted) > 1 else ""
        levels = [group["levels"].iloc[0] for group in chosen]
        for factor in dict.fromkeys(name for of_group in levels for name in of_group):
            known = {of_group[factor] for of_group in levels if factor in of_group}
            first = [*order.get(factor, ()), "baseline", "self"]
            names = sorted(known, key=lambda n: (first.index(n) if n in first else len(first), n))
            if len(names) < 2:
                continue
            pooled = {}
            for name in names:
                parts = [
                    t
                    for t, of_group in zip(chosen, levels, strict=True)
                    if of_group.get(factor) == name
                ]
                pooled[name] = _with_other_levels(pd.concat(parts), factor)
            pooled = _one_cell(pooled)
            for name in names:
                for metric, column, kind, _ in _measured(groups):
                    row = _level(pooled[name], pooled[names[0]], column, kind, orders)
                    rows[f"{factor}={name}{mark}/{metric}"] = row
    return rows


def _measured(groups) -> list[tuple[str, str, str, bool]]:
    """The metrics of which a trial has a value; boxes that were the rule are no second measure."""
    every = pd.concat([*groups.values()]) if groups else pd.DataFrame()
    present = [
        metric for metric in METRICS if metric[1] in every and every[metric[1]].notna().any()
    ]
    if groups and every["collided"].equals(every["boxes"]):
        present = [metric for metric in present if metric[1] != "boxes"]
    return present


def _one_cell(pooled: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """The trials of each level without copies; cells in which programs do the same are one."""
    same: dict[tuple, set] = {}
    for name, trials in pooled.items():
        if trials["scripted"].any():
            same |= _unread(name, trials)
            continue
        for cell, way in zip(trials["cell"], trials["way"], strict=True):
            same.setdefault((name, cell[0], way), set()).add(cell)
    parts: list[set] = []
    for cells in same.values():
        near = [part for part in parts if part & cells]
        parts = [part for part in parts if not part & cells] + [cells.union(*near)]
    named = {cell: min(part) for part in parts for cell in part}
    return {
        name: distinct(trials.assign(cell=trials["cell"].map(named)))
        for name, trials in pooled.items()
    }


def _unread(level: str, trials: pd.DataFrame) -> dict[tuple, set]:
    """The cells of other levels at which a mock model plays the same trials, in every condition."""
    ended = trials[trials["status"] != "failed"]
    ways = ended.groupby("cell")["way"].agg(set).to_dict()
    others = sorted({cell[1:] for cell in ways})
    shared_cells: dict[tuple, set] = {}
    for place, first in enumerate(others):
        for second in others[place + 1 :]:
            shared = [cell[0] for cell in ways if cell[1:] == first and (cell[0], *second) in ways]
            pairs = [(ways[name, *first], ways[name, *second]) for name in shared]
            if shared and all(a <= b or b <= a for a, b in pairs):
                shared_cells |= {
                    (level, name, first, second): {(name, *first), (name, *second)}
                    for name in shared
                }
    return shared_cells


def _with_other_levels(trials: pd.DataFrame, factor: str) -> pd.DataFrame:
    cells = [
        (cell, *sorted((n, v) for n, v in levels.items() if n != factor))
        for cell, levels in zip(trials["cell"], trials["levels"], strict=True)
    ]
    return trials.assign(cell=pd.Series(cells, trials.index, dtype=object))


def _level(trials, reference, column, kind, orders) -> dict:
    value, low, high, n = _estimate(trials, column, kind)
    ended = int((trials["status"] != "failed").sum())
    row = {"trials": ended, "n": n, "value": value, "ci_low": low, "ci_high": high}
    names = ("difference", "difference_ci_low", "difference_ci_high", "p")
    row |= dict.fromkeys(names)
    if trials is reference or not _together(orders, trials, reference):
        return row
    if kind == "median":
        first, second = (t[t[column].notna()] for t in _otherwise(trials, reference))
        shared = set(first["cell"]) & set(second["cell"])
        if shared:
            a, b = (frame[frame["cell"].isin(shared)][column].median() for frame in (first, second))
            row["difference"] = a - b
        return row
    tested = _compared(trials, reference, column, kind)
    if tested:
        row |= {"difference": tested["difference"], "p": tested.get("p")}
        row |= {f"difference_{end}": tested.get(end) for end in ("ci_low", "ci_high")}
    return row
