"""Decisions of a study computed a second time from its stored files, without any code of pfbench.

It reads the result files with numpy and follows docs/statistics.md. Trimmed means, tests and corrections are
those of scipy and statsmodels. The exchange test enumerates all exchanges. Studies with equal runs in all
conditions and one part per job are read.

Run: make recompute STUDY=quickstart
"""

from __future__ import annotations

import json
import sys
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats
from scipy.stats import mstats
from statsmodels.stats.multitest import multipletests

ALPHA, TRIM = 0.05, 0.2
FAMILIES = ("planned pairs, track and error", "planned pairs, secondary metrics")
METRICS = {
    "error": "ratio", "CRPS": "ratio", "energy score": "ratio", "largest error": "ratio",
    "log score per step": "score", "overconfident runs": "share", "keeps track": "track",
}  # fmt: skip


def read_runs(folder: Path) -> pd.DataFrame:
    """One row per run: condition, filter, status and all metrics of the main group."""
    tables = []
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as file:
            data = {name: file[name] for name in file.files}
        tables.append(runs_of(data, json.loads(str(data["meta"]))))
    return pd.concat(tables, ignore_index=True)


def runs_of(data: dict[str, np.ndarray], meta: dict[str, Any]) -> pd.DataFrame:
    """Runs of one result file. The main group has one unit: the first of a mixed group."""
    groups, units = meta["state"]["groups"], meta["state"]["units"]
    name = "position" if "position" in groups else next(iter(groups))
    places = [k for k in groups[name] if units[k] == units[groups[name][0]]]
    index, is_whole = list(groups).index(name), len(places) == len(groups[name])
    norm = np.sqrt((data["error"][..., places].astype(float) ** 2).sum(-1))
    nees = data["nees"][..., index].astype(float).mean(1)
    paper = meta["config"]["scenario"].get("paper") or {}
    limit = paper.get("divergence_threshold") or np.inf
    is_lost = data["lost"]
    diverged = ((norm > limit).mean(1) >= 0.1) | (norm[:, -1] > limit)
    energy = data["energy_score"][..., index].astype(float).mean(1)
    overconfident = (nees > stats.chi2.ppf(0.999, len(groups[name]))).astype(float)
    scenario = meta["choices"]["scenario"]
    others = {}
    for other, index_of_group in groups.items():
        for unit in dict.fromkeys(units[k] for k in index_of_group):
            part = [k for k in index_of_group if units[k] == unit]
            title = other if len(part) == len(index_of_group) else f"{other} [{unit}]"
            square = (data["error"][..., part].astype(float) ** 2).sum(-1)
            if part != places:
                others[f"{title} error"] = np.sqrt(square.mean(1))
    return pd.DataFrame({
        "filter": meta["label"], "scenario": scenario, "world": paper.get("family") or scenario,
        "regime": meta["choices"]["noise"], "run": np.arange(len(norm)),
        "keeps": ~is_lost & ~diverged,
        "error": np.sqrt((norm**2).mean(1)),
        "largest error": norm.max(1),
        "CRPS": data["crps"][..., places].astype(float).mean((1, 2)),
        "energy score": energy if is_whole else np.nan,
        "log score per step": data["log_evidence"] / norm.shape[1],
        "overconfident runs": np.where(is_lost, np.nan, overconfident),
        **others,
    })  # fmt: skip


# of each condition: weight, differences of the runs, and log errors of both filters if it has a ratio
Levels = tuple[np.ndarray, np.ndarray] | None
Worlds = dict[str, list[tuple[float, np.ndarray, Levels]]]


def paired_values(runs: pd.DataFrame, a: str, b: str, metric: str) -> Worlds:
    """Differences of a pair by world, over the runs in their order; weights of a world have sum 1."""
    worlds: dict[str, dict[str, list[tuple[np.ndarray, Levels]]]] = {}
    for (world, scenario, _), rows in runs.groupby(["world", "scenario", "regime"]):
        first, second = (rows[rows["filter"] == name].set_index("run") for name in (a, b))
        if metric == "keeps track" or first.get(metric, pd.Series(dtype=float)).notna().any():
            values = differences(first, second, metric), log_errors(first, second, metric)
            worlds.setdefault(str(world), {}).setdefault(str(scenario), []).append(values)
    return {
        world: [(1 / len(scenarios) / len(rows), *v) for rows in scenarios.values() for v in rows]
        for world, scenarios in worlds.items()
    }


