"""The figures of the method pages: `python experiments/analyses/method_pictures.py`, or with names of functions for some of them."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import (
    GaussianBelief,
    ParticleBelief,
    normalise_log_weights,
    weighted_mean_cov,
)
from pfbench.filter.gaussian.ensemble_kalman import EnsembleKalmanFilter, EnsembleTransformUpdate
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.innovation import GainAdaptation, NoiseAdaptation
from pfbench.filter.gaussian.linearisation_rules import (
    AxisDegree3,
    AxisDegree5,
    RadialDegree3,
    RadialDegree5,
    SigmaPointLinearisation,
    SimplexDegree3,
    SphericalRadialPoints,
    TaylorLinearisation,
)
from pfbench.filter.gaussian.noise_adaptation import (
    AdaptiveFactorGain,
    BoundedRatioGain,
    ConstrainedNoiseAdaptation,
    FadingMemory,
    MatrixNoiseAdaptation,
)
from pfbench.filter.guided.guides import SharedGuideProposal
from pfbench.filter.guided.noise_guide import GuidedNoiseProposal
from pfbench.filter.loop import run_filter
from pfbench.filter.marginal.rao_blackwellised import RaoBlackwellisedFilter
from pfbench.filter.moves.metropolis import MetropolisHastings, StateHistory as Past
from pfbench.filter.moves.path_kernels import NoiseFlowKernel
from pfbench.filter.particle.gaussian_particle_filter import GaussianResampler
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.regularised_resampling import RegularisedResampler
from pfbench.filter.particle.sqmc import HaltonPoints
from pfbench.filter.particle.stages import (
    BootstrapProposal,
    EssResampler,
    Proposal,
    Resampler,
    Systematic,
)
from pfbench.filter.proposed import swarm_motion
from pfbench.filter.proposed.dmc_controller import DmcController
from pfbench.filter.proposed.polymerised import (
    AxisAlignedCells,
    PolymerisedResampler,
    ScaledCentrePlacement,
    UnchangedAllocation,
    WhitenedCells,
    divide_cells,
)
from pfbench.filter.proposed.reconstructed import NoWeightCorrection, ReconstructedProposal
from pfbench.filter.proposed.swarm import SwarmLimits, SwarmProposal
from pfbench.filter.proposed.swarm_coordinates import AllComponents, LikelihoodFitness
from pfbench.filter.proposed.swarm_weighting import PrintedWeighting
from pfbench.model.linear_gaussian import LinearGaussian, linear_walk

PAGES = Path(__file__).parents[2] / "docs" / "methods"


def dmc_reconstructed() -> None:
    """Effect of the shift on predicted particles, as printed and with marginal weights; the position is measured."""
    model = LinearGaussian(
        [[1.0, 0.0], [0.0, 1.0]], [[0.1, 0.0], [0.0, 0.1]], [[1.0, 0.0]], [2.0], [0.0, 0.0], [[2.0, 0.0], [0.8, 0.4]],
        names=("position", "velocity"),
    )  # fmt: skip
    y, draws = torch.tensor([[4.0]], dtype=torch.float64), PhiloxStream(3, torch.arange(1))
    cloud = ParticleFilter(250).init(model, 1, draws)
    seen, control = (
        Record(y),
        DmcController(control_weight=1.0),
    )  # a gain of a half, so that the shift is visible
    plain = BootstrapProposal()(model, cloud, seen, draws.at_step(1))
    exact, _ = GaussianFilter(TaylorLinearisation()).step(
        model, GaussianFilter(TaylorLinearisation()).init(model, 1, draws), seen, draws
    )
    panels: dict[str, Proposal] = {
        "predicted (SIR)": BootstrapProposal(),
        "as printed: all are shifted": ReconstructedProposal(
            controller=control, weight_correction=NoWeightCorrection()
        ),
        "marginal: half shifted, weights corrected": ReconstructedProposal(controller=control),
    }
    figure, axes = plt.subplots(
        1, 3, figsize=(12, 3.6), sharex=True, sharey=True, layout="constrained"
    )
    for axis, (title, proposal) in zip(axes, panels.items(), strict=True):
        sent = proposal(model, cloud, seen, draws.at_step(1))
        log_w = model.log_likelihood(y, sent.x, ()) + sent.log_ratio
        after = ParticleBelief(sent.x, log_w.log_softmax(1), cloud.log_evidence)
        moved = (sent.x != plain.x).any(-1)[0]
        size = 250 * 12 * normalise_log_weights(after.log_w)[0]
        for group, colour in ((~moved, "#0072B2"), (moved, "#E69F00")):
            axis.scatter(*sent.x[0, group].T, s=size[group], color=colour, alpha=0.6, linewidths=0)
        for mean, covariance, colour, label in (
            (exact.mean[0], exact.covariance[0], "#009E73", "exact posterior"),
            (
                *(part[0] for part in weighted_mean_cov(model.chart, after)),
                "#D55E00",
                "weighted particles",
            ),
        ):
            axis.plot(*_ellipse(mean, covariance), color=colour, label=f"{label}, 2 sd")
        axis.axvline(4.0, color="0.6", linewidth=1, linestyle=":")
        axis.set_title(title, fontsize=11)
        axis.set(xlabel="position (measured, dotted)")
    axes[0].set_ylabel("velocity (not measured)")
    axes[0].legend(loc="upper left", frameon=False)
    figure.savefig(PAGES / "dmc_reconstructed.png", dpi=80)


def mssrckf() -> None:
    """Points of four rules in two dimensions, and what they make of a turn by an uncertain angle."""
    rules = {
        "CKF": (SphericalRadialPoints(AxisDegree3(), RadialDegree3()), "#0072B2"),
        "SSRCKF": (SphericalRadialPoints(SimplexDegree3(), RadialDegree3()), "#009E73"),
        "MSSRCKF": (SphericalRadialPoints(SimplexDegree3(), RadialDegree5()), "#D55E00"),
        "HCKF": (SphericalRadialPoints(AxisDegree5(), RadialDegree5()), "#CC79A7"),
    }
    spread = torch.diag(torch.tensor([0.12, 0.7], dtype=torch.float64))  # distance, direction
    middle = torch.tensor([2.0, math.pi / 2], dtype=torch.float64)
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.4, 4.0), layout="constrained")
    polar = (
        middle
        + torch.randn(4000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        @ spread
    )
    cloud = torch.stack(
        [polar[:, 0] * torch.cos(polar[:, 1]), polar[:, 0] * torch.sin(polar[:, 1])], -1
    )
    right.scatter(*cloud.T, s=1.5, color="0.75", rasterized=True)
    right.plot(
        *_ellipse(cloud.mean(0), torch.cov(cloud.T)),
        color="0.35",
        linestyle="--",
        label="moments of the sample",
    )
    for (name, (rule, colour)), mark in zip(rules.items(), "s^oD", strict=True):
        xi, w, _ = rule(2)
        left.scatter(
            *xi.T, s=300 * w.abs(), marker=mark, facecolors="none", edgecolors=colour, label=name
        )
        at = middle + xi @ spread
        moved = torch.stack([at[:, 0] * torch.cos(at[:, 1]), at[:, 0] * torch.sin(at[:, 1])], -1)
        mean = w @ moved
        right.plot(
            *_ellipse(mean, (w[:, None] * (moved - mean)).T @ (moved - mean)),
            color=colour,
            label=name,
        )
    left.set(
        aspect="equal",
        title="points for N(0, I), area by weight",
        xlim=(-2.9, 2.9),
        ylim=(-2.5, 3.8),
    )
    left.set(xlabel="state 1 in sd", ylabel="state 2 in sd")
    right.set(aspect="equal", title="after a turn: ellipses of 2 sd", xlabel="east", ylabel="north")
    left.legend(fontsize=8, loc="upper center", ncols=4, columnspacing=0.7, handletextpad=0.1)
    right.legend(fontsize=8, loc="lower center")
    figure.savefig(PAGES / "mssrckf.png", dpi=80)


def fm_mssrckf() -> None:
    """Errors of 300 runs in the last step of a burst of process noise, with the covariances of the filters."""
    figure = _errors(
        {
            "MSSRCKF": ((), ()),
            "S = 1.05": ((FadingMemory(1.05),), ()),
            "S and alpha": ((FadingMemory(1.05),), (AdaptiveFactorGain(),)),
        },
        q=400.0,
    )
    figure.savefig(PAGES / "fm_mssrckf.png", dpi=80)


def fm_mssrckf_step() -> None:
    """One step with a large velocity innovation: effect of the adaptive factor, as printed and as repaired."""
    model = LinearGaussian(
        [[1.0, 1.0], [0.0, 1.0]],
        torch.eye(2) * 1e-3,
        torch.eye(2),
        [10.0, 0.1],
        [0.0, 0.0],
        [6.0, 0.15],
    )
    start, y = (
        torch.diag(torch.tensor([36.0, 0.0225], dtype=torch.float64)),
        torch.tensor([[4.0, 1.2]], dtype=torch.float64),
    )
    belief = GaussianBelief(
        torch.zeros(1, 2, dtype=torch.float64), start[None], torch.zeros(1, dtype=torch.float64)
    )
    ways = {
        "MSSRCKF": (),
        "FM, printed: W = I": (AdaptiveFactorGain(weight_by_noise=False),),
        "FM: W = 1/R": (AdaptiveFactorGain(),),
    }
    figure, axes = plt.subplots(
        1, 3, figsize=(9.0, 4.0), sharex=True, sharey=True, layout="constrained"
    )
    e = torch.randn(600, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    for at, (name, gains), colour in zip(
        axes, ways.items(), ("#0072B2", "#CC79A7", "#E69F00"), strict=True
    ):
        method = GaussianFilter(
            SigmaPointLinearisation(SphericalRadialPoints(SimplexDegree3(), RadialDegree5())),
            (FadingMemory(1.002),) if gains else (),
            gains,
        )
        new = method.advance(model, belief, Record(y))
        wide = new.innovation.predicted_covariance[
            0
        ]  # the measurement is the state: prediction with the factor
        cloud = e @ torch.linalg.cholesky(wide).mT
        at.scatter(*cloud.T, s=3, color="0.75", label="prediction with the factor")
        at.plot(
            *_ellipse(new.mean[0], new.root[0] @ new.root[0].mT),
            color=colour,
            label="2 sd after the step, in colour",
        )
        at.errorbar(
            *y.T,
            xerr=20.0,
            yerr=0.2,
            color="0.2",
            capsize=2,
            linewidth=1,
            label="measurement, 2 sd",
        )
        at.set(title=name, xlabel="position, m", xlim=(-45.0, 45.0), ylim=(-1.6, 1.8))
    axes[0].set_ylabel("velocity, m/s")
    figure.legend(
        *axes[0].get_legend_handles_labels(),
        fontsize=8,
        loc="outside lower center",
        ncols=3,
        frameon=False,
    )
    figure.savefig(PAGES / "fm_mssrckf_step.png", dpi=80)


def cofm_mssrckf() -> None:
    """Errors of 300 runs in the last step of a burst of measurement noise, and what the filters believe of them."""
    both = (FadingMemory(1.002), ConstrainedNoiseAdaptation())
    figure = _errors(
        {
            "MSSRCKF": ((), ()),
            "FM-MSSRCKF": (both[:1], (AdaptiveFactorGain(),)),
            "COFM-MSSRCKF": (both, (AdaptiveFactorGain(), BoundedRatioGain())),
            "COFM, printed": (
                (FadingMemory(1.002), MatrixNoiseAdaptation(0.99)),
                (AdaptiveFactorGain(weight_by_noise=False), BoundedRatioGain()),
            ),
        },
        r=9.5,
    )
    figure.savefig(PAGES / "cofm_mssrckf.png", dpi=80)


def _errors(
    methods: dict[str, tuple[tuple[NoiseAdaptation, ...], tuple[GainAdaptation, ...]]],
    r: float = 1.0,
    q: float = 1.0,
) -> Figure:
    """A walk in the plane measured by five equal sensors; the last 15 of 40 steps are a burst."""
    h = torch.tensor(
        [[1.0, 0.0], [0.8, 0.6], [0.5, -0.9], [0.2, 1.0], [-0.7, 0.4]], dtype=torch.float64
    )
    eye = torch.eye(2, dtype=torch.float64)
    model = LinearGaussian(eye, 0.3 * eye, h, [1.0] * 5, [0.0, 0.0], [1.0, 1.0])
    draws, runs, steps = torch.Generator().manual_seed(3), 300, 40
    burst = torch.arange(steps)[None, :, None] >= steps - 15
    moved = (
        0.3
        * torch.randn(runs, steps, 2, dtype=torch.float64, generator=draws)
        * torch.where(burst, math.sqrt(q), 1.0)
    )
    x = torch.randn(runs, 1, 2, dtype=torch.float64, generator=draws) + moved.cumsum(1)
    noise = torch.randn(runs, steps, 5, dtype=torch.float64, generator=draws) * torch.where(
        burst, math.sqrt(r), 1.0
    )
    size, colours = (3.0 * len(methods), 4.3), ("#0072B2", "#E69F00", "#009E73", "#CC79A7")
    figure, axes = plt.subplots(
        1, len(methods), figsize=size, sharex=True, sharey=True, layout="constrained"
    )
    for at, (name, (adaptations, gains)), colour in zip(
        axes, methods.items(), colours, strict=False
    ):
        method = GaussianFilter(
            SigmaPointLinearisation(SphericalRadialPoints(SimplexDegree3(), RadialDegree5())),
            adaptations,
            gains,
        )
        found = run_filter(
            method,
            model,
            Record(x @ h.mT + noise),
            PhiloxStream(0, torch.arange(runs)),
            lambda t, i: {"p": i.covariance()},
        )
        error = (found.mean - x)[:, -1]
        at.scatter(*error.T, s=5, color="0.6", label="errors")
        centre, believed = (
            torch.zeros(2, dtype=torch.float64),
            found.trace["p"][:, -1].median(0).values,
        )
        at.plot(
            *_ellipse(centre, torch.cov(error.T)), color="0.35", linestyle="--", label="sample 2 sd"
        )
        at.plot(*_ellipse(centre, believed), color=colour, label="2 sd of the filter, in colour")
        at.set(
            aspect="equal",
            title=f"{name}: RMSE {float(error.square().sum(-1).mean().sqrt()):.2f}",
            xlabel="error of state 1",
        )
    axes[0].set_ylabel("error of state 2")
    figure.legend(
        *axes[0].get_legend_handles_labels(),
        fontsize=8,
        loc="outside lower center",
        ncols=3,
        frameon=False,
    )
    return figure


def _ellipse(mean: Tensor, covariance: Tensor) -> Tensor:
    """Points at two standard deviations of a normal distribution in the plane, [2, 100]."""
    angle = torch.linspace(0.0, 2.0 * torch.pi, 100, dtype=mean.dtype)
    circle = torch.stack([torch.cos(angle), torch.sin(angle)])
    return mean[:, None] + 2.0 * torch.linalg.cholesky(covariance) @ circle


def cpso_escape() -> None:
    """Predicted particles after a chaotic swarm with escape factor, as printed and corrected; the position is measured."""
    model = LinearGaussian(
        [[1.0, 0.0], [0.0, 1.0]], [[0.1, 0.0], [0.0, 0.1]], [[1.0, 0.0]], [2.0], [0.0, 0.0], [[2.0, 0.0], [0.8, 0.4]],
        names=("position", "velocity"),
    )  # fmt: skip
    y, draws = torch.tensor([[4.0]], dtype=torch.float64), PhiloxStream(3, torch.arange(1))
    cloud = ParticleFilter(250).init(model, 1, draws)
    seen, plain = Record(y), BootstrapProposal()(model, cloud, Record(y), draws.at_step(1))
    exact, _ = GaussianFilter(TaylorLinearisation()).step(
        model, GaussianFilter(TaylorLinearisation()).init(model, 1, draws), seen, draws
    )
    printed = SwarmProposal(
        fitness=LikelihoodFitness(),
        coordinates=AllComponents(),
        limits=SwarmLimits(scale_by_prior=True, max_distance_sd=None),
        iterations=30,
        weighting=PrintedWeighting(),
    )
    panels: dict[str, Proposal] = {
        "predicted (SIR)": BootstrapProposal(),
        "as printed, 30 iterations": printed,
        "corrected: half drawn about the swarm": SwarmProposal(),
    }
    figure, axes = plt.subplots(
        1, 3, figsize=(12, 3.6), sharex=True, sharey=True, layout="constrained"
    )
    for axis, (title, proposal) in zip(axes, panels.items(), strict=True):
        sent = proposal(model, cloud, seen, draws.at_step(1))
        after = ParticleBelief(
            sent.x,
            (model.log_likelihood(y, sent.x, ()) + sent.log_ratio).log_softmax(1),
            cloud.log_evidence,
        )
        moved = ((sent.x - plain.x).abs() > 1e-9).any(-1)[0]
        size = 250 * 12 * normalise_log_weights(after.log_w)[0]
        for group, colour in ((~moved, "#0072B2"), (moved, "#E69F00")):
            axis.scatter(*sent.x[0, group].T, s=size[group], color=colour, alpha=0.6, linewidths=0)
        for mean, covariance, colour, label in (
            (exact.mean[0], exact.covariance[0], "#009E73", "exact posterior"),
            (
                *(part[0] for part in weighted_mean_cov(model.chart, after)),
                "#D55E00",
                "weighted particles",
            ),
        ):
            axis.plot(*_ellipse(mean, covariance), color=colour, label=f"{label}, 2 sd")
        axis.axvline(4.0, color="0.6", linewidth=1, linestyle=":")
        axis.set_title(title, fontsize=11)
        axis.set(xlabel="position (measured, dotted)", ylim=(-4, 8))
    axes[0].set_ylabel("velocity (not measured)")
    axes[0].legend(loc="upper left", frameon=False)
    figure.savefig(PAGES / "cpso_escape.png", dpi=80)


def enkf() -> None:
    """Members of a small ensemble before and after the update, with perturbed measurements and without."""
    model = LinearGaussian(
        [[1.0, 0.0], [0.0, 1.0]], [[0.1, 0.0], [0.0, 0.1]], [[1.0, 0.0]], [1.0], [0.0, 0.0], [[2.0, 0.0], [0.8, 0.4]],
        names=("position", "velocity"),
    )  # fmt: skip
    seen, draws = (
        Record(torch.tensor([[2.5]], dtype=torch.float64)),
        PhiloxStream(5, torch.arange(1)),
    )
    kalman = GaussianFilter(TaylorLinearisation())
    panels = {
        "perturbed measurements": EnsembleKalmanFilter(60),
        "square root": EnsembleKalmanFilter(60, EnsembleTransformUpdate()),
    }
    exact, _ = kalman.step(model, kalman.init(model, 1, draws), seen, draws)
    figure, axes = plt.subplots(
        1, 2, figsize=(9, 3.8), sharex=True, sharey=True, layout="constrained"
    )
    for axis, (title, method) in zip(axes, panels.items(), strict=True):
        before = method.init(model, 1, draws)
        after, info = method.step(model, before, seen, draws.at_step(1))
        start = BootstrapProposal()(model, before, seen, draws.at_step(1)).x[0]
        axis.plot(*torch.stack([start, after.x[0]]).permute(2, 0, 1), color="0.8", linewidth=0.7)
        axis.scatter(*start.T, s=10, color="#0072B2", label="predicted")
        axis.scatter(*after.x[0].T, s=10, color="#E69F00", label="updated")
        for mean, covariance, colour, label in (
            (exact.mean[0], exact.covariance[0], "#009E73", "Kalman, 2 sd"),
            (info.mean[0], info.covariance()[0], "#D55E00", "ensemble, 2 sd"),
        ):
            axis.plot(*_ellipse(mean, covariance), color=colour, label=label)
        axis.axvline(2.5, color="0.6", linewidth=1, linestyle=":")
        axis.set(title=title, xlabel="position (measured, dotted)")
    axes[0].set_ylabel("velocity (not measured)")
    axes[0].legend(loc="upper left", frameon=False)
    figure.savefig(PAGES / "enkf.png", dpi=80)


def rbpf() -> None:
    """40 particles, and 40 sampled positions, each with a normal distribution of the velocity."""
    model = LinearGaussian(
        [[1.0, 0.5], [0.0, 0.95]], [[0.8, 0.0], [0.0, 0.4]], [[1.0, 0.0]], [0.7], [0.0, 0.0], [1.0, 1.5],
        names=("position", "velocity"),
    )  # fmt: skip
    y, draws = (
        torch.tensor([[[0.4], [1.6], [2.0]]], dtype=torch.float64),
        PhiloxStream(4, torch.arange(1)),
    )
    exact = GaussianFilter(TaylorLinearisation()).init(model, 1, draws)
    for t in range(y.shape[1]):
        exact, _ = GaussianFilter(TaylorLinearisation()).step(model, exact, Record(y[:, t]), draws)
    figure, axes = plt.subplots(
        1, 2, figsize=(9, 3.8), sharex=True, sharey=True, layout="constrained"
    )
    panels = {
        "SIR, 40 particles": ParticleFilter(40),
        "RBPF, 40: position sampled, velocity normal": RaoBlackwellisedFilter(40, ["position"]),
    }
    for axis, (title, method) in zip(axes, panels.items(), strict=True):
        cloud = method.init(model, 1, draws)
        for t in range(y.shape[1]):
            cloud, info = method.step(model, cloud, Record(y[:, t]), draws.at_step(t + 1))
        if cloud.memory:
            sd = 2.0 * cloud.memory["root"][0, 0, 0, 0].abs()
            axis.errorbar(
                *cloud.x[0].T,
                yerr=sd,
                fmt="none",
                ecolor="#E69F00",
                elinewidth=1,
                label="conditional distribution, 2 sd",
            )
        axis.scatter(
            *cloud.x[0].T,
            s=40 * 16 * normalise_log_weights(cloud.log_w)[0],
            color="#0072B2",
            linewidths=0,
            zorder=3,
        )
        for mean, covariance, colour, label in (
            (exact.mean[0], exact.covariance[0], "#009E73", "Kalman, 2 sd"),
            (info.mean[0], info.covariance()[0], "#D55E00", "estimate, 2 sd"),
        ):
            axis.plot(*_ellipse(mean, covariance), color=colour, label=label)
        axis.set(title=title, xlabel="position (measured)")
    axes[0].set_ylabel("velocity (not measured)")
    axes[1].legend(loc="upper left", frameon=False)
    figure.savefig(PAGES / "rbpf.png", dpi=80)


def qmc_polymerised() -> None:
    """Weighted particles on a ridge across the axes before and after aggregation, as repaired and in two readings of eq. 18."""
    model, draws = _plain(2), PhiloxStream(5, torch.arange(1))
    z = draws.normal("x", 250, 2)
    x = torch.stack([z[..., 0] + 0.25 * z[..., 1], z[..., 0] - 0.25 * z[..., 1]], -1)
    cloud = ParticleBelief(
        x, (-(x[..., 0] - 1.0).square()).log_softmax(1), torch.zeros(1, dtype=torch.float64)
    )
    panels: dict[str, PolymerisedResampler | None] = {
        "weighted, whitened cells": None,
        "repaired: shares, pooled spread": PolymerisedResampler(),
        "eq. 18, counts by weight": PolymerisedResampler(placement=ScaledCentrePlacement()),
        "as printed: boxes, unchanged counts": PolymerisedResampler(
            AxisAlignedCells(), UnchangedAllocation(), ScaledCentrePlacement()
        ),
    }
    figure, axes = plt.subplots(
        1, 4, figsize=(13, 3.6), sharex=True, sharey=True, layout="constrained"
    )
    for axis, (title, resampler) in zip(axes, panels.items(), strict=True):
        _scatter_resampled(axis, model, cloud, resampler, title)
    w, (mean, covariance) = (
        normalise_log_weights(cloud.log_w),
        weighted_mean_cov(model.chart, cloud),
    )
    number = divide_cells(WhitenedCells(), x - mean.unsqueeze(1), w > 0, covariance)[0]
    shades = ["#0072B2", "#E69F00", "#009E73", "#CC79A7"]
    axes[0].collections[0].set_color([shades[int(k) % 4] for k in number])
    axes[1].legend(loc="lower right", frameon=False, fontsize=9)
    figure.savefig(PAGES / "qmc_polymerised.png", dpi=75)


def gpf() -> None:
    """Particles on a curve and the normal distribution of a Gaussian particle filter, by random and by Halton points."""
    model, draws = _plain(2), PhiloxStream(5, torch.arange(1))
    z = draws.normal("x", 250, 2)
    x = torch.stack([z[..., 0], z[..., 0].square() - 1.0 + 0.3 * z[..., 1]], -1)
    cloud = ParticleBelief(
        x, (-0.5 * (x[..., 0] - 0.5).square()).log_softmax(1), torch.zeros(1, dtype=torch.float64)
    )
    panels: dict[str, GaussianResampler | None] = {
        "weighted": None,
        "resampled at random": GaussianResampler(),
        "resampled on Halton points": GaussianResampler(HaltonPoints()),
    }
    figure, axes = plt.subplots(
        1, 3, figsize=(10.5, 3.6), sharex=True, sharey=True, layout="constrained"
    )
    for axis, (title, resampler) in zip(axes, panels.items(), strict=True):
        _scatter_resampled(axis, model, cloud, resampler, title)
    axes[1].legend(loc="lower right", frameon=False, fontsize=9)
    figure.savefig(PAGES / "gpf.png", dpi=75)


def _plain(d: int) -> LinearGaussian:
    """Some model of d plain numbers, for stages that ask for nothing else."""
    eye = torch.eye(d, dtype=torch.float64)
    return LinearGaussian(eye, eye, eye, [1.0] * d, [0.0] * d, [1.0] * d)


def _scatter_resampled(
    axis: Axes,
    model: LinearGaussian,
    belief: ParticleBelief,
    resampler: Resampler | None,
    title: str,
) -> None:
    """Particles [1, N, 2] before or after a resampler, areas by weight, with ellipses of 2 sd of both."""
    n = torch.full((1, 1), float(belief.x.shape[1]), dtype=torch.float64)
    after = (
        belief
        if resampler is None
        else resampler(model, belief, belief.log_w, n, PhiloxStream(6, torch.arange(1)))[0]
    )
    size = belief.x.shape[1] * 9 * normalise_log_weights(after.log_w)[0]
    axis.scatter(
        *after.x[0].T,
        s=size,
        color="#0072B2" if resampler is None else "#E69F00",
        alpha=0.7,
        linewidths=0,
    )
    for shown, colour, label in (
        (belief, "#009E73", "before, 2 sd"),
        (after, "#D55E00", "after, 2 sd"),
    ):
        mean, covariance = (part[0] for part in weighted_mean_cov(model.chart, shown))
        axis.plot(*_ellipse(mean, covariance), color=colour, label=label)
    axis.set_title(title, fontsize=11)
    axis.set_xlabel("state 1")
    if axis.get_subplotspec().is_first_col():
        axis.set_ylabel("state 2")


def mcmc_rpf() -> None:
    """Constant velocity with small noise: particles of few ancestors, smoothed, and moved, with the Kalman distribution."""
    model, n, steps = linear_walk(1.0, 0.01, 1.0), 200, 12
    draws, runs = PhiloxStream(4, torch.arange(1)), torch.ones(1, dtype=torch.bool)
    record = Record(
        0.3 * torch.arange(1.0, steps + 1).reshape(1, steps, 1).double()
        + draws.normal("y", steps, 1)
    )
    kept = Past(steps, store_noise=True)
    method, kalman = (
        ParticleFilter(n, EssResampler(Systematic(), 0.5)),
        GaussianFilter(TaylorLinearisation()),
    )
    cloud, law = method.init(model, 1, draws), kalman.init(model, 1, draws)
    cloud = kept.start(
        model, cloud, model.m0.expand(1, -1), (model.l0 @ model.l0.mT).expand(1, -1, -1)
    )
    size = method.particle_count(cloud)
    for t in range(steps):
        now, seen = draws.at_step(t + 1), record.at_step(t)
        cloud, _ = method.resampler(model, cloud, cloud.log_w, size, now)
        sent = method.proposal(model, cloud, seen, now)
        log_w = (cloud.log_w + model.log_likelihood(seen.y, sent.x, seen.u)).log_softmax(1)
        cloud = kept.append(model, cloud, cloud._replace(x=sent.x, log_w=log_w), sent.w, seen)
        law, _ = kalman.step(model, law, seen, now)
    copies, _ = EssResampler(Systematic(), 1.0)(model, cloud, cloud.log_w, size, draws)
    smoothed, _ = RegularisedResampler(EssResampler(Systematic(), 1.0))(
        model, cloud, cloud.log_w, size, draws
    )
    moved, _ = MetropolisHastings(NoiseFlowKernel(steps), 20)(model, copies, runs, draws)
    count = len(torch.unique(copies.x[0, :, 0]))
    panels = {
        f"resampled: {count} different particles": copies,
        "RPF as printed: smoothed": smoothed,
        "20 moves with the flow kernel": moved,
    }
    figure, axes = plt.subplots(
        1, 3, figsize=(12, 3.6), sharex=True, sharey=True, layout="constrained"
    )
    for axis, (title, shown), colour in zip(
        axes, panels.items(), ("#0072B2", "#E69F00", "#CC79A7"), strict=True
    ):
        axis.scatter(*shown.x[0].T, s=12, color=colour, alpha=0.7, linewidths=0)
        axis.plot(*_ellipse(law.mean[0], law.covariance[0]), color="#009E73", label="Kalman, 2 sd")
        mean, covariance = (part[0] for part in weighted_mean_cov(model.chart, shown))
        axis.plot(*_ellipse(mean, covariance), color="#D55E00", label="particles, 2 sd")
        axis.set_title(title, fontsize=11)
        axis.set_xlabel("position")
    axes[0].set_ylabel("velocity")
    axes[0].legend(frameon=False, fontsize=9)
    figure.savefig(PAGES / "mcmc_rpf.png", dpi=90)
    plt.close(figure)


def cofm_amssrcpf() -> None:
    """A position measured far from its prediction: children by three proposals, areas by weight."""
    model = linear_walk(1.0, 0.8, 0.3, (1.0, 1.0))
    guide, draws = GaussianFilter(TaylorLinearisation()), PhiloxStream(3, torch.arange(1))
    seen = Record(torch.tensor([[2.5]], dtype=torch.float64))
    exact, _ = guide.step(model, guide.init(model, 1, draws), seen, draws)
    panels: dict[str, Proposal] = {
        "model's noise (SIR)": BootstrapProposal(),
        "noise given parent and y": GuidedNoiseProposal(guide),
        "one guide for all particles": SharedGuideProposal(guide),
    }
    figure, axes = plt.subplots(
        1, 3, figsize=(12, 3.6), sharex=True, sharey=True, layout="constrained"
    )
    for axis, (title, proposal), colour in zip(
        axes, panels.items(), ("#0072B2", "#E69F00", "#CC79A7"), strict=True
    ):
        method = ParticleFilter(150, proposal=proposal)
        after, info = method.step(model, method.init(model, 1, draws), seen, draws.at_step(1))
        w = normalise_log_weights(after.log_w)[0]
        axis.scatter(*after.x[0].T, s=8.0 + 1500.0 * w, color=colour, alpha=0.5, linewidths=0)
        axis.plot(
            *_ellipse(exact.mean[0], exact.covariance[0]), color="#009E73", label="Kalman, 2 sd"
        )
        axis.set_title(f"{title}: ESS {float(info.trace['ess'][0]):.0f} of 150", fontsize=11)
        axis.set_xlabel("position")
    axes[0].set_ylabel("velocity")
    axes[0].legend(frameon=False, fontsize=9)
    figure.savefig(PAGES / "cofm_amssrcpf.png", dpi=90)
    plt.close(figure)


def escape_factor() -> None:
    """Figure 1 of Tian et al. and their chaotic map: the factor over the iterations, two sequences, the distribution of many."""
    blue, orange, most = "#0072B2", "#D55E00", 150  # iterations, as in their figure
    figure, (factor, orbit, histogram) = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
    k = np.arange(most + 1)
    intended = [
        swarm_motion.InertiaVelocity(escape_coefficient=0.12).compute_escape_factor(i / most)
        for i in k
    ]
    factor.plot(
        k,
        0.12 - 0.12 * np.cos(k * np.pi) / most,
        color=orange,
        ls="--",
        label="as printed [eq. 35]",
    )
    factor.plot(k, intended, color=blue, label="as intended: rises as in their figure")
    factor.set(title="escape factor c3 = c4", xlabel="iteration", ylabel="c3", ylim=(0, 0.26))
    factor.legend(fontsize=8, loc="upper left")

    z = torch.tensor([0.3, 0.3 + 1e-6], dtype=torch.float64)
    sequence = [z]
    for _ in range(40):
        sequence.append(swarm_motion.logistic_map(sequence[-1], z))
    both = torch.stack(sequence)
    orbit.plot(both[:, 0], color=blue, marker="o", ms=3, label="from 0.3")
    orbit.plot(both[:, 1], color=orange, ls="--", marker="s", ms=3, label="from 0.3 + 1e-6")
    orbit.set(title="z' = 4 z (1 - z) [eq. 31]", xlabel="iteration", ylabel="z")
    orbit.legend(fontsize=8, loc="lower left")

    generator = torch.Generator().manual_seed(1)
    values = swarm_motion.iterate_logistic(
        torch.rand(200_000, dtype=torch.float64, generator=generator)
    )
    histogram.hist(
        values.numpy(), bins=50, range=(0, 1), density=True, color="0.75", label="200 000 sequences"
    )
    at = np.linspace(0.004, 0.996, 400)
    histogram.plot(
        at, 1 / (np.pi * np.sqrt(at * (1 - at))), color=blue, label="arcsine distribution"
    )
    histogram.set(title="distribution after 50 iterations", xlabel="z", ylabel="density")
    histogram.legend(fontsize=8, loc="upper center")
    figure.savefig(PAGES / "escape_factor.png", dpi=80)
    plt.close(figure)


if __name__ == "__main__":
    pictures = [
        name
        for name, value in globals().items()
        if callable(value) and getattr(value, "__module__", "") == "__main__"
    ]
    for name in sys.argv[1:] or [name for name in pictures if not name.startswith("_")]:
        globals()[name]()
