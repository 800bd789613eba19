"""Decisions of stored studies against an independent computation: planned pairs and rows of verdicts.csv.

It reads the published files of a study (runs.parquet, page.json.gz, verdicts.csv) without code of pfbench. Numbers
of a page have four digits, p-values of random exchanges are estimates. If the study has decisions.json and
results, all metrics are computed from the result files, too.

Run: make recompute STUDY=all_seven, or python tests/recompute.py [STUDY ...]; without a name all published studies.
"""

from __future__ import annotations

import gzip
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from board_oracle import find_differences as find_row_differences
from decision_oracle import (
    decide,
    estimate,
    find_differences,
    pair_cells,
    recompute,
)
from result_oracle import read_runs

TOP = Path(__file__).parents[1]
FAMILIES = ("planned pairs, track and error", "planned pairs, secondary metrics")
DIGITS = 6e-4  # relative: four digits are stored
RANDOM = 0.02  # p-values of 9999 random exchanges: five standard errors at 0.05
LEVELS, TRACK_MARGIN = np.log(1.05), 0.05


class Outcome(NamedTuple):
    """Comparison of the decisions of a study.

    Attributes:
        count: Number of decisions that were computed again.
        largest: Largest relative difference of a number from the stored one.
        problems: One line per difference.
    """

    count: int
    largest: float
    problems: list[str]


def read_page(folder: Path) -> dict[str, Any]:
    """Data of a published page."""
    page: dict[str, Any] = json.loads(gzip.decompress((folder / "page.json.gz").read_bytes()))
    return page


def read_table(folder: Path, metric: str = "rmse") -> pd.DataFrame:
    """Runs of a report, with one name per run."""
    table = pd.read_parquet(folder / "runs.parquet")
    names = {"family": "world", metric: "error", "keeps_track": "keeps"}
    return table.assign(run=10**6 * table["seed"] + table["run"]).rename(columns=names)


def decide_planned(runs: pd.DataFrame, pairs: Sequence[tuple[str, str]]) -> dict[str, list[Any]]:
    """Decide track and error of all pairs: (track, error, estimate of the error) by question."""
    track = [estimate(pair_cells(runs, *pair, "keeps track"), "track") for pair in pairs]
    error = [estimate(pair_cells(runs, *pair, "error"), "ratio") for pair in pairs]
    members = []
    for first, second in zip(track, error, strict=True):
        members += [
            first | {"margin": TRACK_MARGIN, "is_ratio": False},
            second | {"margin": LEVELS, "is_ratio": not second["won"]},
        ]
    decided = {question: decide(members, question) for question in "ab"}
    return {q: list(zip(rows[::2], rows[1::2], error, strict=True)) for q, rows in decided.items()}


def pair_word(track: dict[str, Any], error: dict[str, Any], effect: dict[str, Any]) -> str:
    """Word of a pair from its words of track and error."""
    both = effect["both"]
    is_material = abs(track["estimate"]) > TRACK_MARGIN and abs(both) > LEVELS
    words = {w for w in (track["word"], error["word"]) if w in ("better", "worse")}
    if len(words) == 2 or (is_material and track["estimate"] * both < 0):
        return "trade-off"
    if words:
        return words.pop()
    if error["word"] == "not tested":
        return "not tested"
    is_equal = {track["word"], error["word"]} <= {"equivalent", "identical"}
    return str(error["word"]) if is_equal else "inconclusive"


def expect_entry(decided: dict[str, Any], k: int) -> dict[str, Any]:
    """Entry of a planned pair on a page, with all digits."""
    track, error, effect = decided["a"][k]
    new = decided["b"][k][1]
    entry = {"word": pair_word(track, error, effect), "p": error["p_corrected"]}
    is_ratio = not effect["won"] and (effect["has_error"] or not effect["identical"])

    def ratio(value: float) -> float:
        return float(np.exp(value)) if is_ratio and np.isfinite(value) else np.nan

    for name in ("estimate", "low", "high"):
        entry[name] = ratio(error[name])
    if len(effect["theta"]) > 1:
        entry["new_world.word"] = new["word"]
        entry |= {f"new_world.{k}": ratio(new[k]) for k in ("estimate", "low", "high")}
    return entry


