"""Pyro's SMCFilter, in the project's own environment. It has no evidence and no axis of runs.

python peer_pyro.py WORKLOAD
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from problems import Problem
from pyro.infer import SMCFilter
from worker import Filter, serve


class Model:
    """Model, and without measurements guide, which draws the same noise and may not write; particles are a plate."""

    def __init__(self, problem: Problem, y: torch.Tensor | None) -> None:
        self.problem, self.y, self.t = problem, y, -1

    def init(self, state: dict[str, torch.Tensor], *given: Any) -> None:
        z = pyro.sample("z0", dist.Normal(0.0, 1.0).expand([self.problem.d]).to_event(1))
        self.t = -1
        if self.y is not None:
            state["x"] = self.problem.initial(z)

    def step(self, state: dict[str, torch.Tensor], *given: Any) -> None:
        self.t += 1
        z = pyro.sample(
            f"z{self.t + 1}", dist.Normal(0.0, 1.0).expand([self.problem.w]).to_event(1)
        )
        if self.y is not None:
            state["x"] = self.problem.move(self.t, state["x"], z)
            pyro.factor(f"y{self.t}", self.problem.log_like(self.y[self.t], state["x"]))


def sir(work: Any) -> Filter:
    problem = Problem(work, torch, lambda a: torch.from_numpy(np.ascontiguousarray(a)).float())
    runs, steps, _ = problem.y.shape

    @torch.no_grad()
    def run(seed: int) -> tuple[np.ndarray, np.ndarray]:
        pyro.set_rng_seed(seed)
        means = torch.empty(runs, steps, problem.d)
        for r in range(runs):
            model, guide = Model(problem, problem.y[r]), Model(problem, None)
            smc = SMCFilter(
                model,
                guide,
                num_particles=int(work.particles),
                max_plate_nesting=0,
                ess_threshold=1.0,
            )
            smc.init()
            for t in range(steps):
                smc.step()
                x, w = smc.state["x"], torch.softmax(smc.state._log_weights, 0)
                means[r, t] = w @ x
                _variance, _ess = w @ (x - means[r, t]) ** 2, 1.0 / (w @ w)
        return np.full(runs, np.nan), means.numpy()

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    torch.set_num_threads(1)
    pyro.enable_validation(False)
    return sir(work), {"pyro": pyro.__version__, "torch": torch.__version__}


if __name__ == "__main__":
    serve(contestant)
