"""Workloads W1 to W5 as files that need numpy only, and what they are, written once for every array library.

A peer's script asks `Problem(work, xp)` for the pieces of a bootstrap filter: xp is numpy, jax.numpy, or torch. All arrays of
states are [..., N, D]; step t = 0, 1, ... moves the particles and then weighs them by y[t].
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)

GROWTH = {"process_sd": math.sqrt(10.0), "measurement_sd": 1.0, "initial_sd": math.sqrt(2.0)}
VOLATILITY = {"mu": -1.0, "rho": 0.95, "sigma": 0.3}
RADAR = {"interval": 1.0, "acceleration_sd": 0.1, "bearing_sd": 0.01, "range_sd": 5.0}
RADAR_START = (500.0, 5.0, 800.0, -8.0)  # east, its rate, north, its rate: m, m/s
RADAR_SPREAD = (20.0, 1.0, 20.0, 1.0)


class Workload(NamedTuple):
    """What contestants of W1 to W3 are given; W4 and W5 have `workload.Workload`, with `kind` beside it.

    Attributes:
        kind: growth, volatility, radar.
        y: measurements [R, T, k].
        truth: states [R, T, D].
        particles: N [].
    """

    kind: np.ndarray
    y: np.ndarray
    truth: np.ndarray
    particles: np.ndarray


def make(kind: str, steps: int, particles: int, seed: int = 1, runs: int = 1) -> Workload:
    """One world for each run, drawn from the model itself."""
    chance = np.random.default_rng(seed)
    empty = Workload(
        np.array(kind),
        np.zeros((runs, steps, 2 if kind == "radar" else 1)),
        np.zeros((runs, steps, 1)),
        np.array(1),
    )
    problem = Problem(empty, np)
    x = problem.initial(chance.standard_normal((runs, problem.d)))
    states, ys = [], []
    for t in range(steps):
        x = problem.move(t, x, chance.standard_normal((runs, problem.w)))
        states.append(x)
        ys.append(problem.see(x, chance.standard_normal((runs, empty.y.shape[2]))))
    return Workload(np.array(kind), np.stack(ys, 1), np.stack(states, 1), np.array(particles))


class Problem:
    """The pieces of a bootstrap filter for one workload.

    Args:
        work: the workload; `kind` says which.
        xp: numpy, jax.numpy or torch.
        array: makes one of its arrays, in the precision of the contestant; numpy's float64 where none is given.

    Attributes:
        d, w: dimensions of the state and of its noise.
    """

    def __init__(self, work: Any, xp: Any, array: Any = np.asarray) -> None:
        self.kind, self.xp, self.y = str(work.kind), xp, array(work.y)
        if self.kind == "ins":
            self.d, self.w = work.step.shape[1], work.step.shape[2] - work.step.shape[1]
            transposed = work.step.transpose(0, 2, 1)
            self.phi, self.gain = (
                array(transposed[:, : self.d].copy()),
                array(transposed[:, self.d :].copy()),
            )
            self.p0, self.scale = array(work.p0), array(np.sqrt(0.5) / work.r)
            order = np.argsort(work.seen)
            self.y, self.scale = array(work.y[..., order]), array((np.sqrt(0.5) / work.r)[order])
            self.seen = slice(int(work.seen.min()), int(work.seen.max()) + 1)
            self.constant = float(-np.log(work.r).sum() - len(work.r) * HALF_LOG_2PI)
            return
        self.d, self.w = (4, 2) if self.kind == "radar" else (1, 1)
        if self.kind == "radar":
            dt, q = RADAR["interval"], RADAR["acceleration_sd"]
            block = np.array([[1.0, dt], [0.0, 1.0]])
            reach = q * np.array([[0.5 * dt**2], [dt]])
            self.phi_t = array(np.kron(np.eye(2), block).T.copy())
            self.gain_t = array(np.kron(np.eye(2), reach).T.copy())
            self.start, self.spread = array(np.array(RADAR_START)), array(np.array(RADAR_SPREAD))

    def initial(self, z: Any) -> Any:
        """States before the first step from standard normals [..., D]."""
        if self.kind == "growth":
            return GROWTH["initial_sd"] * z
        if self.kind == "volatility":
            mu, rho, sigma = VOLATILITY.values()
            return mu + sigma / math.sqrt(1.0 - rho**2) * z
        return self.p0 * z if self.kind == "ins" else self.start + self.spread * z

    def move(self, t: Any, x: Any, z: Any) -> Any:
        """The next states from standard normals [..., W]."""
        if self.kind == "growth":
            clock = math.cos(1.2 * (t + 1)) if isinstance(t, int) else self.xp.cos(1.2 * (t + 1.0))
            return 0.5 * x + 25.0 * x / (1.0 + x * x) + 8.0 * clock + GROWTH["process_sd"] * z
        if self.kind == "volatility":
            mu, rho, sigma = VOLATILITY.values()
            return mu + rho * (x - mu) + sigma * z
        if self.kind == "ins":
            return x @ self.phi[t] + z @ self.gain[t]
        return x @ self.phi_t + z @ self.gain_t

    def see(self, x: Any, z: Any) -> Any:
        """A measurement [..., k] of states, with its error from standard normals."""
        if self.kind == "growth":
            return x * x / 20.0 + GROWTH["measurement_sd"] * z
        if self.kind == "volatility":
            return self.xp.exp(0.5 * x) * z
        sd = np.array([RADAR["bearing_sd"], RADAR["range_sd"]])
        return self.polar(x) + sd * z

    def polar(self, x: Any) -> Any:
        """Bearing from north and range [..., 2]."""
        east, north = x[..., 0], x[..., 2]
        atan2 = self.xp.arctan2
        return self.xp.stack([atan2(east, north), self.xp.sqrt(east * east + north * north)], -1)

    def log_like(self, y: Any, x: Any) -> Any:
        """Log density of one measurement y [k] at states x [..., N, D]: [..., N]."""
        if self.kind == "growth":
            e = (y[0] - x[..., 0] * x[..., 0] / 20.0) / GROWTH["measurement_sd"]
            return -0.5 * e * e - math.log(GROWTH["measurement_sd"]) - HALF_LOG_2PI
        if self.kind == "volatility":
            return -0.5 * (y[0] * y[0] * self.xp.exp(-x[..., 0]) + x[..., 0]) - HALF_LOG_2PI
        if self.kind == "ins":
            e = (y - x[..., self.seen]) * self.scale
            return self.constant - (e * e).sum(-1)
        east, north = x[..., 0], x[..., 2]  # the target stays in front: no angle wraps
        turn = (y[0] - self.xp.arctan2(east, north)) / RADAR["bearing_sd"]
        far = (y[1] - self.xp.sqrt(east * east + north * north)) / RADAR["range_sd"]
        sd = RADAR["bearing_sd"] * RADAR["range_sd"]
        return -0.5 * (turn * turn + far * far) - math.log(sd) - 2.0 * HALF_LOG_2PI
