"""Errors of fixes that last: a Gauss-Markov process next to the motion, its share and its time from the innovations."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from torch.nn.functional import pad
from typing_extensions import override

from pfbench.core.density import independent_normal
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.linearisation_rules import TaylorLinearisation
from pfbench.filter.loop import run_filter
from pfbench.model.strapdown import StrapdownModel, block_diagonal
from pfbench.nav.strapdown import PreintegratedImu

_WHITE = (0.7, 0.4, 0.15, 0.05)  # shares of the standard deviation that are tried, and 1
_TIMES = (3.0, 6.0, 12.0, 24.0, 48.0, 96.0, 192.0)  # s, with each of them
_MOST_STEPS = 3000  # of the log, from its start on, that the fit takes: ten minutes of usual steps
_LEAST = 1e-3  # share of a slow error that is none, so that covariances have roots
_CLEAR = 100.0  # odds that white errors reach in one log of a hundred at most (Markov's inequality)


class LastingErrors(NamedTuple):
    """Errors of fixes with a part that lasts, by the innovations of the EKF.

    Attributes:
        white: White part of the stated standard deviation, 0 to 1.
        time_s: Time at which the correlation of the rest is 1/e, s.
        odds: Likelihood of errors that last, in the mean over what was tried, over that of white errors.
    """

    white: float
    time_s: float
    odds: float

    @property
    def is_clear(self) -> bool:
        """True if the innovations are not those of white errors."""
        return self.odds > _CLEAR


class SlowFixErrors(StrapdownModel):
    """A strapdown model whose position fixes have white errors, and slow ones as the last three states.

    The slow errors, East, North, Up, m, are Gauss-Markov processes. The variances of both parts add up to those that the
    model states, since innovations do not show the size of an error that lasts. A run can have its own share and time.

    Args:
        motion: Model of the motion, whose first three components are the position of a fix.
        white: White part of the standard deviations, [C], C = 1 or the number of runs.
        time_s: Correlation time of the slow errors, s, [C].
    """

    def __init__(self, motion: StrapdownModel, white: Tensor, time_s: Tensor) -> None:
        super().__init__()
        self.motion, self.white, self.time_s = motion, white[:, None, None], time_s[:, None, None]
        self.slow_sd = (1.0 - self.white**2).clamp(min=_LEAST**2).sqrt() * motion.r[:3]
        shares = pad(self.white.expand(-1, 1, 3), (0, len(motion.r) - 3), value=1.0)
        self.register_buffer("r", shares * motion.r)
        self.register_buffer("p0", torch.cat([motion.p0, motion.r[:3]]))
        self.further, self.noise_dim = motion.further + 3, motion.noise_dim + 3
        self.channel_names, self.choices = motion.channel_names, motion.choices
        self.names = (*motion.names, *(f"slow_fix_error_{axis}" for axis in "ENU"))
        self.units = (*motion.units, "m", "m", "m")
        first = len(motion.names)
        self.groups = {**motion.groups, "slow_fix_error": (first, first + 1, first + 2)}

    @override
    def prepare(self, record: Record) -> Record:
        return self.motion.prepare(record)

    @override
    def propagate(self, x: Tensor, u: PreintegratedImu, w: Tensor) -> Tensor:
        keep, gain = self._relax(u)
        slow = keep * x[..., -3:] + gain * w[..., -3:]
        return torch.cat([self.motion.propagate(x[..., :-3], u, w[..., :-3]), slow], -1)

    @override
    def noise_gain(self, u: PreintegratedImu) -> Tensor:
        slow, motion = torch.diag_embed(self._relax(u)[1][:, 0]), self.motion.noise_gain(u)
        assert motion is not None
        return block_diagonal(motion.expand(len(slow), -1, -1), slow)

    def _relax(self, u: PreintegratedImu) -> tuple[Tensor, Tensor]:
        """Return what remains of a slow error after a step, and the standard deviation of what comes, m, [C, 1, 1 or 3]."""
        keep = torch.exp(-u.duration[:, None, None] / self.time_s)
        return keep, torch.sqrt(1.0 - keep**2) * self.slow_sd

    @override
    def observation(self, x: Tensor, u: PreintegratedImu) -> Distribution:
        mean = self.motion.observation(x[..., :-3], u).mean
        return independent_normal(mean + pad(x[..., -3:], (0, mean.shape[-1] - 3)), self.r)

    def start(self, record: Record) -> Record:
        """Add slow errors to starts, whose position is that of fixes and has these errors with the other sign.

        Args:
            record: Record with start [R, D] and spread [R, d, d] of the motion. R is 1 for all members of a grid.

        Returns:
            The record for this model.
        """
        start, root = record.start, record.spread
        assert start is not None
        assert root is not None
        runs, d = max(len(root), len(self.white)), root.shape[-1]
        # of the position, which are rows 6 to 8, only the white part is independent of the slow errors
        white = pad(self.white.expand(-1, 3, 1) - 1.0, (0, 0, 6, d - 9)) + 1.0
        slow = torch.diag_embed(self.slow_sd[:, 0].expand(runs, 3))
        effect = pad(slow, (0, 0, d, 0)) - pad(slow, (0, 0, 6, d - 6))
        covariance = pad((white * root) @ (white * root).mT, (0, 3, 0, 3)) + effect @ effect.mT
        return record._replace(
            y=record.y.expand(runs, -1, -1),
            start=pad(start, (0, 3)).expand(runs, -1),
            spread=torch.linalg.cholesky(covariance),
        )


def fit_lasting_errors(motion: StrapdownModel, record: Record) -> LastingErrors:
    """Fit share and time of the errors that last to the innovations of a log, by their mean over a grid.

    White errors have the weight of all others together before the log is seen. Each member of the grid is a run of an EKF.

    Args:
        motion: Model of the motion.
        record: Record of one run, [1, T, Dy], with a start and its standard deviations.

    Returns:
        The errors.
    """
    tried = torch.tensor([(1.0, 1.0), *product(_WHITE, _TIMES)], dtype=torch.float64)
    model, runs = SlowFixErrors(motion, *tried.T), len(tried)
    draws, method = PhiloxStream(0, torch.arange(runs)), GaussianFilter(TaylorLinearisation())
    started = model.start(record.select_steps(slice(_MOST_STEPS)))
    evidence = run_filter(method, model, started, draws).log_evidence
    evidence[1:] -= torch.tensor(runs - 1.0).log()
    weight, odds = torch.softmax(evidence, 0), evidence[1:].logsumexp(0) - evidence[0]
    # in a long log of white errors no weight but theirs is a number
    white, slow = (weight * tried[:, 0] ** 2).sum(), (weight + 1e-300) * (1.0 - tried[:, 0] ** 2)
    time_s = torch.exp((slow * tried[:, 1].log()).sum() / slow.sum())
    return LastingErrors(float(white.sqrt()), float(time_s), float(odds.exp()))
