"""Posterior draws of parameters: table, diagnostics, plot, and simulation-based calibration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from pyro.ops.stats import effective_sample_size, hpdi, split_gelman_rubin
from scipy.stats import binom, chisquare, gaussian_kde
from torch import Tensor

from pfbench.core.parameter_checks import require
from pfbench.core.record import Record
from pfbench.filter.belief import Filter
from pfbench.ppl.likelihood import evaluate_fixes
from pfbench.ppl.parameterised_model import ParameterisedModel, check_inference_call
from pfbench.ppl.pyro_program import simulate
from pfbench.results.plotting import COLUMN, RC, add_legend, line_styles

WELL_MIXED = 1.05  #: upper limit of split r-hat for chains that agree


@dataclass(frozen=True)
class ParameterPosterior:
    """Draws of the parameters.

    Attributes:
        draws: Draws by parameter, [chains, S], or [chains, S, R] if runs have their own parameters.
        accepted: Acceptance rate, [chains] or [chains, R]; None without proposals.
        method: Algorithm, for captions.
        stats: Numbers of each draw, such as its log density `lp` or `diverging`, shaped as the draws.
    """

    draws: Mapping[str, Tensor]
    accepted: Tensor | None = None
    method: str = ""
    stats: Mapping[str, Tensor] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary that JSON can store and `from_dict` reads."""
        draws, stats = (
            {k: a.tolist() for k, a in group.items()} for group in (self.draws, self.stats)
        )
        accepted = None if self.accepted is None else self.accepted.tolist()
        return {"draws": draws, "accepted": accepted, "how": self.method, "stats": stats}

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> ParameterPosterior:
        """Build a posterior from the dictionary of `to_dict`."""
        rate = {} if content["accepted"] is None else {"": content["accepted"]}
        draws, stats, rates = (
            {k: torch.tensor(a, dtype=torch.float64) for k, a in group.items()}
            for group in (content["draws"], content.get("stats", {}), rate)
        )
        return ParameterPosterior(draws, rates.get(""), content["how"], stats)

    @staticmethod
    def join(posteriors: Sequence[ParameterPosterior]) -> ParameterPosterior:
        """Join the chains of several posteriors of one method."""
        draws, stats = (
            {k: torch.cat([group[k] for group in groups]) for k in groups[0]}
            for groups in ([p.draws for p in posteriors], [p.stats for p in posteriors])
        )
        rates = [p.accepted for p in posteriors if p.accepted is not None]
        return ParameterPosterior(
            draws, torch.cat(rates) if rates else None, posteriors[0].method, stats
        )

    def run(self, r: int) -> ParameterPosterior:
        """Return the posterior of run r, if runs have their own parameters."""
        accepted = None if self.accepted is None else self.accepted[..., r]
        return ParameterPosterior(
            {name: a[..., r] for name, a in self.draws.items()}, accepted, self.method
        )

    def pooled_draws(self, name: str) -> Tensor:
        """Return the draws of all chains, [chains S]."""
        return self.draws[name].flatten(0, 1)

    def table(self, mass: float = 0.9) -> pd.DataFrame:
        """Summarise each parameter in a row.

        Columns are mean, sd, median, the narrowest interval of this mass, split r-hat and effective
        sample size. Without chains to compare (SVI, or fewer than four draws) r-hat is NaN and the
        effective sample size is the number of draws.

        Args:
            mass: Probability of the interval.

        Returns:
            Table with the parameters as index.

        Raises:
            ValueError: If runs have their own parameters.
        """
        rows = {}
        for name, a in self.draws.items():
            require(a.dim() == 2, "table", "have parameters shared by all runs", "one set per run", "Use posterior.run(r).table().")  # fmt: skip
            flat = a.flatten().double()
            low, high = hpdi(flat, mass).tolist()
            chained = self.accepted is not None and a.shape[1] >= 4
            rows[name] = {
                "mean": float(flat.mean()),
                "sd": float(flat.std()),
                "median": float(flat.median()),
                "low": low,
                "high": high,
                "r_hat": float(split_gelman_rubin(a.double())) if chained else np.nan,
                "ess": float(effective_sample_size(a.double())) if chained else float(flat.numel()),
            }
        return pd.DataFrame.from_dict(rows, orient="index")

    def to_arviz(
        self,
        unknown: ParameterisedModel | None = None,
        method: Filter | None = None,
        record: Record | None = None,
    ) -> Any:
        """Return the draws as ArviZ reads them, with the axes chain, draw and, if runs have their own parameters, run.

        With all arguments there are also the measurements, as many draws of the prior as the posterior has, and the log density
        of each fix given those before it. This is what `loo` compares models by, which leaves out one of these terms at a
        time, not a fix of the record with what later ones say of it.

        Args:
            unknown: Model and prior of the draws.
            method: Filter of the likelihood.
            record: Measurements that were used.

        Returns:
            Inference data of ArviZ with the groups `posterior` and `sample_stats`, and with all arguments `log_likelihood`,
            `prior` and `observed_data`.

        Raises:
            ModuleNotFoundError: If ArviZ is not installed.
        """
        try:
            from arviz_base import from_dict
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "to_arviz must have arviz-base, got no such package. Install it: pip install pfbench[arviz]"
            ) from error
        groups, first = {"posterior": self.draws}, next(iter(self.draws.values()))
        stats = dict(self.stats)
        if self.accepted is not None:
            stats["acceptance_rate"] = self.accepted.unsqueeze(1).expand(first.shape)
        groups |= {"sample_stats": stats} if stats else {}
        if unknown is not None and method is not None and record is not None:
            values = {name: a.flatten(0, 1) for name, a in self.draws.items()}
            terms = evaluate_fixes(unknown, method, record, values)
            prior = unknown.sample(first[..., 0].numel() if first.dim() == 3 else first.numel(), 0)
            groups["log_likelihood"] = {"y": terms.unflatten(0, first.shape[:2])}
            groups["prior"] = {name: a.view(first.shape[:2]) for name, a in prior.items()}
            groups["observed_data"] = {"y": record.y}
        by_group = {
            k: {name: a.double().numpy() for name, a in g.items()} for k, g in groups.items()
        }
        dims = {name: ["run"] for name, a in by_group["posterior"].items() if a.ndim == 3}
        return from_dict(by_group, dims=dims, attrs={"posterior": {"method": self.method}})

    @property
    def has_converged(self) -> bool:
        """True if split r-hat of all parameters is below 1.05.

        Also true without chains. False with fewer than four draws.
        """
        if self.accepted is None:
            return True
        samples = [a.double() for a in self.draws.values()]
        return all(
            a.shape[1] >= 4 and bool((split_gelman_rubin(a) < WELL_MIXED).all()) for a in samples
        )