def compare_planned(folder: Path) -> tuple[Outcome, dict[Any, str]]:
    """Compare the planned pairs of a page; also the words of the errors in these worlds."""
    page = read_page(folder)
    metric = page["metrics"][0]["key"]
    pairs = [(entry["a"], entry["b"]) for entry in page["planned"]]
    if not pairs:
        return Outcome(0, 0.0, []), {}
    decided = decide_planned(read_table(folder, metric), pairs)
    count, largest, problems, words = 0, 0.0, [], {}
    for k, entry in enumerate(page["planned"]):
        stored = entry | {f"new_world.{n}": v for n, v in (entry["new_world"] or {}).items()}
        expected = expect_entry(decided, k)
        count += 1 + ("new_world.word" in expected)
        for name, value in expected.items():
            shown = stored.get(name)
            if isinstance(value, str):
                gap, limit = float(value != shown), 0.0
            else:
                gap, limit = (
                    relative_gap(value, shown),
                    RANDOM if name == "p" and stored["estimate"] is None else DIGITS,
                )
                largest = max(largest, gap)
            if gap > limit:
                problems.append(f"{folder.name} {pairs[k]} {name}: {value} is not {shown}")
        words[pairs[k]] = decided["a"][k][1]["word"]
    return Outcome(count, largest, problems), words


def relative_gap(value: float, shown: float | None) -> float:
    """Relative difference of a number from the stored one; infinite if only one of them exists."""
    if shown is None or not np.isfinite(value):
        return 0.0 if shown is None and not np.isfinite(value) else np.inf
    return abs(value - shown) / max(abs(value), 1e-300)


def compare_rows(folder: Path, words: dict[Any, str]) -> Outcome:
    """Compare all rows of verdicts.csv, given the words of planned pairs."""
    opposite = {"better": "worse", "worse": "better"}
    both = words | {(b, a): opposite.get(word, word) for (a, b), word in words.items()}
    count = len(pd.read_csv(folder / "verdicts.csv"))
    return Outcome(count, 0.0, find_row_differences(folder, both))


def compare_result_files(folder: Path, results: Path) -> Outcome:
    """Compare decisions.json, with all digits and metrics, with the result files."""
    records = [
        r for r in json.loads((folder / "decisions.json").read_text()) if r["family"] in FAMILIES
    ]
    different = find_differences(recompute(read_runs(results), records))
    return Outcome(
        len(records), 0.0, different.to_string().splitlines()[1:] if len(different) else []
    )


def main(studies: Sequence[str]) -> int:
    """Compare the decisions of studies; all published ones without a name."""
    studies = studies or sorted(path.parent.name for path in TOP.glob("reports/*/page.json.gz"))
    total = Outcome(0, 0.0, [])
    for study in studies:
        folder, results = TOP / "reports" / study, TOP / "results" / study
        if not (folder / "page.json.gz").exists():
            print(
                f"reports/{study} must have page.json.gz, got none. Run: pfbench report study={study}"
            )
            return 2
        planned, words = compare_planned(folder)
        rows = compare_rows(folder, words)
        parts = [planned, rows]
        text = f"{planned.count} decisions on planned pairs, {rows.count} rows of verdicts.csv"
        if (folder / "decisions.json").exists() and results.is_dir():
            parts.append(compare_result_files(folder, results))
            text += f", {parts[-1].count} decisions from result files"
        problems = [line for part in parts for line in part.problems]
        print(
            f"{study}: {text}; {len(problems)} differ; largest difference {planned.largest:.1e}",
            flush=True,
        )
        total = Outcome(
            total.count + sum(p.count for p in parts),
            max(total.largest, planned.largest),
            total.problems + problems,
        )
    print("\n".join(total.problems))
    print(
        f"{total.count} decisions of {len(studies)} studies computed again, {len(total.problems)} differ; "
        f"largest relative difference {total.largest:.1e}, where the files have four digits"
    )
    return int(bool(total.problems))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
