"""Filters that start with a wrong heading: how many settle, when, and whether they state their error.

A vehicle weaves at 10 m/s from rest, with position fixes of 1 m each second. The truth of each run is drawn from
the model of the filter, so the filters have no model error. The heading of the start is wrong by plus or minus
the angle, with the angle as its standard deviation. Results are kept in heading_errors.json.

Run: python benchmarks/heading_errors.py [--runs 24]; --page writes the page from the stored results alone, --filter
NAME adds or replaces the rows of one filter, with the CPU time of the EKF beside it.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import binomtest
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    Filter,
    GaussianFilter,
    GaussianSplitFilter,
    InvariantFilter,
    ParticleFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    UnscentedPoints,
    run_filter,
)
from pfbench.model import StrapdownTotal, StrapdownTuning
from pfbench.nav.strapdown import PreintegratedImu, preintegrate
from pfbench.results import order_statistic_interval

HERE = Path(__file__).parent
STORE = HERE / "heading_errors.json"
ANGLES = (10, 45, 90, 150)  # deg
INTERVAL, SAMPLES = 0.5, 10  # s; IMU samples of an interval
SETTLED = 5.0  # deg
PARTICLES, HEADINGS = 500, 32


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
    angle: float, runs: int, seconds: float, seed: int, is_random: bool = False
) -> tuple[StrapdownTotal, Record, Tensor]:
    """Draw truth and fixes from the model.

    Args:
        angle: Heading error and its standard deviation, deg.
        runs: Number of runs, with errors of alternating signs.
        seconds: Duration.
        seed: Seed.
        is_random: Whether the heading error is drawn with this standard deviation instead.

    Returns:
        Model, record, and true states [R, T, D].
    """
    model, u = StrapdownTotal(tuning(angle)), weave(seconds)
    steps = u.duration.shape[1]
    u = PreintegratedImu(*(a.expand(runs, *a.shape[1:]) for a in u))
    stream = PhiloxStream(seed, torch.arange(runs))
    d = stream.normal("start", 1, 15).squeeze(1) * model.p0
    if not is_random:
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


def filters() -> dict[str, Filter]:
    """Return the filters of the table by name."""
    ekf = GaussianFilter(TaylorLinearisation())
    points = {alpha: unscented_filter(alpha) for alpha in (1.0, 0.3)}
    return {
        "EKF": ekf,
        "invariant EKF, left": InvariantFilter(ekf, "left"),
        "invariant EKF, left, reset": InvariantFilter(replace(ekf, reset_covariance=True), "left"),
        "invariant EKF, right": InvariantFilter(ekf, "right"),
        "UKF, alpha 1": points[1.0],
        "UKF, alpha 0.3": points[0.3],
        "invariant UKF, left, alpha 0.3": InvariantFilter(points[0.3], "left"),
        f"SIR, {PARTICLES} particles": ParticleFilter(PARTICLES),
        f"heading RBPF, {HEADINGS} particles": GaussianSplitFilter(ekf, HEADINGS),
    }


def unscented_filter(alpha: float) -> GaussianFilter:
    """Return the UKF with a spread of the points, which may pass half a turn."""
    points = UnscentedPoints(alpha=alpha)
    return GaussianFilter(SigmaPointLinearisation(points, largest_angle=None))


def measure(
    method: Filter, angle: float, runs: int, seconds: float = 60.0, is_random: bool = False
) -> dict[str, Any]:
    """Run a filter and compare it with the truth.

    NEES is the squared error in the filter's own chart, over the 15 components of the state.

    Args:
        method: Filter.
        angle: Heading error, deg.
        runs: Number of runs.
        seconds: Duration.
        is_random: Whether the heading error is drawn with this standard deviation instead.

    Returns:
        Share of runs that settle, seconds until they do, NEES over its dimension, position error.
    """
    model, record, truth = draw(angle, runs, seconds, seed=1, is_random=is_random)
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

    started = time.process_time()
    with torch.no_grad():
        result = run_filter(method, model, record, PhiloxStream(2, torch.arange(runs)), watch)
    heading = model.error(result.mean, truth)[..., 2].abs().rad2deg()
    wrong = ~(heading < SETTLED)
    after = torch.where(wrong, torch.arange(1, wrong.shape[1] + 1), 0).amax(1) * INTERVAL
    times = describe_times(torch.where(after < seconds, after, torch.inf).numpy())
    position = (result.mean - truth)[..., 7:10].square().sum(-1).mean(1).sqrt()
    values, half = torch.stack(nees, 1), len(nees) // 2
    early = values[:, round(10 / INTERVAL) : round(30 / INTERVAL)]
    return {
        "settled": int((after < seconds).sum()),
        **times,
        "lost": int(result.lost.sum()),
        "nees_10_30": float(early.nanmean()),
        "nees_half": float(values[:, half:].nanmean()),
        "position": float(position.nanmedian()),
        "cpu_s": time.process_time() - started,
    }


def describe_times(times: np.ndarray) -> dict[str, float | None]:
    """Return the median of the times of runs with its 95 % interval; None for never.

    Args:
        times: Seconds until a run settles, inf for never, [R].
    """
    interval = order_statistic_interval(times, 0.95)
    found = {"settle_s": np.median(times), "settle_low": interval.low, "settle_high": interval.high}
    return {key: float(value) if math.isfinite(value) else None for key, value in found.items()}


def format_settled(row: dict[str, Any], runs: int) -> str:
    """Format the share of runs that settle and their median time, two cells with 95 % intervals.

    Args:
        row: Stored row.
        runs: Number of runs.
    """
    share = binomtest(row["settled"], runs).proportion_ci(method="wilson")
    middle, low, high = (
        "never" if (value := row[key]) is None else f"{value:.1f}"
        for key in ("settle_s", "settle_low", "settle_high")
    )
    return (
        f"{100 * row['settled'] / runs:.0f} [{100 * share.low:.0f}, {100 * share.high:.0f}] | "
        f"{middle} [{low}, {high}]"
    )


def change(model: StrapdownTotal, chart: Any, mean: Tensor) -> Tensor:
    """Return the derivative from the model's chart to another, by central differences, [R, d, d]."""
    steps = 1e-6 * torch.eye(15, dtype=mean.dtype).unsqueeze(1)
    sides = [chart.subtract(model.chart.add(mean, s * steps), mean) for s in (1.0, -1.0)]
    return ((sides[0] - sides[1]) / 2e-6).permute(1, 2, 0)


