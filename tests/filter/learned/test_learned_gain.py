"""KalmanNet: with the Kalman gain it is the Kalman filter, training approaches that gain, and it states no distribution."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from model_cases import tracker
from refusals import check_refused
from torch import Tensor, nn
from torch.distributions import Cauchy, Distribution, Independent

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    EvidenceLowerBound,
    LearnedProposal,
    ParticleFilter,
    SkipMlp,
    StateErrorLoss,
)
from pfbench.filter.exactness import check_has_evidence, has_covariance, has_evidence
from pfbench.filter.health import HEALTH
from pfbench.filter.learned.gain_filter import GainInputs, LearnedGain, LearnedGainFilter
from pfbench.filter.loop import FilterResult, apply_feedback, run_filter
from pfbench.job.scoring import ScoreRecorder
from pfbench.learn.trainer import Training, TrainingState
from pfbench.learn.training_data import TrainingData, draw_training_data
from pfbench.learn.training_job import train
from pfbench.model.linear_gaussian import LinearGaussian, local_level
from pfbench.noise.base import NominalNoise
from pfbench.scenario.simulated import ModelSimulation
from pfbench.testing import filter_record

LEVEL = local_level(0.5, 1.0, 0.0, 1.0)
HEAD = partial(SkipMlp, hidden=(16,))
NORMALISATIONS = ("length", "asinh")


def shaken(inputs: int, outputs: int) -> nn.Module:
    """A head with random weights, which stand for any result of training."""
    network = HEAD(inputs, outputs)
    with torch.no_grad():
        for weight in network.parameters():
            weight.add_(0.2 * torch.randn_like(weight))
    return network


def measurements(runs: int, steps: int = 12) -> Tensor:
    """Measurements of the tracker with gaps of one and of both components."""
    y = PhiloxStream(3, torch.arange(runs)).normal("y", steps, 2)
    y[:, 2:4, 0] = torch.nan
    y[:, 3:6, 1] = torch.nan
    return y


def filtered(method: LearnedGainFilter, y: Tensor, **options: Any) -> FilterResult:
    with torch.no_grad():
        return run_filter(
            method, tracker(), Record(y), PhiloxStream(1, torch.arange(len(y))), **options
        )


# the filter with a known gain


class KalmanGain(nn.Module):
    """The Kalman gains of a record, computed by numpy, times a factor."""

    hidden = 1

    def __init__(self, gains: np.ndarray, factor: float = 1.0) -> None:
        super().__init__()
        self.gains, self.factor = torch.tensor(gains), factor

    def forward(self, model: Any, inputs: GainInputs, past: Tensor) -> tuple[Tensor, Tensor]:
        t = int(past[0, 0])
        return self.factor * self.gains[t].expand(len(past), -1, -1), past + 1.0


def kalman_recursion(model: LinearGaussian, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means [T, D] and gains [T, D, k] of the Kalman filter on one record, in numpy."""
    f, g, h, r = (a.numpy() for a in (model.f, model.g, model.h, model.r))
    x, p = model.m0.numpy(), (model.l0 @ model.l0.T).numpy()
    means, gains = [], []
    for row in y:
        x, p = f @ x, f @ p @ f.T + g @ g.T
        seen = ~np.isnan(row)
        k = np.zeros((len(x), len(row)))
        k[:, seen] = p @ h[seen].T @ np.linalg.inv(h[seen] @ p @ h[seen].T + np.diag(r[seen] ** 2))
        x = x + k[:, seen] @ (row[seen] - h[seen] @ x)
        p = p - k @ h @ p
        means.append(x)
        gains.append(k)
    return np.array(means), np.array(gains)


def test_with_the_kalman_gain_it_is_the_kalman_filter() -> None:
    y = measurements(3)
    means, gains = zip(*(kalman_recursion(tracker(), run.numpy()) for run in y), strict=True)
    wanted = torch.tensor(np.array(means))
    assert np.allclose(gains[0], gains[2])  # gains of a linear model depend on the gaps only
    found = filtered(LearnedGainFilter(KalmanGain(gains[0])), y).mean  # type: ignore[arg-type]
    torch.testing.assert_close(found, wanted, rtol=0.0, atol=1e-6)
    wrong = filtered(LearnedGainFilter(KalmanGain(gains[0], 1.01)), y).mean  # type: ignore[arg-type]
    assert float((wrong - wanted).abs().max()) > 1e-4


class Recording(LearnedGain):
    """A gain that keeps what it is given."""

    def forward(self, model: Any, inputs: GainInputs, past: Tensor) -> tuple[Tensor, Tensor]:
        self.seen = [*getattr(self, "seen", []), (inputs, self._features(inputs))]
        return super().forward(model, inputs, past)


