"""Tests of models and proposals: derivatives equal finite differences, weighted averages equal those of the model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import (
    EACH_SATELLITE,
    Episode,
    MeasurementChannels,
    Record,
    check_inputs,
)
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.linearisation import find_observation_jacobian, find_propagation_jacobian
from pfbench.filter.particle.stages import Proposal
from pfbench.model.base import StateSpaceModel
from pfbench.model.linear_gaussian import linear_walk
from pfbench.noise import NominalNoise, make_normal
from pfbench.scenario import RecordingRegime
from pfbench.testing.results import (
    LawCheck,
    check_count,
    check_is_model,
    check_means,
    compute_twice,
    find_kind,
)


def check_jacobians(
    model: StateSpaceModel, x: Tensor, u: Any, step: float = 1e-4, limit: float = 1e-5
) -> dict[str, float]:
    """Compare stated Jacobians and the noise gain with central differences.

    The methods are `propagation_jacobian`, `observation_jacobian` and `noise_gain`. The differences
    of the noise gain are taken about the mean of the noise, one standard deviation wide.

    Args:
        model: State-space model in double precision.
        x: States at which the derivatives are taken, [R, N, D].
        u: Inputs of a step.
        step: Half width of the difference in each component of the chart.
        limit: Largest error, relative to the largest entry of the Jacobian.

    Returns:
        Relative error of each derivative that the model states, by name.

    Raises:
        AssertionError: If the model states none, or an error exceeds the limit.
        ValueError: If the model is not a `StateSpaceModel`, or the states have another shape.
    """
    check_is_model("check_jacobians", model)
    if x.dim() != 3 or x.shape[-1] != model.chart.size:
        raise ValueError(
            f"check_jacobians: x must have shape [R, N, {model.chart.size}], got {list(x.shape)}."
        )
    mean = model.noise.mean.expand(*x.shape[:2], -1)
    maps: dict[str, tuple[Any, Callable[[Tensor], Tensor], Any]] = {
        "propagation_jacobian": (
            find_propagation_jacobian(model, x, u),
            lambda at: model.propagate(at, u, mean),
            model.chart.subtract,
        ),
        "observation_jacobian": (
            find_observation_jacobian(model, x, u),
            lambda at: model.observation(at, u).mean,
            model.residual,
        ),
    }
    pairs = {
        name: (value, _difference_quotients(model, x, f, subtract, step))
        for name, (value, f, subtract) in maps.items()
        if value is not None
    }
    gain = model.noise_gain(u)
    if gain is not None:
        for side in (1.0, -1.0):  # both: the central difference of a square is 0
            pairs[f"noise_gain ({side:+g} sd)"] = gain[:, None], _noise_quotients(model, x, u, side)
    errors: dict[str, float] = {}
    for label, (value, expected) in pairs.items():
        name, scale = label.split(" ")[0], expected.abs().max().clamp(min=1e-300)
        error = float((value - expected).abs().max() / scale)
        assert error <= limit, (
            f"{type(model).__name__}.{name} must be the derivative, got a relative error of "
            f"{error:.2g}."
        )
        errors[name] = max(error, errors.get(name, 0.0))
    assert errors, f"{type(model).__name__} must state a Jacobian, got none."
    return errors


def _noise_quotients(model: StateSpaceModel, x: Tensor, u: Any, side: float) -> Tensor:
    """Return difference quotients of the step in the noise, [R, N, d, W]."""
    noise = model.noise
    mean, steps = noise.mean.expand(*x.shape[:2], -1), side * noise.stddev
    quiet_x = model.propagate(x, u, mean)
    columns = [
        model.chart.subtract(model.propagate(x, u, mean + e), quiet_x) / steps[i]
        for i, e in enumerate(torch.diag(steps))
    ]
    return torch.stack(columns, -1)


def _difference_quotients(
    model: StateSpaceModel,
    x: Tensor,
    f: Callable[[Tensor], Tensor],
    subtract: Callable[[Tensor, Tensor], Tensor],
    step: float,
) -> Tensor:
    """Return central difference quotients of f along the chart, [R, N, k, d]."""
    increments = step * torch.eye(model.chart.dimension, dtype=x.dtype)
    columns = [
        subtract(f(model.chart.add(x, e)), f(model.chart.add(x, -e))) / (2.0 * step)
        for e in (row.expand(*x.shape[:2], -1) for row in increments)
    ]
    return torch.stack(columns, -1)


# --------------------------------------------------------------------------------------------------
# Test of proposals: their weighted averages equal averages over the model.

_STATEMENT = "a proposal returns log p(w) - log q(w)"


def check_proposal(
    proposal: Proposal, particles: int = 20, runs: int = 4000, seed: int = 1, limit: float = 4.5
) -> LawCheck:
    """Check E_q[exp(log_ratio) f(x)] = E_p[f(x)] for f = 1, x and x^2.

    The model is a walk with constant velocity, whose predicted moments are known. Its measurement
    is weak, so that a proposal that uses it stays close to the model and the ratio has a variance.

    Args:
        proposal: Proposal to test.
        particles: Number of particles in a run.
        runs: Number of independent repetitions.
        seed: Seed of the random stream.
        limit: Largest number of standard errors.

    Returns:
        The average with the most standard errors.

    Raises:
        AssertionError: If the statement does not hold, or if the proposal is not repeatable.
        ValueError: If the proposal is not an instance that is called with these arguments.
    """
    kinds = {"proposal": ("model", "belief", "record", "draws")}
    find_kind("check_proposal", proposal, kinds, "BootstrapProposal()")
    check_count("check_proposal", particles=particles)
    check_count("check_proposal", 2, runs=runs)
    model = linear_walk(1.0, 0.5, 2.0)
    streams = PhiloxStream(seed, torch.arange(runs))
    flat = torch.full((runs, particles), -math.log(particles), dtype=torch.float64)
    belief = ParticleBelief(
        streams.normal("state", particles, 2), flat, torch.zeros(runs, dtype=torch.float64)
    )
    record = Record(torch.full((runs, 1), 0.7, dtype=torch.float64))
    proposed = compute_twice(
        "proposal",
        lambda: proposal(model, belief, record, streams.at_step(1)),
        lambda sample: {"states": sample.x, "ratio": sample.log_ratio},
    )
    ratio = torch.exp(proposed.log_ratio).unsqueeze(-1)
    parent = belief.x @ model.f.mT
    variance = (model.g @ model.g.mT).diagonal()
    z = (proposed.x - parent) / variance.sqrt()  # standard normal under the model
    averages = {
        "exp(log_ratio) - 1": ratio - 1.0,
        "exp(log_ratio) z": ratio * z,
        "exp(log_ratio) z^2 - 1": ratio * z * z - 1.0,
    }
    deviations = {
        f"{name}, component {i}": value.mean(1)[:, i].numpy()
        for name, value in averages.items()
        for i in range(value.shape[-1])
    }
    return check_means(_STATEMENT, deviations, limit)


def check_scenario(scenario: Any) -> Mapping[str, LawCheck]:
    """Check that an episode has the axes of its runs and steps, and that a run is the same alone and among others.

    Args:
        scenario: Scenario.

    Raises:
        AssertionError: If one does not hold.
    """
    name = type(scenario).__name__

    def draw(numbers: Any) -> Any:
        episode = scenario.draw(RecordingRegime(NominalNoise()), numbers, 1)
        assert isinstance(episode, Episode), (
            f"{name}.draw must return an Episode, got {type(episode).__name__}. Return Episode(Record(y), time, truth)"
        )
        runs, steps = len(numbers), len(episode.time)
        values = {"record.y": episode.record.y}
        values |= {f"truth[{group!r}]": value for group, value in episode.truth.items()}
        for key, value in values.items():
            assert list(value.shape[:-1]) == [runs, steps], (
                f"{name}.draw must return {key} with the axes of runs, steps and components, [{runs}, {steps}, ...], got "
                f"{list(value.shape)}. Add the axis that it lacks, or let `time` have as many steps"
            )
        stated, width = getattr(scenario, "channel_names", ()), episode.record.y.shape[-1]
        assert len(stated) in (0, width) or any(EACH_SATELLITE in text for text in stated), (
            f"{name}.channel_names must be {width}, as the components of record.y, got {len(stated)}. Name each one"
        )
        inputs = getattr(scenario, "input_type", None) or type(episode.record.u)
        assert isinstance(episode.record.u, inputs), (
            f"{name}.draw must return the inputs {inputs.__name__}, which input_type states, got "
            f"{type(episode.record.u).__name__}. Return Record(y, {inputs.__name__}(...))"
        )
        check_inputs(episode.record)
        return episode.record.y

    return _check_alone("the data of a run do not depend on other runs", draw)


_SIZES = 1, 2, 3  # numbers of channels that a regime is tried with


def check_regime(noise: Any, runs: int = 2000, scenario: Any = None) -> Mapping[str, LawCheck]:
    """Check that a regime works with any number of channels, and that its errors are independent and as it states.

    Args:
        noise: Noise regime. Each law is checked with 1, 2 and 3 channels of a standard deviation of 1.
        runs: Number of runs; 2 leave out the test of the distribution.
        scenario: Scenario with whose channels and times the regime is checked, too.

    Raises:
        AssertionError: If one does not hold.
    """
    time = torch.arange(1, 201, dtype=torch.float64)
    sds = (torch.ones(size, dtype=torch.float64) for size in _SIZES)
    worlds = [(MeasurementChannels.of_one_kind(sd, "position"), time) for sd in sds]
    if scenario is not None:
        source = RecordingRegime(NominalNoise())
        episode = scenario.draw(source, torch.arange(2), 1)
        worlds += [(source.channels, episode.time)] if source.channels else []
    checks = [check_regime_in(noise, channels, at, runs) for channels, at in worlds]
    return {
        name: max(
            (rows[name] for rows in checks if name in rows), key=lambda check: check.statistic
        )
        for name in dict.fromkeys(name for rows in checks for name in rows)
    }


def check_regime_in(
    noise: Any, channels: MeasurementChannels, time: Tensor, runs: int = 2
) -> Mapping[str, LawCheck]:
    """Check a regime with the channels of one world at times [T]; 2 runs leave out the test of the distribution."""
    name, steps, size = type(noise).__name__, len(time), len(channels.sd)

    def draw(numbers: Any) -> Any:
        shape, problem = [len(numbers), steps, size], None
        try:
            errors = noise.draw_errors(PhiloxStream(1, numbers), channels, time)
            got = list(getattr(errors, "shape", ())) or type(errors).__name__
        except (RuntimeError, IndexError) as error:  # of tensors that do not fit
            problem, got = error, f"the error {error}"
        if got == shape:
            return errors
        raise AssertionError(
            f"{name}.draw_errors must return errors [R, T, Dy] = {shape} for {size} of any number of channels, got {got}. "
            "Draw them by draws.normal(name, len(time), len(channels.sd)) and scale them by channels.sd"
        ) from problem

    results = _check_alone("the errors of a run do not depend on other runs", draw)
    factors = noise.process_factors(time)
    got = list(factors.shape) if float(factors.min()) >= 0.0 else "a negative one"
    assert got == [steps], (
        f"{name}.process_factors must return a factor of at least 0 for each time, [{steps}], got {got}. "
        "Leave the method out for nominal process noise"
    )
    try:
        stated_errors = noise.error_distribution(channels, time)
    except ValueError:
        return results
    errors = draw(torch.arange(runs)) / channels.sd
    return {**results, **_check_family(name, stated_errors, errors, runs)}


def _check_family(
    name: str, stated_errors: Any, errors: Tensor, runs: int
) -> Mapping[str, LawCheck]:
    """Check the distribution that a regime states by its errors in standard deviations, [R, T, Dy]; only its shape for 2 runs."""
    assert isinstance(stated_errors, tuple) and len(stated_errors) == 3, (  # noqa: PT018
        f"{name}.error_distribution must return a family, shift and scale, got {type(stated_errors).__name__}. "
        "Return for example (make_normal, shift, scale) with pfbench.noise.make_normal"
    )
    family, shift, scale = stated_errors
    density, narrow = family(shift, scale).log_prob(errors), make_normal(shift, 0.7 * scale)
    assert list(density.shape) == list(errors.shape[:2]), (
        f"{name}.error_distribution must make a distribution of all components of a measurement, with log_prob [R, T] = "
        f"{list(errors.shape[:2])}, got {list(density.shape)}. Return for example lambda shift, scale: Independent(Laplace(shift, scale), 1)"
    )
    if runs == 2:
        return {}
    ratio = (narrow.log_prob(errors) - density).exp().nan_to_num(1.0).mean(1).numpy()
    means = {"the ratio of a narrow normal density to it - 1": ratio - 1.0}
    return {"distribution": check_means("error_distribution is that of the errors", means, 4.5)}


def _check_alone(statement: str, draw: Callable[[Any], Any]) -> Mapping[str, LawCheck]:
    """Compare the draw of a run alone with that among others."""
    several, alone = draw(torch.arange(2)), draw(torch.tensor([1]))
    difference = float((several[1] - alone[0]).abs().nan_to_num().max())
    assert difference <= 1e-12, (
        f"{statement}: run 1 alone must be as among others, got a difference of {difference:.3g}. "
        "Draw all random numbers from PhiloxStream(seed, runs), none from torch or NumPy"
    )
    return {"alone": LawCheck(statement, difference, 1e-12)}
