"""Regimes that switch: which of several laws a series of errors obeyed, and when. Exact, by Pyro's DiscreteHMM."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pyro
import torch
from pyro.distributions import DiscreteHMM, Normal, Unit
from torch import Tensor

from pfbench.ppl.program import Law, Values
from pfbench.record import Record


@dataclass(frozen=True)
class Switching:
    """Independent normal errors of two sizes, nominal and surge, with a Markov chain that says which.

    Fits where what is seen is independent from instant to instant given the regime: errors of a sensor at rest or against a
    reference, or the innovations of a filter. The chain is summed over exactly, so that the program is differentiable.

    Args:
        sd: law of the nominal standard deviation.
        ratio: law of the surge's to it; above 1, or the two could change names.
        stay, surge_stay: laws of the probabilities to stay in the nominal regime, and in the surge.
    """

    sd: Law
    ratio: Law
    stay: Law
    surge_stay: Law

    @property
    def prior(self) -> dict[str, Law]:
        return {"sd": self.sd, "ratio": self.ratio, "stay": self.stay, "surge_stay": self.surge_stay}

    def program(self) -> Callable[[Record], Values]:
        """A Pyro program of the record whose y [R, T, Dy] are the errors, NaN where none is known; regimes hold for all Dy."""

        def run(record: Record) -> Values:
            values = {name: pyro.sample(name, law) for name, law in self.prior.items()}
            pyro.factor("evidence", self.chain(values, emission(record, values)).sum())
            return values

        return run

    def chain(self, values: Values, table: Tensor) -> Tensor:
        """log p(y_1:T) [R] by log densities of every instant under each regime [R, T, 2]."""
        stay, surge = values["stay"].double(), values["surge_stay"].double()
        steps = torch.stack([torch.stack([stay, 1.0 - stay]), torch.stack([1.0 - surge, surge])]).log()
        leave, come_back = 1.0 - stay, 1.0 - surge
        begin = torch.stack([come_back, leave]).log() - (leave + come_back).log()  # the chain's stationary law
        hmm = DiscreteHMM(begin, steps, Unit(table, validate_args=False), duration=table.shape[1])
        found: Tensor = hmm.log_prob(table.new_empty(*table.shape[:2], 0))
        return found

    def probability(self, record: Record, values: Values) -> Tensor:
        """Of the surge at each instant, given the whole record and these numbers [R, T].

        It is the derivative of log p(y_1:T) by the log density of that instant under that regime.
        """
        with torch.enable_grad():
            table = emission(record, values).detach().requires_grad_()
            (slope,) = torch.autograd.grad(self.chain(values, table).sum(), table)
        return slope[..., 1].detach()


def emission(record: Record, values: Values) -> Tensor:
    """Log densities of the errors under each regime [R, T, 2]; 0 where nothing is known."""
    seen = ~torch.isnan(record.y)
    sds = values["sd"].double() * torch.stack([torch.ones_like(values["ratio"]), values["ratio"]]).double()
    each = Normal(0.0, sds).log_prob(torch.where(seen, record.y, 0.0).unsqueeze(-1))
    return (each * seen.unsqueeze(-1)).sum(2)
