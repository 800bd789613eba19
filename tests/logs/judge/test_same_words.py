"""The same runs give the same verdict in a study and in a judgement."""

from pathlib import Path

import judge_cases as cases
import numpy as np
import pytest

from pfbench.logs.judge.judge_options import JudgeOptions
from pfbench.logs.judge.judgement import judge_programs
from pfbench.report.board.entries import build_run_table
from pfbench.results.conditions import load_conditions
from pfbench.results.store import write_result
from pfbench.stats.court import Court
from pfbench.stats.study_runs import arrange_runs

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


@pytest.mark.parametrize(("effect", "word"), [(-0.5, "better"), (0.0, "not decided"), (0.5, "worse")])  # fmt: skip
def test_a_study_and_a_judgement_agree(tmp_path: Path, effect: float, word: str) -> None:
    rng = np.random.default_rng(3)
    shared = np.exp(0.5 * rng.exponential(size=RUNS))
    a = shared * np.exp(effect + 0.4 * rng.exponential(size=RUNS) - 0.4)
    files = {
        "a": str(write_filter(tmp_path, "a", a, 1)),
        "b": str(write_filter(tmp_path, "b", shared, 2)),
    }
    rows = build_run_table(load_conditions("s", tmp_path))
    court = Court(arrange_runs(rows, ("a", "b")), [("a", "b")])
    verdict = court.find("rmse", np.ones(1, dtype=bool), "a", "b")
    reference = cases.write(cases.drive(20.0), tmp_path / "truth.csv")
    (pair,) = judge_programs(str(reference), files, JudgeOptions(limit=1000.0)).pairs
    assert pair.unit == "run"
    assert pair.verdict.word == verdict.word == word
    for name in ("ratio", "low", "high", "p", "n"):
        assert getattr(pair.verdict, name) == pytest.approx(getattr(verdict, name), rel=1e-4)
