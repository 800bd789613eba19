"""The word "robust" needs two proofs beside the tuned control, and Holm's correction over the filters."""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

from pfbench.config.named_sets import FILTER_SETS
from pfbench.report.board.robust_word import (
    CONTROL,
    RobustnessEvidence,
    describe_robust_filters,
    find_robust_filters,
)
from pfbench.results.statistics.world_effects import EffectEstimate


def effect(differences: np.ndarray) -> EffectEstimate:
    n = len(differences)
    error = differences.std(ddof=1) / math.sqrt(n)
    return EffectEstimate(np.asarray(differences.mean()), np.asarray(error), np.asarray(n - 1.0))


def sample(centre: float, sd: float = 0.05, n: int = 40, seed: int = 0) -> np.ndarray:
    z = np.random.default_rng(seed).standard_normal(n)
    return centre + sd * (z - z.mean()) / z.std(ddof=1)


def judge(**pairs: tuple[float, float]) -> tuple[str, ...]:
    """Filters by (log ratio in outliers, log ratio in nominal noise), each with the sd of `sample`."""
    return find_robust_filters(
        {k: RobustnessEvidence(effect(sample(a)), effect(sample(b))) for k, (a, b) in pairs.items()}
    )


def test_both_halves_are_needed() -> None:
    assert judge(both=(-0.5, 0.0), greedy=(-0.5, 0.2), idle=(0.0, 0.0)) == ("both",)
    assert judge(better=(-0.5, -0.2)) == ("better",)


def test_the_published_numbers_of_a_flight_are_not_robust() -> None:
    """Half of the error of R x 4 in outliers, but 1.15 times it in nominal noise."""
    assert judge(wolf=(math.log(0.48), math.log(1.15))) == ()


def test_the_limits_are_those_of_two_one_sided_tests() -> None:
    """Against scipy: just below and just above the p-value of the worse half."""
    nominal, outliers = sample(0.03, 0.05), sample(-0.012, 0.05)
    p = max(
        stats.ttest_1samp(outliers, 0.0, alternative="less").pvalue,
        stats.ttest_1samp(nominal, math.log(1.05), alternative="less").pvalue,
    )
    one = {"a": RobustnessEvidence(effect(outliers), effect(nominal))}
    assert 0.001 < p < 0.2
    assert find_robust_filters(one, p * 1.001) == ("a",)
    assert find_robust_filters(one, p * 0.999) == ()
    # with nine idle filters beside it Holm asks for a tenth
    idle = RobustnessEvidence(effect(sample(0.5)), effect(sample(0.5)))
    many = one | {f"idle{k}": idle for k in range(9)}
    assert find_robust_filters(many, 10 * p * 0.999) == ()
    assert find_robust_filters(many, 10 * p * 1.001) == ("a",)


def test_lost_runs_and_identical_filters_prove_nothing() -> None:
    none = EffectEstimate(np.asarray(np.inf), np.asarray(np.nan), np.asarray(np.nan))
    same = EffectEstimate(np.asarray(0.0), np.asarray(0.0), np.asarray(39.0))
    assert find_robust_filters({"lost": RobustnessEvidence(none, none)}) == ()
    assert find_robust_filters({"same": RobustnessEvidence(same, same)}) == ()
    assert find_robust_filters({}) == ()


def test_sentences_name_the_rule() -> None:
    assert CONTROL in FILTER_SETS["tuned_baselines"]
    names = {"gate": "Gated EKF", "wolf": "WoLF EKF"}
    assert describe_robust_filters(names, ("gate", "wolf")).startswith(
        "Robust: [[Gated EKF]] and [[WoLF EKF]] (better than the EKF with tuned"
    )
    assert describe_robust_filters(names, ()).startswith("No filter is shown to be robust")
    assert describe_robust_filters({}, ()) == ""
