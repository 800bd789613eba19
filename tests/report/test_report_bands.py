"""Bands of consistency: the level over all filters of a report, the size of a deviation, and what is left out."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from pfbench.stats.consistency_bands import assess_consistency

RUNS, DOF = 40, 60


def table(sizes: dict[str, float], seed: int, runs: int = RUNS) -> pd.DataFrame:
    """NEES over its expectation of each run and world, whose runs share random numbers; 1 is consistent."""
    rng = np.random.default_rng(seed)
    parts = []
    for label, size in sizes.items():
        run = rng.chisquare(DOF, runs) / DOF
        for world in ("w0", "w1"):
            parts.append(pd.DataFrame({
                "label": label, "metric": "nees_ratio", "group": "position", "noise": "nominal", "model": "m",
                "scenario": world, "family": world, "seed": 1, "run": np.arange(runs), "lost": False,
                "value": size * run * (1 + 0.01 * rng.standard_normal(runs)),
            }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def test_consistent_filters_are_rarely_called_otherwise() -> None:
    """The level holds for all filters together, although the worlds of a run are not independent."""
    studies, wrong = 50, 0
    for seed in range(studies):
        bands = assess_consistency(table(dict.fromkeys("abcd", 1.0), seed))
        words = bands["word"] != "no deviation shown"
        assert (words == ((bands["low"] > 1) | (bands["high"] < 1))).all()
        wrong += bool(words.any())
    assert 0 < wrong / studies <= 0.05 + 2.5 * math.sqrt(0.05 * 0.95 / studies)


def test_a_word_comes_with_the_size_of_the_deviation() -> None:
    """Intervals of all filters together contain the sizes in nearly all studies."""
    sizes = {"a": 1.5, "b": 0.6, "c": 400.0, "d": 1.0}
    inside = 0
    for seed in range(30):
        bands = assess_consistency(table(sizes, seed)).set_index("filter")
        assert bands.loc[["a", "b", "c"], "word"].tolist() == ["overconfident", "underconfident", "overconfident"]  # fmt: skip
        true = pd.Series(sizes)
        assert np.abs(np.log(bands["ratio"] / true)).max() < 0.2
        inside += bool(((bands["low"] <= true) & (true <= bands["high"])).all())
    assert inside / 30 >= 0.95 - 2.5 * math.sqrt(0.05 * 0.95 / 30)


def test_lost_runs_are_left_out_and_counted_and_few_runs_decide_nothing() -> None:
    data = table({"a": 9.0}, 1)
    data.loc[(data["run"] < 5) & (data["scenario"] == "w0"), "value"] = np.nan
    (row,) = assess_consistency(data).to_dict("records")
    assert (row["runs"], row["lost"], row["word"]) == (35, 5, "overconfident")
    (row,) = assess_consistency(table({"a": 9.0}, 1, runs=9)).to_dict("records")
    assert (row["word"], row["reason"]) == ("no deviation shown", "9 valid runs, 10 are required")
    assert (row["low"], row["high"], row["p"]) == (0.0, math.inf, pytest.approx(1.0))
