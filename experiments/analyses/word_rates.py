"""Error rates of the words of a report in simulated studies: the block `rates` of docs/statistics.md.

`python experiments/analyses/word_rates.py [STUDIES]` simulates studies of seven methods and three baselines in one world by the
functions of a report. Filters share the difficulty of a run. A word has its own null: half of the runs smaller for better and
worse, also where the differences are skewed; a ratio at the margin, and a gap of 10 % of lost runs, for equal; equal shares of lost runs
for "loses more"; a share of 80 % for "loses track"; the error of the best baseline for the star. Two controls must fail:
each pair alone at 5 %, and the rule without the sign test.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

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
MARGIN, ALPHA, GAP = math.log(1.05), 0.05, 0.1
DIFFICULTY, OWN, CLOSE = 0.4, 0.28, 0.03  # SD of the log error of a run; of filters that are equal
_BLOCK = re.compile(r"<!-- numbers:rates -->\n.*?<!-- numbers:end -->", re.DOTALL)
_MEDIANS = {"exponential": math.log(2.0), "log-normal": 1.0}


class Setting(NamedTuple):
    """Size and noise of simulated studies.

    Attributes:
        runs: Number of runs.
        noise: normal, t3, or of skewed differences: exponential, log-normal.
        lost: Share of runs without track, of every filter.
    """

    runs: int = 30
    noise: str = "t3"
    lost: float = 0.0


SETTINGS = (
    Setting(30), Setting(100, "normal"), Setting(30, "exponential"), Setting(100, "exponential"), Setting(200, "exponential"),
    Setting(100, "log-normal"), Setting(100, lost=0.1), Setting(100, "exponential", 0.1),
)  # fmt: skip


def draw_study(
    setting: Setting, rng: np.random.Generator, levels: np.ndarray, spread: float = OWN, gap: float = 0.0
) -> StudyRuns:  # fmt: skip
    """Draw the runs of a study whose filters have given log levels, [F]; methods lose a larger share by the gap."""
    shape = (len(levels), 1, setting.runs)
    own = _draw(rng, setting.noise, shape)
    hard = rng.standard_normal((1, *shape[1:]))
    error = np.exp(levels[:, None, None] + DIFFICULTY * hard + spread * own)
    lost = np.where(np.arange(shape[0]) < METHODS, setting.lost + gap, setting.lost)
    keeps = rng.random(shape) >= lost[:, None, None]
    conditions = pd.DataFrame({"family": ["w"], "scenario": ["w"], "regime": ["nominal"]})
    names = tuple(f"f{k}" for k in range(shape[0]))
    return StudyRuns(names, conditions, {"rmse": error}, keeps, np.ones(shape, dtype=bool))


def _draw(rng: np.random.Generator, noise: str, shape: tuple[int, ...]) -> np.ndarray:
    """Draw noise; that of a skewed law has median 0 for the methods, and is absent in the baselines, so that differences are skewed."""
    if noise == "t3":
        return rng.standard_t(3, shape) / math.sqrt(3.0)
    x = rng.standard_normal(shape)
    if noise in _MEDIANS:
        x = (rng.exponential(size=shape) if noise == "exponential" else np.exp(x)) - _MEDIANS[noise]
        x[METHODS:] = 0.0
    return x


def rate_words(setting: Setting, studies: int, seed: int) -> list[float]:
    """Return the shares of studies with a false word of each kind, of the controls, and with true ones."""
    rng = np.random.default_rng([seed, setting.runs])
    found = np.zeros(10)
    pairs = [(f"f{k}", f"f{METHODS}") for k in range(METHODS)]
    equal = np.zeros(METHODS + BASELINES)
    at_margin, better = equal.copy(), equal.copy()
    at_margin[:METHODS], better[0] = MARGIN, -0.2

    def compare(runs: StudyRuns) -> list[Any]:
        return compare_filters(runs, compute_losses(runs, "rmse"), pairs)

    for _ in range(studies):
        runs = draw_study(setting, rng, equal)
        effects = compare(runs)
        verdicts = decide(effects, MARGIN, ALPHA)
        close = decide(compare(draw_study(setting, rng, equal, CLOSE, GAP)))
        kept = draw_study(setting._replace(lost=0.2), rng, equal)
        looks = decide_at_looks(runs, pairs, LookSchedule(max(20, setting.runs)), margin=MARGIN)
        unsigned = decide([effect._replace(p_sign=0.0) for effect in effects], MARGIN, ALPHA)
        found += [
            _differs(v.word for v in verdicts),
            "equal" in [v.word for v in decide(compare(draw_study(setting, rng, at_margin)))],
            close[0].word == "equal",
            any(v.lost.word for v in verdicts),
            bool(find_lost_conditions(kept, ALPHA).any()),
            _has_star(compute_losses(runs, "rmse")),
            _differs(state.verdict.word for state in looks),
            _differs(decide([effect], MARGIN, ALPHA)[0].word for effect in effects),
            _differs(v.word for v in unsigned),
            decide(compare(draw_study(setting, rng, better)))[0].word == "better",
        ]
    return [float(value) for value in found / studies]


def _differs(words: Iterable[str]) -> bool:
    """Return whether a word says that two filters differ."""
    return bool({"better", "worse"} & set(words))


def _has_star(losses: np.ndarray) -> bool:
    """Return whether a method is called better than all baselines of a world, by the rule of the first page."""
    p = [
        find_largest_p([(losses[m, w], losses[METHODS + b, w]) for b in range(BASELINES)])
        for m, w in product(range(METHODS), range(losses.shape[1]))
    ]
    return bool((holm(p) < ALPHA).any())


def rates_table(studies: int) -> str:
    """Table of the rates of all settings."""
    lines = markdown_head(
        "runs", "noise", "lost", "better or worse", "equal at the margin", "equal at a gap of 10 %", "loses more", "loses track", "star",
        "until decided", "each pair alone", "without the sign test", "true effect",
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
