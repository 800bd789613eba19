"""Needs of a world: the best conventional filter in it, and whether Kalman filters fit it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from pfbench.config.named_sets import SUFFIX
from pfbench.config.paper_block import PAPER
from pfbench.job.tuning.candidate_search import (
    Candidate,
    CandidateSearch,
    TuningResult,
    with_candidate,
)
from pfbench.results.error_measures import Array

_UNTUNED = ("ekf", "ukf")  # conventional filters without knobs
_PARTICLE_FILTERS = ("sir", "rpf")
FIT_LIMIT = (
    0.95  # of the error of the best conventional filter, below which Kalman filters do not fit
)
_LEVEL = 0.05  # of the two intervals together
FIT_RULE = (
    "false if SIR or RPF has less than 0.95 of the error of the best filter: geometric mean over runs, "
    "Student interval without 0.95, 95 % for both together; errors are at most the cap, which a lost run has"
)
_NO_FIX = {"r_factor": 1e12, "q_factor": 1.0}  # dead reckoning


class Ratio(NamedTuple):
    """Error of a particle filter, divided by that of the best conventional filter.

    Attributes:
        value: Geometric mean over runs.
        low: Lower end of the interval.
        high: Upper end of the interval.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class WorldFit:
    """Best conventional filter of a world, and whether Kalman filters fit the world.

    Attributes:
        best: Name of the filter with the smallest objective.
        objectives: Objective by filter, with capped errors.
        cap: Largest error of a run, in the unit of the scenario.
        cap_source: What the cap is.
        regime: Noise regime of the ratios.
        particles: Number of particles.
        runs: Number of runs of the ratios.
        ratios: Ratios by particle filter.
    """

    best: str
    objectives: dict[str, float]
    cap: float
    cap_source: str
    regime: str
    particles: int
    runs: int
    ratios: dict[str, Ratio] = field(default_factory=dict)

    @property
    def kalman_fits(self) -> bool:
        """True if no particle filter is shown to have less than 0.95 of the error."""
        return decide_fit(self.ratios)


def decide_fit(ratios: Mapping[str, Ratio]) -> bool:
    """Return whether Kalman filters fit a world: no interval lies below 0.95.

    Args:
        ratios: Ratios by particle filter.
    """
    return not any(ratio.high < FIT_LIMIT for ratio in ratios.values())


def compare_errors(errors: Array, reference: Array, cap: float, filters: int = 1) -> Ratio:
    """Compare the errors of paired runs by the mean of their log ratios.

    Args:
        errors: Error of each run, [R]; infinite for a lost run.
        reference: Errors of the reference in the same runs, [R].
        cap: Largest error that counts.
        filters: Number of filters that share the level of 5 %.
    """
    difference = np.log(np.fmin(errors, cap)) - np.log(np.fmin(reference, cap))
    mean, runs = float(difference.mean()), len(difference)
    half = float(stats.t.ppf(1 - _LEVEL / filters / 2, runs - 1) * difference.std(ddof=1))
    half /= math.sqrt(runs)
    return Ratio(math.exp(mean), math.exp(mean - half), math.exp(mean + half))


def find_best(
    errors: Mapping[str, Mapping[str, float]], cap: float
) -> tuple[str, dict[str, float]]:
    """Find the filter with the smallest objective.

    Args:
        errors: Error by filter and regime, infinite if most runs are lost. The filter `ekf` is the reference.
        cap: Largest error that counts.

    Returns:
        The name, and the objective by filter.
    """

    def objective(values: Mapping[str, float]) -> float:
        return float(
            np.mean([math.log(min(e, cap) / min(errors["ekf"][r], cap)) for r, e in values.items()])
        )

    objectives = {name: objective(values) for name, values in errors.items()}
    return min(objectives, key=lambda name: objectives[name]), objectives


def measure_fit(
    search: CandidateSearch, results: list[TuningResult], runs: int, particles: int
) -> WorldFit:
    """Find the best conventional filter, and compare SIR and RPF with it in the first noise regime.

    Args:
        search: Search on the world.
        results: Results for all tuned filters.
        runs: Number of runs of the comparison, at most those of the search.
        particles: Number of particles.
    """
    regime = search.regimes[0]
    first = [f"runs={runs}", f"particles={particles}"]
    tuned = {f"{result.method}_{SUFFIX}": result.choice for result in results}
    errors = {name: _errors_of(search, name) for name in _UNTUNED}
    errors = {name: e for name, e in errors.items() if e}
    errors |= {name: choice.errors for name, choice in tuned.items()}
    cap, source, threshold = _find_cap(search, first)
    best, objectives = find_best(errors, cap)
    reference = _run(search, best, first, tuned.get(best), threshold)
    ratios = {}
    for name in _PARTICLE_FILTERS:
        search.progress(f"{name} particles={particles}")
        errors_of_runs = _run(search, name, first, threshold=threshold)
        ratios[name] = compare_errors(errors_of_runs, reference, cap, len(_PARTICLE_FILTERS))
    return WorldFit(best, objectives, cap, source, regime, particles, runs, ratios)


def _errors_of(search: CandidateSearch, name: str) -> dict[str, float]:
    """Return the error by regime of a filter without knobs, empty if the model does not support it."""
    if name == "ekf":
        return {regime: score.error for regime, score in search.reference.items()}
    search.progress(name)
    try:
        return search.score_method(name).errors
    except ValueError as error:
        search.progress(f"{name} cannot run: {error}")
        return {}


def _find_cap(search: CandidateSearch, words: list[str]) -> tuple[float, str, float]:
    """Return the cap, its source, and the divergence threshold of the scenario; infinite without one.

    Without a threshold the cap is the median error of dead reckoning: a filter that ignores all measurements.
    """
    config = search.compose("ekf_scaled", search.regimes[0])
    stated: Any = (config.values["scenario"].get(PAPER) or {}).get("divergence_threshold")
    if stated:
        return float(stated), "divergence threshold of the scenario", float(stated)
    search.progress("dead reckoning")
    errors = _run(search, "ekf_scaled", words, Candidate(_NO_FIX, 0.0, 0.0, {}))
    return float(np.median(errors)), "median error of dead reckoning", math.inf


def _run(
    search: CandidateSearch,
    name: str,
    words: list[str],
    choice: Candidate | None = None,
    threshold: float = math.inf,
) -> Array:
    """Run a filter in the first noise regime and return the error of each run."""
    config = search.compose(name.removesuffix(f"_{SUFFIX}"), search.regimes[0], words)
    return search.pass_alone(with_candidate(config, choice.values if choice else {}), threshold)
