"""Networks whose output is a distribution of noise.

They map features [R, N, F] to a distribution with batch [R, N] and event [W]. Each is made
from the number of features and the dimension of the noise, so YAML files do not contain them.
The output of an untrained Diagonal is exactly N(0, I), which is the proposal that it corrects.
The others start close to it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from pyro.distributions import (
    Independent,
    MixtureSameFamily,
    Normal,
)
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.filter.learned.checkpoint import UNTRAINED, load_parameters, read_checkpoint
from pfbench.model.base import StateSpaceModel

_MAX_LOG_SCALE = 4.0  # log of the largest factor on a standard deviation


class SkipMlp(nn.Module):
    """Multilayer perceptron (tanh) plus linear skip connection, with initial output 0.

    Args:
        inputs: Number of inputs.
        outputs: Number of outputs.
        hidden: Sizes of the hidden layers.
    """

    def __init__(self, inputs: int, outputs: int, hidden: Sequence[int] = (32, 32)) -> None:
        super().__init__()
        sizes = [inputs, *hidden]
        layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.Tanh())]
        last, self.skip_layer = nn.Linear(sizes[-1], outputs), nn.Linear(inputs, outputs)
        self.hidden_layers = nn.Sequential(*layers, last)
        for end in (last, self.skip_layer):
            nn.init.zeros_(end.weight)
            nn.init.zeros_(end.bias)

    @override
    def forward(self, features: Tensor) -> Tensor:
        output: Tensor = self.hidden_layers(features) + self.skip_layer(features)
        return output


def bounded_log_scale(log_scale: Tensor) -> Tensor:
    """Map a log scale smoothly to a factor from e^-4 to e^4, with 0 mapped to 1."""
    return torch.exp(_MAX_LOG_SCALE * torch.tanh(log_scale / _MAX_LOG_SCALE))


def independent_heads(mean: Tensor, sd: Tensor) -> Distribution:
    """Return the normal distribution N(mean, diag(sd^2)).

    Shapes: mean [..., W], sd [..., W].
    """
    return Independent(Normal(mean, sd, validate_args=False), 1, validate_args=False)


class DiagonalNormalHead(nn.Module):
    """N(m, diag(s^2)). Initially N(0, I)."""

    def __init__(self, features: int, noise: int, hidden: Sequence[int] = (32, 32)) -> None:
        super().__init__()
        self.net = SkipMlp(features, 2 * noise, hidden)

    @override
    def forward(self, features: Tensor) -> Distribution:
        mean, log_scale = self.net(features).chunk(2, -1)
        return independent_heads(mean, bounded_log_scale(log_scale))


class NormalMixtureHead(nn.Module):
    """Mixture of diagonal normal distributions.

    The initial means differ, since equal components would stay equal.
    """

    def __init__(
        self, features: int, noise: int, hidden: Sequence[int] = (32, 32), components: int = 3
    ) -> None:
        super().__init__()
        self.components, self.noise = components, noise
        self.net = SkipMlp(features, components * (1 + 2 * noise), hidden)
        nn.init.normal_(self.net.skip_layer.bias[components : components * (1 + noise)], std=0.5)

    @override
    def forward(self, features: Tensor) -> Distribution:
        k, w = self.components, self.noise
        logits, mean, log_scale = self.net(features).split([k, k * w, k * w], -1)
        component = independent_heads(
            mean.unflatten(-1, (k, w)), bounded_log_scale(log_scale).unflatten(-1, (k, w))
        )
        return MixtureSameFamily(
            Categorical(logits=logits, validate_args=False), component, validate_args=False
        )


# --------------------------------------------------------------------------------------------------
# Networks of a learned filter part, built untrained or from a checkpoint.

SIZES = {
    "features": "number of features",
    "noise": "components of the noise or of the gain",
    "memory": "hidden size of the recurrent network",
}


@dataclass(frozen=True)
class CheckpointSpec:
    """Source of the weights of a learned part of a filter.

    Attributes:
        key: Name in the checkpoint: `proposal`, `kernel` or `gain`.
        checkpoint: File, `untrained`, or None, which raises on use.
        seed: Seed of untrained weights.
        frame: Description of the distribution that the network corrects. The same weights give
            another distribution in another frame.
    """

    key: str
    checkpoint: str | None
    seed: int
    frame: str = ""


def build_networks(
    learnable: CheckpointSpec,
    make: Callable[[], dict[str, nn.Module]],
    sizes: tuple[int, int, int],
    model: StateSpaceModel,
    fresh: bool,
) -> dict[str, nn.Module]:
    """Build networks in the model's precision and load the checkpoint, unless `fresh`.

    The global random state of torch does not change.

    Returns the modules by name.
    """
    path = learnable.checkpoint
    require(
        path is not None or fresh,
        "checkpoint",
        "be a file or `untrained` for a filter with a network",
        "null",
        "Train it with `pfbench train` and the same options, then set checkpoint=FILE.",
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(learnable.seed)
        modules = {name: module.to(model.anchor) for name, module in make().items()}
    if path not in (None, UNTRAINED) and not fresh:
        content = read_checkpoint(str(path))
        _check_sizes(str(path), content, learnable, sizes, model)
        load_parameters(str(path), content["networks"][learnable.key], modules)
    return modules


def _check_sizes(
    path: str,
    content: Mapping[str, Any],
    learnable: CheckpointSpec,
    sizes: tuple[int, int, int],
    model: StateSpaceModel,
) -> None:
    """Check that a checkpoint fits the filter and the model."""
    key, choices = learnable.key, content["choices"]
    if key not in content["networks"]:
        keys = ", ".join(content["networks"])
        raise ValueError(
            f"checkpoint must hold a learned {key}, got a learned {keys} in {path}. "
            "Train this filter."
        )
    trained = list(content["model"]["names"])
    if trained != list(model.names):
        options = [
            f"{group}={choices[group]}" for group in ("scenario", "model") if group in choices
        ]
        raise ValueError(
            f"checkpoint must be trained on a model with the {len(model.names)} states of "
            f"{type(model).__name__} ({', '.join(model.names)}), got {len(trained)} "
            f"({', '.join(trained)}) in {path}. Train on this model, or set "
            f"{' '.join(options) or 'the scenario and the model of the training'}."
        )
    frame = content.get("frames", {}).get(key, learnable.frame)  # missing in older files
    require(
        frame == learnable.frame,
        "checkpoint",
        f"correct {learnable.frame}",
        f"{frame} in {path}",
        f"Set filter={choices.get('filter', 'NAME')} as in the training, or train this filter.",
    )
    for (name, label), size, stored in zip(
        SIZES.items(), sizes, content["sizes"][key], strict=True
    ):
        require(
            size == stored,
            "checkpoint",
            f"have {name}={size} ({label})",
            f"{stored} in {path}",
            "Set the model and filter options of the training, or train again.",
        )
