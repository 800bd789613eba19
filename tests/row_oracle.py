"""The numbers of a report computed a second time from runs.parquet by scipy alone, without any code of pfbench.

It follows docs/statistics.md: all rows of verdicts.csv, and all pairs of decisions.csv.
"""

from __future__ import annotations

import base64
import functools
import gzip
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml
from pyarrow import parquet
from scipy import stats

FEW, EXACT = 10, 50
TUNED = Path(__file__).parents[1] / "conf" / "tuned"


class Stored(NamedTuple):
    """Runs of a study, and the data of its page."""

    runs: pd.DataFrame
    page: dict[str, Any]


def read_stored(folder: Path) -> Stored:
    """Read the file of a study."""
    table = parquet.read_table(folder / "runs.parquet")
    page = json.loads(gzip.decompress(base64.b64decode(table.schema.metadata[b"pfbench"])))
    return Stored(table.to_pandas(), page)


def find_caps(stored: Stored) -> dict[str, float]:
    """Largest error that counts by scenario: the limit of the world, else that of its tuning."""
    caps = {world["key"]: world["limit"] for world in stored.page["worlds"]}
    models = stored.runs.groupby("scenario")["model"].first()
    for path in sorted(TUNED.glob("*.yaml")):
        content = yaml.safe_load(path.read_text())
        world = content.get("world") or {}
        name = world.get("scenario")
        if name in caps and caps[name] is None and world.get("model") == models[name]:
            caps[name] = (content.get("fit") or {}).get("cap")
    return {name: math.nan if cap is None else float(cap) for name, cap in caps.items()}


def pair_losses(
    runs: pd.DataFrame, pair: Sequence[str], caps: Mapping[str, float], metric: str = "rmse"
) -> np.ndarray:
    """Mean over conditions of the log errors of two filters by run, [2, n]."""
    wide: dict[Any, pd.DataFrame] = {}
    for key, part in runs[runs["filter"].isin(list(pair))].groupby(["family", "scenario", "regime"], observed=True):  # fmt: skip
        ranks = part["seed"].rank(method="dense").astype(int)
        part = part.assign(key=list(zip(ranks, part["run"], strict=True)))
        part = part[~(part["keeps_track"] & part[metric].isna())]
        sides = [part[part["filter"] == label].set_index("key") for label in pair]
        common = sides[0].index.intersection(sides[1].index)
        if not len(common):
            continue
        cap = caps.get(key[1], math.nan) if metric in ("rmse", "crps") else math.nan
        logs = {}
        for name, side in zip("ab", sides, strict=True):
            row = side.loc[common]
            log = np.log(row[metric].astype(float)).where(row["keeps_track"], math.inf)
            logs[name] = log.clip(upper=math.log(cap)) if np.isfinite(cap) else log
        both = pd.DataFrame(logs)
        largest = both.where(np.isfinite(both)).max(axis=None)
        wide[key] = both.replace(math.inf, 0.0 if np.isnan(largest) else largest)
    if not wide:
        return np.zeros((2, 0))
    scenarios = Counter(family for family, _ in {key[:2] for key in wide})
    regimes = Counter(key[:2] for key in wide)
    total: Any = 0.0
    for key, both in wide.items():
        total = total + both / (len(scenarios) * scenarios[key[0]] * regimes[key[:2]])
    return total.dropna().sort_index().to_numpy().T


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
    means = np.sort((d[i] + d[j]) / 2)
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


def decide_family(
    family: Sequence[np.ndarray], margin: float, alpha: float
) -> list[dict[str, Any]]:
    """Verdicts on a family of pairs by their differences."""
    tested = [len(d) >= FEW and np.ptp(d) > 1e-6 for d in family]
    signed = [
        float(stats.wilcoxon(d, zero_method="zsplit", correction=False).pvalue) if yes else 1.0
        for d, yes in zip(family, tested, strict=True)
    ]
    trimmed = [trimmed_test(d)[1] if yes else 1.0 for d, yes in zip(family, tested, strict=True)]
    p, q = correct(signed), correct(trimmed)
    rows = []
    for k, d in enumerate(family):
        if len(d) == 0 or not d.any():
            word = "identical" if len(d) else "not decided"
            rows.append({"word": word, "ratio": 0.0 if len(d) else math.nan})
            continue
        location, low, high = estimate(d, alpha / len(family))
        if not tested[k]:
            rows.append({"word": "not decided", "ratio": location})
            continue
        if p[k] < alpha:
            low, high = (low, min(high, 0.0)) if location < 0 else (max(low, 0.0), high)
        else:
            low, high = min(low, 0.0), max(high, 0.0)
        word = "not decided"
        if -margin < low and high < margin:
            word = "equal"
        elif p[k] < alpha and q[k] < alpha and location * trimmed_test(d)[0] > 0:
            word = "better" if location < 0 else "worse"
        rows.append({"word": word, "ratio": location, "low": low, "high": high, "p": p[k]})
    return rows


