"""One verdict for each pair of a published study, in all that shows it; its ratio is that of the errors of the runs."""

from __future__ import annotations

import io
import math
import re
from typing import Any

import numpy as np
import pandas as pd
import pytest
from checkout import ROOT, list_published

from pfbench.report import RUNS_FILE, read_stored_study
from pfbench.report.study_page.page_writer import render_markdown
from pfbench.report.study_report import format_verdicts

FEW = ["paper_000_growth", "paper_004_alone", "paper_003_states"]
TURNED = {"better": "worse", "worse": "better"}


def crawl(study: str) -> tuple[int, list[str]]:
    """Collect every word on a pair over all conditions; return their number and the contradictions."""
    pack, table = read_stored_study(ROOT / "reports" / study)
    decided = {(row["a"], row["b"]): row for row in pack["decisions"] if row["world"] == "all"}
    decided |= {(b, a): turn(row) for (a, b), row in decided.items()}
    metric = pack["facts"]["options"]["metric"]
    said: list[tuple[str, str, str, str, float | None]] = [
        ("planned", p["a"], p["b"], p["word"], p["estimate"]) for p in pack["planned"]
    ]
    views = pd.read_csv(io.StringIO(format_verdicts(pack)))
    opening = views[(views["world"] == "all") & (views["regime"] == "all") & (views["metric"] == metric)]  # fmt: skip
    for row in opening.to_dict("records"):
        if row["verdict"] not in ("baseline", "missing", "loses track"):
            ratio = None if math.isnan(row["ratio"]) else row["ratio"]
            said.append(("verdicts.csv", row["filter"], row["baseline"], row["verdict"], ratio))
    problems = []
    for place, a, b, word, ratio in said:
        row = decided[a, b]
        has_ratio = not math.isnan(row["ratio"])
        if word != row["word"] or (ratio is not None) != has_ratio:
            problems.append(f"{study} {place} {a} {b}: {word} {ratio} against {row['word']} {row['ratio']}")  # fmt: skip
        elif has_ratio and not math.isclose(row["ratio"], ratio or 0.0, rel_tol=1e-3):
            problems.append(f"{study} {place} {a} {b}: {ratio} is not {row['ratio']}")
    problems += check_first(study, pack) + check_ratios(study, table, decided)
    return len(said), problems


def turn(row: dict[str, Any]) -> dict[str, Any]:
    return {**row, "word": TURNED.get(row["word"], row["word"]), "ratio": 1 / row["ratio"]}


def check_first(study: str, pack: dict[str, Any]) -> list[str]:
    """The filter that a sentence calls first in the table is its first better one."""
    markdown = render_markdown(pack)
    named = re.search(r"first in the table: (.*?)(?:, \d|\)[;.])", markdown)
    better = re.search(r"^\| \d+ \| ([^|]*?)(?: \(proposed\))? \| [^|]*\| ▲ better", markdown, re.MULTILINE)  # fmt: skip
    if named and better and better[1] != named[1] and not pack.get("world_orders"):
        return [f"{study}: {named[1]} is not {better[1]}"]
    return []


def check_ratios(study: str, table: pd.DataFrame, decided: dict[Any, Any]) -> list[str]:
    """Ratios of a study of one condition by hand: Hodges and Lehmann of the log errors, a lost run infinite."""
    if table.groupby(["scenario", "regime"]).ngroups > 1:
        return []
    errors = table["rmse"].where(table["keeps_track"], math.inf)
    wide = table.assign(log=np.log(errors.astype(float))).pivot_table("log", ["seed", "run"], "filter")  # fmt: skip
    problems = []
    for (a, b), row in decided.items():
        first, second = wide[a].to_numpy(), wide[b].to_numpy()
        lost = np.isinf(first) | np.isinf(second)
        if math.isnan(row["ratio"]) != (lost.mean() > 0.2):
            problems.append(f"{study} {a} {b}: ratio {row['ratio']} with {lost.sum()} lost pairs")
        elif not lost.any():
            means = np.add.outer(first - second, first - second)[np.triu_indices(len(first))] / 2
            if not math.isclose(math.exp(np.median(means)), row["ratio"], rel_tol=1e-4):
                problems.append(f"{study} {a} {b}: {row['ratio']} is not that of the errors")
    return problems


@pytest.mark.parametrize("study", FEW)
def test_a_pair_has_one_word_and_one_ratio(study: str) -> None:
    count, problems = crawl(study)
    assert count > 0
    assert problems == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "study", [p.name for p in list_published() if (p / RUNS_FILE).is_file() and p.name not in FEW]
)
def test_a_pair_has_one_word_and_one_ratio_in_every_study(study: str) -> None:
    assert crawl(study)[1] == []
