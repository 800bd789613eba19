"""What is decided does not hang on the order of runs, rows, files, or on who computed them when."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic

from pfbench.report import study_report
from pfbench.report.board.entries import StudyFacts
from pfbench.report.board.pack import build_pack, decide_parts, read_study
from pfbench.report.options import ReportOptions
from pfbench.results import store
from pfbench.results.conditions import load_conditions

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


Stored = tuple[dict[str, object], pd.DataFrame]


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Stored:
    """Pack and runs of a study."""
    conditions = load_conditions("demo", study(tmp_path_factory.mktemp("results") / "demo").parent)
    options = ReportOptions()
    data = read_study(conditions, options)
    return build_pack("demo", conditions, options, data), data.table


def decide(stored: Stored, table: pd.DataFrame) -> pd.DataFrame:
    parts = decide_parts(table, StudyFacts.from_pack(stored[0]))
    return pd.DataFrame(parts["decisions"]).set_index(["a", "b"])


def test_the_order_of_rows_changes_no_verdict(stored: Stored) -> None:
    mixed, first = (decide(stored, table) for table in (stored[1].sample(frac=1, random_state=1), stored[1]))  # fmt: skip
    pd.testing.assert_frame_equal(mixed, first, check_exact=False, rtol=1e-9)


def test_the_numbers_of_the_runs_change_no_verdict(stored: Stored) -> None:
    """The same runs made in another order: each has another number, the same for all filters."""
    table, number = stored[1], np.random.default_rng(4).permutation(16)
    renamed = table.assign(run=number[table["run"].to_numpy()])
    first = decide(stored, table)
    pd.testing.assert_frame_equal(decide(stored, renamed), first, check_exact=False, rtol=1e-9)
    one = table["run"].where(table["filter"] != "ukf", renamed["run"])
    apart = decide(stored, table.assign(run=one))  # they are paired by it
    widths = [math.log(t.loc[("cofm_amssrcpf", "ukf"), "high"] / t.loc[("cofm_amssrcpf", "ukf"), "low"]) for t in (first, apart)]  # fmt: skip
    assert widths[1] > 1.2 * widths[0]


@pytest.mark.slow
def test_order_of_files_and_workers_change_no_verdict(tmp_path: Path) -> None:
    said = []
    for turn in (0, 7):
        folder = study(tmp_path / f"results{turn}" / "demo", turn)
        made = study_report.write_report("demo", folder.parent, tmp_path / f"reports{turn}")
        said.append([(made.parent / f"{name}.csv").read_text() for name in ("decisions", "consistency", "metrics", "verdicts")])  # fmt: skip
        assert ("worker 3" in made.read_text()) is bool(turn)
    assert said[0] == said[1]
    assert len(said[0][0].splitlines()) == 4  # all pairs of three filters
