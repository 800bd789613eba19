"""The numbers of a report computed a second time from runs.parquet by scipy alone, without any code of pfbench.

It follows docs/statistics.md: all rows of verdicts.csv, and all pairs of decisions.csv.
"""

import base64
import functools
import gzip
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pyarrow import parquet
from scipy import stats

FEW, EXACT = 10, 50


class Stored(NamedTuple):
    """Runs of a study, and the data of its page."""

    runs: pd.DataFrame
    page: dict[str, Any]


def read_stored(folder: Path) -> Stored:
    """Read the file of a study."""
    table = parquet.read_table(folder / "runs.parquet")
    page = json.loads(gzip.decompress(base64.b64decode(table.schema.metadata[b"pfbench"])))
    return Stored(table.to_pandas(), page)


def arrange(runs: pd.DataFrame, metric: str) -> dict[Any, tuple[pd.DataFrame, pd.DataFrame]]:
    """Log errors and lost runs by condition, a row per run and a column per filter; NaN without a value."""
    wide = {}
    runs = runs[~(runs["keeps_track"] & runs[metric].isna())]
    for key, part in runs.groupby(["family", "scenario", "regime"], observed=True):
        ranks = part["seed"].rank(method="dense").astype(int)
        part = part.assign(
            key=1_000_000 * ranks + part["run"], lost=(~part["keeps_track"]).astype(float)
        )
        part["log"] = np.log(part[metric].astype(float)).where(part["keeps_track"], 0.0)
        wide[key] = tuple(part.pivot(index="key", columns="filter", values=v) for v in ("log", "lost"))  # fmt: skip
    return wide


def pair_losses(wide: Mapping[Any, Any], pair: Sequence[str]) -> np.ndarray:
    """Mean over conditions of the log errors of two filters by run, [2, n]; infinite for the one that loses more."""
    parts = {}
    for key, tables in wide.items():
        if set(pair) <= set(tables[0].columns):
            both = pd.concat([t[list(pair)] for t in tables], axis=1).dropna()
            if len(both):
                parts[key] = both
    if not parts:
        return np.zeros((2, 0))
    scenarios = Counter(family for family, _ in {key[:2] for key in parts})
    regimes = Counter(key[:2] for key in parts)
    keys = functools.reduce(lambda x, y: x.intersection(y), [p.index for p in parts.values()])
    total = sum(
        part.loc[keys.sort_values()].to_numpy()
        / (len(scenarios) * scenarios[k[0]] * regimes[k[:2]])
        for k, part in parts.items()
    )
    lost = total[:, 2:]
    is_lost = (lost > 1e-12) & (lost >= lost[:, ::-1] - 1e-9)
    return np.where(is_lost, math.inf, total[:, :2]).T


@functools.cache
def rank_distribution(n: int) -> np.ndarray:
    """Distribution function of the signed-rank statistic, by its generating function."""
    counts = np.ones(1)
    for rank in range(1, n + 1):
        counts = np.convolve(counts, np.concatenate([[1.0], np.zeros(rank - 1), [1.0]]))
    return np.cumsum(counts) / 2.0**n


def estimate(d: np.ndarray, alpha: float) -> tuple[float, float, float]:
    """Location of Hodges and Lehmann with its interval."""
    i, j = np.triu_indices(len(d))
    with np.errstate(invalid="ignore"):
        means = (d[i] + d[j]) / 2
    means = np.sort(
        np.where(np.isnan(means), 0.0, means)
    )  # one filter lost the one run, the other the other
    n = len(d)
    if n <= EXACT:
        k = int((rank_distribution(n) <= alpha / 2).sum())
    else:
        sd = math.sqrt(n * (n + 1) * (2 * n + 1) / 24)
        k = max(int(n * (n + 1) / 4 + stats.norm.ppf(alpha / 2) * sd), 0)
    if k == 0:
        return float(np.median(means)), -math.inf, math.inf
    return float(np.median(means)), float(means[k - 1]), float(means[-k])


