"""Stone Soup: its particle filter, and its unscented filter by the cubature rule. Runs in an environment of its own.

    python peer_stonesoup.py sir|ckf WORKLOAD

Its updater can resample, but then nobody sees the weighted particles: here its resampler is called after it. It tells no
evidence of particles; that of the Gaussian filter is the density of each measurement under the library's prediction of it. Its
own cubature filter moves point after point, and a round takes it 62 s, which is too long; its unscented filter moves all points
together, in 16 s, and computes the same when the middle point has no weight. The library's arrays of states are [D, N].
"""

from __future__ import annotations

import sys
from datetime import datetime, timedelta
from importlib.metadata import version
from typing import Any

import numpy as np
from problems import GROWTH, RADAR, Problem
from scipy.stats import multivariate_normal
from stonesoup.base import Property
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.measurement.nonlinear import (
    CartesianToBearingRange,
    NonLinearGaussianMeasurement,
)
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.models.transition.nonlinear import GaussianTransitionModel
from stonesoup.predictor.kalman import UnscentedKalmanPredictor
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import SystematicResampler
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState, ParticleState
from stonesoup.updater.kalman import UnscentedKalmanUpdater
from stonesoup.updater.particle import ParticleUpdater
from worker import Filter, serve

START = datetime(2000, 1, 1)
RULE = {"alpha": 1.0, "beta": 0.0, "kappa": 0.0}  # no weight for the middle point


class Growth(GaussianTransitionModel):
    """W1's law of motion; the time tells the step."""

    problem: Problem = Property(doc="The workload.")

    @property
    def ndim_state(self) -> int:
        return 1

    def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
        t = int((state.timestamp - START).total_seconds())
        moved = self.problem.move(t, state.state_vector, 0.0)
        return moved + self.rvs(len(state)) if noise else moved

    def covar(self, **kwargs: Any) -> np.ndarray:
        return np.array([[GROWTH["process_sd"] ** 2]])


class Square(NonLinearGaussianMeasurement):
    """W1's measurement."""

    problem: Problem = Property(doc="The workload.")

    @property
    def ndim_meas(self) -> int:
        return 1

    def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
        seen = self.problem.see(state.state_vector, 0.0)
        return seen + self.rvs(len(state)) if noise else seen


def models(problem: Problem) -> tuple[Any, Any]:
    """Laws of motion and of measurement of W1 or W3.

    Raises:
        ValueError: another workload.
    """
    if problem.kind == "growth":
        spread = np.array([[GROWTH["measurement_sd"] ** 2]])
        return Growth(problem), Square(
            problem=problem, ndim_state=1, mapping=(0,), noise_covar=spread
        )
    if problem.kind != "radar":
        raise ValueError(f"kind={problem.kind}: this contestant takes growth and radar")
    gain, spread = problem.gain_t.T, np.diag([RADAR["bearing_sd"] ** 2, RADAR["range_sd"] ** 2])
    move = LinearGaussianTimeInvariantTransitionModel(
        transition_matrix=problem.phi_t.T, covariance_matrix=gain @ gain.T
    )
    return move, CartesianToBearingRange(
        ndim_state=4, mapping=(2, 0), noise_covar=spread
    )  # its bearings count from the first


def times(steps: int) -> list[datetime]:
    return [START + timedelta(seconds=t + 1) for t in range(steps)]


def sir(work: Any) -> Filter:
    problem, n = Problem(work, np), int(work.particles)
    move, see = models(problem)
    predictor, updater, resampler = (
        ParticlePredictor(move),
        ParticleUpdater(see),
        SystematicResampler(),
    )

    def run(seed: int) -> tuple[np.ndarray, np.ndarray]:
        np.random.seed(seed)
        chance, means = np.random.default_rng(seed), []
        for y in problem.y:
            x = StateVectors(problem.initial(chance.standard_normal((n, problem.d))).T)
            cloud, path = ParticleState(x, log_weight=np.full(n, -np.log(n)), timestamp=START), []
            for seen, time in zip(y, times(len(y)), strict=True):
                ahead = predictor.predict(cloud, timestamp=time)
                found = updater.update(
                    SingleHypothesis(ahead, Detection(StateVector(seen), timestamp=time))
                )
                path.append(np.asarray(found.mean, float).ravel())
                _variance, _ess = np.diag(found.covar), 1.0 / np.exp(2.0 * found.log_weight).sum()
                cloud = resampler.resample(found)
            means.append(path)
        return np.full(len(means), np.nan), np.array(means)

    return run


def ckf(work: Any) -> Filter:
    """Cubature filter on W4's model."""
    d = len(work.p0)
    predictors = []
    for step in work.step:
        phi, gain = step[:, :d], step[:, d:]
        law = LinearGaussianTimeInvariantTransitionModel(
            transition_matrix=phi, covariance_matrix=gain @ gain.T
        )
        predictors.append(UnscentedKalmanPredictor(law, **RULE))
    see = LinearGaussian(
        ndim_state=d, mapping=tuple(map(int, work.seen)), noise_covar=np.diag(work.r**2)
    )
    updater = UnscentedKalmanUpdater(see, **RULE)

    def run(seed: int) -> tuple[list[float], np.ndarray]:
        log_z, means = [], []
        for y in work.y:
            belief, total, path = (
                GaussianState(np.zeros(d), np.diag(work.p0**2), timestamp=START),
                0.0,
                [],
            )
            for predictor, seen, time in zip(predictors, y, times(len(y)), strict=True):
                ahead = predictor.predict(belief, timestamp=time)
                both = SingleHypothesis(ahead, Detection(StateVector(seen), timestamp=time))
                belief = updater.update(both)
                expected = both.measurement_prediction
                total += multivariate_normal.logpdf(seen, expected.mean.ravel(), expected.covar)
                path.append(np.asarray(belief.mean).ravel())
            log_z.append(total)
            means.append(path)
        return log_z, np.array(means)

    return run


def contestant(work: Any) -> tuple[Filter, dict[str, str]]:
    return (ckf if sys.argv[1] == "ckf" else sir)(work), {
        name: version(name) for name in ("stonesoup", "numpy")
    }


if __name__ == "__main__":
    serve(contestant)
