"""FilterPy: its systematic resampling around plain NumPy, and its cubature filter. Runs in an environment of its own.

python peer_filterpy.py sir|ckf WORKLOAD
"""

from __future__ import annotations

import math
import sys
from importlib.metadata import version
from typing import Any

import numpy as np
from filterpy.kalman import CubatureKalmanFilter
from filterpy.kalman.CubatureKalmanFilter import spherical_radial_sigmas
from filterpy.monte_carlo import systematic_resample
from problems import Problem
from worker import Filter, serve


def sir(work: Any) -> Filter:
    problem, n = Problem(work, np), int(work.particles)

    def run(seed: int) -> tuple[list[float], np.ndarray]:
        np.random.seed(seed)
        chance, log_z, means = np.random.default_rng(seed), [], []
        for y in problem.y:
            x, w, total, path = (
                problem.initial(chance.standard_normal((n, problem.d))),
                np.full(n, 1.0 / n),
                0.0,
                [],
            )
            for t, seen in enumerate(y):
                x = problem.move(
                    t, x[systematic_resample(w)], chance.standard_normal((n, problem.w))
                )
                log_w = problem.log_like(seen, x)
                top = log_w.max()
                w = np.exp(log_w - top)
                total += top + math.log(w.mean())
                w /= w.sum()
                mean = w @ x
                _variance, _ess = w @ (x - mean) ** 2, 1.0 / (w @ w)
                path.append(mean)
            log_z.append(total)
            means.append(path)
        return log_z, np.array(means)

    return run


def ckf(work: Any) -> Filter:
    """Cubature filter on W4's model."""
    d, k = len(work.p0), len(work.r)
    noise = [step[:, d:] @ step[:, d:].T for step in work.step]

    def run(seed: int) -> tuple[list[float], np.ndarray]:
        log_z, means = [], []
        for y in work.y:
            kf = CubatureKalmanFilter(
                d, k, 1.0, hx=lambda x: x[work.seen], fx=lambda x, dt, phi: phi @ x
            )
            kf.x, kf.P, kf.R = np.zeros((d, 1)), np.diag(work.p0**2), np.diag(work.r**2)
            total, path = 0.0, []
            for t, seen in enumerate(y):
                kf.Q = noise[t]
                kf.predict(fx_args=(work.step[t, :, :d],))
                kf.sigmas_f = spherical_radial_sigmas(
                    kf.x, kf.P
                )  # it would go on with the old points, without the noise
                kf.update(seen[:, None])
                total += kf.log_likelihood
                path.append(kf.x.ravel().copy())
            log_z.append(total)
            means.append(path)
        return log_z, np.array(means)

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    return (ckf if sys.argv[1] == "ckf" else sir)(work), {
        name: version(name) for name in ("filterpy", "numpy")
    }


if __name__ == "__main__":
    serve(contestant)
