"""Decisions on pairs of filters computed a second time, without any code of pfbench.

It follows docs/statistics.md. Trimmed means, tests and corrections are those of scipy and statsmodels. The
exchange test counts all exchanges in exact fractions. `recompute.py` applies it to stored studies.
"""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats
from scipy.stats import mstats
from statsmodels.stats.multitest import multipletests

ALPHA, TRIM, FEWEST, SAME = 0.05, 0.2, 10, 1e-6
METRICS = {
    "error": "ratio", "CRPS": "ratio", "energy score": "ratio", "largest error": "ratio",
    "log score per step": "score", "overconfident runs": "share", "keeps track": "track",
}  # fmt: skip


class Cell(NamedTuple):
    """Runs of a pair in one condition, by the name of the run.

    Attributes:
        weight: Weight in its world; the weights of a world have sum 1.
        d: Differences, negative if the first filter is better.
        logs: Log errors of both filters, infinite where the track is lost; None without a ratio.
        both: Whether both filters keep track.
    """

    weight: Fraction
    d: pd.Series
    logs: tuple[pd.Series, pd.Series] | None
    both: pd.Series


Worlds = dict[str, list[Cell]]


def pair_cells(runs: pd.DataFrame, a: str, b: str, metric: str) -> Worlds:
    """Runs that a pair shares, by world and condition."""
    kind = METRICS.get(metric, "ratio")
    worlds: dict[str, dict[str, list[Cell]]] = {}
    runs = runs[runs["filter"].isin((a, b))]
    for (world, scenario, _), rows in runs.groupby(["world", "scenario", "regime"]):
        first, second = (rows[rows["filter"] == name].set_index("run") for name in (a, b))
        if metric in rows:
            if metric != "error" and not first[metric].notna().any():
                continue  # the condition lacks the metric
            first, second = (x[x[metric].notna() | ~x["keeps"]] for x in (first, second))
        names = first.index.intersection(second.index).sort_values()
        if len(names):
            first, second = first.loc[names], second.loc[names]
            logs = log_errors(first, second, metric) if kind == "ratio" else None
            cell = Cell(
                Fraction(1),
                differences(first, second, metric),
                logs,
                first["keeps"] & second["keeps"],
            )
            worlds.setdefault(str(world), {}).setdefault(str(scenario), []).append(cell)
    return {
        world: [
            cell._replace(weight=Fraction(1, len(scenarios) * len(cells)))
            for cells in scenarios.values()
            for cell in cells
        ]
        for world, scenarios in worlds.items()
    }


def differences(first: pd.DataFrame, second: pd.DataFrame, metric: str) -> pd.Series:
    """Differences of the runs of one condition, negative if the first filter is better."""
    kind = METRICS.get(metric, "ratio")
    if kind == "track":
        return second["keeps"].astype(float) - first["keeps"].astype(float)
    x, y = first[metric].astype(float), second[metric].astype(float)
    if kind == "share":
        return (x - y)[x.notna() & y.notna()]
    with np.errstate(divide="ignore", invalid="ignore"):
        d = np.log(x / y) if kind == "ratio" else y - x
    d[d.abs() <= SAME] = 0.0
    d[first["keeps"] & ~second["keeps"]] = -np.inf
    d[second["keeps"] & ~first["keeps"]] = np.inf
    d[~first["keeps"] & ~second["keeps"]] = 0.0
    return d


def log_errors(
    first: pd.DataFrame, second: pd.DataFrame, metric: str
) -> tuple[pd.Series, pd.Series]:
    """Log errors of both filters, infinite where the track is lost."""
    a, b = (
        np.log(rows[metric].astype(float)).where(rows["keeps"], np.inf) for rows in (first, second)
    )
    return a, b


def trimmed(d: pd.Series) -> tuple[float, pd.Series, int]:
    """Trimmed mean, contribution of each run to it, and number of runs that it uses."""
    n, cut = len(d), int(TRIM * len(d) + 1e-9)
    middle = n - 2 * cut
    with np.errstate(invalid="ignore"):
        location = float(stats.trim_mean(d.to_numpy(), TRIM)) if n else np.nan
    if not np.isfinite(location):
        return location, 0.0 * d.where(np.isfinite(d), 0.0), middle
    clipped = np.asarray(mstats.winsorize(np.ma.array(d.to_numpy()), limits=(cut / n, cut / n)))
    influence = (clipped.astype(float) - clipped.mean()) / middle
    return location, pd.Series(influence, index=d.index), middle


