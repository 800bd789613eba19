"""Priors of parameters: by two quantiles on the range that a model accepts, by the name of a distribution, or as a distribution."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import pyro.distributions as laws
import torch
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch.distributions import Distribution

from pfbench.core.parameter_checks import require

_Z_95 = 1.6448536269514722  # 95 % quantile of the standard normal distribution
_FAR = 1e15  # accepted where the range is infinite
_NAMED = {
    re.sub(r"(?<=.)(?=[A-Z])", "_", name).lower(): kind
    for name, kind in vars(laws).items()
    if isinstance(kind, type) and issubclass(kind, Distribution)
}


class OnInterval(laws.TransformedDistribution):  # type: ignore[misc]
    """A distribution on [0, 1] that its last transform stretches to another interval."""

    @property
    def support(self) -> Any:
        """The interval."""
        low, width = self.transforms[-1].loc, self.transforms[-1].scale
        return laws.constraints.interval(low, low + width)


def as_prior(name: str, distribution: Any) -> Any:
    """Return a distribution of torch or Pyro as one that Pyro samples, without errors outside its support.

    Raises:
        ValueError: If it is not a distribution, not scalar, improper, or discrete.
    """
    ok = isinstance(distribution, Distribution) and not (
        isinstance(distribution, laws.ImproperUniform)
        or getattr(distribution.support, "is_discrete", True)
        or distribution.batch_shape + distribution.event_shape
    )
    remedy = "Take one of pyro.distributions or torch.distributions for each parameter."
    require(ok, f"prior[{name}]", "be a proper continuous scalar distribution", distribution, remedy)  # fmt: skip
    return as_pyro(distribution)


def as_pyro(distribution: Any) -> Any:
    """Return a distribution of torch or Pyro as one that Pyro samples, without errors outside its support."""
    kind: Any = type(distribution)
    copied = copy.copy(distribution)
    if not isinstance(copied, TorchDistributionMixin):
        copied.__class__ = type(kind.__name__, (kind, TorchDistributionMixin), {})
    copied._validate_args = False
    return copied


def find_range(accepts: Callable[[float], bool], value: float) -> tuple[float, float]:
    """Find the ends of the range of a number by trying values: the checks of a model alone state what it accepts.

    Args:
        accepts: Whether a value is accepted.
        value: A value that is, such as that of the configuration.

    Returns:
        Ends of the range about this value; infinite where 1e15 is accepted.
    """
    ends = []
    for side in (-1.0, 1.0):
        inside, outside = value, side * _FAR
        has_end = not accepts(outside)
        for _ in range(100 * has_end):
            middle = (inside + outside) / 2
            inside, outside = (middle, outside) if accepts(middle) else (inside, middle)
        ends.append(round(outside, 9) + 0.0 if has_end else side * math.inf)
    return ends[0], ends[1]


def read_priors(
    parameters: Mapping[str, Any],
    numbers: Mapping[str, float],
    find_ends: Callable[[str], tuple[float, float]],
    must: str = "name numbers of the model",
) -> dict[str, Any]:
    """Read priors by name or by quantiles of some of the numbers, whose ranges `find_ends` finds; others are refused."""
    priors = {}
    for name, words in parameters.items():
        require(name in numbers, "parameters", must, name, f"Choose from {', '.join(numbers)}.")
        if isinstance(words, Mapping):
            priors[name] = prior_by_name(name, words)
        else:
            priors[name] = prior_by_quantiles(name, words, numbers[name], find_ends(name))
    return priors


def prior_by_quantiles(name: str, quantiles: Any, value: float, ends: tuple[float, float]) -> Any:
    """Make a prior by its 5 % and 95 % quantile: normal, log-normal on positive numbers, logit-normal on an interval.

    Args:
        name: Parameter.
        quantiles: The two quantiles.
        value: Value of the configuration, for advice.
        ends: Ends of the range of the parameter.

    Returns:
        Scalar distribution.

    Raises:
        ValueError: If the quantiles do not increase inside the range.
    """
    low, high = ends
    is_pair = isinstance(quantiles, list | tuple) and [type(v) in (int, float) for v in quantiles]
    words = {0.0: "positive", -math.inf: "increasing"}.get(low) if high == math.inf else None
    half = max(abs(value), 1.0) / 2
    near = max(value - half, (low + value) / 2), min(value + half, (high + value) / 2)
    require(
        is_pair == [True, True] and low < quantiles[0] < quantiles[1] < high,
        f"parameters.{name}",
        f"be two {words or 'increasing'} numbers{'' if words else f' in ({low:g}, {high:g})'}, the 5 % and the 95 % quantile of its prior",
        quantiles,
        f"Set parameters.{name}=[{near[0]:.4g},{near[1]:.4g}].",
    )
    z = torch.tensor(quantiles, dtype=torch.float64)
    is_bounded = math.isfinite(high - low)
    if is_bounded:
        z = torch.logit((z - low) / (high - low))
    elif low == 0.0:
        z = z.log()
    loc, scale = z.mean(), (z[1] - z[0]) / (2 * _Z_95)
    if is_bounded:
        return OnInterval(laws.Normal(loc, scale), [laws.transforms.SigmoidTransform(), _stretch(low, high)])  # fmt: skip
    return (laws.LogNormal if low == 0.0 else laws.Normal)(loc, scale)


def prior_by_name(name: str, words: Mapping[Any, Any]) -> Any:
    """Make a prior of a distribution of Pyro: {beta: [20, 1.5], on: [-1, 1]}.

    Args:
        name: Parameter.
        words: Name of the distribution with its numbers; `on` stretches one on [0, 1] to an interval.

    Returns:
        Scalar distribution.

    Raises:
        ValueError: If Pyro does not have this distribution or refuses its numbers.
    """
    key, on = f"parameters.{name}", words.get("on", words.get(True))  # YAML may read `on` as true
    kinds: list[Any] = [kind for kind in words if kind not in ("on", True)]
    remedy = f"Set {key}={{normal:[0,1]}}, or another: beta, cauchy, gamma, half_cauchy, uniform."
    require(
        [kind in _NAMED for kind in kinds] == [True],
        key,
        "name one distribution of pyro.distributions",
        kinds,
        remedy,
    )
    values = words[kinds[0]]
    try:
        values = [float(v) for v in (values if isinstance(values, list | tuple) else [values])]
        numbers = torch.tensor(values, dtype=torch.float64)
        prior = as_prior(name, _NAMED[kinds[0]](*numbers))
        if on is None:
            return prior
        low, high = map(float, on)
        is_unit = prior.support.check(numbers.new_tensor([-1e-9, 0.5, 1 + 1e-9])).tolist()
        require(low < high and is_unit == [False, True, False], f"{key}.on", "be two increasing numbers, for a distribution on [0, 1]", on)  # fmt: skip
    except (TypeError, ValueError, NotImplementedError) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        require(False, f"{key}.{kinds[0]}", f"be a scalar distribution of Pyro with its numbers ({reason})", dict(words), remedy)  # fmt: skip
    return OnInterval(prior, [_stretch(low, high)])


def _stretch(low: float, high: float) -> Any:
    """Return the map of [0, 1] to [low, high]."""
    return laws.transforms.AffineTransform(*torch.tensor([low, high - low], dtype=torch.float64))
