"""Error rates of the words of a report in simulated studies: the block `rates` of docs/statistics.md.

`python experiments/analyses/word_rates.py [STUDIES]` simulates studies of seven methods and three baselines by the
functions of a report. Filters share the difficulty of a run, and runs of different conditions correlate. A word has
its own null: equal filters for better and worse, a ratio at the margin for equal, a share of 80 % for "loses track",
the error of the best baseline for the star. The control decides each pair alone at 5 %, which must fail.
"""

from __future__ import annotations

import math
import re
import sys
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.files import markdown_head, markdown_row
from pfbench.report import find_lost_conditions
from pfbench.results import (
    LookSchedule,
    StudyRuns,
    compare_filters,
    compute_losses,
    decide,
    decide_at_looks,
    find_largest_p,
    holm,
)

PAGE = Path(__file__).parents[2] / "docs" / "statistics.md"
METHODS, BASELINES = 7, 3
MARGIN, ALPHA, CAP = math.log(1.05), 0.05, 30.0
DIFFICULTY, OWN = 0.4, 0.28  # SD of the log error of a run
_BLOCK = re.compile(r"<!-- numbers:rates -->\n.*?<!-- numbers:end -->", re.DOTALL)


class Setting(NamedTuple):
    """Size and noise of simulated studies.

    Attributes:
        worlds: Number of worlds of one condition.
        runs: Runs of each.
        lost: Share of runs without track, of every filter.
        correlation: Of two worlds over runs, which share random numbers.
        noise: normal, t3 or skewed.
    """

    worlds: int = 3
    runs: int = 30
    lost: float = 0.0
    correlation: float = 0.15
    noise: str = "t3"


SETTINGS = (
    Setting(1, 20), Setting(1, 30), Setting(1, 100), Setting(1, 300), Setting(3, 20), Setting(3, 30), Setting(3, 100),
    Setting(6, 30), Setting(12, 30), Setting(12, 100), Setting(3, 30, 0.1), Setting(3, 30, 0.2), Setting(3, 30, 0.4),
    Setting(1, 100, 0.4), Setting(12, 30, 0.4), Setting(6, 30, correlation=0.0), Setting(6, 30, correlation=0.5),
    Setting(3, 30, noise="normal"), Setting(3, 100, noise="normal"), Setting(3, 30, noise="skewed"),
    Setting(3, 100, noise="skewed"), Setting(3, 100, 0.2, noise="skewed"),
)  # fmt: skip


def draw_study(setting: Setting, rng: np.random.Generator, levels: np.ndarray) -> StudyRuns:
    """Draw the runs of a study whose filters have given log levels, [F]."""
    shape = (len(levels), setting.worlds, setting.runs)
    common = math.sqrt(setting.correlation) * _draw(rng, setting.noise, (shape[0], 1, shape[2]))
    own = common + math.sqrt(1 - setting.correlation) * _draw(rng, setting.noise, shape)
    hard = rng.standard_normal((1, *shape[1:]))
    error = np.exp(levels[:, None, None] + DIFFICULTY * hard + OWN * own)
    keeps = rng.random(shape) >= setting.lost
    worlds = [f"w{k}" for k in range(setting.worlds)]
    conditions = pd.DataFrame({"family": worlds, "scenario": worlds, "regime": "nominal"})
    names = tuple(f"f{k}" for k in range(shape[0]))
    present = np.ones(shape, dtype=bool)
    return StudyRuns(names, conditions, {"rmse": error}, keeps, present, np.full(shape[1], CAP))


def _draw(rng: np.random.Generator, noise: str, shape: tuple[int, ...]) -> np.ndarray:
    """Draw noise of unit variance."""
    if noise == "t3":
        return rng.standard_t(3, shape) / math.sqrt(3.0)
    return rng.standard_normal(shape) if noise == "normal" else rng.standard_exponential(shape) - 1


def rate_words(setting: Setting, studies: int, seed: int) -> list[float]:
    """Return the shares of studies with a false word of each kind, of the control, and with a true one."""
    rng = np.random.default_rng([seed, *map(hash_text, map(str, setting))])
    found = np.zeros(7)
    pairs = [(f"f{k}", f"f{METHODS}") for k in range(METHODS)]
    equal = np.zeros(METHODS + BASELINES)
    at_margin, better = equal.copy(), equal.copy()
    at_margin[:METHODS], better[0] = MARGIN, -0.2
    for _ in range(studies):
        runs = draw_study(setting, rng, equal)
        losses = compute_losses(runs, "rmse")
        effects = compare_filters(runs, losses, pairs)
        verdicts = decide(effects, MARGIN, ALPHA)
        moved = draw_study(setting, rng, at_margin)
        words = [
            v.word for v in decide(compare_filters(moved, compute_losses(moved, "rmse"), pairs))
        ]
        shifted = draw_study(setting, rng, better)
        strong = decide(compare_filters(shifted, compute_losses(shifted, "rmse"), pairs))[0]
        kept = draw_study(setting._replace(lost=0.2), rng, equal)
        looks = decide_at_looks(runs, pairs, LookSchedule(max(20, setting.runs)), margin=MARGIN)
        found += [
            any(v.word in ("better", "worse") for v in verdicts),
            "equal" in words,
            bool(find_lost_conditions(kept, ALPHA).any()),
            _has_star(losses),
            any(state.verdict.word in ("better", "worse") for state in looks),
            any(
                decide([effect], MARGIN, ALPHA)[0].word in ("better", "worse") for effect in effects
            ),
            strong.word == "better",
        ]
    return [float(value) for value in found / studies]


def _has_star(losses: np.ndarray) -> bool:
    """Return whether a method is called better than all baselines of a world, by the rule of the first page."""
    p = [
        find_largest_p([(losses[m, w], losses[METHODS + b, w]) for b in range(BASELINES)])
        for m, w in product(range(METHODS), range(losses.shape[1]))
    ]
    return bool((holm(p) < ALPHA).any())


def hash_text(text: str) -> int:
    """Return a number of a text, equal in all processes."""
    return int.from_bytes(text.encode()[:7], "big")


def rates_table(studies: int) -> str:
    """Table of the rates of all settings."""
    lines = markdown_head(
        "worlds", "runs", "lost", "correlation", "noise", "better or worse", "equal", "loses track", "star", "until decided",
        "each pair alone", "true effect",
    )  # fmt: skip
    for k, setting in enumerate(SETTINGS):
        rates = rate_words(setting, studies, k)
        lines.append(markdown_row(*map(str, setting), *(f"{rate:.3f}" for rate in rates)))
        print(lines[-1], flush=True)
    error = math.sqrt(0.05 * 0.95 / studies)
    note = f"{studies} studies a row; the standard error of a rate of 0.050 is {error:.4f}."
    return "\n".join([*lines, "", note])


if __name__ == "__main__":
    table = rates_table(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
    block = f"<!-- numbers:rates -->\n{table}\n<!-- numbers:end -->"
    PAGE.write_text(_BLOCK.sub(lambda match: block, PAGE.read_text()))
