"""The filter of split normal distributions: unbiased where it is linear, a grid filter where it is not, and any heading."""

import math
from dataclasses import replace
from typing import Any

import heading_cases
import numpy as np
import oracles
import pytest
import torch
from filter_cases import method_of
from refusals import check_refused
from scipy.integrate import trapezoid
from torch import Tensor
from torch.distributions import Distribution

from pfbench.core import PhiloxStream, Record
from pfbench.core.density import independent_normal, normal_batch
from pfbench.filter import (
    FadingMemory,
    GaussianFilter,
    GaussianSplitFilter,
    IidPoints,
    InvariantFilter,
    ParticleFilter,
    TaylorLinearisation,
    run_filter,
)
from pfbench.filter.whitening import split_root
from pfbench.model import LinearGaussian, StateSpaceModel, StrapdownTotal
from pfbench.testing import check_causality, check_convergence, check_evidence, check_independence

EKF = GaussianFilter(TaylorLinearisation())
# noise that makes both states uncertain again, so that particles are split at many steps
TURNING = LinearGaussian(
    [[0.9, 0.5], [-0.3, 0.8]],
    [[0.3, 0.0], [0.4, 0.6]],
    [[1.0, 0.2]],
    [0.7],
    [1.0, -1.0],
    [2.0, 1.5],
)
Y = torch.tensor([[2.0], [math.nan], [0.5], [1.5], [-0.4], [0.3]], dtype=torch.float64)


def unmerged(particles: int = 20, **options: Any) -> GaussianSplitFilter:
    chosen = {"sampled_states": ["x0"], "largest_sd": 0.5, "merge": False} | options
    return GaussianSplitFilter(EKF, particles, **chosen)


# algebra


@pytest.mark.parametrize("components", [[0], [2, 0]], ids=str)
def test_a_split_keeps_the_covariance_and_leaves_the_stated_variance(components: list[int]) -> None:
    a = PhiloxStream(1, torch.arange(5)).normal("a", 4, 6)
    a[0, 0] *= 1e-3  # smaller than what may remain
    columns, rest = split_root(a, components, 0.4)
    drawn = sum((c[..., :, None] * c[..., None, :] for c in columns), torch.zeros_like(a @ a.mT))
    torch.testing.assert_close(drawn + rest @ rest.mT, a @ a.mT, rtol=1e-12, atol=1e-12)
    sd = rest.norm(dim=-1)[:, components]
    assert bool((sd <= 0.4 + 1e-12).all())
    assert float(sd[1:, -1].min()) == pytest.approx(0.4)  # the last one is not split again
    torch.testing.assert_close(rest[0, 0], a[0, 0] if components == [0] else rest[0, 0])


@pytest.mark.parametrize(
    ("largest", "sd", "is_split"),
    [(0.5, 0.45, False), (0.5, 0.55, True), (2.0, 1.9, False), (2.0, 2.1, True)],
)
def test_a_distribution_is_split_beyond_the_largest_deviation(
    largest: float, sd: float, *, is_split: bool
) -> None:
    """At deviations below and above 1, where a variance is less and more than its root."""
    model = LinearGaussian([[1.0]], [[0.1]], [[1.0]], [1.0], [0.0], [sd])
    method = unmerged(sampled_states=["x0"], largest_sd=largest)
    belief = method.init(model, 1, PhiloxStream(1, torch.arange(1)))
    assert bool((belief.log_w > -math.inf).sum() > 1) == is_split
    kept = belief.memory["covariance"][0, 0, 0, 0]
    assert float(kept) == pytest.approx((0.5 * largest) ** 2 if is_split else sd**2)


# linear models


@pytest.mark.parametrize("sampled", [["x0"], ["x1"], ["x0", "x1"]], ids="+".join)
def test_mean_and_evidence_are_unbiased_on_a_linear_model(sampled: list[str]) -> None:
    check_evidence(unmerged(12, sampled_states=sampled), TURNING, Y, runs=1500)


def test_independent_offsets_are_unbiased_too() -> None:
    check_evidence(unmerged(12, points=IidPoints()), TURNING, Y, runs=1500)


def test_errors_fall_with_the_root_of_the_number() -> None:
    def sized(particles: int) -> GaussianSplitFilter:
        return unmerged(particles, sampled_states=["position"], points=IidPoints())

    check_convergence(sized, sizes=(16, 64, 256), runs=60)


def test_a_limit_that_is_never_reached_leaves_the_kalman_filter() -> None:
    record, draws = Record(Y.expand(3, -1, -1)), PhiloxStream(1, torch.arange(3))
    ours, kalman = (
        run_filter(m, TURNING, record, draws) for m in (unmerged(20, largest_sd=50.0), EKF)
    )
    torch.testing.assert_close(ours.mean, kalman.mean)
    torch.testing.assert_close(ours.variance, kalman.variance)
    torch.testing.assert_close(ours.log_evidence, kalman.log_evidence)


def test_runs_are_independent_and_causal_with_and_without_merging() -> None:
    y = Y.nan_to_num(0.4) + PhiloxStream(8, torch.arange(3)).normal("y", *Y.shape)
    for merge in (False, True):
        method = unmerged(largest_sd=1.2, merge=merge)
        check_causality(method, TURNING, y)
        check_independence(method, TURNING, y, tolerance=1e-9)


# a model that no single linearisation describes


