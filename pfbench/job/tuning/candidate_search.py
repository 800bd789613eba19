"""Search of the knobs of a filter: all candidates, several noise regimes, seeds that no study scores."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pfbench.config.composition import JobConfig, compose
from pfbench.job.run_job import run
from pfbench.job.tuning.knobs import apply_candidate
from pfbench.results import store
from pfbench.results.error_measures import mean_per_run, rmse_per_run
from pfbench.results.frame import drop_before
from pfbench.results.state_groups import main_component_group

SEED_SHIFT = 1000  # seed of a tuning minus seed of the study
TIE = 0.01  # relative difference of two scores that calibration decides
OBJECTIVE = (
    "mean over regimes of log(median RMSE / median RMSE of the EKF), smallest; within 1 % the candidate whose "
    "NEES divided by its dimension is closest to 1"
)
_PARTS = ("world", "scores", "filter")  # of the seconds of a job


class JobScore(NamedTuple):
    """Score of a job.

    Attributes:
        error: Median over runs of the RMSE of the main group; a lost run counts as infinite.
        nees_ratio: Median over runs of the mean NEES of the main group, divided by its dimension.
        seconds: Computing time of the job.
    """

    error: float
    nees_ratio: float
    seconds: float


@dataclass(frozen=True)
class Candidate:
    """A candidate with its scores.

    Attributes:
        values: Values by knob.
        log_ratio: Mean over regimes of log(error / error of the EKF in the regime).
        nees_ratio: Geometric mean over regimes of NEES divided by the dimension.
        errors: Error by regime.
    """

    values: dict[str, float]
    log_ratio: float
    nees_ratio: float
    errors: dict[str, float]


@dataclass(frozen=True)
class TuningResult:
    """Result of the search for one filter.

    Attributes:
        method: Name of the filter.
        choice: Candidate of the choice.
        untuned: The filter as its file states it, without a factor on R.
        candidates: All candidates.
        seconds: Computing time of the jobs of all candidates.
    """

    method: str
    choice: Candidate
    untuned: Candidate
    candidates: tuple[Candidate, ...]
    seconds: float


def choose_candidate(candidates: Sequence[Candidate]) -> Candidate:
    """Choose the candidate of the smallest error; within 1 % the best calibrated one.

    Args:
        candidates: Candidates with their scores.

    Raises:
        ValueError: If no candidate keeps half of its runs.
    """
    least = min(c.log_ratio for c in candidates)
    if not math.isfinite(least):
        raise ValueError(
            "the candidates must keep half of their runs, got none that does. Tune on another "
            "scenario or model."
        )
    near = [c for c in candidates if c.log_ratio <= least + math.log1p(TIE)]
    return min(near, key=lambda c: abs(math.log(c.nees_ratio)))


class CandidateSearch:
    """Search on one world.

    Args:
        words: Overrides that name scenario, model, runs and seed of the tuning.
        regimes: Noise regimes of equal weight.
        progress: Function that is called with the name of each filter and candidate.
        start_time_s: Time before which errors do not count [s].
    """

    def __init__(
        self,
        words: Sequence[str],
        regimes: Sequence[str],
        progress: Callable[[str], object] = lambda text: None,
        start_time_s: float = 0.0,
    ) -> None:
        self.words, self.regimes, self.progress = tuple(words), tuple(regimes), progress
        self.start_time_s, self.seconds = start_time_s, 0.0
        self.reference = {regime: self._score("ekf", regime, None) for regime in self.regimes}

    def tune(self, method: str, grid: Sequence[dict[str, float]]) -> TuningResult:
        """Search the knobs of a filter.

        Args:
            method: Name of the filter.
            grid: Values of all candidates by knob.

        Returns:
            The result.
        """
        candidates, self.seconds = [], 0.0
        for values in grid:
            self.progress(f"{method} {' '.join(f'{k}={v:g}' for k, v in values.items())}")
            candidates.append(self._try(method, values))
        choice, seconds = choose_candidate(candidates), self.seconds
        return TuningResult(method, choice, self._try(method, {}), tuple(candidates), seconds)

    def _try(self, method: str, values: dict[str, float]) -> Candidate:
        """Run a candidate in all regimes."""
        scores = {regime: self._score(method, regime, values) for regime in self.regimes}
        logs = [math.log(s.error / self.reference[r].error) for r, s in scores.items()]
        ratios = [math.log(s.nees_ratio) for s in scores.values()]
        return Candidate(
            values,
            float(np.mean(logs)),
            math.exp(float(np.mean(ratios))),
            {regime: s.error for regime, s in scores.items()},
        )

    def _score(self, method: str, regime: str, values: Mapping[str, float] | None) -> JobScore:
        """Run one job, or read its result."""
        config = compose([*self.words, f"filter={method}", f"noise={regime}"])
        score = score_job(run(_with_candidate(config, values)).path, self.start_time_s)
        self.seconds += score.seconds
        return score


def _with_candidate(config: JobConfig, values: Mapping[str, float] | None) -> JobConfig:
    """Return a configuration with the knobs of a candidate."""
    if not values:
        return config
    changed = copy.deepcopy(config.values)
    node = changed["filter"]
    node["noise_adaptations"] = apply_candidate(node["noise_adaptations"], values)
    return JobConfig(changed, config.choices, config.uses_shared_particles, config.trusted)


def score_job(path: Any, start_time_s: float = 0.0) -> JobScore:
    """Compute the score of a stored job.

    Args:
        path: File of the result.
        start_time_s: Time before which errors do not count [s].

    Returns:
        The score.
    """
    result = drop_before(store.read_result(path), start_time_s)
    group = main_component_group(result.meta["state"])
    lost = np.asarray(result.data["lost"], dtype=bool)
    error = result.data["error"][..., group.places].astype(float) * group.scale
    rmse = np.where(lost, np.inf, rmse_per_run(error, lost))
    number = list(result.meta["state"]["groups"]).index(group.state_group)
    nees = mean_per_run(result.data["nees"][..., number].astype(float), lost)
    size = len(result.meta["state"]["groups"][group.state_group])
    seconds = sum(result.meta["seconds"].get(part, 0.0) for part in _PARTS)
    return JobScore(float(np.median(rmse)), float(np.nanmedian(nees)) / size, seconds)