def locate(cell: Cell, kind: str) -> tuple[float, pd.Series, int]:
    """Effect of one condition: difference of levels, trimmed mean of differences, or share."""
    if cell.logs:
        (x, parts_x, middle), (y, parts_y, _) = map(trimmed, cell.logs)
        with np.errstate(invalid="ignore"):
            return x - y, parts_x - parts_y, middle
    if kind == "score":
        return trimmed(cell.d)
    return float(cell.d.mean()), (cell.d - cell.d.mean()) / len(cell.d), len(cell.d)


def exchange_test(worlds: Worlds) -> tuple[pd.Series, float]:
    """Contribution of each run to a mean of signs, and the exact p-value over all exchanges of runs."""
    total: dict[Any, Fraction] = {}
    for cells in worlds.values():
        for cell in cells:
            step = cell.weight / (len(cell.d) * len(worlds))
            for run, value in cell.d.items():
                total[run] = total.get(run, Fraction(0)) + step * int(value)
    unit = math.lcm(*(x.denominator for x in total.values()))
    steps = [int(x * unit) for x in total.values()]
    chances = np.ones(1)
    for step in map(abs, filter(None, steps)):
        padded = np.zeros(len(chances) + 2 * step)
        padded[: len(chances)] += chances / 2
        padded[2 * step :] += chances / 2
        chances = padded
    sums = np.arange(len(chances)) - len(chances) // 2
    p = min(1.0, float(chances[np.abs(sums) >= abs(sum(steps))].sum()))
    return pd.Series({run: float(x) for run, x in total.items()}), p


def sum_by_run(parts: list[pd.Series]) -> float:
    """Sum of squares of contributions that are added run by run."""
    return float((pd.concat(parts).groupby(level=0).sum() ** 2).sum())


def estimate(worlds: Worlds, kind: str) -> dict[str, Any]:
    """Estimate, standard error, degrees of freedom and p-value for both questions."""
    effects = {w: [(float(c.weight), *locate(c, kind)) for c in cells] for w, cells in worlds.items()}  # fmt: skip
    theta = np.array([sum(g * x for g, x, _, _ in cells) for cells in effects.values()])
    parts = [[g * row for g, _, row, _ in cells] for cells in effects.values()]
    middles = [min(cell[3] for cell in cells) for cells in effects.values()]
    correction = [m / (m - 1) if m > 1 else np.nan for m in middles]
    least, count = min(middles), len(theta)
    joint = min(correction) if least < 2 else least / (least - 1)
    total = joint * sum_by_run([row for rows in parts for row in rows])
    value, error = float(theta.mean()), math.sqrt(total) / count
    is_constant = all(np.ptp(c.d.to_numpy()) <= 1e-9 for cells in worlds.values() for c in cells if np.isfinite(c.d).all())  # fmt: skip
    is_same = all((c.d.abs() <= SAME).all() for cells in worlds.values() for c in cells)
    if kind in ("ratio", "score") and not is_same and not (np.isfinite(value) and (error > 0 or is_constant)):  # fmt: skip
        won = {w: [c._replace(d=np.sign(c.d), logs=None) for c in cells] for w, cells in worlds.items()}  # fmt: skip
        return estimate(won, "won") | {"both": both_kept(worlds, kind)}
    here = (value, error, least - 1.0)
    p = 2 * stats.t.sf(abs(value) / error, least - 1) if error > 0 else np.nan
    own = sum(f * sum_by_run(rows) for f, rows in zip(correction, parts, strict=True))
    shared = max(0.0, (total - own) / (count * (count - 1))) if count > 1 else np.nan
    between = theta.std(ddof=1) ** 2 / count + shared if count > 1 else np.nan
    if kind in ("track", "share", "won"):
        contributions, p = exchange_test(worlds)
        n = len(contributions)
        x = contributions.to_numpy() * n
        shrunk = x.sum() / (n + 2)
        error = math.sqrt((((x**2).sum() + 1) / (n + 2) - shrunk**2) / (n + 2))
        value, here, between = x.mean(), (shrunk, error, n - 1.0), max(between, error**2)
    new = (float(theta.mean()), math.sqrt(between), count - 1.0)
    p_new = 2 * stats.t.sf(abs(new[0]) / new[1], count - 1) if count > 1 else np.nan
    if min(len(c.d) for cells in worlds.values() for c in cells) < FEWEST:
        p = np.nan
    if is_same:
        p = p_new = np.nan
    return {
        "value": value, "a": here, "b": new, "p_a": p, "p_b": p_new, "won": kind == "won",
        "is_share": kind in ("track", "share", "won"),
        "identical": is_same, "theta": theta, "both": both_kept(worlds, kind),
        "has_error": any(c.both.any() for cells in worlds.values() for c in cells),
    }  # fmt: skip


