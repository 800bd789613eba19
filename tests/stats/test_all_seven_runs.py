"""Known values of the first study of all seven methods: `tests/all_seven_runs.parquet`, which no later study changes.

One row for each filter and run in single precision, with the divergence threshold that its scenario had.
"""

from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pfbench.stats.rank_tests import holm, wilcoxon_signed_rank_rows

FILE = Path(__file__).parents[1] / "all_seven_runs.parquet"
SEVEN = [
    "mcmc_rpf", "qmc_polymerised", "fm_mssrckf", "cofm_mssrckf", "cofm_amssrcpf", "dmc_reconstructed",
    "cpso_escape",
]  # fmt: skip
PAIRS = list(combinations(range(7), 2))


@pytest.fixture(scope="module")
def runs() -> pd.DataFrame:
    return pd.read_parquet(FILE)


@pytest.fixture(scope="module")
def differences(runs: pd.DataFrame) -> list[np.ndarray]:
    """Differences of the loss of all pairs by condition, [28][21, R]: the log error, at most the threshold, which a run without track has."""
    found = []
    seven = runs[runs["filter"].isin(SEVEN)]
    for _, part in seven.groupby(["scenario", "regime"], observed=True):
        error, kept = (
            part.pivot_table(index="run", columns="filter", values=column, observed=True)[SEVEN]
            for column in ("rmse", "keeps_track")
        )
        cap = float(part["threshold"].iloc[0])
        loss = np.log(np.where(kept.to_numpy(bool), np.minimum(error.astype(float), cap), cap))
        d = np.stack([loss[:, a] - loss[:, b] for a, b in PAIRS])
        found.append(np.where(np.abs(d) < 1e-6, 0.0, d))
    return found


def adjust(p: np.ndarray) -> np.ndarray:
    """Holm's correction, written down a second time."""
    order = np.argsort(p)
    steps = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return np.asarray(np.minimum(steps, 1.0)[np.argsort(order)])


def test_400_of_588_pairs_are_decided_by_scipy_alone(differences: list[np.ndarray]) -> None:
    """By Wilcoxon's test with Holm's correction over all pairs, 450 with a correction for each condition."""
    p = np.array([
        [stats.wilcoxon(d, zero_method="zsplit").pvalue if d.any() else 1.0 for d in condition]
        for condition in differences
    ])  # fmt: skip
    assert p.shape == (28, 21)
    assert (adjust(p.ravel()) < 0.05).sum() == 400
    assert sum((adjust(row) < 0.05).sum() for row in p) == 450


def test_the_tests_of_pfbench_decide_the_same_pairs(differences: list[np.ndarray]) -> None:
    p = np.concatenate([wilcoxon_signed_rank_rows(condition)[1] for condition in differences])
    assert (holm(p) < 0.05).sum() == 400


def test_the_runs_are_those_of_the_study(runs: pd.DataFrame) -> None:
    assert len(runs) == 74000
    assert runs["filter"].nunique() == 37
    assert runs.groupby(["scenario", "regime"], observed=True).ngroups == 28
    assert set(runs["seed"]) == {1}
    assert not runs["lost"].any()
    kept = runs.groupby(["filter", "scenario", "regime"], observed=True)["keeps_track"].mean()
    assert 1 - kept["sir"].mean() == pytest.approx(0.67, abs=0.005)  # as its page says
    assert FILE.stat().st_size < 500_000
