"""File of a tuning: the knobs of each filter as the group `tuned`, and all candidates with their scores."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from pfbench.files.atomic_write import write_atomically
from pfbench.job.config import SUFFIX, TUNED_METHODS
from pfbench.job.tuning import OBJECTIVE, Candidate, CandidateSearch, TuningResult, with_candidate
from pfbench.results.paper_block import PAPER
from pfbench.stats.error_measures import Array

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

    Returns the file, `FOLDER/tuned/NAME.yaml`.
    """
    lines = [
        f"# Knobs of tuned filters, chosen by `pfbench tune` in the world {world['scenario']}.",
        f"data: {json.dumps(describe_world(world))}",
        f"objective: {json.dumps(OBJECTIVE)}",
        "world:",
        *(f"  {key}: {json.dumps(value)}" for key, value in world.items()),
        *(_list_fit(fit) if fit else ()),
    ]
    path = folder / "tuned" / f"{name}.yaml"
    _write_lines(path, [*lines, *_list_methods(results, unsupported or {})])
    return path


def add_to_tuned_file(
    results: Sequence[TuningResult], path: Path, unsupported: Mapping[str, str]
) -> None:
    """Add filters to the file of a tuning of the same world, or replace them; the rest of the file stays."""
    done = {*unsupported, *(result.method for result in results)}
    entries = re.split(r"^(?=\w+:)", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    others = "".join(entry for entry in entries if entry.split(":")[0] not in done)
    _write_lines(path, [*others.splitlines(), *_list_methods(results, unsupported)])


def _write_lines(path: Path, lines: Sequence[str]) -> None:
    """Write a file of a tuning."""
    write_atomically(path, lambda file: file.write(("\n".join(lines) + "\n").encode()))


def _list_methods(results: Sequence[TuningResult], unsupported: Mapping[str, str]) -> Iterator[str]:
    """Yield the lines of all filters: those that cannot run here first."""
    for method, reason in unsupported.items():
        yield from (f"{method}:", f"  unsupported: {json.dumps(reason)}")
    for result in results:
        yield f"{result.method}:"
        yield from (f"  {key}: {json.dumps(value)}" for key, value in result.choice.values.items())
        if (
            len({(c.log_ratio, *c.errors.values()) for c in (*result.candidates, result.untuned)})
            == 1
        ):
            yield f"  note: {json.dumps(_NO_EFFECT)}"
        if result.particles is not None:
            yield f"  particles: {result.particles}"
        yield from (f"  seconds: {result.seconds:.1f}", "  candidates: |")
        yield from (f"    {' '.join(row)}" for row in _list_rows(result))


def _list_fit(fit: WorldFit) -> Iterator[str]:
    """Yield the lines of the best conventional filter, and of the fit of Kalman filters with its numbers."""
    yield f"best: {fit.best}"
    yield f"kalman_fits: {json.dumps(fit.kalman_fits)}"
    yield "fit:"
    yield f"  rule: {json.dumps(FIT_RULE)}"
    yield from (
        f"  {key}: {getattr(fit, key)}" for key in ("noise", "runs", "first_run", "particles")
    )
    yield "  objectives:"
    yield from (f"    {name}: {score:.{_DIGITS}g}" for name, score in fit.objectives.items())
    yield "  ratios:  # with both ends of the interval"
    for name, ratio in fit.ratios.items():
        yield f"    {name}: [{', '.join(f'{number:.{_DIGITS}g}' for number in ratio)}]"


def _list_rows(result: TuningResult) -> Iterator[list[str]]:
    """Yield the rows of a record: the head, all candidates, and the filter without tuned knobs."""
    knobs = list(result.choice.values)
    yield [*knobs, "log_ratio", "nees_ratio", *(f"{_ERROR}{r}" for r in result.choice.errors)]
    for candidate in (*result.candidates, result.untuned):
        values = (candidate.values.get(knob) for knob in knobs)
        words = ["-" if value is None else f"{value:g}" for value in values]
        scores = (candidate.log_ratio, candidate.nees_ratio, *candidate.errors.values())
        yield [*words, *(f"{score:.{_DIGITS}g}" for score in scores)]


def describe_world(world: Mapping[str, Any]) -> str:
    """Describe the data of a search for reports."""
    settings = [re.sub(r"^scenario\.", "", word) for word in world.get("settings", ())]
    parts = [f"model {world['model']}", *settings, f"seed {world['seed']}"]
    if world.get("start_time_s"):
        parts += [f"scored from {world['start_time_s']:g} s"]
    return (
        f"{world['scenario']} ({', '.join(parts)}, {world['runs']} runs; "
        f"noise: {', '.join(world['regimes'])})"
    )


# --------------------------------------------------------------------------------------------------
# Needs of a world: the best conventional filter in it, and whether Kalman filters fit it.

_UNTUNED = ("ekf", "ukf")  # conventional filters without knobs
_PARTICLE_FILTERS = ("sir", "rpf")
FIT_LIMIT = (
    0.95  # of the error of the best conventional filter, below which Kalman filters do not fit
)
_LEVEL = 0.05  # of the two intervals together
FIT_RULE = (
    "false if SIR or RPF has less than 0.95 of the error of the best filter: geometric mean over runs, "
    "Student interval without 0.95, 95 % for both together; errors are at most the limit of the scenario, "
    "else the median error of dead reckoning, which a lost run has"
)
_NO_FIX = {"r_factor": 1e12, "q_factor": 1.0}  # dead reckoning


class Ratio(NamedTuple):
    """Error of a particle filter, divided by that of the best conventional filter.

    Attributes:
        value: Geometric mean over runs.
        low: Lower end of the interval.
        high: Upper end of the interval.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class WorldFit:
    """Best conventional filter of a world, and whether Kalman filters fit the world.

    Attributes:
        best: Name of the filter with the smallest objective.
        objectives: Objective by filter, with capped errors.
        noise: Noise regime of the ratios.
        particles: Number of particles.
        runs: Number of runs, which are others than those that chose the knobs.
        first_run: Number of the first of them.
        ratios: Ratios by particle filter.
    """

    best: str
    objectives: dict[str, float]
    noise: str
    particles: int
    runs: int
    first_run: int
    ratios: dict[str, Ratio] = field(default_factory=dict)

    @property
    def kalman_fits(self) -> bool:
        """True if no particle filter is shown to have less than 0.95 of the error."""
        return decide_fit(self.ratios)


def decide_fit(ratios: Mapping[str, Ratio]) -> bool:
    """Return whether Kalman filters fit a world: no interval lies below 0.95."""
    return not any(ratio.high < FIT_LIMIT for ratio in ratios.values())


def compare_errors(errors: Array, reference: Array, cap: float, filters: int = 1) -> Ratio:
    """Compare the errors of paired runs by the mean of their log ratios.

    Shapes: errors [R], reference [R].
    """
    difference = np.log(np.fmin(errors, cap)) - np.log(np.fmin(reference, cap))
    mean, runs = float(difference.mean()), len(difference)
    half = float(stats.t.ppf(1 - _LEVEL / filters / 2, runs - 1) * difference.std(ddof=1))
    half /= math.sqrt(runs)
    return Ratio(math.exp(mean), math.exp(mean - half), math.exp(mean + half))


def find_best(
    errors: Mapping[str, Mapping[str, float]], cap: float
) -> tuple[str, dict[str, float]]:
    """Find the filter with the smallest objective."""

    def objective(values: Mapping[str, float]) -> float:
        return float(
            np.mean([math.log(min(e, cap) / min(errors["ekf"][r], cap)) for r, e in values.items()])
        )

    objectives = {name: objective(values) for name, values in errors.items()}
    return min(objectives, key=lambda name: objectives[name]), objectives


def measure_fit(search: CandidateSearch, results: list[TuningResult], particles: int) -> WorldFit:
    """Find the best conventional filter, and compare SIR and RPF with it in the first noise regime.

    The search has other runs than that which chose the knobs: a filter may be the best of 16 candidates by chance.
    """
    first, runs = [f"particles={particles}"], search.batches[0].plan.runs
    tuned = {f"{r.method}_{SUFFIX}": r.choice for r in results if r.method in TUNED_METHODS}
    errors = {name: _errors_of(search, name) for name in _UNTUNED}
    errors = {name: e for name, e in errors.items() if e}
    for name, choice in tuned.items():
        errors[name] = search.score_method(name.removesuffix(f"_{SUFFIX}"), choice.values).errors
    cap, threshold = _find_cap(search, first)
    best, objectives = find_best(errors, cap)
    reference = _run(search, best, first, tuned.get(best), threshold)
    ratios = {}
    for name in _PARTICLE_FILTERS:
        search.progress(f"{name} particles={particles}")
        errors_of_runs = _run(search, name, first, threshold=threshold)
        ratios[name] = compare_errors(errors_of_runs, reference, cap, len(_PARTICLE_FILTERS))
    return WorldFit(best, objectives, search.regimes[0], particles, len(runs), int(runs[0]), ratios)


def _errors_of(search: CandidateSearch, name: str) -> dict[str, float]:
    """Return the error by regime of a filter without knobs, empty if the model does not support it."""
    if name == "ekf":
        return {regime: score.error for regime, score in search.reference.items()}
    search.progress(name)
    try:
        return search.score_method(name).errors
    except ValueError as error:
        search.progress(f"{name} cannot run: {error}")
        return {}


def _find_cap(search: CandidateSearch, words: list[str]) -> tuple[float, float]:
    """Return the cap of a search, and the divergence threshold of the scenario; infinite without one.

    Without a threshold the cap is the median error of dead reckoning: a filter that ignores all measurements.
    """
    config = search.compose("ekf_scaled", search.regimes[0])
    stated: Any = (config.values["scenario"].get(PAPER) or {}).get("divergence_threshold")
    if stated:
        return float(stated), float(stated)
    search.progress("dead reckoning")
    errors = _run(search, "ekf_scaled", words, Candidate(_NO_FIX, 0.0, 0.0, {}))
    return float(np.median(errors)), math.inf


def _run(
    search: CandidateSearch,
    name: str,
    words: list[str],
    choice: Candidate | None = None,
    threshold: float = math.inf,
) -> Array:
    """Run a filter in the first noise regime and return the error of each run."""
    config = search.compose(name.removesuffix(f"_{SUFFIX}"), search.regimes[0], words)
    return search.pass_alone(with_candidate(config, choice.values if choice else {}), threshold)
