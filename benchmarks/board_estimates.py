"""Size and power of two estimates of a board: trimmed log levels and ratios of medians.

    python benchmarks/board_estimates.py

Studies are drawn per filter: two filters share the difficulty of each run (SD 0.4) and have noise of
their own (SD 0.28, Student's t with 3 degrees of freedom, or a skewed distribution). One condition.
"""

from __future__ import annotations

import numpy as np

from pfbench.report.board.levels import RunArrays, compute_levels

STUDIES, RESAMPLES = 1000, 499
EFFECTS = {"size": 0.0, "power at -10 %": np.log(0.9)}


def draw_studies(rng: np.random.Generator, runs: int, noise: str, effect: float) -> np.ndarray:
    """Draw errors of two filters, [S, 2, N]."""
    shape = (STUDIES, 2, runs)
    skewed = rng.standard_exponential(shape) - 1
    own = rng.standard_t(3, shape) / np.sqrt(3) if noise == "t3" else skewed
    log_error = 0.4 * rng.standard_normal((STUDIES, 1, runs)) + 0.28 * own
    log_error[:, 0] += effect
    return np.exp(log_error)


def decide_by_levels(errors: np.ndarray) -> float:
    """Return the share of studies whose interval of the difference of levels excludes 0."""
    decided = 0
    for study in errors:
        present = np.ones((2, 1, study.shape[1]), dtype=bool)
        runs = RunArrays(("a", "b"), np.ones(1), study[:, None], present, present)
        low, high = compute_levels(runs).difference(0, 1).interval(0.05)
        decided += not low <= 0 <= high
    return decided / len(errors)


def decide_by_medians(errors: np.ndarray, rng: np.random.Generator) -> float:
    """Return the share of studies whose bootstrap interval of the ratio of medians excludes 1."""
    decided = 0
    for study in errors:
        index = rng.integers(0, study.shape[1], (RESAMPLES, study.shape[1]))
        a, b = (np.median(values[index], axis=1) for values in study)
        low, high = np.quantile(a / b, [0.025, 0.975])
        decided += not low <= 1 <= high
    return decided / len(errors)


def main() -> None:
    """Print a table."""
    print("| noise | runs | quantity | trimmed log levels | ratio of medians |")
    print("| --- | --- | --- | --- | --- |")
    for noise in ("t3", "skewed"):
        for runs in (10, 30, 100):
            for quantity, effect in EFFECTS.items():
                rng = np.random.default_rng(1)
                errors = draw_studies(rng, runs, noise, effect)
                levels, medians = decide_by_levels(errors), decide_by_medians(errors, rng)
                print(f"| {noise} | {runs} | {quantity} | {levels:.3f} | {medians:.3f} |")


if __name__ == "__main__":
    main()
