"""Notes on worlds, for readers who quote their numbers: recordings, tunings on the same data, and weak references."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from pfbench.results.conditions import parse_label
from pfbench.results.paper_block import conf_dir
from pfbench.stats.world_table import TRACK_SHARE, World, compare_with_each

DEAD_RECKONING, PLAIN = "dead_reckoning", "ukf"


def list_world_notes(
    worlds: Sequence[World], tuned_on_part: Mapping[str, bool]
) -> dict[str, tuple[str, ...]]:
    """List the notes of each world.

    Args:
        worlds: Worlds of the page.
        tuned_on_part: Whether the tuning of a world had a part of its recording.
    """
    idle = _find_idle_references(worlds)
    notes = {}
    for world in worlds:
        drives = count_recorded_drives(parse_label(world.name)[0])
        texts = []
        if drives == 1:
            texts.append("one recording: words are about other starts and random numbers on it")
        if drives and tuned_on_part[world.name]:
            texts.append("the best Kalman filter was tuned on a part of it")
        elif drives:
            same = "it" if drives == 1 else f"the same {drives} recordings"
            texts.append(f"the best Kalman filter was tuned on {same}, with other random numbers")
        if world.name in idle:
            texts.append("the best Kalman filter is not shown to be better than dead reckoning")
        share = float(world.keeps_track[world.reference].mean())
        if share < TRACK_SHARE:
            texts.append(f"the best Kalman filter keeps track in {100 * share:.0f} % of runs")
        notes[world.name] = tuple(texts)
    return notes


def find_plain_losses(
    worlds: Sequence[World], worse: Mapping[str, Sequence[str]], plain: str = PLAIN
) -> dict[str, tuple[str, ...]]:
    """Find the cells in which a method is worse than the plain UKF too, which is as little tuned as the methods.

    Args:
        worlds: Worlds of the page.
        worse: Methods that are worse than the reference, by world.
        plain: Label of the UKF.

    Returns:
        These methods by world, by one family of tests; without the worlds that lack the UKF.
    """
    able = [world for world in worlds if plain in world.losses]
    pairs = [(w, [(m, plain) for m in worse[w.name] if w.reference != plain]) for w in able]
    worse_than_plain = {w.name: tuple(worse[w.name]) for w in able if w.reference == plain}
    for (world, _), verdicts in zip(pairs, compare_with_each(pairs), strict=True):
        methods = tuple(verdict.a for verdict in verdicts if verdict.word == "worse")
        worse_than_plain.setdefault(world.name, methods)
    return worse_than_plain


def _find_idle_references(worlds: Sequence[World]) -> set[str]:
    """Find the worlds whose reference is not shown to be better than dead reckoning."""
    able = [w for w in worlds if any(_is_dead_reckoning(label) for label in w.losses)]
    pairs = [
        (w, [(w.reference, next(label for label in w.losses if _is_dead_reckoning(label)))])
        for w in able
    ]
    verdicts = compare_with_each(pairs)
    return {
        w.name for w, (verdict,) in zip(able, verdicts, strict=True) if verdict.word != "better"
    }


def _is_dead_reckoning(label: str) -> bool:
    """Return whether a label is that of dead reckoning."""
    return parse_label(label)[0] == DEAD_RECKONING


def count_recorded_drives(scenario: str) -> int:
    """Count the recorded drives of a scenario by its file; 0 for simulated data or without a file."""
    node = _read_scenario(scenario)
    return len(node.get("flights") or (1,)) if "root" in node else 0


def _read_scenario(name: str) -> dict[str, Any]:
    """Read the file of a scenario, in pfbench or in `conf` of the current folder, with those on which it is based."""
    for folder in (conf_dir(), Path("conf")):
        path = folder / "scenario" / f"{name}.yaml"
        if path.is_file():
            content = yaml.safe_load(path.read_text(encoding="utf-8"))
            bases = [base for base in content.get("defaults", ()) if isinstance(base, str)]
            values: dict[str, Any] = {}
            for base in bases:
                values |= {} if base == "_self_" else _read_scenario(base)
            return values | content
    return {}