def differences(first: pd.DataFrame, second: pd.DataFrame, metric: str) -> np.ndarray:
    """Differences of the runs of one condition, negative if the first filter is better."""
    kind = METRICS.get(metric, "ratio")
    keeps_a, keeps_b = first["keeps"].to_numpy(), second["keeps"].to_numpy()
    if kind == "track":
        return np.asarray(keeps_b.astype(float) - keeps_a.astype(float))
    x, y = first[metric].to_numpy(float), second[metric].to_numpy(float)
    if kind == "share":
        return np.asarray(x - y)
    d = np.log(x / y) if kind == "ratio" else y - x
    d[np.abs(d) <= 1e-6] = 0.0
    d[keeps_a & ~keeps_b], d[keeps_b & ~keeps_a] = -np.inf, np.inf
    d[~keeps_a & ~keeps_b] = 0.0
    return np.asarray(d)


def log_errors(first: pd.DataFrame, second: pd.DataFrame, metric: str) -> Levels:
    """Log errors of both filters, infinite where the track is lost."""
    if METRICS.get(metric, "ratio") != "ratio":
        return None
    a, b = (
        np.where(rows["keeps"], np.log(rows[metric].to_numpy(float)), np.inf)
        for rows in (first, second)
    )
    return a, b


def level_difference(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray, int]:
    """Difference of two trimmed means, with the differences of the contributions of the runs."""
    (x, parts_x, middle), (y, parts_y, _) = trimmed(a), trimmed(b)
    with np.errstate(invalid="ignore"):
        return x - y, parts_x - parts_y, middle


def trimmed(d: np.ndarray) -> tuple[float, np.ndarray, int]:
    """Trimmed mean, contribution of each run to it, and number of runs that it uses."""
    n, cut = len(d), int(TRIM * len(d) + 1e-9)
    middle = n - 2 * cut
    with np.errstate(invalid="ignore"):
        location = float(stats.trim_mean(d, TRIM))
    if not np.isfinite(location):
        return location, np.zeros(n), middle
    ordered = np.asarray(mstats.winsorize(np.ma.array(d), limits=(cut / n, cut / n)), float)
    return location, (ordered - ordered.mean()) / middle, middle


def plain_mean(d: np.ndarray) -> tuple[float, np.ndarray, int]:
    return float(d.mean()), (d - d.mean()) / len(d), len(d)


def exchange_p(contributions: np.ndarray) -> float:
    """Exact two-sided p-value over all exchanges of whole runs."""
    x = contributions[np.abs(contributions) > 1e-12]
    sums = np.zeros(1)
    for value in x:
        sums = np.concatenate([sums + value, sums - value])
    return float((np.abs(sums) >= abs(x.sum()) - 1e-9).mean())


def estimate(worlds: Worlds, kind: str) -> dict[str, Any]:
    """Estimate, standard error, degrees of freedom and p-value for both questions."""
    location = trimmed if kind == "score" else plain_mean
    parts = {
        w: [(g, *(level_difference(*logs) if logs else location(d))) for g, d, logs in conditions]
        for w, conditions in worlds.items()
    }
    theta = np.array([sum(g * x for g, x, _, _ in conditions) for conditions in parts.values()])
    psi = np.array([sum(g * row for g, _, row, _ in conditions) for conditions in parts.values()])
    middle = min(c[3] for conditions in parts.values() for c in conditions)
    count = len(theta)
    correction = middle / (middle - 1)
    error = np.sqrt(correction * (psi.mean(0) ** 2).sum())
    if kind in ("ratio", "score") and not (np.isfinite(theta).all() and error > 0):
        won = {w: [(g, np.sign(d), None) for g, d, _ in c] for w, c in worlds.items()}
        return estimate(won, "won")
    value = theta.mean()
    here = (value, error, middle - 1)
    p = 2 * stats.t.sf(abs(value) / error, middle - 1) if error > 0 else np.nan
    joint = (correction * (psi.sum(0) ** 2).sum()) - sum(correction * (row**2).sum() for row in psi)
    shared = max(0.0, joint / (count * (count - 1))) if count > 1 else np.nan
    between = theta.std(ddof=1) ** 2 / count + shared if count > 1 else np.nan
    if kind in ("track", "share", "won"):
        x = np.mean([sum(g * d for g, d, _ in c) for c in worlds.values()], axis=0)
        n = len(x)  # x: contribution of each run, times the number of runs
        p = exchange_p(x / n)
        shrunk = x.sum() / (n + 2)
        variance = ((x**2).sum() + 1) / (n + 2) - shrunk**2
        error = np.sqrt(variance / (n + 2))
        here = (shrunk, error, n - 1)
        between = max(between, error**2)
    new = (value, np.sqrt(between), count - 1)
    p_new = 2 * stats.t.sf(abs(value) / new[1], count - 1) if count > 1 else np.nan
    is_identical = all((np.abs(d) <= 1e-6).all() for c in worlds.values() for _, d, _ in c)
    if is_identical:
        p = p_new = np.nan
    return {
        "value": value, "a": here, "b": new, "p_a": p, "p_b": p_new, "won": kind == "won",
        "identical": is_identical,
    }  # fmt: skip