def plot_posterior(
    posteriors: Mapping[str, ParameterPosterior],
    prior: Mapping[str, Any],
    truth: Mapping[str, float] | None = None,
    names: Mapping[str, str] | None = None,
) -> Figure:
    """Plot traces of the chains and densities of the draws, a row for each parameter.

    The dotted line is the prior density.

    Args:
        posteriors: Posteriors by label; each label has a colour.
        prior: Prior distributions by parameter.
        truth: True values by parameter, drawn as vertical lines.
        names: Axis labels by parameter, with units; None uses the parameter names.

    Returns:
        Figure.
    """
    truth = truth or {}
    axis_labels = {name: name.replace("_", " ") for name in prior} | dict(names or {})
    styles = line_styles(list(posteriors))
    with matplotlib.rc_context(RC):
        size = (2 * COLUMN, 0.3 + 1.5 * len(prior))
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(len(prior), 2, squeeze=False, width_ratios=(1.4, 1.0))
        for (trace, density), name in zip(axes, prior, strict=True):
            for label, posterior in posteriors.items():
                _plot_draws(trace, density, posterior, name, label, styles[label])
            low, high = density.get_xlim()
            x = torch.linspace(low, high, 200)
            x = x[prior[name].support.check(x)]
            density.plot(
                x, prior[name].log_prob(x).exp(), color="0.5", linestyle=":", label="prior"
            )
            if name in truth:
                density.axvline(truth[name], color="black", linewidth=0.8, label="truth")
            trace.set_ylabel(axis_labels[name])
            density.set_xlabel(axis_labels[name])
            density.set_yticks([])
        axes[0, 0].set_title("chains")
        axes[0, 1].set_title("density")
        axes[-1, 0].set_xlabel("stored draws [%]")
        add_legend(figure, axes[0, 1], columns=len(posteriors) + 2)
    return figure


def _plot_draws(
    trace: Any, density: Any, posterior: ParameterPosterior, name: str, label: str, style: Any
) -> None:
    """Plot chains and density of one parameter."""
    chains = posterior.draws[name].double().numpy()
    if posterior.accepted is not None:
        percent = np.linspace(0.0, 100.0, chains.shape[1])
        for chain in chains:
            trace.plot(percent, chain, color=style.colour, linewidth=0.4, alpha=0.7)
    low, high = np.quantile(chains, [0.001, 0.999])
    x = np.linspace(low, high, 200)
    density.plot(x, gaussian_kde(chains.ravel())(x), color=style.colour, linestyle=style.dash, label=label)  # fmt: skip


