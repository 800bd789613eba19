"""Groups of state components that have a common unit, and the units shown to readers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

# The only conversion from SI to displayed units: displayed unit and factor.
_DISPLAY_UNITS = {
    "rad": ("arcmin", 60 * 180 / np.pi),
    "rad/s": ("deg/h", 3600 * 180 / np.pi),
    "m/s^2": ("mg", 1e3 / 9.80665),
}


class ComponentGroup(NamedTuple):
    """Components of one unit, whose error has a norm.

    Attributes:
        group: Name. A group of mixed units is divided by unit, as "clock [m]" and "clock [m/s]".
        state_group: Group of the state that it is or belongs to; NEES refers to it.
        places: Indices of the components in the state.
        components: Names of the components.
        unit: Displayed unit.
        scale: Factor from SI to the displayed unit.
    """

    group: str
    state_group: str
    places: list[int]
    components: list[str]
    unit: str
    scale: float


def component_groups(state: Mapping[str, Any]) -> list[ComponentGroup]:
    """List the groups of a state, `meta["state"]`, in displayed units."""
    groups = []
    for group, index in state["groups"].items():
        units = [state["units"][i] for i in index]
        for unit in dict.fromkeys(units):
            indices = [i for i in index if state["units"][i] == unit]
            display, scale = _DISPLAY_UNITS.get(unit, (unit, 1.0))
            name = group if len(set(units)) == 1 else f"{group} [{display or '1'}]"
            names = [state["names"][i] for i in indices]
            groups.append(ComponentGroup(name, group, indices, names, display, scale))
    return groups


def select_main_group(groups: Sequence[str]) -> str:
    """Return the position, or the first group, or an empty name."""
    return "position" if "position" in groups else groups[0] if groups else ""


def main_component_group(state: Mapping[str, Any]) -> ComponentGroup:
    """Return the group of the headline: position if there is one, else the first of one unit."""
    groups = {group.group: group for group in component_groups(state)}
    return groups[select_main_group(list(groups))]