def page(stored: dict[str, Any]) -> str:
    """Return the page of the stored results."""
    assert __doc__ is not None
    lines = [
        "# Wrong headings",
        "",
        " ".join(__doc__.split("\n\n")[1].split()[:-5]),
        "Written by `benchmarks/heading_errors.py`.",
        "",
        f"{stored['runs']} runs of 60 s with one seed; in brackets are 95 % intervals, Wilson's for the share and that of",
        "order statistics for the time. A run settles when its heading stays within 5 degrees; the time is the",
        "median. NEES is in the chart of the filter, divided by its 15 components; 1 is consistent. The position",
        "error is the median RMSE of the runs. CPU times are relative to the EKF of the same angle. The covariance of",
        "collapsed particles is singular to rounding and has no NEES.",
        "",
        "| heading error [deg] | filter | settled [%] | time [s] | NEES, 10 to 30 s | NEES, second half | position [m] | CPU time |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in stored["rows"]:
        ekf = next(r for r in stored["rows"] if r["angle"] == row["angle"] and r["filter"] == "EKF")
        lines.append(
            f"| {row['angle']} | {row['filter']} | {format_settled(row, stored['runs'])} | "
            f"{format_nees(row['nees_10_30'])} | {format_nees(row['nees_half'])} | {row['position']:.2f} | "
            f"{row['cpu_s'] / row.get('ekf_cpu_s', ekf['cpu_s']):.2g} |"
        )
    return "\n".join(lines) + "\n"


def format_nees(value: float) -> str:
    """Format a NEES; a dash for a covariance that is singular to rounding.

    Args:
        value: Squared error over variance.
    """
    return f"{value:.3g}" if 0.0 <= value < 1e6 else "–"


def add_rows(name: str) -> None:
    """Measure one filter at all angles and store its rows in the order of the table."""
    stored, methods = json.loads(STORE.read_text()), filters()
    rows = {(row["angle"], row["filter"]): row for row in stored["rows"]}
    for angle in ANGLES:
        ekf_cpu_s = measure(methods["EKF"], angle, stored["runs"])["cpu_s"]
        values = measure(methods[name], angle, stored["runs"])
        rows[angle, name] = {"angle": angle, "filter": name, **values, "ekf_cpu_s": ekf_cpu_s}
        print(rows[angle, name], flush=True)
    keys = [(angle, key) for angle in ANGLES for key in methods if (angle, key) in rows]
    stored["rows"] = [rows[key] for key in keys]
    STORE.write_text(json.dumps(stored, indent=1) + "\n")


def main() -> None:
    """Measure all filters and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=96)
    parser.add_argument("--page", action="store_true")
    parser.add_argument("--filter", choices=filters())
    options = parser.parse_args()
    if options.filter:
        add_rows(options.filter)
    elif not options.page:
        rows = []
        for angle in ANGLES:
            for name, method in filters().items():
                rows.append(
                    {"angle": angle, "filter": name, **measure(method, angle, options.runs)}
                )
                print(rows[-1], flush=True)
        STORE.write_text(json.dumps({"runs": options.runs, "rows": rows}, indent=1) + "\n")
    (HERE / "heading_errors.md").write_text(page(json.loads(STORE.read_text())))


if __name__ == "__main__":
    main()
