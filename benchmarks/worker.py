"""A contestant's process: started once, warmed up, then one round for each line that it is sent. Needs numpy only."""

from __future__ import annotations

import gc
import json
import sys
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

Filter = Callable[[int], tuple[Any, Any]]
"""A seed -> log evidence [R] and posterior means [R, T, D]."""


def serve(contestant: Callable[[Any], tuple[Filter, dict[str, str]]]) -> None:
    """Answers each line `go SEED` on standard input by one line of JSON: what the round took, and how good its result is.

    Args:
        contestant: the workload -> the filter to be timed, and versions. The last command-line argument is the workload's file.
    """
    with np.load(sys.argv[-1]) as file:
        work = SimpleNamespace(**{name: file[name] for name in file.files})
    run, versions = contestant(work)
    log_evidence, mean = run(0)  # compilers, caches, allocators
    answer({"versions": versions, **quality(work, np.asarray(log_evidence), np.asarray(mean))})
    for line in sys.stdin:
        seed = int(line.split()[1])
        gc.collect()
        wall, cpu = time.perf_counter(), time.process_time()
        log_evidence, mean = run(seed)
        took = {"cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}
        answer({**took, **quality(work, np.asarray(log_evidence), np.asarray(mean))})


def quality(work: Any, log_evidence: np.ndarray, mean: np.ndarray) -> dict[str, list[float]]:
    """Of each run: error of the log evidence; mean square errors against the truth, in exact posterior variances and in m^2.

    Where nothing exact is known: log evidence itself, NaN from those that have none, and the mean square error, all of it and
    of the first state.
    """
    square = (mean.astype(float) - work.truth) ** 2
    if not hasattr(work, "log_evidence"):
        whole, first = square.mean((1, 2)).tolist(), square[..., 0].mean(1).tolist()
        return {
            "evidence": np.asarray(log_evidence, float).tolist(),
            "normalised": whole,
            "position": first,
        }
    return {
        "evidence": (log_evidence.astype(float) - work.log_evidence).tolist(),
        "normalised": (square / work.sd**2).mean((1, 2)).tolist(),
        "position": square[..., 6:9].sum(-1).mean(1).tolist(),
    }


def answer(message: dict[str, Any]) -> None:
    print(json.dumps(message), flush=True)
