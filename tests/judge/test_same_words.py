"""The same runs give the same estimate and word in a report, in a judgement and at a look."""

from __future__ import annotations

from pathlib import Path

import judge_cases as cases
import numpy as np
import pytest

from pfbench.judge.judgement import METRIC, judge_programs
from pfbench.report.options import ReportOptions
from pfbench.results.frame import load_frame
from pfbench.results.store import write_result
from pfbench.stats.decision import DecisionOptions
from pfbench.stats.pair_states import LookSchedule, decide_pairs
from pfbench.stats.planned_pairs import decide_planned_pairs
from pfbench.stats.sequential_looks import LookPlan, decide_at_looks
from pfbench.stats.study_runs import tidy_runs

RUNS = 30
NAMES = ["position_E", "position_N", "position_U"]
STATE = {"names": NAMES, "units": ["m"] * 3, "groups": {"position": [0, 1, 2]}}


def write_filter(folder: Path, name: str, scale: np.ndarray, seed: int) -> Path:
    """Write a result whose errors have a scale of each run, [R]."""
    truth = cases.drive(20.0)
    rng, steps = np.random.default_rng(seed), len(truth)
    error = scale[:, None, None] * rng.normal(size=(RUNS, steps, 3))
    track = np.stack([truth.pe, truth.pn, -truth.pd], -1)
    meta = {
        "key": name, "study": "s", "choices": {"scenario": "drive", "noise": "nominal", "model": "ins", "filter": name},
        "config": {"filter": {"name": name}}, "label": name, "seed": 1, "runs": RUNS, "first_run": 0, "steps": steps,
        "state": STATE, "seconds": {"per_step": 1e-3}, "versions": {"commit": "c", "pfbench": "1"},
    }  # fmt: skip
    data = {
        "time": truth.t.to_numpy(), "error": error, "sd": np.ones_like(error), "nees": np.ones((RUNS, steps, 1)),
        "log_evidence": np.zeros(RUNS), "lost": np.zeros(RUNS, bool), "track": np.stack([track] * RUNS),
    }  # fmt: skip
    return write_result(folder / "s" / f"{name}.npz", meta, data)


@pytest.mark.parametrize(("effect", "word"), [(-0.5, "better"), (0.0, "inconclusive"), (0.5, "worse")])  # fmt: skip
def test_report_judgement_and_look_agree(tmp_path: Path, effect: float, word: str) -> None:
    """The runs are skewed, so that the trimmed mean of ratios differs from the ratio of trimmed means."""
    rng = np.random.default_rng(3)
    shared = np.exp(0.5 * rng.exponential(size=RUNS))
    a = shared * np.exp(effect + 0.4 * rng.exponential(size=RUNS) - 0.4)
    files = {
        "a": str(write_filter(tmp_path, "a", a, 1)),
        "b": str(write_filter(tmp_path, "b", shared, 2)),
    }
    options = ReportOptions().decision_options
    frame = load_frame("s", tmp_path)
    table = tidy_runs(frame[frame.component == "norm"])
    report = decide_planned_pairs(table, [("a", "b")], None, options)[1]
    reference = cases.write(cases.drive(20.0), tmp_path / "truth.csv")
    judged = next(d for d in judge_programs(str(reference), files).decisions if d.question == "a" and d.metric == METRIC)  # fmt: skip
    look = decide_at_looks(table, [("a", "b")], LookPlan(runs=(RUNS,)), None, options)[1]
    (state,) = decide_pairs(table, [("a", "b")], LookSchedule("looks", RUNS), options)
    assert report.pair_word == word
    assert judged.pair_word == look.pair_word == state.word == word
    np.testing.assert_allclose([judged.estimate, look.estimate], report.estimate, atol=1e-4)
    other = DecisionOptions(estimate="paired")
    paired = decide_planned_pairs(table, [("a", "b")], None, other)[1]
    assert abs(paired.estimate - report.estimate) > 1e-3  # the other estimate is another number