def trimmed_test(d: np.ndarray) -> tuple[float, float]:
    """Trimmed mean, and p-value of Tukey and McLaughlin."""
    n, g = len(d), int(0.2 * len(d) + 1e-9)
    if np.isinf(np.sort(d)[[g, n - g - 1]]).any():
        return float(np.sign(d).sum()), sign_test(int((d > 0).sum()), int((d < 0).sum()))
    mean = float(stats.trim_mean(d, 0.2))
    low, high = np.sort(d)[[g, n - g - 1]]
    spread = ((np.clip(d, low, high) - np.clip(d, low, high).mean()) ** 2).sum()
    h = n - 2 * g
    if mean == 0.0:
        return mean, 1.0
    if spread <= 1e-24:
        return mean, 0.0
    error = math.sqrt(spread / (h * (h - 1)))
    return mean, float(2 * stats.t.sf(abs(mean) / error, h - 1))


def sign_test(more: int, fewer: int) -> float:
    """Exact p-value of equal chances, two-sided."""
    return float(stats.binomtest(more, more + fewer).pvalue) if more + fewer else 1.0


def side_test(d: np.ndarray) -> float:
    """Exact p-value of equal chances, of the side on which the median of the means of pairs is."""
    side = -1 if estimate(d, 0.5)[0] < 0 else 1
    count = int((np.sign(d) == side).sum())
    return float(stats.binomtest(count, int((d != 0).sum()), alternative="greater").pvalue)


def decide_family(
    family: Sequence[np.ndarray], margin: float, alpha: float
) -> list[dict[str, Any]]:
    """Verdicts on a family of pairs by their losses, [2, n] each."""
    differences = [subtract(losses) for losses in family]
    tested = [len(d) >= FEW and (np.isinf(d[0]) or np.ptp(d) > 1e-6) for d in differences]
    signed = [signed_rank(d) if yes else 1.0 for d, yes in zip(differences, tested, strict=True)]
    trimmed = [trimmed_test(d)[1] if yes else 1.0 for d, yes in zip(differences, tested, strict=True)]  # fmt: skip
    alone = [count_alone(losses) for losses in family]
    mcnemar = [
        sign_test(*counts) if yes else 1.0 for counts, yes in zip(alone, tested, strict=True)
    ]
    p, q, r = correct(signed), correct(trimmed), correct(mcnemar)
    s = correct([side_test(d) if yes else 1.0 for d, yes in zip(differences, tested, strict=True)])
    rows = []
    for k, (losses, d) in enumerate(zip(family, differences, strict=True)):
        n, lost = len(d), np.isinf(losses)
        if n == 0 or not d.any():
            is_same = n and not lost.all()
            rows.append({"word": "identical" if is_same else "not decided", "ratio": 0.0 if is_same else math.nan})  # fmt: skip
            continue
        location, low, high = estimate(d, alpha / len(family))
        has_ratio = lost.any(axis=0).sum() <= 0.2 * n
        if not tested[k]:
            rows.append({"word": "not decided", "ratio": location if has_ratio else math.nan})
            continue
        if p[k] < alpha:
            low, high = (low, min(high, 0.0)) if location < 0 else (max(low, 0.0), high)
        else:
            low, high = min(low, 0.0), max(high, 0.0)
        word, side = "not decided", np.sign(location)
        if -margin < low and high < margin:
            bounds = [stats.beta.ppf(0.95, count + 1, n - count) for count in alone[k]]
            word = "equal" if not lost.any() or max(bounds) < 0.1 else "equal in kept runs"
        elif max(p[k], q[k], s[k]) < alpha and side * trimmed_test(d)[0] > 0:
            word = "better" if location < 0 else "worse"
        loses = (
            "" if r[k] >= alpha else "loses more" if alone[k][0] > alone[k][1] else "loses fewer"
        )
        ends = (location, low, high) if has_ratio else (math.nan,) * 3
        rows.append({"word": word, "p": p[k], "loses": loses, **dict(zip(("ratio", "low", "high"), ends, strict=True))})  # fmt: skip
    return rows


