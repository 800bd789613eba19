"""Noise levels that switch by a Markov chain, by Pyro's DiscreteHMM."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pyro
import torch
from pyro.distributions import DiscreteHMM, Normal, Unit
from torch import Tensor

from pfbench.core.record import Record
from pfbench.ppl.parameterised_model import Prior, Values


@dataclass(frozen=True)
class SwitchingNoise:
    """Independent normal errors of two sizes, switched by a Markov chain.

    It fits errors that are independent from step to step given the regime: errors of a sensor at
    rest or against a reference, or innovations of a filter. The sum over the chain is exact, so
    the program is differentiable.

    Attributes:
        sd: Distribution of the nominal standard deviation.
        ratio: Distribution of the ratio of the surge's standard deviation to the nominal one.
            Values must exceed 1, or the regimes could exchange their meaning.
        stay: Distribution of the probability to stay in the nominal regime.
        surge_stay: Distribution of the probability to stay in the surge.
    """

    sd: Prior
    ratio: Prior
    stay: Prior
    surge_stay: Prior

    @property
    def prior(self) -> dict[str, Prior]:
        """Distributions of the parameters by name."""
        return {
            "sd": self.sd,
            "ratio": self.ratio,
            "stay": self.stay,
            "surge_stay": self.surge_stay,
        }

    def program(self) -> Callable[[Record], Values]:
        """Build a Pyro program of a record whose y [R, T, Dy] are the errors.

        NaN marks a missing error. A regime applies to all Dy components.
        """

        def run(record: Record) -> Values:
            values = {name: pyro.sample(name, prior) for name, prior in self.prior.items()}
            pyro.factor("evidence", self.chain(values, emission_distribution(record, values)).sum())
            return values

        return run

    def chain(self, values: Values, table: Tensor) -> Tensor:
        """Compute log p(y_1:T).

        Args:
            values: Parameters, [].
            table: Log densities of each step under each regime, [R, T, 2].

        Returns:
            Log evidence, [R].
        """
        stay, surge_stay = values["stay"].double(), values["surge_stay"].double()
        rows = [torch.stack([stay, 1.0 - stay]), torch.stack([1.0 - surge_stay, surge_stay])]
        log_transition = torch.stack(rows).log()
        to_surge, to_nominal = 1.0 - stay, 1.0 - surge_stay
        log_total = (to_surge + to_nominal).log()
        log_initial = torch.stack([to_nominal, to_surge]).log() - log_total  # stationary
        observation = Unit(table, validate_args=False)
        hmm = DiscreteHMM(log_initial, log_transition, observation, duration=table.shape[1])
        log_evidence: Tensor = hmm.log_prob(table.new_empty(*table.shape[:2], 0))
        return log_evidence

    def probability(self, record: Record, values: Values) -> Tensor:
        """Compute the probability of the surge at each step, given the whole record.

        It is the derivative of log p(y_1:T) by the log density of that step under that regime.

        Args:
            record: Errors, y [R, T, Dy].
            values: Parameters, [].

        Returns:
            Probabilities, [R, T].
        """
        with torch.enable_grad():
            table = emission_distribution(record, values).detach().requires_grad_()
            (gradient,) = torch.autograd.grad(self.chain(values, table).sum(), table)
        return gradient[..., 1].detach()


def emission_distribution(record: Record, values: Values) -> Tensor:
    """Compute log densities of the errors under each regime.

    Args:
        record: Errors, y [R, T, Dy].
        values: Parameters, [].

    Returns:
        Log densities, [R, T, 2]; 0 where all components are missing.
    """
    observed_mask = ~torch.isnan(record.y)
    ratios = torch.stack([torch.ones_like(values["ratio"]), values["ratio"]])
    sds = values["sd"].double() * ratios.double()
    y = torch.where(observed_mask, record.y, 0.0).unsqueeze(-1)
    return (Normal(0.0, sds).log_prob(y) * observed_mask.unsqueeze(-1)).sum(2)
