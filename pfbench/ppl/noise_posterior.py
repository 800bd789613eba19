"""Posterior of the noise numbers of a log: priors from data sheets, a table with verdicts, one value of each for a filter, scores."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pyro.distributions as laws
import torch
from matplotlib.figure import Figure
from scipy.stats import chi2
from torch import Tensor

from pfbench.core.random_stream import RandomStream
from pfbench.ppl.fix_filter import DENSITIES, LEVER, FixFilter
from pfbench.ppl.mixture_sampling import NoiseTarget, WeightedDraws, find_modes, sample_mixture
from pfbench.ppl.parameterised_model import constrain, draw_prior, unconstrain
from pfbench.ppl.priors import read_priors
from pfbench.results.plotting import COLUMN, PLAIN_COLOURS, RC

_UNITS = {
    "gyro_density": "rad/s/sqrt(Hz)", "accelerometer_density": "m/s^2/sqrt(Hz)", "gyro_bias_walk": "rad/s/sqrt(s)",
    "accelerometer_bias_walk": "m/s^2/sqrt(s)", "velocity_horizontal": "m/s", "velocity_vertical": "m/s", "delay": "s",
}  # fmt: skip
_VIBRATION = 5.0  # prior median of a density over that of the data sheet: sensors vibrate
_WALK_SHARE = 30.0  # prior median of a density over that of its bias walk
_SENSOR_FACTOR, _FIX_FACTOR = 10.0, 3.0  # one standard deviation of the logarithm
_LEVER_SD, _LONGEST_DELAY = 1.0, 0.5  # m, s
NOT_IDENTIFIED, CONFLICT = (
    0.8,
    2.5,
)  # posterior over prior deviation; shift of the mean in prior deviations
_LEVEL = 0.9


class NoiseFit(NamedTuple):
    """Posterior of noise numbers: density with its priors, and weighted draws."""

    target: NoiseTarget
    draws: WeightedDraws

    @property
    def values(self) -> dict[str, Tensor]:
        """Draws of the numbers, [S]."""
        return constrain(self.target.prior, self.draws.z)[0]

    def quantiles(self, name: str, levels: tuple[float, ...] = (0.05, 0.5, 0.95)) -> list[float]:
        """Return quantiles of a number."""
        draws, order = self.values[name], self.values[name].argsort()
        below = self.draws.weights[order].cumsum(0)
        at = torch.searchsorted(below, torch.tensor(levels).double()).clamp(max=len(order) - 1)
        return [float(draws[order[i]]) for i in at]


def make_noise_priors(
    numbers: Mapping[str, float], sheet: Mapping[str, float | None], replacements: Mapping[str, Any]
) -> dict[str, Any]:
    """Make priors of the noise numbers of a log.

    A density is log-normal about five times that of the data sheet, or about the number of the scenario without one. A bias
    walk is about a thirtieth of the density, a fix about the number of the scenario. `replacements` has priors by name or by quantiles that
    replace these.
    """
    priors: dict[str, Any] = {}
    for name, number in numbers.items():
        stated = sheet.get(name)
        if name in DENSITIES[:2]:
            priors[name] = _log_normal(number if stated is None else _VIBRATION * stated, _SENSOR_FACTOR)  # fmt: skip
        elif name in DENSITIES:
            density = priors[name.replace("bias_walk", "density")].loc.exp()
            priors[name] = _log_normal(density / _WALK_SHARE, _SENSOR_FACTOR)
        elif name == "delay":
            priors[name] = laws.Uniform(*torch.tensor([-_LONGEST_DELAY, _LONGEST_DELAY]).double())
        elif name in LEVER:
            priors[name] = laws.Normal(*torch.tensor([0.0, _LEVER_SD]).double())
        else:
            priors[name] = _log_normal(number, _FIX_FACTOR)
    must = "name noise numbers that change the fixes of this log"
    return priors | read_priors(replacements, numbers, lambda k: (0.0 if numbers[k] else -math.inf, math.inf), must)  # fmt: skip


def _log_normal(median: Any, factor: float) -> Any:
    """Return a log-normal distribution by its median and the factor of one standard deviation."""
    return laws.LogNormal(torch.as_tensor(median).double().log(), torch.tensor(factor).double().log())  # fmt: skip


def fit_noise(
    passes: FixFilter, prior: Mapping[str, Any], stream: RandomStream, draws: int, rounds: int
) -> NoiseFit:
    """Find modes and draw; mean and deviation of the prior are those of draws of it."""
    z = unconstrain(prior, {k: draw_prior(d, stream, f"prior.{k}", 4000)[0] for k, d in prior.items()})  # fmt: skip
    target = NoiseTarget(passes, prior, z.mean(0), z.std(0))
    return NoiseFit(target, sample_mixture(target, find_modes(target, stream), stream, draws, rounds))  # fmt: skip


def choose_values(fit: NoiseFit) -> dict[str, float]:
    """Choose one value of each number for a filter.

    For a standard deviation the root of the mean variance: the median of one that the log hardly determines is too small, and
    the filter too sure. Lever arm and delay are their means if the log distinguishes them from zero, else zero.
    """
    numbers: dict[str, float] = {}
    far = {name for name in fit.target.prior if math.prod(fit.quantiles(name, (0.05, 0.95))) > 0.0}
    for name, draws in fit.values.items():
        group = LEVER if name in LEVER else (name,)
        if name in LEVER or name == "delay":
            numbers[name] = float(fit.draws.weights @ draws) if far & set(group) else 0.0
        else:
            numbers[name] = math.sqrt(float(fit.draws.weights @ draws.square()))
    return numbers


def summarise_noise(fit: NoiseFit) -> dict[str, dict[str, Any]]:
    """Return the row of each number: posterior, prior, value for a filter, and a verdict on what the log says of it."""
    target, weights = fit.target, fit.draws.weights
    mean = weights @ fit.draws.z
    ratio = (weights @ (fit.draws.z - mean).square()).sqrt() / target.scale
    shift = (mean - target.centre) / target.scale
    levels = torch.tensor([[-1.645], [0.0], [1.645]]).double()
    priors, _ = constrain(target.prior, target.centre + levels * target.scale)
    plug_in, rows = choose_values(fit), {}
    for i, (name, (prior_low, prior, prior_high)) in enumerate(priors.items()):
        low, median, high = fit.quantiles(name)
        word = "not identified" if ratio[i] > NOT_IDENTIFIED else "prior conflict" if abs(shift[i]) > CONFLICT else ""  # fmt: skip
        rows[name] = {
            "prior low": float(prior_low), "prior": float(prior), "prior high": float(prior_high), "median": median, "low": low,
            "high": high, "value": plug_in[name], "sd/prior": float(ratio[i]), "unit": _UNITS.get(name, "m"), "note": word,
        }  # fmt: skip
    return rows


def score_settings(
    passes: FixFilter, settings: Mapping[str, Mapping[str, float]], first: int, truth: Tensor | None
) -> dict[str, dict[str, float]]:
    """Score settings of the noise numbers at the fixes from number `first` on, each predicted from those before it.

    `truth` has the positions at the fixes, [G, F, 3]; NaN or None without a reference. The share within 90 % is that of
    innovations below the quantile of their chi-squared distribution.
    """
    numbers = passes.numbers
    filled = {k: torch.tensor([s.get(k, numbers[k]) for s in settings.values()]).double() for k in numbers}  # fmt: skip
    terms = passes(filled)
    size = torch.isfinite(passes.record.y[:, passes.fix_steps]).sum(-1)[:, first:]
    used, nis = size > 0, terms.nis[:, :, first:]
    limit = torch.from_numpy(chi2.ppf(_LEVEL, size.clamp(min=1).numpy()))
    rows = {}
    for i, label in enumerate(settings):
        rows[label] = {
            "log score": float(terms.log_density[i, :, first:][used].mean()),
            "NIS/dim": float(nis[i][used].sum() / size.sum()),
            "NIS in 90 %": float((nis[i] < limit)[used].double().mean()),
        }
        if truth is not None and bool(torch.isfinite(truth[:, first:]).any()):
            rows[label] |= _score_positions(terms.position[i, :, first:] - truth[:, first:], terms.position_variance[i, :, first:])  # fmt: skip
    return rows


def _score_positions(error: Tensor, variance: Tensor) -> dict[str, float]:
    """Return the RMS of the horizontal and the vertical error, and the share of 90 % intervals that have the reference."""
    has_reference = torch.isfinite(error).all(-1)
    squares = error[has_reference].square()
    inside = squares < 1.645**2 * variance[has_reference]
    level, up = squares[:, :2].sum(-1).mean().sqrt(), squares[:, 2].mean().sqrt()
    return {"RMS level [m]": float(level), "RMS up [m]": float(up), "position in 90 %": float(inside.double().mean())}  # fmt: skip


def plot_noise(fit: NoiseFit) -> Figure:
    """Plot prior density and posterior histogram of each number; positive ones on a logarithmic axis."""
    with matplotlib.rc_context(RC):
        rows = -(-len(fit.target.prior) // 3)
        figure = Figure(figsize=(2 * COLUMN, 0.3 + 1.3 * rows), layout="constrained")
        axes = figure.subplots(rows, 3, squeeze=False).ravel()
        for axis in axes[len(fit.target.prior) :]:
            axis.axis("off")
        for i, (name, prior) in enumerate(fit.target.prior.items()):
            z, centre, scale = fit.draws.z[:, i].numpy(), fit.target.centre[i], fit.target.scale[i]
            edges = np.linspace(min(float(centre - 2.5 * scale), z.min()), max(float(centre + 2.5 * scale), z.max()), 61)  # fmt: skip
            at, log_density = constrain({name: prior}, torch.from_numpy(edges)[:, None])
            height = np.histogram(z, edges, weights=fit.draws.weights.numpy(), density=True)[0]
            axes[i].stairs(height, at[name].numpy(), fill=True, alpha=0.6, color=PLAIN_COLOURS[0], label="posterior")  # fmt: skip
            axes[i].plot(at[name], log_density.exp(), color="0.4", linestyle=":", label="prior")
            axes[i].set(xlabel=f"{name.replace('_', ' ')}\n[{_UNITS.get(name, 'm')}]", yticks=[])
            if isinstance(prior, laws.LogNormal):
                axes[i].set_xscale("log")
                axes[i].xaxis.get_major_locator().set_params(numticks=5)
            axes[i].xaxis.set_major_formatter(lambda value, _: f"{value:g}")
            axes[i].xaxis.set_minor_formatter("")
        axes[0].legend()
    return figure