def count_alone(losses: np.ndarray) -> tuple[int, int]:
    """Runs that each of two filters lost alone."""
    a, b = np.isinf(losses)
    return int((a & ~b).sum()), int((b & ~a).sum())


def signed_rank(d: np.ndarray) -> float:
    """p-value of Wilcoxon's test; lost runs have the largest ranks, which any large number gives."""
    finite = np.where(np.isinf(d), np.sign(d) * 1e6, d)
    return float(stats.wilcoxon(finite, zero_method="zsplit", correction=False).pvalue)


def correct(p: Sequence[float]) -> np.ndarray:
    """Holm's correction."""
    values = np.asarray(p, dtype=float)
    order = np.argsort(values, kind="stable")
    steps = np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    return np.asarray(np.minimum(steps, 1.0)[np.argsort(order, kind="stable")])


def subtract(losses: np.ndarray) -> np.ndarray:
    """Differences of losses [2, n], 0 within the stored precision and where both are lost."""
    with np.errstate(invalid="ignore"):
        d = losses[0] - losses[1]
    return np.where(np.isnan(d) | (np.abs(d) <= 1e-6), 0.0, d)


def decide_scope(
    runs: pd.DataFrame, fixed: set[frozenset[str]], metric: str, levels: tuple[float, float]
) -> dict[tuple[str, str], dict[str, Any]]:
    """Verdicts on all pairs of a selection of runs, in two families: those fixed in advance, and all others."""
    decided, wide = {}, arrange(runs, metric)
    have = {
        name: set(map(tuple, rows[["scenario", "regime"]].drop_duplicates().to_numpy()))
        for name, rows in runs.groupby("filter", observed=True)
    }
    for is_fixed in (True, False):
        pairs = [p for p in combinations(sorted(runs["filter"].unique()), 2) if (frozenset(p) in fixed) == is_fixed and have[p[0]] & have[p[1]]]  # fmt: skip
        losses = [pair_losses(wide, pair) for pair in pairs]
        for (a, b), word in zip(pairs, decide_family(losses, *levels), strict=True):
            decided[a, b], decided[b, a] = word, flip(word)
    return decided


def flip(row: Mapping[str, Any]) -> dict[str, Any]:
    """The verdict on the second filter against the first."""
    swap = {"better": "worse", "worse": "better", "loses more": "loses fewer", "loses fewer": "loses more"}  # fmt: skip
    ends = {"ratio": "ratio", "low": "high", "high": "low"}
    turned = {key: -row[other] for key, other in ends.items() if other in row}
    return {**row, **turned, **{k: swap.get(row[k], row[k]) for k in ("word", "loses") if k in row}}


def read_fixed(folder: Path) -> dict[str, set[frozenset[str]]]:
    """Pairs that decisions.csv calls fixed in advance, over all conditions and in each world that has its own."""
    table = pd.read_csv(folder / "decisions.csv")
    rows = table[table["family"] == "fixed in advance"]
    return {
        world: {frozenset(pair) for pair in zip(some["a"], some["b"], strict=True)}
        for world, some in rows.groupby("world")
    }