@pytest.mark.parametrize("normalisation", NORMALISATIONS)
def test_the_inputs_are_the_four_differences_of_kalman_net(normalisation: str) -> None:
    """Revach et al. 2022, F1 to F4: of measurements, of the prediction, of estimates, and of an estimate from its prediction.

    From the estimates of the filter by numpy, in deviations that differ from 1 by component.
    """
    gain, y = Recording(shaken, 4, normalisation), measurements(2).nan_to_num(0.3)
    found = filtered(LearnedGainFilter(gain), y).mean.numpy()
    model = tracker()
    f, h, r, sd = (a.numpy() for a in (model.f, model.h, model.r, model.l0.diagonal()))
    for t in range(2, len(y[0])):
        inputs, features = gain.seen[t]
        mean, last, before = found[:, t - 1], found[:, t - 2], y[:, t - 1].numpy()
        wanted = (
            (y[:, t].numpy() - mean @ f.T @ h.T) / r, (y[:, t].numpy() - before) / r,
            (mean - last @ f.T) / sd, (mean - last) / sd,
        )  # fmt: skip
        for name, a, scale in zip(GainInputs._fields, wanted, (r, r, sd, sd), strict=False):
            np.testing.assert_allclose(getattr(inputs, name).numpy(), a * scale, atol=1e-9)
        shape = np.arcsinh if normalisation == "asinh" else lambda a: a / np.linalg.norm(a, axis=1, keepdims=True)  # fmt: skip
        columns = np.concatenate([*map(shape, wanted), np.ones((2, 2))], 1)
        np.testing.assert_allclose(features.numpy(), columns, atol=1e-9)


@pytest.mark.parametrize("units", [(20.0, 1.0, 5.0, 1 / 3), (1.0, 0.1, 1.0, 8.0)])
def test_estimates_do_not_depend_on_the_units_of_states_and_measurements(
    units: tuple[float, ...],
) -> None:
    """The same network with a state in 1/20 and measurements in 1/5 and 3 of their units: a gain in m per unit of y."""
    base, y = tracker(), measurements(3)
    state, unit = torch.tensor(units, dtype=torch.float64).split(2)
    scaled = LinearGaussian(
        state[:, None] * base.f / state, state[:, None] * base.g, unit[:, None] * base.h / state,
        unit * base.r, state * base.m0, state[:, None] * base.l0,
    )  # fmt: skip
    means = [
        filter_record(
            LearnedGainFilter(LearnedGain(shaken, 8, "asinh", seed=3)), model, record
        ).mean
        for model, record in ((base, y), (scaled, y * unit))
    ]
    torch.testing.assert_close(means[0], means[1] / state, rtol=1e-9, atol=1e-9)


# training


def lessons(runs: int, seed: int, steps: int = 20) -> TrainingData:
    return draw_training_data(
        ModelSimulation(LEVEL, steps), [NominalNoise()], LEVEL, runs, seed, None
    )


def level_mse(gain: float) -> float:
    """Steady-state mean square error of the local level with a constant gain."""
    q, r, a = 0.25, 1.0, 1.0 - gain
    return (a * a * q + gain * gain * r) / (1.0 - a * a)


def test_training_approaches_the_steady_state_kalman_gain(tmp_path: Path) -> None:
    """The bound holds for gains within a tenth of the Kalman gain, and not for one of R times 4."""
    kalman_gain = (np.sqrt(17.0) - 1.0) / 8.0  # P- = (q + sqrt(q^2 + 4 q r)) / 2
    best = level_mse(kalman_gain)
    slack = 0.02 * best
    assert level_mse(0.9 * kalman_gain) - best < slack
    assert level_mse(0.22) - best > 5 * slack  # about the gain for R times 4
    plan = Training(
        StateErrorLoss(), epochs=30, learning_rate=0.02, gradient_steps=20, batch_size=16,
        patience_epochs=30,
    )  # fmt: skip
    pupil = LearnedGainFilter(LearnedGain(HEAD, 16, checkpoint=None))
    path = train(plan, pupil, LEVEL, lessons(48, 1), lessons(16, 2), tmp_path / "gain.pt")
    runs = torch.arange(200)
    episode = ModelSimulation(LEVEL, 60).draw(NominalNoise(), runs, 3)
    truth = LEVEL.assemble(episode.truth)
    excess = {}
    for checkpoint in (str(path), "untrained"):
        method = LearnedGainFilter(LearnedGain(HEAD, 16, checkpoint=checkpoint))
        with torch.no_grad():
            mean = run_filter(method, LEVEL, episode.record, PhiloxStream(3, runs)).mean
        x = torch.zeros_like(mean[:, 0])
        steady = []
        for t in range(60):  # the filter of the steady-state gain
            x = x + kalman_gain * (episode.record.y[:, t] - x)
            steady.append(x)
        square = (mean - truth).square() - (torch.stack(steady, 1) - truth).square()
        per_run = square[:, 20:, 0].mean(1)
        excess[checkpoint] = float(per_run.mean()), float(per_run.std() / len(runs) ** 0.5)
    value, error = excess[str(path)]
    assert -4.0 * error < value < slack + 4.0 * error
    assert 4.0 * error < 2.0 * slack  # the test has power
    value, error = excess["untrained"]
    assert value - 4.0 * error > 10.0 * slack