def word_of(low: float, high: float, is_decided: bool, value: float, margin: float) -> str:
    """Word of an interval."""
    if is_decided:
        return "better" if value < 0 else "worse"
    return "equivalent" if -margin < low and high < margin else "inconclusive"


def recompute(runs: pd.DataFrame, records: list[dict[str, Any]]) -> pd.DataFrame:
    """Decide the same pairs, metrics and questions as the records, family by family."""
    rows = []
    records = sorted(records, key=lambda r: (r["family"], r["question"]))
    for _, family in groupby(records, key=lambda r: (r["family"], r["question"])):
        members = list(family)
        estimates = []
        for r in members:
            is_known = r["metric"] in METRICS or r["metric"] in runs
            metric = r["metric"] if is_known else "error"  # "main group error"
            kind = METRICS.get(metric, "ratio")
            estimates.append(estimate(paired_values(runs, r["a"], r["b"], metric), kind))
        question = members[0]["question"]
        p = np.array([e[f"p_{question}"] for e in estimates])
        tested = np.isfinite(p)
        corrected = np.full(len(p), np.nan)
        corrected[tested] = multipletests(p[tested], method="holm")[1]
        for r, e, p_single, p_holm in zip(members, estimates, p, corrected, strict=True):
            centre, error, df = e[question]
            half = stats.t.ppf(1 - ALPHA / tested.sum() / 2, df) * error
            low, high = centre - half, centre + half
            is_decided = bool(np.nan_to_num(p_holm, nan=1.0) <= ALPHA)
            if is_decided:
                low, high = (low, min(high, 0.0)) if e["value"] < 0 else (max(low, 0.0), high)
            else:
                low, high = min(low, 0.0), max(high, 0.0)
            word = word_of(low, high, is_decided, e["value"], 0.0 if e["won"] else r["margin"])
            if np.isnan(p_single):
                low, high, word = -np.inf, np.inf, "not tested"
            if e["identical"] and (
                r["scale"] != "log ratio" or max(r["share_a"], r["share_b"]) > 0.0
            ):
                low, high, word = 0.0, 0.0, "identical"
            rows.append({
                "family": r["family"], "question": question, "a": r["a"], "b": r["b"],
                "metric": r["metric"], "estimate": e["value"], "low": low, "high": high,
                "p": p_single, "p_corrected": p_holm, "word": word,
                "stored_estimate": float(r["estimate"]), "stored_low": float(r["low"]),
                "stored_high": float(r["high"]), "stored_p": float(r["p"]),
                "stored_p_corrected": float(r["p_corrected"]), "stored_word": r["word"],
            })  # fmt: skip
    return pd.DataFrame(rows)


def find_differences(table: pd.DataFrame, tolerance: float = 1e-8) -> pd.DataFrame:
    """Rows of `recompute` whose word or a number differs from that of the record."""
    is_different = table["word"] != table["stored_word"]
    for name in ("estimate", "low", "high", "p", "p_corrected"):
        own, stored = table[name].to_numpy(float), table[f"stored_{name}"].to_numpy(float)
        is_different |= ~np.isclose(own, stored, rtol=tolerance, atol=tolerance, equal_nan=True)
    return table[is_different]


def main(results: Path, decisions: Path) -> int:
    """Compare all records of a report with an independent computation."""
    records = [r for r in json.loads(decisions.read_text()) if r["family"] in FAMILIES]
    table = recompute(read_runs(results), records)
    different = find_differences(table)
    print(f"{len(table)} decisions computed again, {len(different)} differ")
    print(different.to_string() if len(different) else "", end="")
    return int(len(different) > 0)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