def correct(p: Sequence[float]) -> np.ndarray:
    """Holm's correction."""
    values = np.asarray(p, dtype=float)
    order = np.argsort(values, kind="stable")
    steps = np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1))
    return np.asarray(np.minimum(steps, 1.0)[np.argsort(order, kind="stable")])


def subtract(losses: np.ndarray) -> np.ndarray:
    """Differences of losses [2, n], 0 within the stored precision."""
    d = losses[0] - losses[1]
    return np.where(np.abs(d) <= 1e-6, 0.0, d)


def compare_rows(folder: Path, metric: str = "") -> tuple[int, list[str]]:
    """Compute all rows of verdicts.csv again; return their number and one line per difference."""
    stored = read_stored(folder)
    options, caps = stored.page["facts"]["options"], find_caps(stored)
    margin, alpha = math.log1p(options["equivalence_margin"]), options["alpha"]
    rows = pd.read_csv(folder / "verdicts.csv")
    problems, count = [], 0
    for key, view in rows.groupby(["metric", "world", "regime", "baseline"], sort=False):
        if key[0] == "log_score" or (metric and key[0] != metric):
            continue
        runs = stored.runs
        runs = runs[(runs["scenario"] == key[1]) | (key[1] == "all")]
        runs = runs[(runs["regime"] == key[2]) | (key[2] == "all")]
        present = view[view["verdict"] != "missing"]["filter"]
        conditions = runs.groupby(["scenario", "regime"], observed=True)["filter"].agg(set)
        complete = [k for k, have in conditions.items() if set(present) <= have]
        runs = runs[[k in complete for k in zip(runs["scenario"], runs["regime"], strict=True)]]
        others = [label for label in present if label != key[3]]
        if key[3] not in set(present):
            continue
        family = [subtract(pair_losses(runs, (a, key[3]), caps, key[0])) for a in others]
        expected = dict(zip(others, decide_family(family, margin, alpha), strict=True))
        for row in view.to_dict("records"):
            if row["filter"] in expected:
                count += 1
                problems += _compare_row(f"{folder.name} {key} {row['filter']}", row, expected[row["filter"]])  # fmt: skip
    return count, problems


def _compare_row(name: str, row: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Compare one row with its expected values."""
    problems = []
    if row["verdict"] not in (wanted["word"], "loses track"):
        problems.append(f"{name}: {row['verdict']} is not {wanted['word']}")
    for column, key in (("ratio", "ratio"), ("ratio_low", "low"), ("ratio_high", "high")):
        if key in wanted:
            value, shown = math.exp(min(wanted[key], 700.0)), row[column]
            shown = math.inf if pd.isna(shown) else shown
            if not (math.isclose(value, shown, rel_tol=6e-4) or value == shown):
                problems.append(f"{name} {column}: {shown} is not {value}")
    if "p" in wanted and not math.isclose(wanted["p"], row["p"], rel_tol=2e-3, abs_tol=1e-300):
        problems.append(f"{name} p: {row['p']} is not {wanted['p']}")
    return problems


def compare_pairs(folder: Path, most: int = 100) -> tuple[int, list[str]]:
    """Compute pairs of decisions.csv again, all in one family; return their number and the differences."""
    stored = read_stored(folder)
    options, caps = stored.page["facts"]["options"], find_caps(stored)
    table = pd.read_csv(folder / "decisions.csv")
    metric = options["metric"]
    family = [subtract(pair_losses(stored.runs, (a, b), caps, metric)) for a, b in zip(table["a"], table["b"], strict=True)]  # fmt: skip
    wanted = decide_family(family, math.log1p(options["equivalence_margin"]), options["alpha"])
    problems = []
    for row, expected in list(zip(table.to_dict("records"), wanted, strict=True))[:most]:
        shown = {"verdict": row["word"], "ratio": row["ratio"], "ratio_low": row["low"], "ratio_high": row["high"], "p": row["p"]}  # fmt: skip
        problems += _compare_row(f"{folder.name} {row['a']} {row['b']}", shown, expected)
    return min(len(table), most), problems
