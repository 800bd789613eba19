"""Error rates of decisions along one run: how often two equal programs are called different.

    python benchmarks/judge_blocks.py

It writes judge_blocks.json and a table of docs/judge.md, in about eight minutes.

The errors of two programs are independent in three axes, at 2 Hz. Their correlation in time is
exponential, or oscillates with a period of four correlation times. With varying size, the exponential
errors of a program have a factor whose logarithm has the same correlation and SD 0.5. With size over
10 s, the logarithm has a correlation time of 10 s and SD 1, so that few bursts hold most of the error.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from board_estimates import page
from scipy.signal import lfilter

from pfbench.judge.block_bootstrap import compare_along_run

STORE = Path(__file__).with_name("judge_blocks.json")
PAGE = Path(__file__).parents[1] / "docs" / "judge.md"
START = "<!-- numbers:judge_blocks -->"
STUDIES, EPOCH_S, LEVEL, GAIN = 2000, 0.5, 0.05, 0.8
CORRELATIONS = ("exponential", "oscillating", "varying size", "size over 10 s")
BURST_S = 10.0
TIMES_S, LENGTHS_S = (0.5, 2.0, 5.0, 20.0), (300, 1000, 3000)


def draw_errors(rng: np.random.Generator, kind: str, time_s: float, length_s: int) -> np.ndarray:
    """Draw errors of two programs in three axes, [2, 3, T]."""
    epochs, time = round(length_s / EPOCH_S), time_s / EPOCH_S
    errors = _filter_noise(rng, (2, 3), epochs, time, 0.25 if kind == "oscillating" else 0.0)
    if kind == "varying size":
        errors = errors * np.exp(0.5 * _filter_noise(rng, (2, 1), epochs, time, 0.0))
    if kind == "size over 10 s":
        errors = errors * np.exp(_filter_noise(rng, (2, 1), epochs, BURST_S / EPOCH_S, 0.0))
    return errors


def _filter_noise(
    rng: np.random.Generator, shape: tuple[int, ...], epochs: int, time: float, turns: float
) -> np.ndarray:
    """Draw stationary noise with a correlation time, and with turns per correlation time."""
    a = np.exp(-1 / time)
    poles = [1, -2 * a * np.cos(2 * np.pi * turns / time), a * a] if turns else [1, -a]
    warm = round(10 * time)
    gain = 1.0 if turns else np.sqrt(1 - a * a)
    white = rng.standard_normal((*shape, epochs + warm))
    return np.asarray(lfilter([gain], poles, white, axis=-1)[..., warm:])


def measure_rates(
    kind: str, time_s: float, length_s: int, studies: int = STUDIES
) -> dict[str, Any]:
    """Return one row of the table."""
    rng = np.random.default_rng([CORRELATIONS.index(kind), round(10 * time_s), length_s])
    tested = alarms = decided = 0
    for _ in range(studies):
        first, second = (draw_errors(rng, kind, time_s, length_s) ** 2).sum(axis=1)
        p = compare_along_run(first, second).p
        tested += np.isfinite(p)
        alarms += p < LEVEL
        decided += compare_along_run(GAIN**2 * first, second).p < LEVEL
    return {
        "correlation": kind, "correlation time [s]": f"{time_s:g}", "length [s]": length_s,
        "tested": tested / studies, "equal programs called different": alarms / studies,
        "decided at 20 % smaller errors": decided / studies,
    }  # fmt: skip


def main() -> None:
    """Write the rows and the table."""
    rows = [
        measure_rates(kind, time_s, length_s)
        for kind in CORRELATIONS
        for time_s in TIMES_S
        for length_s in LENGTHS_S
    ]
    STORE.write_text(json.dumps(rows, indent=1) + "\n")
    PAGE.write_text(page(PAGE.read_text(), rows, START))


if __name__ == "__main__":
    main()
