"""Estimates of the posterior density of parameters by a filter."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pfbench.core.derived_stream import relabel
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import Filter
from pfbench.filter.exactness import check_has_evidence
from pfbench.filter.loop import run_filter
from pfbench.ppl.correlated_numbers import CorrelatedStream, StoredNumbers
from pfbench.ppl.parameterised_model import ParameterisedModel, Values

_START_ATTEMPTS = 20


class PosteriorEstimator:
    """Estimator of log p(z) + log p(y | z) for chains z [C, Q, P].

    Q is the number of runs R if they have separate parameters, otherwise 1.

    Args:
        unknown: Model and prior.
        method: Any filter.
        record: Measurements and inputs of R runs.
        chains: Number of chains C of each posterior.
        seed: Seed of all random numbers.
        separate_parameters: Whether each run has its own parameters.
        rho: Correlation of the filter's random numbers between iterations.
    """

    def __init__(
        self,
        unknown: ParameterisedModel,
        method: Filter,
        record: Record,
        chains: int,
        seed: int,
        separate_parameters: bool,
        rho: float,
    ) -> None:
        check_has_evidence(method, "pmmh")
        self.unknown, self.method = unknown, method
        self.seed, self.separate_parameters, self.rho = seed, separate_parameters, rho
        runs = len(record.y)
        self.shape = (chains, runs if separate_parameters else 1)
        self.runs_per_model = 1 if separate_parameters else runs
        self.record = repeat_runs(record, chains)
        self._stored: StoredNumbers = {}

    def __call__(self, z: Tensor, iteration: int) -> tuple[Tensor, CorrelatedStream | None]:
        """Estimate the log density, and return the random numbers if they are correlated.

        Args:
            z: Unconstrained parameters, [C, Q, P].
            iteration: Number of the iteration, for the random stream.

        Returns:
            Log density [C, Q], and the correlated stream or None.
        """
        values, log_prior = self.unknown.constrained(z.flatten(0, 1))
        is_valid = self.unknown.in_support(values) & torch.isfinite(log_prior)
        if not bool(is_valid.all()):  # any valid value serves: the proposal is rejected anyway
            medians = self._prior_medians()
            values = {name: torch.where(is_valid, a, medians[name]) for name, a in values.items()}
        runs = torch.arange(is_valid.numel() * self.runs_per_model)
        source = relabel(PhiloxStream(self.seed, runs), f"pmmh_{iteration}.")
        correlated = CorrelatedStream(source, self.rho, self._stored) if self.rho else None
        stream: Any = correlated or source
        model = self.unknown.models_per_run(values, self.runs_per_model)
        log_z = run_filter(self.method, model, self.record, stream).log_evidence
        log_z = log_z.view(-1, self.runs_per_model).sum(1)
        total = torch.where(is_valid & torch.isfinite(log_z), log_prior + log_z, -torch.inf)
        return total.view(self.shape), correlated

    def store_numbers(self, numbers: CorrelatedStream | None, is_accepted: Tensor) -> None:
        """Store the correlated random numbers of accepted chains.

        Args:
            numbers: Result of a call.
            is_accepted: Mask of the chains, [C, Q].
        """
        if numbers is not None:
            numbers.accept(is_accepted.flatten().repeat_interleave(self.runs_per_model))

    def draw_start(self, start: ParameterisedModel) -> tuple[Tensor, Tensor]:
        """Draw the starts of the chains, repeated while the filter is lost.

        Args:
            start: Model with the distributions of the starts.

        Returns:
            Unconstrained parameters [C, Q, P], and their log densities, [C, Q].

        Raises:
            ValueError: If the filter is lost for all starts of a chain.
        """
        log_p = torch.full(self.shape, -torch.inf, dtype=torch.float64)
        z = self._sample(start, 0)
        for attempt in range(_START_ATTEMPTS):
            is_lost = ~torch.isfinite(log_p)
            z = torch.where(is_lost.unsqueeze(-1), self._sample(start, attempt), z)
            new_log_p, numbers = self(z, -attempt - 1)
            self.store_numbers(numbers, is_lost)
            log_p = torch.where(is_lost, new_log_p, log_p)
            if bool(torch.isfinite(log_p).all()):
                return z, log_p
        lost = int((~torch.isfinite(log_p)).sum())
        raise ValueError(
            f"pmmh needs a start at which the filter is not lost, got {lost} chains lost at "
            f"{_START_ATTEMPTS} draws. Narrow the prior, or use more particles."
        )

    def start_covariance(self, start: ParameterisedModel) -> Tensor:
        """Return the covariance of the starts, [Q, P, P]."""
        z = self.unknown.unconstrained(start.sample(1000, self.seed))
        p = z.shape[-1]
        return torch.cov(z.T).view(1, p, p).repeat(self.shape[1], 1, 1)

    def _sample(self, start: ParameterisedModel, attempt: int) -> Tensor:
        values = start.sample(self.shape[0] * self.shape[1], self.seed + 7919 * (attempt + 1))
        return self.unknown.unconstrained(values).view(*self.shape, -1)

    def _prior_medians(self) -> Values:
        return {name: a.median() for name, a in self.unknown.sample(101, self.seed).items()}


def repeat_runs(record: Record, copies: int) -> Record:
    """Repeat all runs of a record.

    Args:
        record: Record of R runs.
        copies: Number of repetitions.

    Returns:
        Record of R `copies` runs, all runs in turn.
    """

    def repeat(a: Tensor) -> Tensor:
        return a.repeat(copies, *[1] * (a.dim() - 1))

    start, spread = (None if a is None else repeat(a) for a in (record.start, record.spread))
    u = map_inputs(lambda a: a if len(a) == 1 else repeat(a), record.u)
    return Record(repeat(record.y), u, start, spread, record.feedback)
