"""Kernels of paths: started at exact draws of a linear model's path they leave its moments, and broken ones do not."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from refusals import check_refused
from smoothing_cases import SINGULAR, Swing, Tumbler, dense, record_of
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    ConditionalSmcKernel,
    CrankNicolsonKernel,
    GaussianFilter,
    NoiseSpace,
    PathKernel,
    TaylorLinearisation,
    fit_path_laplace,
    sample_smoothed_paths,
    smooth_iteratively,
)
from pfbench.model.linear_gaussian import LinearGaussian
from pfbench.noise.base import NominalNoise
from pfbench.scenario.simulated import ModelSimulation

CHAINS, STEPS = 4000, 7
RECORD = record_of(SINGULAR, 1, STEPS)
SPACE = NoiseSpace(SINGULAR, RECORD)
FULL = LinearGaussian(
    [[1.0, 0.7], [0.0, 0.9]], [[0.4, 0.0], [0.3, 0.5]], [[1.0, 0.0]], [0.8], [1.0, -1.0], [2.0, 1.0]
)


def exact_vectors(chains: int, seed: int, model: LinearGaussian = SINGULAR) -> Tensor:
    """Draws of theta given y from the dense normal law of a linear model, in NumPy."""
    f, g, h, r, m0, l0 = (getattr(model, n).numpy() for n in ("f", "g", "h", "r", "m0", "l0"))
    w = g.shape[1]
    row, centre, rows, means = np.concatenate([l0, np.zeros((2, STEPS * w))], 1), m0, [], []
    for t in range(STEPS):
        row, centre = f @ row, f @ centre
        row[:, 2 + t * w : 2 + (t + 1) * w] += g
        rows.append(h @ row)
        means.append(h @ centre)
    y = RECORD.y[0].numpy().ravel()
    seen = ~np.isnan(y)
    j = (np.concatenate(rows) / r)[seen]
    covariance = np.linalg.inv(np.eye(len(j.T)) + j.T @ j)
    mean = covariance @ j.T @ ((y - np.concatenate(means)) / r)[seen]
    z = np.random.default_rng(seed).normal(size=(chains, len(mean)))
    return torch.from_numpy(mean + z @ np.linalg.cholesky(covariance).T).unsqueeze(0)


def largest_deviation(states: Tensor, model: LinearGaussian = SINGULAR) -> float:
    """Return the largest |z| of means and variances of states [1, M, T, 2] against the dense solve."""
    mean, covariance = dense(model, RECORD.y[0].numpy())
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    z = (states[0].numpy() - mean) / sd
    m = len(z)
    of_means = z.mean(0) * m**0.5
    of_variances = ((z**2).mean(0) - 1.0) * (m / 2) ** 0.5
    return float(max(np.abs(of_means).max(), np.abs(of_variances).max()))


@dataclass(frozen=True)
class Truncated(ConditionalSmcKernel):
    """Looks one step ahead in place of the whole future: another law."""

    def _draw_parent(self, space, theta, t, x, log_w, later, draws):  # type: ignore[no-untyped-def]
        short = NoiseSpace.__new__(NoiseSpace)
        vars(short).update(vars(space), steps=space.steps[: t + 1])
        return super()._draw_parent(short, theta, t, x, log_w, later, draws)


class Careless(CrankNicolsonKernel):
    """Accepts whatever is proposed about a wrong centre."""

    def _log_weight(self, space: NoiseSpace, theta: Tensor) -> Tensor:
        return torch.zeros_like(theta[..., 0])


LAPLACE = fit_path_laplace(SPACE)
OFF_CENTRE = LAPLACE._replace(
    mode=LAPLACE.mode + 0.3 * LAPLACE.root.sum(-1), root=1.3 * LAPLACE.root
)
KERNELS: dict[str, tuple[PathKernel, float]] = {
    "conditional": (ConditionalSmcKernel(5, sample_ancestors=False), 0.3),
    "ancestors": (ConditionalSmcKernel(5), 0.9),
    "crank_nicolson": (CrankNicolsonKernel(LAPLACE), 0.999),
    "crank_nicolson_off_centre": (CrankNicolsonKernel(OFF_CENTRE, 0.5), 0.3),
}


@pytest.mark.parametrize("name", KERNELS)
def test_kernels_leave_the_smoothed_law_of_a_singular_model(name: str) -> None:
    """28 numbers of 4000 chains each; every chain starts at an exact draw and takes two steps."""
    kernel, least = KERNELS[name]
    theta, start = exact_vectors(CHAINS, 1), exact_vectors(CHAINS, 1)
    assert largest_deviation(SPACE.roll_out(start)[0]) < 4.0
    for k in range(2):
        theta, changed = kernel(SPACE, theta, PhiloxStream(k, torch.arange(1)))
    assert changed.double().mean() > least
    assert largest_deviation(SPACE.roll_out(theta)[0]) < 4.0


def test_a_kernel_leaves_the_smoothed_law_of_a_model_with_as_many_noises_as_states() -> None:
    """There the parent of a future is drawn by the transition density, and its noise changes with it."""
    space, theta = NoiseSpace(FULL, RECORD), exact_vectors(CHAINS, 1, FULL)
    assert largest_deviation(space.roll_out(theta)[0], FULL) < 4.0
    new, _ = ConditionalSmcKernel(5)(space, theta, PhiloxStream(1, torch.arange(1)))
    assert (new != theta).double().mean() > 0.5  # so many of the numbers of a path are new
    assert largest_deviation(space.roll_out(new)[0], FULL) < 4.0


@pytest.mark.parametrize(
    "kernel", [Truncated(5), Careless(OFF_CENTRE, 0.5)], ids=["truncated", "careless"]
)
def test_broken_kernels_are_seen(kernel: PathKernel) -> None:
    theta = exact_vectors(CHAINS, 1)
    for k in range(2):
        theta, _ = kernel(SPACE, theta, PhiloxStream(k, torch.arange(1)))
    assert largest_deviation(SPACE.roll_out(theta)[0]) > 8.0


def test_ancestor_sampling_renews_the_first_noise() -> None:
    theta = exact_vectors(1000, 2)
    shares = []
    for ancestors in (False, True):
        kernel = ConditionalSmcKernel(5, sample_ancestors=ancestors)
        new, _ = kernel(SPACE, theta, PhiloxStream(1, torch.arange(1)))
        shares.append(float((new[..., 2] != theta[..., 2]).double().mean()))
    assert shares[0] < 0.1 < 0.2 < shares[1], shares


def test_the_mode_of_a_linear_model_is_the_smoothed_mean() -> None:
    mean, _ = dense(SINGULAR, RECORD.y[0].numpy())
    states, _ = SPACE.roll_out(LAPLACE.mode.unsqueeze(1))
    np.testing.assert_allclose(states[0, 0], mean, atol=1e-9)


@pytest.mark.parametrize("model", [Swing(), Tumbler(0.2)], ids=["swing", "tumbler"])
def test_the_mode_of_a_bent_model_is_where_the_iterated_smoother_ends(model) -> None:  # type: ignore[no-untyped-def]
    """Two codes for one maximum: a dense derivative in noise space, and Kalman recursions about states.

    On the chart the recursions are exact to first order in a step's noise, 0.1 rad here.
    """
    record = ModelSimulation(model, 6).draw(NominalNoise(), torch.arange(2), 5).record
    space = NoiseSpace(model, record)
    mode = space.roll_out(fit_path_laplace(space, 7).mode.unsqueeze(1))[0][:, 0]
    result = smooth_iteratively(GaussianFilter(TaylorLinearisation()), model, record, 7)
    off = model.chart.subtract(result.mean, mode).abs()
    sd = result.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert result.changes[:, -1].max() < 1e-4
    assert (off / sd).max() < (1e-3 if isinstance(model, Swing) else 0.05), (off / sd).amax()


def test_paths_of_a_singular_bent_model_have_the_law_of_weighted_prior_paths() -> None:
    """Three measurements of two states with one noise: importance sampling from the prior is the oracle."""
    model = Swing()
    y = torch.tensor([[[0.6], [1.5], [0.2]]], dtype=torch.float64)
    space = NoiseSpace(model, Record(y))
    prior = torch.from_numpy(np.random.default_rng(3).normal(size=(1, 200_000, space.size)))
    states, log_w = space.roll_out(prior)
    w = torch.softmax(log_w[0], 0)
    reference = (w[:, None, None] * states[0]).sum(0)
    spread = ((w[:, None, None] * (states[0] - reference).square()).sum(0)).sqrt()
    sample = sample_smoothed_paths(model, Record(y), PhiloxStream(1, torch.arange(1)), 3000, 8)
    z = (sample.states[0].mean(0) - reference) / (spread / 3000**0.5)
    assert sample.changed.item() > 0.3
    assert z.abs().max() < 4.5, z


def test_a_run_has_the_same_paths_alone_and_in_a_batch() -> None:
    record = record_of(SINGULAR, 3, 5)
    for kernel in (None, ConditionalSmcKernel(4)):
        many = sample_smoothed_paths(
            SINGULAR, record, PhiloxStream(1, torch.arange(3)), 6, 2, kernel
        )
        alone = sample_smoothed_paths(
            SINGULAR,
            record.select_runs(slice(2, 3)),
            PhiloxStream(1, torch.tensor([2])),
            6,
            2,
            kernel,
        )
        torch.testing.assert_close(many.states[2:], alone.states)


def test_settings_outside_their_range_say_why() -> None:
    check_refused([
        ("paths must be at least 1", lambda: sample_smoothed_paths(SINGULAR, RECORD, PhiloxStream(1, torch.arange(1)), 0)),
        (r"rho must be in \[0, 1\), got 1", lambda: CrankNicolsonKernel(LAPLACE, 1.0)),
        ("particles must be at least 2", lambda: ConditionalSmcKernel(1)),
        ("passes must be at least 1", lambda: fit_path_laplace(SPACE, 0)),
    ])  # fmt: skip
