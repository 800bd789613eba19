"""Draws from a posterior: table, convergence, picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from pyro.ops.stats import effective_sample_size, hpdi, split_gelman_rubin
from scipy.stats import gaussian_kde
from torch import Tensor

from pfbench.report.canvas import COLUMN, RC, legend, looks

WELL_MIXED = 1.05  # split r-hat; above it chains have not met


@dataclass(frozen=True)
class Posterior:
    """Draws of the unknown numbers.

    Attributes:
        draws: {name: [chains, S]}, or [chains, S, R] where runs have numbers of their own.
        accepted: share of proposals that were accepted [chains] or [chains, R]; None where nothing is proposed.
        how: by which algorithm, for captions.
    """

    draws: Mapping[str, Tensor]
    accepted: Tensor | None = None
    how: str = ""

    def told(self) -> dict[str, Any]:
        """As JSON can hold it; `heard` is the way back."""
        accepted = None if self.accepted is None else self.accepted.tolist()
        return {"draws": {name: a.tolist() for name, a in self.draws.items()}, "accepted": accepted, "how": self.how}

    @staticmethod
    def heard(told: Mapping[str, Any]) -> Posterior:
        """The posterior that told so."""
        draws = {name: torch.tensor(a, dtype=torch.float64) for name, a in told["draws"].items()}
        accepted = None if told["accepted"] is None else torch.tensor(told["accepted"], dtype=torch.float64)
        return Posterior(draws, accepted, told["how"])

    def run(self, r: int) -> Posterior:
        """Of one run that has numbers of its own."""
        accepted = None if self.accepted is None else self.accepted[..., r]
        return Posterior({name: a[..., r] for name, a in self.draws.items()}, accepted, self.how)

    def flat(self, name: str) -> Tensor:
        """Draws of all chains in one line [chains S]."""
        return self.draws[name].flatten(0, 1)

    def table(self, mass: float = 0.9) -> pd.DataFrame:
        """A row per number: mean, sd, median, the narrowest interval of this mass, split r-hat and effective sample size.

        Convergence is what Pyro makes of the chains; r-hat is NaN and the effective size that of independent draws where there
        are no chains to compare (SVI, or fewer than four draws).

        Raises:
            ValueError: runs with numbers of their own; ask run(r).
        """
        rows = {}
        for name, a in self.draws.items():
            if a.dim() != 2:
                raise ValueError("table: runs have numbers of their own here; ask posterior.run(r).table()")
            flat = a.flatten().double()
            low, high = hpdi(flat, mass).tolist()
            chained = self.accepted is not None and a.shape[1] >= 4
            rows[name] = {
                "mean": float(flat.mean()), "sd": float(flat.std()), "median": float(flat.median()), "low": low, "high": high,
                "r_hat": float(split_gelman_rubin(a.double())) if chained else np.nan,
                "ess": float(effective_sample_size(a.double())) if chained else float(flat.numel()),
            }  # fmt: skip
        return pd.DataFrame.from_dict(rows, orient="index")

    @property
    def mixed(self) -> bool:
        """Have the chains of all numbers met: split r-hat below 1.05? True without chains, False with fewer than four draws."""
        if self.accepted is None:
            return True
        drawn = [a.double() for a in self.draws.values()]
        return all(a.shape[1] >= 4 and bool((split_gelman_rubin(a) < WELL_MIXED).all()) for a in drawn)


def picture(
    posteriors: Mapping[str, Posterior], prior: Mapping[str, Any], truth: Mapping[str, float] | None = None,
    names: Mapping[str, str] | None = None,
) -> Figure:  # fmt: skip
    """Traces of the chains and densities of the draws, a row for each number, an algorithm a colour; dotted is the prior.

    Args:
        posteriors: by label.
        prior: laws of the numbers.
        truth: by number, where it is known: a vertical line.
        names: what to call a number at its axes, with its unit; None as in the prior.
    """
    truth, called = truth or {}, {name: name.replace("_", " ") for name in prior} | dict(names or {})
    drawn = looks(list(posteriors))
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(2 * COLUMN, 0.3 + 1.5 * len(prior)), layout="constrained")
        axes = figure.subplots(len(prior), 2, squeeze=False, width_ratios=(1.4, 1.0))
        for (trace, density), name in zip(axes, prior, strict=True):
            for label, posterior in posteriors.items():
                chains = posterior.draws[name].double().numpy()
                if posterior.accepted is not None:
                    share = np.linspace(0.0, 100.0, chains.shape[1])
                    for chain in chains:
                        trace.plot(share, chain, color=drawn[label].colour, linewidth=0.4, alpha=0.7)
                at, height = _density(chains.ravel())
                density.plot(at, height, color=drawn[label].colour, linestyle=drawn[label].dash, label=label)
            low, high = density.get_xlim()
            wide = torch.linspace(low, high, 200)
            wide = wide[prior[name].support.check(wide)]
            density.plot(wide, prior[name].log_prob(wide).exp(), color="0.5", linestyle=":", label="prior")
            if name in truth:
                density.axvline(truth[name], color="black", linewidth=0.8, label="truth")
            trace.set_ylabel(called[name])
            density.set_xlabel(called[name])
            density.set_yticks([])
        axes[0, 0].set_title("chains")
        axes[0, 1].set_title("density")
        axes[-1, 0].set_xlabel("draws kept, %")
        legend(figure, axes[0, 1], columns=len(posteriors) + 2)
    return figure


def _density(draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.quantile(draws, [0.001, 0.999])
    at = np.linspace(low, high, 200)
    return at, gaussian_kde(draws)(at)
