"""Workload W4: what users do all day. A 15-state INS error model, position and velocity measured, many Monte Carlo runs.

One nominal trajectory, hence one dense [Phi | L] for each step, shared by all runs; states and measurements drawn from the
model itself, so that the Kalman filter is exact and tells whether all contestants computed the same thing.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra import compose, initialize_config_dir

from pfbench import job
from pfbench.core import PhiloxStream
from pfbench.job import conf_dir
from pfbench.model import InsGnss
from pfbench.model.ins_gnss import LooseStep
from pfbench.nav.strapdown import InsIntervals

Array = np.ndarray

# From flight_300s's own coarse alignment every bootstrap filter of 500 particles diverges, whoever wrote it, and evidences that are
# wrong by 1e4 cannot be compared. The arithmetic does not depend on these sizes.
FINE = (
    "scenario.initial_errors.attitude_arcmin=[1.0, 1.0, 3.0]",
    "scenario.initial_errors.velocity=[0.1, 0.1, 0.1]",
    "scenario.initial_errors.position=[1.0, 1.0, 1.0]",
    "scenario.imu.accelerometer_bias_ug=100.0",
)


class Workload(NamedTuple):
    """Arrays only, so that a contestant needs numpy to read it. All float64.

    Attributes:
        step: [Phi | L] of each step [T, 15, 30].
        p0: initial standard deviations [15].
        r: standard deviations of the measurements [6].
        seen: the states that are measured [6].
        y: measurements [R, T, 6].
        truth: states [R, T, 15].
        log_evidence: exact log p(y_1:T) [R].
        mean: exact posterior means [R, T, 15].
        sd: exact posterior standard deviations [T, 15], the same for all runs.
        particles: N [].
    """

    step: Array
    p0: Array
    r: Array
    seen: Array
    y: Array
    truth: Array
    log_evidence: Array
    mean: Array
    sd: Array
    particles: Array


def ins_model() -> InsGnss:
    """The 15-state model of the configuration, with noise added on purpose and after a fine alignment."""
    return job.instantiate(_configured().model)


def make(runs: int, steps: int, particles: int, seed: int = 1, zeros: str = "model") -> Workload:
    """The workload, drawn from the model over the first `steps` seconds of flight flight_300s.

    `zeros` says which coefficients of [Phi | L] are 0: those of the `model` (6 in 10), `none` (each 0 becomes 1e-9), or `small` ones
    (below 1e-4: 8 in 10). Data and exact posterior are those of the coefficients.

    Raises:
        ValueError: more steps than the flight has.
    """
    model = ins_model()
    phi, gain = (
        _change_zeros(a[:, :steps], zeros) for a in model.discretise(_nominal(steps, seed))
    )
    draws = PhiloxStream(seed, torch.arange(runs))
    x = model.p0 * draws.normal("world.state", 1, len(model.p0))
    states = []
    for t in range(steps):
        x = model.propagate(
            x,
            LooseStep(phi[:, t], gain[:, t]),
            draws.at_step(t + 1).normal("world.state", 1, model.noise_dim),
        )
        states.append(x[:, 0])
    truth = torch.stack(states, 1)
    error = torch.stack(
        [
            draws.at_step(t + 1).normal("world.measurement", 1, len(model.r))[:, 0]
            for t in range(steps)
        ],
        1,
    )
    y = truth[..., model.observed_indices] + model.r * error
    step0, p0, r, seen, seen_y = (
        a.numpy()
        for a in (torch.cat([phi, gain], -1)[0], model.p0, model.r, model.observed_indices, y)
    )
    log_evidence, mean, sd = kalman(step0, p0, r, seen, seen_y)
    return Workload(
        step0, p0, r, seen, seen_y, truth.numpy(), log_evidence, mean, sd, np.array(particles)
    )


def _change_zeros(a: torch.Tensor, zeros: str) -> torch.Tensor:
    """Coefficients without zeros, or with more."""
    if zeros == "none":
        return torch.where(a == 0.0, 1e-9, a)
    return torch.where(a.abs() < 1e-4, 0.0, a) if zeros == "small" else a


def _nominal(steps: int, seed: int) -> InsIntervals:
    """At least `steps` seconds of the flight, in whole segments: what nobody filters need not be flown."""
    cfg = _configured()
    flight = job.instantiate(cfg.scenario)
    segments = [segment for manoeuvre in flight.trajectory.segments for segment in manoeuvre]
    ends = np.cumsum([segment.duration_s for segment in segments])
    if steps > ends[-1]:
        raise ValueError(f"steps={steps}: the flight lasts {ends[-1]:g} s; give at most that")
    flown = segments[: int(np.searchsorted(ends, steps)) + 1]
    return (
        replace(flight, trajectory=replace(flight.trajectory, segments=flown))
        .draw(job.instantiate(cfg.noise), torch.arange(1), seed)
        .record.u
    )


def _configured() -> Any:
    job.register_experiments()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return compose(
            "config",
            ["scenario=flight_300s", "model=ins_gnss_inflated", "episode_cache_dir=null", *FINE],
        )


def kalman(step: Array, p0: Array, r: Array, seen: Array, y: Array) -> tuple[Array, Array, Array]:
    """Exact log evidence [R], means [R, T, D] and standard deviations [T, D]; gains are the same for all runs."""
    d = len(p0)
    m, p = np.zeros((len(y), d)), np.diag(p0**2)
    log_evidence, means, sds = np.zeros(len(y)), [], []
    for t in range(y.shape[1]):
        phi, gain = step[t, :, :d], step[t, :, d:]
        m, p = m @ phi.T, phi @ p @ phi.T + gain @ gain.T
        h = np.eye(d)[seen]
        s = h @ p @ h.T + np.diag(r**2)
        k = np.linalg.solve(s, h @ p).T
        e = y[:, t] - m @ h.T
        log_evidence -= 0.5 * (
            (e * np.linalg.solve(s, e.T).T).sum(1) + np.linalg.slogdet(2.0 * math.pi * s)[1]
        )
        left = np.eye(d) - k @ h
        m, p = m + e @ k.T, left @ p @ left.T + (k * r**2) @ k.T
        means.append(m)
        sds.append(np.sqrt(np.diag(p)))
    return log_evidence, np.stack(means, 1), np.stack(sds)
