"""Access to the data of a report: filters, conditions and rows of views, as the board decided them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

ALL = "all"

FAMILY_ORDER = ("kalman", "gaussian", "particle", "guided", "swarm", "learned")

Pack = Mapping[str, Any]
Row = Mapping[str, Any]


def filters_by_key(pack: Pack) -> dict[str, Mapping[str, Any]]:
    """Return names and looks of the filters by key, in the order of the report."""
    return {str(look["key"]): look for look in pack["filters"]}


def filters_by_family(pack: Pack) -> list[list[str]]:
    """Return the keys of the filters of each family, families in a fixed order."""
    looks = filters_by_key(pack)
    families = dict.fromkeys([*FAMILY_ORDER, *(str(look["family"]) for look in looks.values())])
    groups = [[key for key, look in looks.items() if look["family"] == name] for name in families]
    return [group for group in groups if group]


def find_rows(pack: Pack, world: str = ALL, regime: str = ALL) -> dict[str, Row]:
    """Return the rows of a view of the first metric against the first baseline, by filter."""
    baseline = next(iter(map(str, pack["baselines"])), "")
    view = pack["views"].get((pack["metrics"][0]["key"], world, regime, baseline), {"rows": ()})
    return {str(row["filter"]): row for row in view["rows"]}


def list_cells(pack: Pack) -> list[tuple[str, str]]:
    """List the pairs of world and regime that have results, in the order of worlds and regimes."""
    present = {(str(cell["world"]), str(cell["regime"])) for cell in pack["cells"]}
    worlds, regimes = ([str(node["key"]) for node in pack[name]] for name in ("worlds", "regimes"))
    return [(w, r) for w in worlds for r in regimes if (w, r) in present]


def name_of(pack: Pack, kind: str, key: str) -> str:
    """Return the name of a world or a regime."""
    return next((str(node["name"]) for node in pack[kind] if node["key"] == key), key)


def name_baseline(pack: Pack) -> str:
    """Return the name of the first baseline, or words for none."""
    keys = map(str, pack["baselines"])
    return next((str(filters_by_key(pack)[key]["name"]) for key in keys), "the baseline")


def name_with_star(pack: Pack, key: str) -> str:
    """Return the name of a filter, with a star if it is a proposed method."""
    look = filters_by_key(pack)[key]
    return f"{look['name']}{'*' if look['proposed'] else ''}"


def is_number(value: Any) -> bool:
    """Return whether a value of the data is a finite number."""
    return isinstance(value, int | float) and value == value and abs(value) != float("inf")


def list_pairs(pack: Pack) -> list[Pack]:
    """List the pairs that were compared in advance and have a ratio of errors."""
    return [pair for pair in pack["planned"] if is_number(pair["estimate"])]