class Angle(StateSpaceModel):
    """An angle that walks, seen through its sine and cosine; the prior covers the circle."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("sd", torch.tensor([0.5], dtype=torch.float64))
        self.names, self.units, self.groups, self.noise_dim = (
            ("angle",),
            ("rad",),
            {"angle": (0,)},
            1,
        )

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, 4.0 * self.sd)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x + 0.05 * w

    def noise_gain(self, u: Any) -> Tensor:
        return 0.05 * torch.ones(1, 1, 1, dtype=torch.float64)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(
            torch.cat([torch.sin(x), torch.cos(2.0 * x)], -1), 0.6 * self.sd.expand(2)
        )


ANGLES = torch.tensor([[0.8, -0.5], [0.9, -0.2], [1.1, math.nan], [0.7, -1.1]], dtype=torch.float64)


def on_a_grid() -> tuple[np.ndarray, np.ndarray, float]:
    """Return means, variances and log evidence by quadrature."""
    grid = np.linspace(-12.0, 12.0, 4001)
    step = oracles.normal_density(grid[:, None], grid[None], 0.05)

    def log_likelihood(t: int) -> np.ndarray:
        seen = [np.sin(grid), np.cos(2.0 * grid)]
        terms = [
            np.log(oracles.normal_density(float(y), h, 0.3))
            for y, h in zip(ANGLES[t], seen, strict=True)
            if not math.isnan(float(y))
        ]
        return np.sum(terms, axis=0)

    return oracles.grid_filter(
        grid, oracles.normal_density(grid, 0.0, 2.0), lambda t: step, log_likelihood, len(ANGLES)
    )


def distance_to_grid(method: Any) -> tuple[float, float]:
    """Return the largest error of means in standard deviations, and the error of the log evidence."""
    means, variances, log_z = on_a_grid()
    record, draws = Record(ANGLES.expand(20, -1, -1)), PhiloxStream(3, torch.arange(20))
    result = run_filter(method, Angle(), record, draws)
    error = (result.mean[..., 0].mean(0).numpy() - means) / np.sqrt(variances)
    return float(np.abs(error).max()), abs(float(result.log_evidence.mean()) - log_z)


def test_narrow_particles_reach_the_posterior_that_one_linearisation_misses() -> None:
    def split(sd: float, n: int) -> GaussianSplitFilter:
        return unmerged(n, sampled_states=["angle"], largest_sd=sd)

    fine, coarse, single = (distance_to_grid(m) for m in (split(0.1, 800), split(0.6, 200), EKF))
    assert max(fine) < 0.03, fine
    assert fine[1] < coarse[1] < single[1]
    assert single[1] > 10.0 * coarse[1], (fine, coarse, single)


def test_the_grid_itself_is_fine_enough() -> None:
    grid = np.linspace(-12.0, 12.0, 4001)
    assert trapezoid(oracles.normal_density(grid, 0.0, 2.0), grid) == pytest.approx(1.0, abs=1e-6)


# headings


def test_every_run_settles_at_150_degrees_and_states_its_error() -> None:
    runs = 6
    ours, single = (
        heading_cases.measure(m, 150.0, runs, 30.0) for m in (GaussianSplitFilter(EKF, 32), EKF)
    )
    assert ours["settled"] == runs > single["settled"]
    # a mean over time has at most the variance of one time, 2 / 15 for a chi-square of 15 over 15
    assert abs(ours["nees_10_30"] - 1.0) < 3.5 * math.sqrt(2 / 15 / runs)


@pytest.mark.parametrize("filter_", [EKF, InvariantFilter(EKF, "left")], ids=["plain", "left"])
def test_particles_are_merged_when_the_heading_is_known(filter_: Any) -> None:
    model, record, _ = heading_cases.draw(150.0, 4, 30.0, seed=3)
    counts = run_filter(
        GaussianSplitFilter(filter_, 32), model, record, PhiloxStream(2, torch.arange(4))
    ).trace["components"]
    assert bool((counts[:, 0] == 32).all())
    assert bool((counts[:, -1] == 1).all())


def test_the_configured_filter() -> None:
    method = method_of("rbpf_heading")
    assert replace(method, sampled_states=("attitude_yaw",)) == GaussianSplitFilter(EKF, 32)
    assert not method.is_exact


# refusals


def test_what_cannot_be_split_says_why() -> None:
    for option, value in (
        ("particles", 1),
        ("particles", 2.5),
        ("largest_sd", 0.0),
        ("largest_sd", math.nan),
    ):
        with pytest.raises(ValueError, match=rf"filter\.{option} must be .*got {value}\. Use"):
            unmerged(**{option: value})
    adapts = GaussianFilter(TaylorLinearisation(), noise_adaptations=[FadingMemory()])
    for inner in (adapts, InvariantFilter(ParticleFilter(10)), ParticleFilter(10)):
        with pytest.raises(
            ValueError, match=r"filter\.filter must be a Gaussian filter without adaptations"
        ):
            GaussianSplitFilter(inner, 8)  # type: ignore[arg-type]
    draws, model = PhiloxStream(1, torch.arange(1)), StrapdownTotal(heading_cases.tuning(45.0))
    check_refused(
        [
            (
                r"must have one unit.*got \['m/s', 'rad'\].*Select",
                lambda: GaussianSplitFilter(EKF, 8, ["attitude", "velocity"]).init(model, 1, draws),
            ),
            (
                r"must be groups .*got \['heading'\]",
                lambda: GaussianSplitFilter(EKF, 8, ["heading"]).init(model, 1, draws),
            ),
        ],
        remedy=False,
    )