@pytest.mark.parametrize("normalisation", NORMALISATIONS)
def test_the_gradient_is_that_of_the_loss(normalisation: str) -> None:
    """Central differences of the loss of a whole record, which include the GRU through time."""
    data = lessons(2, 1, 6)
    gain = LearnedGain(shaken, 4, normalisation, checkpoint=None)
    state = TrainingState(Training(StateErrorLoss()), LearnedGainFilter(gain), LEVEL, data)

    def loss() -> Tensor:
        segments = state._segments(data, state._draws("x", torch.arange(2)))
        return torch.cat([losses for losses, _ in segments]).mean()

    state.training = Training(StateErrorLoss(), gradient_steps=None)
    loss().backward()
    assert gain.recurrent is not None
    for weight in state.weights:
        assert weight.grad is not None
        assert bool(torch.isfinite(weight.grad).all())
        row = int(weight.grad.abs().flatten().argmax())
        flat, step = weight.data.view(-1), 1e-5
        values = []
        for sign in (1.0, -1.0):
            flat[row] += sign * step
            values.append(float(loss().detach()))
            flat[row] -= sign * step
        numeric = (values[0] - values[1]) / (2.0 * step)
        assert float(weight.grad.flatten()[row]) == pytest.approx(numeric, rel=1e-5, abs=1e-9)
    assert float(gain.recurrent.weight_hh.grad.abs().max()) > 0.0  # type: ignore[union-attr, operator]


# runs, gaps and time


@pytest.mark.parametrize("normalisation", NORMALISATIONS)
def test_runs_are_an_axis_and_no_step_uses_the_future(normalisation: str) -> None:
    y = measurements(5)
    method = LearnedGainFilter(LearnedGain(shaken, 8, normalisation))
    together = filtered(method, y).mean
    for found in (filtered(method, y[:1]).mean, filtered(method, y, run_batch=2).mean[:1]):
        torch.testing.assert_close(found, together[:1], rtol=1e-12, atol=1e-12)
    later = y.clone()
    later[:, 8:] += 3.0
    changed = filtered(method, later).mean
    assert torch.equal(changed[:, :8], together[:, :8])
    assert float((changed[:, 8:] - together[:, 8:]).abs().amin((0, 2)).min()) > 0.0


def test_without_a_measurement_the_model_moves_the_estimate() -> None:
    y = measurements(2)
    found = filtered(LearnedGainFilter(LearnedGain(shaken, 8)), y).mean
    moved = found[:, 2] @ tracker().f.mT
    torch.testing.assert_close(found[:, 3], moved, rtol=1e-12, atol=1e-12)
    assert float((found[:, 1] - found[:, 0] @ tracker().f.mT).abs().min()) > 0.0


# what it does not state


def test_it_states_no_covariance_and_no_evidence() -> None:
    y = measurements(2)
    method = LearnedGainFilter(LearnedGain(shaken, 8))
    truth = torch.zeros(2, y.shape[1], 2, dtype=torch.float64)
    recorder = ScoreRecorder(tracker(), truth, 3)
    found = filtered(method, y, watch=recorder)
    assert not has_evidence(method)
    assert not has_covariance(method)
    check_refused(
        [("evidence is a density of the measurements", lambda: check_has_evidence(method, "pmmh"))],
        remedy=False,
    )
    assert found.variance.isnan().all()
    assert found.trace["nees"].isnan().all()
    assert found.trace["error"].isfinite().all()
    assert recorder.arrays() == {}
    assert not found.lost.any()


@pytest.mark.parametrize(("offset", "health"), [(0.0, "ok"), (50.0, "diverged")])
def test_its_health_is_judged_by_the_measurements(offset: float, health: str) -> None:
    """An untrained filter moves by the model alone, so an offset of 50 standard deviations stays."""
    y = measurements(2) + offset
    found = filtered(LearnedGainFilter(LearnedGain(HEAD, 8)), y)
    assert [HEALTH[k] for k in found.health.tolist()] == [health, health]


