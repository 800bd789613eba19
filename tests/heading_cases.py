"""Flights that start with a wrong heading: the truth is drawn from the model of the filter, so that only the start is wrong.

A vehicle weaves at 10 m/s from rest, with position fixes of 1 m each second. docs/methods/invariant.md has tables of them.
"""

import math
from typing import Any

import torch
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    Filter,
    GaussianFilter,
    InvariantFilter,
    SigmaPointLinearisation,
    UnscentedPoints,
    run_filter,
)
from pfbench.model import StrapdownTotal, StrapdownTuning
from pfbench.nav.strapdown import PreintegratedImu, preintegrate

INTERVAL, SAMPLES = 0.5, 10  # s; IMU samples of an interval
SETTLED = 5.0  # deg


def tuning(heading_sd: float) -> StrapdownTuning:
    """Return the tuning of filter and truth; heading in degrees."""
    return StrapdownTuning(
        gyro_density=1e-3,
        accelerometer_density=0.02,
        gyro_bias_walk=1e-6,
        accelerometer_bias_walk=1e-5,
        position_sd=[1.0, 1.0, 1.0],
        velocity_sd=None,
        attitude_sd_deg=[1.0, 1.0, heading_sd],
        initial_velocity_sd=[0.1, 0.1, 0.1],
        initial_position_sd=[1.0, 1.0, 1.0],
        gyro_bias_sd_deg_s=0.1,
        accelerometer_bias_sd=0.05,
        gyro_bias_deg_s=[0.0, 0.0, 0.0],
        accelerometer_bias=[0.0, 0.0, 0.0],
    )


def weave(seconds: float) -> PreintegratedImu:
    """Return increments of a weaving path: 5 m/s^2 for 2 s, then turns of 0.3 rad/s that alternate."""
    spans = torch.full(
        (round(seconds / INTERVAL), SAMPLES), INTERVAL / SAMPLES, dtype=torch.float64
    )
    t = spans.flatten().cumsum(0).reshape(spans.shape) - 0.5 * spans
    turn = 0.3 * torch.sign(torch.sin(2 * math.pi * t / 20.0)) * (t > 2.0)
    speed = 5.0 * t.clamp(max=2.0)
    zero = torch.zeros_like(t)
    # body axes right, forward, up: a turn to the left accelerates to the left
    force = torch.stack([-turn * speed, 5.0 * (t < 2.0), zero + 9.8], -1)
    rate, bias = torch.stack([zero, zero, turn], -1), torch.zeros(len(t), 6).double()
    parts = preintegrate(force, rate, spans, bias)
    gravity, duration = torch.full_like(t[:, 0], 9.8), spans.sum(-1)
    return PreintegratedImu(*(a.unsqueeze(0) for a in (*parts, bias, gravity, duration)))


def draw(
    angle: float, runs: int, seconds: float, seed: int
) -> tuple[StrapdownTotal, Record, Tensor]:
    """Draw truth and fixes of runs whose heading error has alternating signs: model, record, true states [R, T, D]."""
    model, u = StrapdownTotal(tuning(angle)), weave(seconds)
    steps = u.duration.shape[1]
    u = PreintegratedImu(*(a.expand(runs, *a.shape[1:]) for a in u))
    stream = PhiloxStream(seed, torch.arange(runs))
    d = stream.normal("start", 1, 15).squeeze(1) * model.p0
    d[:, 2] = math.radians(angle) * (1 - 2 * (torch.arange(runs) % 2))
    x = model.chart.add(model.origin.expand(runs, -1), d).unsqueeze(1)
    truth, y = [], torch.full((runs, steps, 3), torch.nan).double()
    noise, errors = stream.normal("noise", steps, 12), stream.normal("fix", steps, 3)
    for t in range(steps):
        inputs = PreintegratedImu(*(a[:, t] for a in u))
        x = model.propagate(x, inputs, noise[:, t : t + 1])
        truth.append(x)
        if t % 2:  # a fix each second
            y[:, t] = x[:, 0, 7:10] + errors[:, t]
    return model, Record(y, u), torch.cat(truth, 1)


def unscented_filter(alpha: float) -> GaussianFilter:
    """Return the UKF with a spread of the points, which may pass half a turn."""
    points = UnscentedPoints(alpha=alpha)
    return GaussianFilter(SigmaPointLinearisation(points, largest_angle=None))


def measure(method: Filter, angle: float, runs: int, seconds: float = 60.0) -> dict[str, float]:
    """Run a filter: runs that settle, and the mean NEES over its dimension of 10 to 30 s, in the filter's own chart."""
    model, record, truth = draw(angle, runs, seconds, seed=1)
    chart = model.chart
    if isinstance(method, InvariantFilter):
        chart = model.group_chart(method.chart)
    nees: list[Tensor] = []

    def watch(t: int, step: Any) -> dict[str, Tensor]:
        error = model.chart.subtract(truth[:, t], step.mean)
        slope = None
        if chart is not model.chart:
            slope, error = change(model, chart, step.mean), chart.subtract(truth[:, t], step.mean)
        covariance = step.covariance()
        covariance = covariance if slope is None else slope @ covariance @ slope.mT
        white, info = torch.linalg.solve_ex(covariance, error.unsqueeze(-1))
        ratio = (error * white.squeeze(-1)).sum(-1) / error.shape[-1]
        nees.append(torch.where(info == 0, ratio, torch.nan))  # a collapsed cloud is singular
        return {}

    with torch.no_grad():
        result = run_filter(method, model, record, PhiloxStream(2, torch.arange(runs)), watch)
    heading = model.error(result.mean, truth)[..., 2].abs().rad2deg()
    wrong = ~(heading < SETTLED)
    after = torch.where(wrong, torch.arange(1, wrong.shape[1] + 1), 0).amax(1) * INTERVAL
    early = torch.stack(nees, 1)[:, round(10 / INTERVAL) : round(30 / INTERVAL)]
    return {"settled": int((after < seconds).sum()), "nees_10_30": float(early.nanmean())}


def change(model: StrapdownTotal, chart: Any, mean: Tensor) -> Tensor:
    """Return the derivative from the model's chart to another, by central differences, [R, d, d]."""
    steps = 1e-6 * torch.eye(15, dtype=mean.dtype).unsqueeze(1)
    sides = [chart.subtract(model.chart.add(mean, s * steps), mean) for s in (1.0, -1.0)]
    return ((sides[0] - sides[1]) / 2e-6).permute(1, 2, 0)
