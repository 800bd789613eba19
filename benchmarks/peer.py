"""The library `particles` [Chopin and Papaspiliopoulos 2020] in its fastest fair form. Runs in an environment of its own.

    python peer.py float32|float64 WORKLOAD

All that can be computed before the loop is (no Cholesky factor and no distribution object at a step); normals come from
NumPy's ziggurat generator, not from the slow global one; resampling is the library's own numba loop. It has no axis of runs,
so the runs follow each other. `QuadratureEmitterPrior` collects mean and variance, since pfbench computes them too, by two products rather
than by the library's slower default; effective sample size, evidence and the resampling flag are collected anyway.
"""

from __future__ import annotations

import sys
from importlib.metadata import version
from typing import Any

import numpy as np
import particles
from particles.collectors import Moments
from worker import Filter, serve


def moments(w: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean and variance [D] of particles [N, D]; centred, since the variance is small beside the mean squared."""
    w = w.astype(x.dtype)
    mean = w @ x
    return mean, w @ np.square(x - mean)


class Bootstrap(particles.FeynmanKac):
    """One run. pfbench measures after the first propagation, so M0 draws x_0 and propagates once."""

    isAPF = False  # the library finds out at every step, by dir()

    def __init__(
        self,
        work: Any,
        y: np.ndarray,
        steps: list[tuple[np.ndarray, np.ndarray]],
        chance: np.random.Generator,
    ) -> None:
        super().__init__(len(y))
        self.steps, self.chance = steps, chance
        dtype = steps[0][0].dtype
        self.y, self.p0, self.scale = (
            y.astype(dtype),
            work.p0.astype(dtype),
            (np.sqrt(0.5) / work.r).astype(dtype),
        )
        first, width = (
            int(work.seen.min()),
            len(work.seen),
        )  # a slice is faster than a list of columns
        self.seen = slice(first, first + width)
        order = np.argsort(work.seen)
        self.y, self.scale = np.ascontiguousarray(self.y[:, order]), self.scale[order]
        self.constant = -float(np.log(work.r).sum()) - 0.5 * width * np.log(2.0 * np.pi)

    def normals(self, n: int) -> np.ndarray:
        return self.chance.standard_normal((n, len(self.p0)), dtype=self.p0.dtype.type)

    def M0(self, N: int) -> np.ndarray:
        return self.M(0, self.p0 * self.normals(N))

    def M(self, t: int, xp: np.ndarray) -> np.ndarray:
        phi, gain = self.steps[t]
        return xp @ phi + self.normals(len(xp)) @ gain

    def logG(self, t: int, xp: np.ndarray, x: np.ndarray) -> np.ndarray:
        z = (self.y[t] - x[:, self.seen]) * self.scale
        # weights in float64 whatever the states are: the library's resampling loop runs off the end if they sum to less than 1
        return self.constant - np.einsum("ij,ij->i", z, z).astype(float)


def sir(work: Any, dtype: str) -> Filter:
    d = len(work.p0)
    if sorted(work.seen) != list(range(work.seen.min(), work.seen.min() + len(work.seen))):
        raise ValueError(
            f"seen={work.seen}: this contestant wants measured states that are neighbours"
        )
    transposed = np.ascontiguousarray(work.step.transpose(0, 2, 1).astype(dtype))
    steps = [(a[:d], a[d:]) for a in transposed]

    def run(seed: int) -> tuple[list[float], np.ndarray]:
        np.random.seed(seed)
        chance = np.random.Generator(np.random.SFC64(seed))
        log_z, means = [], []
        for y in work.y:
            fk, collect = Bootstrap(work, y, steps, chance), [Moments(mom_func=moments)]
            smc = particles.SMC(
                fk, int(work.particles), resampling="systematic", ESSrmin=1.0, collect=collect
            )
            smc.run()
            log_z.append(smc.logLt)
            means.append([mean for mean, _ in smc.summaries.moments])
        return log_z, np.array(means)

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    return sir(work, sys.argv[1]), {name: version(name) for name in ("particles", "numpy", "numba")}


if __name__ == "__main__":
    serve(contestant)
