"""Size and power of estimates: trimmed log levels, ratios of medians, and trimmed paired ratios.

    python benchmarks/board_estimates.py

It writes board_estimates.json and a table of docs/statistics.md, in less than a minute.

Studies are drawn per filter: two filters share the difficulty of each run (SD 0.4) and have noise of
their own (SD 0.28, Student's t with 3 degrees of freedom, or a skewed distribution). One condition.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pfbench.stats.effects import log_levels, subtract_levels
from pfbench.stats.pair_effects import location_effects

STORE = Path(__file__).with_name("board_estimates.json")
PAGE = Path(__file__).parents[1] / "docs" / "statistics.md"
START, END = "<!-- numbers:board_estimates -->", "<!-- numbers:end -->"
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


def decide_by_pairs(errors: np.ndarray, *, by_levels: bool) -> float:
    """Return the share of studies that decide the pair, by levels or by paired ratios."""
    a, b = errors[:, None, None, 0], errors[:, None, None, 1]
    valid = np.ones(a.shape, dtype=bool)
    levels = subtract_levels(log_levels(a, valid, valid), log_levels(b, valid, valid))
    effects = location_effects(
        np.log(a / b), np.ones((1, 1)), conditions=levels if by_levels else None
    )
    return float((effects.same_worlds.p <= 0.05).mean())


def decide_by_medians(errors: np.ndarray, rng: np.random.Generator) -> float:
    """Return the share of studies whose bootstrap interval of the ratio of medians excludes 1."""
    decided = 0
    for study in errors:
        index = rng.integers(0, study.shape[1], (RESAMPLES, study.shape[1]))
        a, b = (np.median(values[index], axis=1) for values in study)
        low, high = np.quantile(a / b, [0.025, 0.975])
        decided += not low <= 1 <= high
    return decided / len(errors)


def measure_rates() -> list[dict[str, Any]]:
    """Return one row per noise, number of runs and effect."""
    rows = []
    for noise in ("t3", "skewed"):
        for runs in (10, 30, 100):
            for quantity, effect in EFFECTS.items():
                rng = np.random.default_rng(1)
                errors = draw_studies(rng, runs, noise, effect)
                levels, paired = (decide_by_pairs(errors, by_levels=by) for by in (True, False))
                medians = decide_by_medians(errors, rng)
                rows.append(
                    {"noise": noise, "runs": runs, "quantity": quantity, "trimmed log levels": levels,
                     "ratio of medians": medians, "paired ratios": paired}
                )  # fmt: skip
    return rows


def page(text: str, rows: list[dict[str, Any]], start: str = START) -> str:
    """Return the page with the table of the rows."""
    lines = [list(rows[0]), ["---"] * len(rows[0])]
    lines += [
        [f"{v:.3f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows
    ]
    table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
    before, rest = text.split(start)
    return f"{before}{start}\n{table}\n{END}{rest.split(END, 1)[1]}"


def main() -> None:
    """Write the rows and the table."""
    rows = measure_rates()
    STORE.write_text(json.dumps(rows, indent=1) + "\n")
    PAGE.write_text(page(PAGE.read_text(), rows))


if __name__ == "__main__":
    main()
