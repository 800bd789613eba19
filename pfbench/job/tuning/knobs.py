"""Knobs of the filters that are tuned alike: the factor on R, and one knob of the method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

R_FACTORS = (1.0, 2.0, 4.0, 8.0)
_SCALED = "pfbench.filter.ScaledNoise"


@dataclass(frozen=True)
class Knob:
    """Knob of a method.

    Attributes:
        name: Key of the robust update, or `q_factor` of the scaled noise.
        values: Values to try.
    """

    name: str
    values: tuple[float, ...]


# Each method has the same number of values, so that each has the same number of candidates.
KNOBS: Mapping[str, Knob] = {
    "ekf_scaled": Knob("q_factor", (0.25, 0.5, 1.0, 2.0)),
    "gate": Knob("probability", (0.99, 0.999, 0.9999, 1.0)),
    "huber": Knob("threshold", (1.0, 1.345, 2.0, 3.0)),
    "student": Knob("dof", (3.0, 4.0, 6.0, 10.0)),
    "correntropy": Knob("threshold", (1.5, 2.0, 3.0, 5.0)),
    "wolf": Knob("threshold", (2.0, 3.0, 4.0, 6.0)),
    "sage_husa": Knob("forgetting_factor", (0.95, 0.98, 0.99, 0.998)),
    "vb_r": Knob("forgetting_factor", (0.95, 0.98, 0.99, 0.998)),
}


def list_candidates(method: str, r_factors: Sequence[float] = R_FACTORS) -> list[dict[str, float]]:
    """List the candidates of a method.

    Args:
        method: Name of the filter.
        r_factors: Factors on R.

    Returns:
        Values by knob, `r_factor` first.

    Raises:
        ValueError: If the filter does not have a knob.
    """
    if method not in KNOBS:
        raise ValueError(
            f"filter must be of {', '.join(KNOBS)}, got {method}. Only these have knobs that are "
            "tuned alike."
        )
    knob = KNOBS[method]
    return [{"r_factor": r, knob.name: v} for r, v in product(r_factors, knob.values)]


def apply_candidate(adaptations: list[dict[str, Any]], values: Mapping[str, float]) -> list[Any]:
    """Set the knobs in the noise adaptations of a filter.

    Args:
        adaptations: Nodes of the adaptations, the robust update last.
        values: Values by knob.

    Returns:
        The nodes, with the scaled noise first.
    """
    scaled = {"_target_": _SCALED, "r_factor": values["r_factor"], "q_factor": 1.0}
    if "q_factor" in values:
        return [scaled | {"q_factor": values["q_factor"]}]
    (name,) = (key for key in values if key != "r_factor")
    return [scaled, {**adaptations[-1], name: values[name]}]