def both_kept(worlds: Worlds, kind: str) -> float:
    """Effect among the runs in which both filters keep track; NaN without one."""
    if kind in ("track", "share"):
        return np.nan
    pairs = [
        (float(c.weight), float(stats.trim_mean(c.d[c.both].to_numpy(), TRIM)))
        for cells in worlds.values()
        for c in cells
        if c.both.any()
    ]
    return sum(g * x for g, x in pairs) / sum(g for g, _ in pairs) if pairs else np.nan


def word_of(low: float, high: float, is_decided: bool, value: float, margin: float) -> str:
    """Word of an interval."""
    if is_decided:
        return "better" if value < 0 else "worse"
    return "equivalent" if -margin < low and high < margin else "inconclusive"


def decide(estimates: list[dict[str, Any]], question: str) -> list[dict[str, Any]]:
    """Holm's correction and simultaneous intervals of a family.

    Args:
        estimates: Results of `estimate`, with the margin, and whether the metric has ratios.
        question: "a" or "b".
    """
    p = np.array([e[f"p_{question}"] for e in estimates], dtype=float)
    tested = np.isfinite(p)
    corrected = np.full(len(p), np.nan)
    if tested.any():
        corrected[tested] = multipletests(p[tested], method="holm")[1]
    rows = []
    for e, p_single, p_holm in zip(estimates, p, corrected, strict=True):
        centre, error, df = e[question]
        half = stats.t.ppf(1 - ALPHA / max(tested.sum(), 1) / 2, df) * error
        low, high = centre - half, centre + half
        is_decided = bool(np.nan_to_num(p_holm, nan=1.0) <= ALPHA)
        if is_decided:
            low, high = (low, min(high, 0.0)) if e["value"] < 0 else (max(low, 0.0), high)
        else:
            low, high = min(low, 0.0), max(high, 0.0)
        word = word_of(low, high, is_decided, e["value"], 0.0 if e["won"] else e["margin"])
        if e["is_share"]:  # a difference of shares is within 1
            low, high = max(low, -1.0), min(high, 1.0)
        if np.isnan(p_single):
            low, high, word = -np.inf, np.inf, "not tested"
        if e["identical"] and (not e["is_ratio"] or e["has_error"]):
            low, high, word = 0.0, 0.0, "identical"
        rows.append({
            "estimate": e["value"], "low": low, "high": high, "p": p_single, "p_corrected": p_holm,
            "word": word,
        })  # fmt: skip
    return rows


def recompute(runs: pd.DataFrame, records: list[dict[str, Any]]) -> pd.DataFrame:
    """Decide the same pairs, metrics and questions as the records, family by family."""
    rows = []
    known: dict[tuple[str, str, str], dict[str, Any]] = {}  # both questions are of the same runs
    records = sorted(records, key=lambda r: (r["family"], r["question"]))
    for (_, question), family in groupby(records, key=lambda r: (r["family"], r["question"])):
        members = list(family)
        estimates = []
        for r in members:
            is_known = r["metric"] in METRICS or r["metric"] in runs
            metric = r["metric"] if is_known else "error"  # "main group error"
            key = r["a"], r["b"], metric
            if key not in known:
                known[key] = estimate(pair_cells(runs, *key), METRICS.get(metric, "ratio"))
            estimates.append(known[key] | {
                "margin": r["margin"], "is_ratio": r["scale"] == "log ratio",
            })  # fmt: skip
        for r, row in zip(members, decide(estimates, question), strict=True):
            names = {k: r[k] for k in ("family", "question", "a", "b", "metric")}
            numbers = ("estimate", "low", "high", "p", "p_corrected")
            stored = {f"stored_{k}": float(r[k]) for k in numbers}
            rows.append(names | row | stored | {"stored_word": r["word"]})
    return pd.DataFrame(rows)


def find_differences(table: pd.DataFrame, tolerance: float = 1e-8) -> pd.DataFrame:
    """Rows of `recompute` whose word or a number differs from that of the record."""
    is_different = table["word"] != table["stored_word"]
    for name in ("estimate", "low", "high", "p", "p_corrected"):
        own, stored = table[name].to_numpy(float), table[f"stored_{name}"].to_numpy(float)
        is_different |= ~np.isclose(own, stored, rtol=tolerance, atol=tolerance, equal_nan=True)
    return table[is_different]
