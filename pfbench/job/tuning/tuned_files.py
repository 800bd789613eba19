"""File of a tuning: the knobs of each filter as the group `tuned`, and all candidates with their scores."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.files.atomic_write import write_atomically
from pfbench.job.tuning.candidate_search import OBJECTIVE, Candidate, TuningResult
from pfbench.job.tuning.world_fit import FIT_RULE, WorldFit

_NO_EFFECT = "All candidates have the same errors: the knobs change nothing in this world."
_ERROR = "error_"  # start of the columns of a record with the error in a regime
_DIGITS = 6


def write_tuned_file(
    results: Sequence[TuningResult],
    folder: Path,
    name: str,
    world: Mapping[str, Any],
    fit: WorldFit | None = None,
    unsupported: Mapping[str, str] | None = None,
) -> Path:
    """Write the knobs of tuned filters with the record of their search.

    Args:
        results: Results of the search by filter.
        folder: Folder of configuration files.
        name: Name of the file, which `tuned=NAME` chooses.
        world: Scenario, model, settings, seed, runs, start time and regimes of the search.
        fit: Best conventional filter, and whether Kalman filters fit the world.
        unsupported: Reason by filter without knobs in the world.

    Returns:
        The file, `FOLDER/tuned/NAME.yaml`.
    """
    lines = [
        f"# Knobs of tuned filters, chosen by `pfbench tune` in the world {world['scenario']}.",
        f"data: {json.dumps(describe_world(world))}",
        f"objective: {json.dumps(OBJECTIVE)}",
        "world:",
        *(f"  {key}: {json.dumps(value)}" for key, value in world.items()),
        *(_list_fit(fit) if fit else ()),
    ]
    for method, reason in (unsupported or {}).items():
        lines += [f"{method}:", f"  unsupported: {json.dumps(reason)}"]
    for result in results:
        lines += [f"{result.method}:"]
        lines += [f"  {key}: {json.dumps(value)}" for key, value in result.choice.values.items()]
        lines += [f"  note: {json.dumps(_NO_EFFECT)}"] if _has_no_effect(result) else []
        lines += [f"  seconds: {result.seconds:.1f}", "  candidates: |"]
        lines += [f"    {' '.join(row)}" for row in _list_rows(result)]
    path = folder / "tuned" / f"{name}.yaml"
    write_atomically(path, lambda file: file.write(("\n".join(lines) + "\n").encode()))
    return path


def _list_fit(fit: WorldFit) -> Iterator[str]:
    """Yield the lines of the best conventional filter, and of the fit of Kalman filters with its numbers."""
    yield f"best: {fit.best}"
    yield f"kalman_fits: {json.dumps(fit.kalman_fits)}"
    yield "fit:"
    yield f"  rule: {json.dumps(FIT_RULE)}"
    for key, value in (("noise", fit.regime), ("runs", fit.runs), ("particles", fit.particles)):
        yield f"  {key}: {value}"
    yield f"  cap: {fit.cap:.{_DIGITS}g}"
    yield f"  cap_source: {json.dumps(fit.cap_source)}"
    yield "  objectives:"
    yield from (f"    {name}: {score:.{_DIGITS}g}" for name, score in fit.objectives.items())
    yield "  ratios:  # with both ends of the interval"
    for name, ratio in fit.ratios.items():
        yield f"    {name}: [{', '.join(f'{number:.{_DIGITS}g}' for number in ratio)}]"


def _has_no_effect(result: TuningResult) -> bool:
    """Return whether all candidates have the score of the filter without tuned knobs."""
    return (
        len({(c.log_ratio, *c.errors.values()) for c in (*result.candidates, result.untuned)}) == 1
    )


def _list_rows(result: TuningResult) -> Iterator[list[str]]:
    """Yield the rows of a record: the head, all candidates, and the filter without tuned knobs."""
    knobs = list(result.choice.values)
    yield [*knobs, "log_ratio", "nees_ratio", *(f"{_ERROR}{r}" for r in result.choice.errors)]
    for candidate in (*result.candidates, result.untuned):
        values = (candidate.values.get(knob) for knob in knobs)
        words = ["-" if value is None else f"{value:g}" for value in values]
        scores = (candidate.log_ratio, candidate.nees_ratio, *candidate.errors.values())
        yield [*words, *(f"{score:.{_DIGITS}g}" for score in scores)]


def read_candidates(node: Mapping[str, Any]) -> tuple[list[Candidate], Candidate]:
    """Read the candidates of a filter from the file of a tuning.

    Args:
        node: Entry of the filter.

    Returns:
        All candidates, and the filter without tuned knobs.
    """
    head, *rows = (line.split() for line in node["candidates"].splitlines())
    places = {name: k for k, name in enumerate(head)}
    knobs, regimes = head[: places["log_ratio"]], head[places["nees_ratio"] + 1 :]
    candidates = [
        Candidate(
            {knob: float(row[places[knob]]) for knob in knobs if row[places[knob]] != "-"},
            float(row[places["log_ratio"]]),
            float(row[places["nees_ratio"]]),
            {r.removeprefix(_ERROR): float(row[places[r]]) for r in regimes},
        )
        for row in rows
    ]
    return candidates[:-1], candidates[-1]


def describe_world(world: Mapping[str, Any]) -> str:
    """Describe the data of a search for reports.

    Args:
        world: Scenario, model, settings, seed, runs, start time and regimes of the search.
    """
    settings = [re.sub(r"^scenario\.", "", word) for word in world.get("settings", ())]
    parts = [f"model {world['model']}", *settings, f"seed {world['seed']}"]
    if world.get("start_time_s"):
        parts += [f"scored from {world['start_time_s']:g} s"]
    return (
        f"{world['scenario']} ({', '.join(parts)}, {world['runs']} runs; "
        f"noise: {', '.join(world['regimes'])})"
    )