def compare_rows(folder: Path, metric: str = "") -> tuple[int, list[str]]:
    """Compute all rows of verdicts.csv again; return their number and one line per difference."""
    stored, fixed = read_stored(folder), read_fixed(folder)
    options = stored.page["facts"]["options"]
    levels = math.log1p(options["equivalence_margin"]), options["alpha"]
    rows = pd.read_csv(folder / "verdicts.csv")
    problems, count, scopes = [], 0, {}
    for key, view in rows.groupby(["metric", "world", "regime", "baseline"], sort=False):
        if key[0] == "log_score" or (metric and key[0] != metric):
            continue
        if key[:3] not in scopes:
            runs = select_complete(stored.runs, key[1], key[2], set(view[view["verdict"] != "missing"]["filter"]))  # fmt: skip
            # a regime of one world has the pairs that are fixed in it
            only = runs["scenario"].iloc[0] if runs["scenario"].nunique() == 1 else key[1]
            scopes[key[:3]] = decide_scope(
                runs, fixed.get(only, fixed.get("all", set())), key[0], levels
            )
        for row in view.to_dict("records"):
            expected = scopes[key[:3]].get((row["filter"], key[3]))
            if expected is not None and row["verdict"] != "missing":
                count += 1
                problems += _compare_row(f"{folder.name} {key} {row['filter']}", row, expected)
    return count, problems


def select_complete(runs: pd.DataFrame, world: str, regime: str, present: set[str]) -> pd.DataFrame:
    """Runs of the conditions of a scope that all these filters have."""
    runs = runs[(runs["scenario"] == world) | (world == "all")]
    runs = runs[(runs["regime"] == regime) | (regime == "all")]
    conditions = runs.groupby(["scenario", "regime"], observed=True)["filter"].agg(set)
    complete = [k for k, have in conditions.items() if present <= have]
    return runs[[k in complete for k in zip(runs["scenario"], runs["regime"], strict=True)]]


def _compare_row(name: str, row: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Compare one row with its expected values."""
    problems = []
    if row["verdict"] not in (wanted["word"], "loses track"):
        problems.append(f"{name}: {row['verdict']} is not {wanted['word']}")
    loses = "" if pd.isna(row.get("loses")) else row["loses"]
    if loses != wanted.get("loses", ""):
        problems.append(f"{name}: {loses!r} is not {wanted.get('loses')!r}")
    for column, key in (("ratio", "ratio"), ("ratio_low", "low"), ("ratio_high", "high")):
        if key in wanted:
            value, shown = math.exp(min(wanted[key], 700.0)), row[column]
            value = math.inf if wanted[key] == math.inf else value
            both_open = pd.isna(value) and pd.isna(shown)
            if not (both_open or math.isclose(value, shown, rel_tol=6e-4) or value == shown):
                problems.append(f"{name} {column}: {shown} is not {value}")
    if "p" in wanted and not math.isclose(wanted["p"], row["p"], rel_tol=2e-3, abs_tol=1e-300):
        problems.append(f"{name} p: {row['p']} is not {wanted['p']}")
    return problems


def compare_pairs(folder: Path, most: int = 100) -> tuple[int, list[str]]:
    """Compute pairs of decisions.csv over all conditions again; return their number and the differences."""
    stored, fixed = read_stored(folder), read_fixed(folder)
    options = stored.page["facts"]["options"]
    table = pd.read_csv(folder / "decisions.csv")
    views = pd.read_csv(folder / "verdicts.csv")
    opening = views[(views["world"] == "all") & (views["regime"] == "all")]
    present = set(opening[opening["verdict"] != "missing"]["filter"])
    levels = math.log1p(options["equivalence_margin"]), options["alpha"]
    problems, count = [], 0
    for world, rows in table.groupby("world", sort=False):
        if world != "all":
            view = views[(views["world"] == world) & (views["regime"] == "all")]
            present = set(view[view["verdict"] != "missing"]["filter"])
        runs = select_complete(stored.runs, world, "all", present)
        wanted = decide_scope(runs, fixed.get(world, set()), options["metric"], levels)
        for row in rows.to_dict("records")[: most - count]:
            shown = {"verdict": row["word"], "ratio": row["ratio"], "ratio_low": row["low"], "ratio_high": row["high"], "p": row["p"], "loses": row["loses"]}  # fmt: skip
            problems += _compare_row(f"{folder.name} {world} {row['a']} {row['b']}", shown, wanted[row["a"], row["b"]])  # fmt: skip
            count += 1
        if count >= most:
            break
    return count, problems
