"""Recipes of the localisation of a robot in the plane by filters on manifolds, as published for UKF-M.

A robot drives on a circle of 10 m diameter for 40 s, with odometry and a position fix of 1 m each second. Its start is
known, and the error of its heading has a standard deviation of 45 degrees. The published figures are root mean square
errors over 100 runs and all times [Brossard, Barrau and Bonnabel 2020, documentation of UKF-M, "2D Robot Localization -
Benchmark"]. The plane is a subspace of SE(3), and the charts of SE(3) restricted to it are those of SE(2).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from pfbench.experiments.oracles.book import Number, Source, recipe
from pfbench.experiments.oracles.runs import build_filter
from torch import Tensor

from pfbench.core import (
    Chart,
    EuclideanBlock,
    LieGroupBlock,
    PhiloxStream,
    QuaternionBlock,
    Record,
)
from pfbench.filter import Filter, run_filter
from pfbench.model import StateSpaceModel, independent_normal, normal_batch

UKFM = Source("UKF-M", "docs/_sources/auto_benchmark/localization.rst.txt", "BSD 3-Clause", "read in the printed output; the setting is in the same file")  # fmt: skip

SECONDS, RADIUS, FIX_SD = 40, 5.0, 1.0  # s, m, m
PUBLISHED_RATE, PUBLISHED_RUNS = 100, 100  # Hz
SPEED_SD, TURN_SD = 0.01, math.radians(1.0)  # m/s and rad/s, of each odometry sample at 100 Hz
HEADING_SD, KNOWN_SD = (
    math.radians(45.0),
    1e-5,
)  # rad; of what the publication takes as known, rad and m
ALPHA = 1e-2  # spread of the sigma points; published 1e-3, which loses half of the digits


class Odometry(NamedTuple):
    """Inputs of a step: forward and lateral speed and rate of turn, [R, 3]."""

    motion: Tensor


class Robot(StateSpaceModel):
    """Attitude and position of a robot that moves in the plane by its odometry."""

    noise_dim = 3
    names = ("roll", "pitch", "heading", "east", "north", "up")
    units = ("rad",) * 3 + ("m",) * 3
    groups = {"attitude": (0, 1, 2), "position": (3, 4, 5)}  # noqa: RUF012
    p0: Tensor

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.interval = 1.0 / rate
        # the same noise over a second at any rate
        self.noise_factor = math.sqrt(rate / PUBLISHED_RATE)
        sd = torch.full((6,), KNOWN_SD, dtype=torch.float64)
        sd[2] = HEADING_SD
        self.register_buffer("p0", sd)

    @property
    def chart(self) -> Chart:
        return Chart((QuaternionBlock(), EuclideanBlock(3)))

    def group_chart(self, side: str) -> Chart:
        """Return the invariant chart of a side."""
        return Chart((LieGroupBlock(7, side),))

    @property
    def origin(self) -> Tensor:
        return self.p0.new_tensor([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    def initial(self, runs: int) -> Any:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Odometry, w: Tensor) -> Tensor:
        """Move by the odometry, with its errors w [R, N, 3]."""
        sd = w.new_tensor([SPEED_SD, SPEED_SD, TURN_SD]) * self.noise_factor
        motion = (u.motion.unsqueeze(1) + sd * w) * self.interval
        zero = torch.zeros_like(motion[..., :1])
        turn = torch.cat([zero, zero, motion[..., 2:]], -1)
        shift = torch.cat([motion[..., :2], zero], -1)
        x, turn, shift = (a.expand(*motion.shape[:2], -1) for a in (x, turn, shift))
        half = LieGroupBlock(7, "left").add(x, torch.cat([torch.zeros_like(shift), shift], -1))
        turned = QuaternionBlock().add(half[..., :4], turn)
        return torch.cat([turned, half[..., 4:]], -1)

    def observation(self, x: Tensor, u: Any) -> Any:
        return independent_normal(x[..., 4:6], x.new_full((2,), FIX_SD))


def draw(runs: int, rate: int, seed: int) -> tuple[Robot, Record, Tensor]:
    """Draw odometry, fixes and starts: model, record, true states [R, T, 7]."""
    model, steps = Robot(rate), SECONDS * rate
    stream = PhiloxStream(seed, torch.arange(runs))
    motion = torch.tensor([2 * math.pi * RADIUS / SECONDS, 0.0, 2 * math.pi / SECONDS]).double()
    x, truth = model.origin.expand(1, 1, -1), []
    for _ in range(steps):
        x = model.propagate(x, Odometry(motion.expand(1, -1)), torch.zeros(1, 1, 3).double())
        truth.append(x[0, 0])
    path = torch.stack(truth)
    sd = torch.tensor([SPEED_SD, SPEED_SD, TURN_SD]).double() * model.noise_factor
    u = motion + sd * stream.normal("odometry", steps, 3)
    y = torch.full((runs, steps, 2), torch.nan).double()
    y[:, rate - 1 :: rate] = path[rate - 1 :: rate, 4:6] + FIX_SD * stream.normal("fix", SECONDS, 2)
    error = torch.zeros(runs, 6).double()
    error[:, 2:3] = HEADING_SD * stream.normal("heading", 1, 1)[:, 0]
    start = model.chart.add(model.origin.expand(runs, -1), error)
    return model, Record(y, Odometry(u), start), path.expand(runs, -1, -1)


def build(name: str) -> Filter:
    """Build a filter of the registry, and the unscented one with the spread of the publication."""
    words = {"ukf": [f"filter.linearisation.points.alpha={ALPHA}"]}
    right = ("filter@filter.filter=ukf", f"filter.filter.linearisation.points.alpha={ALPHA}", "filter.chart=right")  # fmt: skip
    return build_filter("invariant_ekf", 500, *right) if name == "invariant_ukf" else build_filter(name, 500, *words.get(name, []))  # fmt: skip


def measure(method: Filter, runs: int, rate: int) -> dict[str, float]:
    """Errors of heading [deg] and position [m], each with its standard deviation of one run."""
    model, record, truth = draw(runs, rate, seed=1)
    with torch.no_grad():
        result = run_filter(method, model, record, PhiloxStream(2, torch.arange(runs)))
    # published errors begin with the start, before the first step
    means = torch.cat([record.start.unsqueeze(1), result.mean[:, :-1]], 1)
    truth = torch.cat([model.origin.expand(runs, 1, -1), truth[:, :-1]], 1)
    d = model.chart.subtract(truth, means)
    values: dict[str, float] = {}
    for name, squares in (
        ("heading", d[..., :3].square().sum(-1) * math.degrees(1.0) ** 2),
        ("position", d[..., 3:].square().sum(-1)),
    ):
        each_run = squares.mean(1)
        root = float(each_run.mean().sqrt())
        deviation = float(each_run.std()) / (2.0 * root)  # of the root, by its derivative
        values[name] = root
        values[f"{name}_sd"] = deviation
    return values


RUNS, RATE = 200, 2


@recipe(40, UKFM)
def ukfm_localisation() -> Iterator[Number]:
    """Errors of four filters on the circle."""
    for name, registry, heading, position in (
        ("ekf", ("ekf",), 12.00, 0.76),
        ("ukf", ("ukf",), 11.98, 0.75),
        ("invariant_ekf", ("invariant_ekf",), 11.35, 0.45),
        ("invariant_ukf", (), 11.35, 0.45),
    ):
        row = measure(build(name), 3 * RUNS, RATE)
        for key, printed, unit in (("heading", heading, "deg"), ("position", position, "m")):
            errors = (row[f"{key}_sd"] / math.sqrt(count) for count in (PUBLISHED_RUNS, 3 * RUNS))
            setting = f"robot on a circle, root mean square error of the {key}, {unit}, over {3 * RUNS} runs; theirs over 100"
            yield Number(f"{name}_{key}", setting, printed, row[key], 5e-3, *errors, filters=registry)  # fmt: skip