# --------------------------------------------------------------------------------------------------
# Simulation-based calibration of inference algorithms.
#
# Parameters come from the prior, measurements from the model with these parameters, and draws from
# the algorithm under test. All data sets are runs of one batch. If the algorithm is correct, the
# rank of each parameter among its draws is uniform [Talts, Betancourt, Simpson, Vehtari and Gelman
# 2018, "Validating Bayesian inference algorithms with simulation-based calibration"].

Infer = Callable[[Record], ParameterPosterior]


class SbcRanks(NamedTuple):
    """Ranks of true parameters among their draws.

    Attributes:
        ranks: Ranks by parameter, int64 [R], from 0 to `draws`.
        draws: Draws L of each data set.
    """

    ranks: Mapping[str, Tensor]
    draws: int

    def p_value(self, name: str, bins: int = 10) -> float:
        """Compute the p-value of a chi-square test that the ranks are uniform.

        Args:
            name: Parameter.
            bins: Number of equal bins; it divides draws + 1.

        Returns:
            The p-value.

        Raises:
            ValueError: If the bins do not divide the ranks evenly.
        """
        return float(chisquare(self.counts(name, bins)).pvalue)

    def counts(self, name: str, bins: int) -> np.ndarray:
        """Count the data sets with a rank in each of equal bins [bins].

        Args:
            name: Parameter.
            bins: Number of equal bins; it divides draws + 1.

        Returns:
            Counts, [bins].

        Raises:
            ValueError: If the bins do not divide the ranks evenly.
        """
        ranks = self.draws + 1
        require(
            not ranks % bins,
            "bins",
            f"divide {ranks}, the number of ranks of {self.draws} draws",
            bins,
            "Change bins or draws.",
        )
        return torch.bincount(self.ranks[name] * bins // ranks, minlength=bins).numpy()


def simulation_based_calibration(
    unknown: ParameterisedModel, template: Record, infer: Infer, draws: int = 19, seed: int = 0
) -> SbcRanks:
    """Compute ranks of simulated data sets, one for each run of the template.

    Args:
        unknown: Prior and model of the simulated data.
        template: Shape, inputs, starts and missing components of the records.
        infer: Algorithm under test, on a record whose runs have their own parameters. It may
            assume another model.
        draws: Draws L, evenly spaced among those of the algorithm. L must be much smaller than
            their number, or their autocorrelation changes the ranks.
        seed: Seed of the simulated data.

    Returns:
        Ranks of all parameters.

    Raises:
        ValueError: If a count is too small, or an argument is of another class.
    """
    check_inference_call(
        "simulation_based_calibration",
        unknown=(unknown, ParameterisedModel), template=(template, Record), infer=(infer, Callable), draws=(draws, 1), seed=(seed, 0),
    )  # fmt: skip
    truth = unknown.sample(len(template.y), seed)
    record, _ = simulate(unknown.models_per_run(truth)[0], template, seed)
    posterior = infer(record)
    ranks = {}
    for name, value in truth.items():
        samples = posterior.draws[name].flatten(0, 1)
        index = torch.linspace(0, len(samples) - 1, draws).round().long()
        ranks[name] = (samples[index] < value).sum(0)
    return SbcRanks(ranks, draws)


def sbc_histograms(ranks: Mapping[str, SbcRanks], bins: int = 10) -> Figure:
    """Plot rank histograms, a row for each parameter and a column for each label.

    The band contains 95 % of the bins of uniform ranks.

    Args:
        ranks: Ranks by label.
        bins: Number of bins.

    Returns:
        Figure.
    """
    labels, names = list(ranks), list(next(iter(ranks.values())).ranks)
    width = max(1.0, 0.5 * len(labels)) * COLUMN
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(width, 0.6 + 1.2 * len(names)), layout="constrained")
        axes = figure.subplots(len(names), len(labels), squeeze=False, sharex=True)
        for i, (row, name) in enumerate(zip(axes, names, strict=True)):
            for axis, label in zip(row, labels, strict=True):
                counts = ranks[label].counts(name, bins)
                low, high = binom.ppf([0.025, 0.975], counts.sum(), 1.0 / bins)
                axis.axhspan(low, high, color="0.85", linewidth=0)
                axis.bar((np.arange(bins) + 0.5) / bins, counts, width=0.9 / bins, color="#0072B2")
                text = f"p = {ranks[label].p_value(name, bins):.2g}"
                axis.set_title(f"{label}\n{text}" if i == 0 else text)
                axis.set_ylim(0, None)
            row[0].set_ylabel(name.replace("_", " "))
        figure.supxlabel("rank of the true value among its draws", fontsize=RC["font.size"])
    return figure