def test_a_run_without_a_finite_estimate_is_lost() -> None:
    def broken(inputs: int, outputs: int) -> nn.Module:
        network = HEAD(inputs, outputs)
        nn.init.constant_(network.skip_layer.bias, torch.inf)
        return network

    found = filtered(LearnedGainFilter(LearnedGain(broken, 8)), measurements(2))
    assert bool(found.lost.all())
    assert [HEALTH[k] for k in found.health.tolist()] == ["lost", "lost"]


# where it does not apply


class CauchyLevel(LinearGaussian):
    """A level with measurement errors that have no mean."""

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return Independent(Cauchy(x @ self.h.mT, self.r.expand(*x.shape[:2], -1)), 1)


@dataclass(frozen=True)
class Case:
    act: Callable[[Path], object]
    message: str


def proposal_checkpoint(folder: Path) -> str:
    plan = Training(EvidenceLowerBound(), epochs=1, particles=4, batch_size=2)
    pupil = ParticleFilter(4, proposal=LearnedProposal(_diagonal_head, checkpoint=None))
    return str(train(plan, pupil, LEVEL, lessons(2, 1, 2), lessons(2, 2, 2), folder / "other.pt"))


def _diagonal_head(features: int, noise: int) -> nn.Module:
    from pfbench.filter.learned.networks import DiagonalNormalHead

    return DiagonalNormalHead(features, noise, hidden=(4,))


def filter_level(checkpoint: str | None, model: LinearGaussian = LEVEL) -> FilterResult:
    method = LearnedGainFilter(LearnedGain(HEAD, 8, checkpoint=checkpoint))
    y = torch.zeros(1, 2, 1, dtype=torch.float64)
    return run_filter(method, model, Record(y), PhiloxStream(1, torch.arange(1)))


def train_bound(folder: Path) -> object:
    pupil = LearnedGainFilter(LearnedGain(HEAD, 8, checkpoint=None))
    return train(Training(), pupil, LEVEL, lessons(2, 1, 2), lessons(2, 2, 2), folder / "no.pt")


def correct_process(folder: Path) -> object:
    method, draws = LearnedGainFilter(LearnedGain(HEAD, 8)), PhiloxStream(1, torch.arange(1))
    belief, record = method.init(LEVEL, 1, draws), Record(torch.zeros(1, 1, dtype=torch.float64))
    belief, info = method.step(LEVEL, belief, record, draws)
    feedback: Any = SimpleNamespace(correct=lambda mean: (mean, lambda x: x))
    return apply_feedback(LEVEL, feedback, belief, info)


CAUCHY = CauchyLevel([[1.0]], [[0.5]], [[1.0]], [1.0], [0.0], [1.0])
CASES = {
    "hidden": Case(lambda _: LearnedGain(HEAD, 0), r"gain.hidden must be at least 1, got 0"),
    "inputs": Case(
        lambda _: LearnedGain(HEAD, 8, "unit"), r"gain.normalisation must be one of .*, got unit"
    ),
    "no weights": Case(
        lambda _: filter_level(None), r"checkpoint must be a file or `untrained`.*, got null"
    ),
    "a proposal": Case(
        lambda folder: filter_level(proposal_checkpoint(folder)),
        r"checkpoint must hold a learned gain, got a learned proposal",
    ),
    "no mean": Case(
        lambda _: filter_level("untrained", CAUCHY), r"must have a finite mean .* got Cauchy"
    ),
    "objective": Case(
        train_bound, r"train.objective must be defined without particles.*got EvidenceLowerBound"
    ),
    "feedback": Case(correct_process, r"filter must not have a learned gain.*got one"),
}


@pytest.mark.parametrize("name", CASES)
def test_it_is_refused_where_it_does_not_apply(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=CASES[name].message) as caught:
        CASES[name].act(tmp_path)
    assert re.search(r"\. [A-Z]", str(caught.value))  # a remedy follows


def test_weights_fit_one_normalisation_only(tmp_path: Path) -> None:
    plan = Training(StateErrorLoss(), epochs=1, batch_size=2)
    pupil = LearnedGainFilter(LearnedGain(HEAD, 8, checkpoint=None))
    path = train(plan, pupil, LEVEL, lessons(2, 1, 2), lessons(2, 2, 2), tmp_path / "gain.pt")
    other = LearnedGainFilter(LearnedGain(HEAD, 8, "asinh", checkpoint=str(path)))
    y = Record(torch.zeros(1, 2, 1, dtype=torch.float64))
    check_refused(
        [
            (
                "inputs with normalisation asinh, got",
                lambda: run_filter(other, LEVEL, y, PhiloxStream(1, torch.arange(1))),
            )
        ],
        remedy=False,
    )
