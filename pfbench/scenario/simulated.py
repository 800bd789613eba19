"""Episodes simulated from a model: for textbook models and training.

A filter that uses the same model is without model error. Its results are better than in an
application ("inverse crime").
"""

from __future__ import annotations

import hashlib
import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record, take_groups
from pfbench.core.simulate import (
    SimulatedStep,
    draw_initial_state,
    draw_measurements,
    is_independent_normal,
    simulate_steps,
)
from pfbench.files.atomic_write import (
    DIGEST,
    has_valid_digest,
    hash_content,
    set_aside,
    write_atomically,
)
from pfbench.files.limits import check_zip
from pfbench.kernels.generator_version import GENERATOR_VERSION
from pfbench.model.base import StateSpaceModel, named_inputs
from pfbench.noise.base import NoiseRegime, NominalNoise, process_variance_factors
from pfbench.scenario.base import Scenario, regime_name


@dataclass(frozen=True)
class ModelSimulation(Scenario):
    """A scenario that simulates `steps` steps of `model`.

    Initial state, driving noise and measurements have the model's own distributions. A noise
    regime scales normal measurement errors. Its factor on the process noise multiplies the variance
    of the noise that drives a step, averaged over the interval that ends with the step.

    A model that reads inputs has them from a subclass with `input_type` and `make_inputs`.

    Attributes:
        model: State-space model that draws states and measurements.
        steps: Measurements per run.
        interval_s: Time between measurements, s, for the time axis of the report.

    Raises:
        ValueError: If steps is below 1, or the interval or the threshold is not positive. `draw` raises it if a
            regime changes measurement errors that are not independent normal.
    """

    model: StateSpaceModel
    steps: int
    interval_s: float = 1.0
    input_type = tuple  # no inputs

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Measured channels: those of the model."""
        return self.model.channel_names

    def __post_init__(self) -> None:
        require_ranges("scenario", self, steps="whole [1, inf)", interval_s="(0, inf]")

    def make_inputs(self, time: Tensor) -> Any:
        """Return the inputs of all runs at times [T]: a NamedTuple of tensors [1, T, ...], which is `input_type`."""
        return ()

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        model, stream = self.model, PhiloxStream(seed, runs)
        time = self.interval_s * torch.arange(1, self.steps + 1, dtype=torch.float64)
        blank = torch.full((len(runs), self.steps, 1), torch.nan, dtype=torch.float64)
        x = draw_initial_state(model, model.initial(len(runs)), stream, "world.state")
        u = self.make_inputs(time)
        scale = process_variance_factors(noise, time).sqrt()

        @cache
        def draw_errors(shape: torch.Size, is_nominal: bool) -> Tensor:
            channels = MeasurementChannels.of_one_kind(torch.ones(shape, dtype=torch.float64))
            return (NominalNoise() if is_nominal else noise).draw_errors(stream, channels, time)

        with named_inputs(model):
            inputs = model.prepare(Record(blank, u))
            steps = simulate_steps(model, inputs, stream, x, "world.state", scale)
            groups = take_groups(steps)
            parts = [_join_steps(model, group, draw_errors, stream, noise) for group in groups]
        states, y = (torch.cat(group, 1) for group in zip(*parts, strict=True))
        if model.chart.size != model.chart.dimension:
            states = model.chart.subtract(states, states.new_tensor(model.chart.identity))
        truth = {name: states[..., list(indices)] for name, indices in model.groups.items()}
        return Episode(Record(y, u), time, truth)


def _join_steps(
    model: StateSpaceModel,
    steps: list[SimulatedStep],
    draw_errors: Callable[[torch.Size, bool], Tensor],
    stream: PhiloxStream,
    noise: NoiseRegime,
) -> tuple[Tensor, Tensor]:
    """Join the states of consecutive steps, and draw their measurements [R, T, Dy].

    `draw_errors` returns the errors of all steps, nominal ones if its second argument is true.
    """
    distributions = [step.distribution for step in steps]
    require(
        len(distributions[0].batch_shape) == 2,
        f"{type(model).__name__}.observation",
        "return a distribution of batch shape [R, N]",
        list(distributions[0].batch_shape),
        "Compute it from the states x, with their last axis (x[..., :1], not x[..., 0]).",
    )
    shape, span = distributions[0].event_shape, slice(steps[0].t, steps[-1].t + 1)
    states, errors = torch.cat([step.x for step in steps], 1), draw_errors(shape, False)[:, span]
    if all(is_independent_normal(distribution) for distribution in distributions):
        return states, draw_measurements(distributions, stream, "world.receiver", errors)
    missing_mask, nominal = torch.isnan(errors), draw_errors(shape, True)[:, span]
    require(
        torch.equal(torch.where(missing_mask, nominal, errors), nominal),
        "noise",
        f"be nominal for {type(model).__name__}, whose measurement errors are not independent normal",
        regime_name(noise),
        "Choose noise=nominal.",
    )
    y = draw_measurements(distributions, stream, "world.receiver", first=steps[0].t)
    return states, torch.where(missing_mask, torch.nan, y)


# --------------------------------------------------------------------------------------------------
# Cache of episodes on disk: simulated once and shared by all filters of a study.

Arrays = dict[str, Tensor]
log = logging.getLogger("pfbench")

_KEY = "episode_key"  # name of the key in a file, which shows that a file has another one's name


def load_or_build(folder: str | Path | None, recipe: object, build: Callable[[], Arrays]) -> Arrays:
    """Load tensors from the cache, or build and store them.

    Returns the tensors by name.
    """
    if folder is None:
        return build()
    # one folder for all environments of a user: another version may simulate otherwise
    head = f"episodes 2 generator {GENERATOR_VERSION} pfbench {sys.modules['pfbench'].__version__}"
    key = hashlib.sha256(f"{head} {recipe!r}".encode()).hexdigest()[:16]
    path = Path(folder) / f"{key}.npz"
    if path.exists():
        try:
            return _read(path)
        except Exception as error:  # numpy and zipfile raise many kinds for damaged files
            log.warning(
                "warning  episode cache: %s is damaged (%s). Renamed to %s, built again",
                path, error, set_aside(path).name,
            )  # fmt: skip
    tensors = build()
    data: dict[str, Any] = {name: tensor.numpy() for name, tensor in tensors.items()}
    data[_KEY] = np.array(key)
    data[DIGEST] = np.array(hash_content(data))
    write_atomically(path, lambda file: np.savez(file, **data))
    return tensors


def _read(path: Path) -> Arrays:
    """Read a file of the cache."""
    # opened here, since numpy leaves a damaged file open
    check_zip(path)
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        data = {name: file[name] for name in file.files}
    if not has_valid_digest(data):
        raise ValueError("its digest must be that of its content")
    if str(data.get(_KEY)) != path.stem:
        raise ValueError(f"its key must be {path.stem}, got {data.get(_KEY)}")
    return {name: torch.from_numpy(value) for name, value in data.items() if name not in (DIGEST, _KEY)}  # fmt: skip
