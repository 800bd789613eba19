"""Time per step of the filters of a study, measured in turn: one file in the folder of its results.

Other programs change the time of a job. Here all filters of a condition are timed in turn, in
several rounds, so that a ratio of two filters is paired by round.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import DIGEST, has_valid_digest, hash_content, write_atomically
from pfbench.stats.comparison import EffectEstimate
from pfbench.stats.error_measures import Array

STEP_TIMES = "step_times.json"
STEP_TIME = "step_time"  # of the metadata of a job
WARM_UP = (
    "warm_up"  # of the seconds of a job whose time per step is without what its process loads once
)
FEWEST_ROUNDS = 5
_FORMAT = 1
_LARGEST = 50_000_000  # bytes
Conditions = dict[str, dict[str, Any]]


class StepTimes(NamedTuple):
    """Time per step of one filter in one condition.

    Attributes:
        seconds: Time per step of all runs by round, [K] (s).
        group: Key of the measurement of the condition. Filters of one group took turns.
    """

    seconds: Array
    group: str

    @classmethod
    def from_metadata(cls, meta: Mapping[str, Any]) -> StepTimes | None:
        """Return the times in the metadata of a job, None if it was not measured in rounds."""
        times = meta.get(STEP_TIME)
        return None if times is None else cls(np.array(times["rounds"]), times["group"])

    def to_metadata(self) -> dict[str, Any]:
        """Return the values for the metadata of a job: median and quartiles (s), rounds, group."""
        low, median, high = np.quantile(self.seconds, (0.25, 0.5, 0.75))
        return {
            "median": float(median),
            "low": float(low),
            "high": float(high),
            "rounds": [float(value) for value in self.seconds],
            "group": self.group,
        }


def write_step_times(folder: Path, conditions: Mapping[str, Mapping[str, Any]]) -> Path:
    """Write the measurements of a study.

    Returns path of the file.
    """
    # in the types of JSON: the version of torch has a class of its own
    content = json.loads(json.dumps({"format": _FORMAT, "conditions": dict(conditions)}))
    content[DIGEST] = hash_content(content)
    text = json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n"
    write_atomically(folder / STEP_TIMES, lambda file: file.write(text.encode()))
    return folder / STEP_TIMES


def read_step_times(folder: Path) -> Conditions:
    """Read the measurements of a study by key of the condition; empty without a file."""
    path = folder / STEP_TIMES
    if not path.exists():
        return {}
    try:
        is_note = path.is_file() and path.stat().st_size <= _LARGEST
        content: Any = json.loads(path.read_bytes()) if is_note else None
        fault = "" if isinstance(content, dict) else "no dictionary"
        fault = fault or ("" if has_valid_digest(content) else "another digest")
        fault = fault or _find_fault(content)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        fault = f"{type(error).__name__}: {error}"
    require(
        not fault,
        path,
        "be the times of a study with a valid digest",
        fault,
        f"Delete it and run: pfbench cost study={folder.name}",
    )
    conditions: Conditions = content["conditions"]
    return conditions


def measurement_key(jobs: Sequence[tuple[str, str]]) -> str:
    """Return the key of the measurement of a condition: it changes with its jobs and their version."""
    return hash_content(sorted(jobs))[:16]


def read_commit(meta: Mapping[str, Any]) -> str:
    """Return the commit of a job, or the digest of its sources without one; empty if not known."""
    versions = meta.get("versions", {})
    return str(versions.get("commit") or versions.get("build") or "")


def select_job_times(conditions: Conditions) -> dict[tuple[str, str], StepTimes]:
    """Return the times of each job by its key and its commit."""
    return {
        (key, job["commit"]): StepTimes(np.array(job[entry["clock"]]), group)
        for group, entry in conditions.items()
        for key, job in entry["jobs"].items()
    }


def add_step_times(
    items: Sequence[tuple[Path, dict[str, Any]]], folder: Path
) -> list[tuple[Path, dict[str, Any]]]:
    """Add the times of `pfbench cost` to the metadata of the jobs that were measured."""
    times = select_job_times(read_step_times(folder))
    measured_times = [times.get((str(meta["key"]), read_commit(meta))) for _, meta in items]
    return [
        (path, meta if job_times is None else {**meta, STEP_TIME: job_times.to_metadata()})
        for (path, meta), job_times in zip(items, measured_times, strict=True)
    ]


def estimate_cost_ratio(pairs: Sequence[tuple[Array, Array]]) -> EffectEstimate:
    """Estimate the mean log ratio of the times of two filters over conditions, paired by round.

    Returns estimate with the degrees of freedom of Welch and Satterthwaite. Shapes: pairs [K].
    """
    ratios = [np.log(first / second) for first, second in pairs]
    value = float(np.mean([ratio.mean() for ratio in ratios]))
    variance = np.array([ratio.var(ddof=1) / ratio.size for ratio in ratios])
    rounds = np.array([ratio.size for ratio in ratios])
    total = float(variance.sum())
    # equal ratios in all rounds: of a filter with itself
    df = total**2 / (variance**2 / (rounds - 1)).sum() if total else float(rounds.min() - 1)
    error = math.sqrt(total) / len(ratios)
    return EffectEstimate(np.asarray(value), np.asarray(error), np.asarray(df))


def describe_costs(
    times: Sequence[Mapping[str, StepTimes]], label: str, baseline: str, alpha: float
) -> dict[str, float]:
    """Describe the cost of a filter in some conditions: times in ms, and their ratio to a baseline."""
    if not times or not all(label in by_label for by_label in times):
        return {}
    quartiles = [np.quantile(by_label[label].seconds, (0.25, 0.5, 0.75)) for by_label in times]
    low, middle, high = 1e3 * np.exp(np.mean(np.log(quartiles), axis=0))
    costs = {"ms": float(middle), "ms_low": float(low), "ms_high": float(high)}
    pairs = [(by_label[label], by_label.get(baseline)) for by_label in times]
    same = [(a.seconds, b.seconds) for a, b in pairs if b is not None and a.group == b.group]
    if len(same) < len(times):
        return costs
    estimate = estimate_cost_ratio(same)
    with np.errstate(over="ignore"):
        ends = [float(np.exp(end)) for end in estimate.interval(alpha)]
    names = ("cost", "cost_low", "cost_high")
    return costs | dict(zip(names, (float(np.exp(estimate.value)), *ends), strict=True))


def _find_fault(content: Mapping[str, Any]) -> str:
    """Describe the first fault of the content of a file: format, clock, rounds or times; empty without one."""
    if content["format"] != _FORMAT:
        return f"format {content['format']}"
    for condition in content["conditions"].values():
        clock = condition["clock"]
        if clock not in ("cpu", "wall"):
            return f"clock {clock}"
        jobs = condition["jobs"].values()
        rounds = {len(job[name]) for job in jobs for name in ("cpu", "wall")}
        if len(rounds) != 1 or min(rounds) < FEWEST_ROUNDS:
            return f"{sorted(rounds)} rounds"
        times = [t for job in jobs for t in job[clock]]
        if not all(type(t) is float and math.isfinite(t) and t > 0 for t in times):
            return "times that are not positive numbers"
    return ""
