"""The practical limit: fused.c, compiled on the spot.

python fused.py WORKLOAD
"""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from problems import GROWTH, HALF_LOG_2PI, RADAR, RADAR_SPREAD, RADAR_START, VOLATILITY
from worker import Filter, serve

KINDS = {"growth": 0, "volatility": 1, "radar": 2, "ins": 3}
FLAGS = ("-O3", "-march=native", "-ffast-math", "-fPIC", "-c")


def library() -> Any:
    """fused.c as this machine's compiler makes it.

    Raises:
        OSError: no C compiler.
    """
    compiler = next(
        (found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None
    )
    if compiler is None:
        raise OSError("no C compiler")
    with tempfile.TemporaryDirectory() as folder:
        part, built = Path(folder) / "fused.o", Path(folder) / "fused.so"
        subprocess.run(
            [compiler, *FLAGS, "-o", str(part), str(Path(__file__).with_name("fused.c"))],
            check=True,
        )
        # linked without -ffast-math, with which a library switches small numbers off in the whole process
        subprocess.run([compiler, "-shared", "-o", str(built), str(part), "-lm"], check=True)
        found = ctypes.CDLL(str(built))
    found.run.restype = ctypes.c_double
    return found


def parameters(work: Any) -> tuple[np.ndarray, np.ndarray, int]:
    """Numbers of the model as fused.c wants them, [Phi | L] of each step, and the first state that is measured."""
    kind = str(work.kind)
    if kind == "ins":
        order = np.argsort(work.seen)
        constant = -np.log(work.r).sum() - len(work.r) * HALF_LOG_2PI
        return np.concatenate([work.p0, work.r[order], [constant]]), work.step, int(work.seen.min())
    found = np.zeros(16)
    if kind == "growth":
        found[:2], found[7] = (
            (GROWTH["process_sd"], GROWTH["measurement_sd"]),
            -HALF_LOG_2PI - math.log(GROWTH["measurement_sd"]),
        )
        found[12] = GROWTH["initial_sd"]
    elif kind == "volatility":
        mu, rho, sigma = VOLATILITY.values()
        found[:3], found[7], found[8], found[12] = (
            (mu, rho, sigma),
            -HALF_LOG_2PI,
            mu,
            sigma / math.sqrt(1.0 - rho**2),
        )
    else:
        found[:4] = tuple(RADAR.values())
        found[7] = -2.0 * HALF_LOG_2PI - math.log(RADAR["bearing_sd"] * RADAR["range_sd"])
        found[8:12], found[12:16] = RADAR_START, RADAR_SPREAD
    return found, np.zeros(1), 0


def sir(work: Any) -> Filter:
    compiled, n = library(), int(work.particles)
    numbers, stepped, first = parameters(work)
    runs, steps, k = work.y.shape
    d = work.truth.shape[2]
    order = np.argsort(work.seen) if str(work.kind) == "ins" else slice(None)
    numbers, stepped, y = (
        np.ascontiguousarray(a, dtype=np.float32) for a in (numbers, stepped, work.y[..., order])
    )
    mean, variance, ess = (
        np.empty((runs, steps, d)),
        np.empty((runs, steps, d)),
        np.empty((runs, steps), np.float32),
    )

    def of(a: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(a.ctypes.data)

    def run(seed: int) -> tuple[list[float], np.ndarray]:
        compiled.seed(ctypes.c_uint64(seed))
        sizes = [ctypes.c_int(value) for value in (KINDS[str(work.kind)], n, d, k, steps, first)]
        log_z = [
            compiled.run(
                *sizes, of(numbers), of(stepped), of(y[r]), of(mean[r]), of(variance[r]), of(ess[r])
            )
            for r in range(runs)
        ]
        return log_z, mean.copy()

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    return sir(work), {}


if __name__ == "__main__":
    serve(contestant)
