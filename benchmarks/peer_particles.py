"""The library `particles` on W1 to W3; for W4 there is peer.py. Runs in an environment of its own.

    python peer_particles.py WORKLOAD

A Feynman-Kac model in plain NumPy, normals from a fast generator, resampling by the library's numba loop, its collector of
moments. The library has no axis of runs, so the runs follow each other.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import numpy as np
import particles
from particles.collectors import Moments
from peer import moments
from problems import Problem
from worker import Filter, serve


class Bootstrap(particles.FeynmanKac):
    """One run. Measurements come after the first propagation, so M0 draws x_0 and propagates once."""

    isAPF = False

    def __init__(self, problem: Problem, y: np.ndarray, chance: np.random.Generator) -> None:
        super().__init__(len(y))
        self.problem, self.y, self.chance = problem, y, chance

    def M0(self, N: int) -> np.ndarray:
        return self.M(0, self.problem.initial(self.chance.standard_normal((N, self.problem.d))))

    def M(self, t: int, xp: np.ndarray) -> np.ndarray:
        return self.problem.move(t, xp, self.chance.standard_normal((len(xp), self.problem.w)))

    def logG(self, t: int, xp: np.ndarray, x: np.ndarray) -> np.ndarray:
        return self.problem.log_like(self.y[t], x)


def sir(work: Any) -> Filter:
    problem = Problem(work, np)

    def run(seed: int) -> tuple[list[float], np.ndarray]:
        np.random.seed(seed)
        chance = np.random.Generator(np.random.SFC64(seed))
        log_z, means = [], []
        for y in problem.y:
            fk, collect = Bootstrap(problem, y, chance), [Moments(mom_func=moments)]
            smc = particles.SMC(
                fk, int(work.particles), resampling="systematic", ESSrmin=1.0, collect=collect
            )
            smc.run()
            log_z.append(smc.logLt)
            means.append([mean for mean, _ in smc.summaries.moments])
        return log_z, np.array(means)

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    return sir(work), {name: version(name) for name in ("particles", "numpy", "numba")}


if __name__ == "__main__":
    serve(contestant)
