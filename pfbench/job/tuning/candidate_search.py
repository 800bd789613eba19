"""Search of the knobs of a filter: all candidates, several noise regimes, seeds that no study scores."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from torch import Tensor

from pfbench.config.composition import JobConfig, compose
from pfbench.files.work_start import start_work
from pfbench.job.metadata import describe_state
from pfbench.job.tuning.joint_regimes import draw_batches
from pfbench.job.tuning.knobs import apply_candidate
from pfbench.model.base import StateSpaceModel
from pfbench.results.error_measures import Array, Flags, mean_per_run, rmse_per_run
from pfbench.results.state_groups import main_component_group
from pfbench.results.status import is_diverged

SEED_SHIFT = 1000  # seed of a tuning minus seed of the study
_RUNS_AT_ONCE = 400  # of all candidates and regimes in one pass, which bounds its memory
TIE = 0.01  # relative difference of two scores that calibration decides
OBJECTIVE = (
    "mean over regimes of log(median RMSE / median RMSE of the EKF), smallest; within 1 % the candidate whose "
    "NEES divided by its dimension is closest to 1"
)


class RegimeScore(NamedTuple):
    """Score of a filter in a noise regime.

    Attributes:
        error: Median over runs of the RMSE of the main group; a lost run counts as infinite.
        nees_ratio: Median over runs of the mean NEES of the main group, divided by its dimension.
    """

    error: float
    nees_ratio: float


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
        seconds: Computing time of all candidates.
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
        self.batches = draw_batches({r: self.compose("ekf", r) for r in self.regimes})
        _check_start(self.batches[0].episode.time, start_time_s)
        start_work()
        (self.reference,) = self._score([self.compose("ekf", self.regimes[0])])

    def tune(self, method: str, grid: Sequence[dict[str, float]]) -> TuningResult:
        """Search the knobs of a filter.

        Args:
            method: Name of the filter.
            grid: Values of all candidates by knob.

        Returns:
            The result.
        """
        candidates, self.seconds = [], 0.0
        config = self.compose(method, self.regimes[0])
        at_once = max(1, _RUNS_AT_ONCE // max(len(batch.runs) for batch in self.batches))
        for first in range(0, len(grid), at_once):
            some = grid[first : first + at_once]
            self.progress(f"{method}, candidates {first + 1} to {first + len(some)} of {len(grid)}")
            scores = self._score([with_candidate(config, values) for values in some])
            candidates += [self._rate(*pair) for pair in zip(some, scores, strict=True)]
        choice, seconds = choose_candidate(candidates), self.seconds
        untuned = self._rate({}, *self._score([config]))
        return TuningResult(method, choice, untuned, tuple(candidates), seconds)

    def _rate(self, values: dict[str, float], scores: Mapping[str, RegimeScore]) -> Candidate:
        """Rate a candidate by its scores in all regimes."""
        logs = [math.log(s.error / self.reference[r].error) for r, s in scores.items()]
        ratios = [math.log(s.nees_ratio) for s in scores.values()]
        return Candidate(
            values,
            float(np.mean(logs)),
            math.exp(float(np.mean(ratios))),
            {regime: s.error for regime, s in scores.items()},
        )

    def score_method(self, method: str) -> Candidate:
        """Run a filter without knobs in all regimes.

        Args:
            method: Name of the filter.
        """
        return self._rate({}, *self._score([self.compose(method, self.regimes[0])]))

    def pass_alone(self, config: JobConfig, threshold: float = math.inf) -> Array:
        """Run a filter in one regime and return the RMSE of each run [R], infinite for a lost or diverged run.

        Args:
            config: Configuration of the filter with its runs.
            threshold: Divergence threshold.
        """
        (batch,) = draw_batches({config.choices["noise"]: config})
        result = batch.pass_filter(config)
        data = result.arrays(batch.episode, None)
        error, lost = select_errors(data, result.model, slice(None), self.start_time_s)
        return rmse_per_run(error, lost | is_diverged(error, lost, threshold))

    def compose(self, method: str, regime: str, words: Sequence[str] = ()) -> JobConfig:
        """Compose the configuration of a filter.

        Args:
            method: Name of the filter.
            regime: Noise regime.
            words: Overrides that replace those of the search.
        """
        return compose([*self.words, f"filter={method}", f"noise={regime}", *words])

    def _score(self, configs: Sequence[JobConfig]) -> list[dict[str, RegimeScore]]:
        """Run filters in all regimes and compute the scores of each by regime."""
        scores: list[dict[str, RegimeScore]] = [{} for _ in configs]
        for batch in self.batches:
            is_alone = len(configs) == 1
            result = batch.pass_filter(configs[0]) if is_alone else batch.pass_candidates(configs)
            self.seconds += sum(result.seconds.get(name, 0.0) for name in ("scores", "filter"))
            data = result.arrays(batch.episode, None)
            for k, by_regime in enumerate(scores):
                for regime, runs in batch.list_runs():
                    start = k * len(batch.runs)
                    places = slice(start + runs.start, start + runs.stop)
                    by_regime[regime] = score_runs(data, result.model, places, self.start_time_s)
        return scores


def _check_start(time: Tensor, start_time_s: float) -> None:
    """Check that a step remains after the start time."""
    if not bool((time >= start_time_s).any()):
        raise ValueError(
            f"report.start_time_s must be at most {float(time[-1]):g} s, the end of the episode, "
            f"got {start_time_s:g} s. Use a smaller value."
        )


def with_candidate(config: JobConfig, values: Mapping[str, float]) -> JobConfig:
    """Return a configuration with the knobs of a candidate.

    Args:
        config: Configuration of a filter.
        values: Values by knob, empty for the filter as its file states it.
    """
    if not values:
        return config
    changed = copy.deepcopy(config.values)
    node = changed["filter"]
    node["noise_adaptations"] = apply_candidate(node["noise_adaptations"], values)
    return JobConfig(changed, config.choices, config.uses_shared_particles, config.trusted)


def score_runs(
    data: Mapping[str, np.ndarray], model: StateSpaceModel, runs: slice, start_time_s: float = 0.0
) -> RegimeScore:
    """Compute the score of some runs.

    Args:
        data: Arrays of a job, see `store.JobResult`.
        model: Model of the filter.
        runs: Places of the runs.
        start_time_s: Time before which errors do not count [s].
    """
    state = describe_state(model)
    group, steps = main_component_group(state), data["time"] >= start_time_s
    error, lost = select_errors(data, model, runs, start_time_s)
    number = list(state["groups"]).index(group.state_group)
    nees = mean_per_run(data["nees"][runs][:, steps, number].astype(float), lost)
    size = len(state["groups"][group.state_group])
    return RegimeScore(
        float(np.median(rmse_per_run(error, lost))), float(np.nanmedian(nees)) / size
    )


def select_errors(
    data: Mapping[str, np.ndarray], model: StateSpaceModel, runs: slice, start_time_s: float
) -> tuple[Array, Flags]:
    """Select the errors of the main group in displayed units [R, T, K], and the lost runs [R].

    Args:
        data: Arrays of a job, see `store.JobResult`.
        model: Model of the filter.
        runs: Places of the runs.
        start_time_s: Time before which errors do not count [s].
    """
    group, steps = main_component_group(describe_state(model)), data["time"] >= start_time_s
    error = data["error"][runs][:, steps][..., group.places].astype(float) * group.scale
    return error, np.asarray(data["lost"][runs], dtype=bool)
