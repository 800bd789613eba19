"""A study that adds runs: levels of the looks, state of each pair, and the lines after each look.

The error is spent over looks as a function of the share of runs, so that all looks together have the error rate of
one study. Each look is decided as a study of fixed size by the first runs of the study, at the level of the look.

References:
    P. Armitage, C. K. McPherson and B. C. Rowe (1969), Repeated significance tests on accumulating data.
    K. K. G. Lan and D. L. DeMets (1983), Discrete sequential boundaries for clinical trials.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import DIGEST, has_valid_digest, hash_content, write_atomically
from pfbench.stats.comparison import ALPHA, EQUALITY_MARGIN, NO_DECISION, Verdict
from pfbench.stats.court import Court
from pfbench.stats.error_measures import Array
from pfbench.stats.study_runs import StudyRuns

PairStates = list[Verdict]  # those that are not decided are open
_NODES = 121
_LARGEST = 37.0  # standard score beyond which a normal tail is zero in double precision


def decide_at_looks(
    runs: StudyRuns,
    pairs: Sequence[tuple[str, str]],
    schedule: LookSchedule,
    metric: str = "rmse",
    margin: float = EQUALITY_MARGIN,
    alpha: float = ALPHA,
) -> PairStates:
    """Decide pairs with all looks that the runs allow. A pair keeps the verdict of the look that decides it; else it is open.

    Args:
        runs: Runs so far.
        pairs: Labels of the pairs that were fixed in advance.
        schedule: Looks of the study.
        metric: Column of the error.
        margin: Log ratio within which two filters are equal.
        alpha: Error rate of all pairs and looks together.

    Raises:
        ValueError: If the runs do not reach the first look.
    """
    looks = [n for n in schedule.runs if n <= runs.present.shape[-1]]
    require(
        looks,
        "runs",
        f"be at least {schedule.runs[0]}",
        runs.present.shape[-1],
        "Add runs.",
    )
    levels = look_levels(schedule.runs, alpha / len(pairs))
    everywhere = np.ones(len(runs.conditions), dtype=bool)
    states: PairStates = []
    for number, level in zip(looks, levels, strict=False):
        court = Court(
            runs.take_first(number), pairs, margin, level * len(pairs)
        )  # whose first step is the level
        verdicts = [court.find(metric, everywhere, *pair) for pair in pairs]
        states = [
            new if old.word == NO_DECISION else old
            for old, new in zip(states or verdicts, verdicts, strict=True)
        ]
    return states


def look_levels(runs: Sequence[int], alpha: float) -> list[float]:
    """Return the two-sided levels of the looks of one comparison, which spend its error as Pocock's do."""
    scores = boundary_scores(tuple(n / runs[-1] for n in runs), alpha)
    return [2 * float(ndtr(-z)) for z in scores]


def spent_error(time: float, alpha: float) -> float:
    """Return the error that may be spent until a share of the runs."""
    return alpha * math.log1p(math.expm1(1.0) * time)


