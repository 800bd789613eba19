"""What is decided does not hang on the order of runs, rows, files, or on who computed them when."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic
from pfbench.stats.filter_sets import order_filters
from pfbench.stats.planned_pairs import decide_planned_pairs

from pfbench.report import study_report
from pfbench.results import frame, store
from pfbench.stats.study_runs import tidy_runs

NOISES = ("nominal", "surge", "heavy", "outage", "jam")
METHODS = synthetic.METHODS[1:]


def study(folder: Path, turn: int = 0) -> Path:
    """The same jobs, written in another order, by other workers, at other times."""
    jobs = [(noise, method) for noise in NOISES for method in METHODS]
    for k, (noise, method) in enumerate(jobs[turn:] + jobs[:turn]):
        path = synthetic.write(folder, method, noise=noise, runs=16, steps=8)
        if turn:
            meta, arrays = store.read_result(path)
            meta |= {
                "host": f"worker {k % 5}",
                "threads": 1 + k % 3,
                "created": f"2027-01-{1 + k:02}T00:00:00+00:00",
            }
            store.write_result(path, meta, arrays)
            os.utime(path, (10**9 - k, 10**9 - k))
    return folder


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    folder = study(tmp_path_factory.mktemp("results") / "demo")
    full = frame.load_frame("demo", folder.parent)
    return full[(full.metric == "rmse") & (full.component == "norm")]


def between(table: pd.DataFrame) -> dict[Any, tuple[Any, ...]]:
    """Numbers and words of each planned pair, and the order of the filters."""
    tidy = tidy_runs(table)
    pairs = {
        (d.question, d.a, d.b, d.metric): (d.word, d.pair_word, d.estimate, d.low, d.high, d.p)
        for d in decide_planned_pairs(tidy, [("cofm_amssrcpf", "ukf"), ("sir", "ukf")])
    }
    orders = {
        order.question: (order.top_group, *order.ranks.items()) for order in order_filters(tidy)
    }
    return {**pairs, **orders}


def alike(first: dict[Any, tuple[Any, ...]], second: dict[Any, tuple[Any, ...]]) -> bool:
    """The same words, and the same numbers but for the order in which they were summed."""

    def same(a: Any, b: Any) -> bool:
        if isinstance(a, tuple):
            return len(a) == len(b) and all(map(same, a, b))
        return (
            a == b
            if isinstance(a, str)
            else bool(np.isclose(a, b, rtol=1e-9, atol=0, equal_nan=True))
        )

    return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)


def test_the_order_of_rows_changes_no_verdict(table: pd.DataFrame) -> None:
    mixed = table.sample(frac=1, random_state=1)
    assert alike(between(table), between(mixed))


def test_the_numbers_of_the_runs_change_no_verdict(table: pd.DataFrame) -> None:
    """The same runs made in another order: each has another number, the same for all filters."""
    number = np.random.default_rng(4).permutation(16)
    renamed = table.assign(run=number[table.run.to_numpy()])
    assert alike(between(table), between(renamed))
    apart = table.assign(
        run=np.where(table.label == "ukf", number[table.run.to_numpy()], table.run)
    )
    assert not alike(between(table), between(apart))  # they are paired by it


@pytest.mark.slow
def test_order_of_files_and_workers_change_no_verdict(tmp_path: Path) -> None:
    said = []
    for turn in (0, 7):
        folder = study(tmp_path / f"results{turn}" / "demo", turn)
        made = study_report.write_report("demo", folder.parent, tmp_path / f"reports{turn}")
        names = ("decisions.json", "consistency.json", "metrics.csv", "verdicts.csv")
        said.append([(made.parent / name).read_text() for name in names])
        assert ("worker 3" in made.read_text()) is bool(turn)
    assert said[0] == said[1]
    assert len(json.loads(said[0][0])) > 15