@lru_cache(maxsize=512)
def boundary_scores(times: tuple[float, ...], alpha: float) -> tuple[float, ...]:
    """Compute the standard scores at which a look shows a difference, two-sided.

    The distribution of the sum of runs that have not yet decided is integrated from look to look
    with Gauss-Legendre points.
    """
    nodes, node_weights = np.polynomial.legendre.leggauss(_NODES)
    scores: list[float] = []
    x, mass, before, spent = np.zeros(1), np.ones(1), 0.0, 0.0
    for time in times:
        target = spent_error(time, alpha) - spent
        sd, root = np.sqrt(time - before), np.sqrt(time)
        excess = partial(_excess, x, mass, root, sd, target)
        z = float(brentq(excess, 0.0, _LARGEST, xtol=1e-10)) if target > 0 else _LARGEST
        scores.append(z)
        following = z * root * nodes
        kernel = np.exp(-0.5 * ((following[:, None] - x) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        mass = z * root * node_weights * (kernel @ mass)
        x, before, spent = following, time, spent + max(target, 0.0)
    return tuple(scores)


def _excess(x: Array, mass: Array, root: float, sd: float, target: float, score: float) -> float:
    """Return the probability that the next sum exceeds a score, minus the target."""
    limit = score * root
    return float(mass @ (ndtr((x - limit) / sd) + ndtr((-x - limit) / sd))) - target


# --------------------------------------------------------------------------------------------------
# Runs at each look of a study that adds runs, and the record that keeps its plan.
#
# A plan is fixed before the first look: levels of the looks that follow from another plan would not
# hold the error.

FIRST_LOOK = 20
RECORD = "looks.json"  # in the folder of the results


@dataclass(frozen=True)
class LookSchedule:
    """Runs per condition at the looks of a study: 20, 40, 80 and so on.

    Attributes:
        max_runs: Runs per condition at most.

    Raises:
        ValueError: if the runs do not reach the first look.
    """

    max_runs: int = 320

    def __post_init__(self) -> None:
        require(
            type(self.max_runs) is int and self.max_runs >= FIRST_LOOK,
            "until_decided.max_runs",
            f"be a whole number of at least {FIRST_LOOK}",
            self.max_runs,
            "Use 320.",
        )

    @property
    def runs(self) -> tuple[int, ...]:
        """Runs per condition at each look."""
        looks, following = [], FIRST_LOOK
        while following < self.max_runs:
            looks.append(following)
            following *= 2
        return (*looks, self.max_runs)

    def parts(self, number: int) -> list[tuple[int, int]]:
        """Return the first run and the number of runs of all parts until a look.

        Args:
            number: Number of the look, from 1.
        """
        ends = self.runs[:number]
        return [(first, end - first) for first, end in zip((0, *ends), ends, strict=False)]


class LookRecord:
    """Plan and looks of a study in one file.

    Attributes:
        path: File.
        request: Plan of the study.
        looks: Lines of the looks so far.
        state: Reason why the study has finished, or empty.
    """

    def __init__(self, path: Path, request: Mapping[str, Any]) -> None:
        self.path = path
        self.request: dict[str, Any] = json.loads(json.dumps(request))
        self.looks: list[str] = []
        self.state = ""
        if not path.exists():
            return
        stored = _read_record(path)
        for key, value in self.request.items():
            require(
                stored["request"].get(key) == value,
                key,
                f"be {_shorten(stored['request'].get(key))}, as at the first look of this study",
                _shorten(value),
                f"Use another study=NAME, or delete the folder {path.parent}.",
            )
        self.looks, self.state = list(stored["looks"]), str(stored["state"])

    def write(self, looks: Sequence[str], state: str = "") -> None:
        """Write the looks so far."""
        self.looks, self.state = list(looks), state
        content = {"request": self.request, "looks": self.looks, "state": state}
        text = json.dumps({**content, DIGEST: hash_content(content)}, indent=1)
        write_atomically(self.path, lambda file: file.write(text.encode()))


def find_level(folder: Path, alpha: float) -> tuple[float, str]:
    """Return the level of the last look of a study that adds runs, with a sentence; `alpha` and nothing for another study.

    Args:
        folder: Results of the study.
        alpha: Error rate of all looks together.
    """
    path = folder / RECORD
    stored = _read_record(path) if path.is_file() else {"looks": []}
    if not stored["looks"]:
        return alpha, ""
    number, runs = (
        len(stored["looks"]),
        LookSchedule(stored["request"]["until_decided.max_runs"]).runs,
    )
    level = math.floor(1e4 * look_levels(runs, alpha)[number - 1]) / 1e4
    return level, (
        f"Runs were added until look {number} of {len(runs)}: its tests and intervals have the level {100 * level:.3g} %, "
        f"so that all looks together have {100 * alpha:g} %."
    )


def _read_record(path: Path) -> dict[str, Any]:
    """Read a record and check its digest."""
    try:
        stored = json.loads(path.read_text())
    except ValueError:
        stored = None
    require(
        isinstance(stored, dict) and has_valid_digest(stored),
        path,
        "be the record of a study",
        "a damaged file",
        "Delete it: the results are kept, and all looks are repeated from them.",
    )
    return stored


def _shorten(value: Any) -> str:
    """Format a value in at most 60 characters."""
    text = f"{value}"
    return text if len(text) <= 60 else f"{text[:57]}..."


_LISTED = 6  # pairs in a line


def format_look(
    number: int,
    schedule: LookSchedule,
    states: Sequence[Verdict],
    earlier: Sequence[Verdict] = (),
    warning: str = "",
) -> str:
    """Format what is decided and what is open after a look.

    Args:
        number: Number of the look, from 1.
        schedule: Looks of the study.
        states: Verdict on each pair; those that are not decided are open.
        earlier: States at the look before.
        warning: Sentence on runs that are not independent; empty without one.

    Returns:
        One line.
    """
    unresolved = [v for v in states if v.word == NO_DECISION]
    decided = {v[:2] for v in earlier if v.word != NO_DECISION}
    new = [v for v in states if v.word != NO_DECISION and v[:2] not in decided]
    runs, count = schedule.runs[number - 1], len(states) - len(unresolved)
    parts = [f"look {number}, {runs} runs: {count} of {len(states)} pairs decided"]
    parts += [f"new: {_list_states(new)}"] if new else []
    parts += [f"open: {_list_states(unresolved)}"] if unresolved else []
    return ". ".join(filter(None, ("; ".join(parts), warning)))


def describe_end(number: int, schedule: LookSchedule, states: Sequence[Verdict]) -> str:
    """Return why a study ends with a look, empty if more runs follow.

    Args:
        number: Number of the look, from 1.
        schedule: Looks of the study.
        states: Verdict on each pair; those that are not decided are open.
    """
    runs, count = schedule.runs[number - 1], sum(v.word == NO_DECISION for v in states)
    if not count:
        return f"all {len(states)} pairs are decided after {runs} runs."
    if number == len(schedule.runs):
        return f"{count} of {len(states)} pairs are open after max_runs={runs}."
    return ""


def _list_states(states: Sequence[Verdict]) -> str:
    """List up to six pairs."""
    more = f" and {len(states) - _LISTED} more" if len(states) > _LISTED else ""
    return f"{', '.join(map(describe_pair, states[:_LISTED]))}{more}"


def describe_pair(verdict: Verdict) -> str:
    """Describe a pair after a look."""
    word, is_than = verdict.word, verdict.word in ("better", "worse")
    relation = f"{word} than" if is_than else "/"
    ending = f" {word}" if word in ("equal", "identical") else ""
    return f"{verdict.a} {relation} {verdict.b}{ending} (ratio {verdict.low:.3g} to {verdict.high:.3g})"
