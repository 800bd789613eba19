"""A study that adds runs: levels of its looks, states of pairs, lines and record."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from decision_cases import make_study
from refusals import check_refused

from pfbench.results.paper_block import plan_installed_pairs
from pfbench.stats.comparison import decide
from pfbench.stats.pair_states import (
    LookRecord,
    LookSchedule,
    decide_at_looks,
    describe_end,
    find_level,
    format_look,
    look_levels,
)
from pfbench.stats.rank_tests import wilcoxon_signed_rank_rows
from pfbench.stats.study_runs import StudyRuns, arrange_runs, compare_filters, compute_losses
from pfbench.stats.study_size import count_needed_runs, describe_study_size, detectable_effects

PAIRS = [("A", "B"), ("A", "C"), ("B", "C")]
EFFECTS = {"A": -0.4, "B": 0.0, "C": 0.0}


def study(runs: int, seed: int = 0, effects: dict[str, float] = EFFECTS) -> StudyRuns:
    table = make_study(effects, worlds=2, runs=runs, world_sd=0.0, run_sd=0.5, seed=seed)
    return arrange_runs(table, tuple(effects))


def test_schedules() -> None:
    assert LookSchedule().runs == (20, 40, 80, 160, 320)
    assert LookSchedule(50).runs == (20, 40, 50)
    assert LookSchedule(20).runs == (20,)
    assert LookSchedule(50).parts(3) == [(0, 20), (20, 20), (40, 10)]
    for runs in (19, 9.5):
        with pytest.raises(ValueError, match=r"until_decided.max_runs must be"):
            LookSchedule(runs)  # type: ignore[arg-type]


def test_the_levels_of_the_looks_spend_the_error() -> None:
    """A random walk crosses the bounds of any look with probability alpha: a simulation without their integral."""
    runs = (20, 40, 80)
    levels = look_levels(runs, 0.05)
    assert look_levels((20,), 0.05) == pytest.approx([0.05])
    rng = np.random.default_rng(1)
    x = np.cumsum(rng.standard_normal((40_000, 80)), axis=1)[:, [19, 39, 79]] / np.sqrt(runs)
    limits = [math.sqrt(2) * float(_inverse_erfc(level)) for level in levels]
    share = (np.abs(x) > limits).any(axis=1).mean()
    assert share == pytest.approx(0.05, abs=3 * math.sqrt(0.05 * 0.95 / 40_000))


def _inverse_erfc(level: float) -> float:
    """Solve erfc(z) = level by bisection."""
    low, high = 0.0, 10.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if math.erfc(middle) > level else (low, middle)
    return low


@pytest.mark.parametrize("runs", [20, 40, 80])
def test_each_look_is_a_study_of_its_first_runs_at_its_level(runs: int) -> None:
    schedule, data = LookSchedule(80), study(80)
    levels = look_levels(schedule.runs, 0.05 / 3)
    losses = compute_losses(data, "rmse")
    expected: dict[int, str] = {}
    for number, level in zip(schedule.runs, levels, strict=True):
        if number <= runs:
            effects = compare_filters(data, losses[..., :number], PAIRS)
            for k, verdict in enumerate(decide(effects, alpha=3 * level)):
                if expected.get(k, "not decided") == "not decided":
                    expected[k] = verdict.word
    early = data._replace(
        present=data.present[..., :runs], keeps=data.keeps[..., :runs],
        values={name: value[..., :runs] for name, value in data.values.items()},
    )  # fmt: skip
    states = decide_at_looks(early, PAIRS, schedule)
    assert [s.word for s in states] == list(expected.values())
    assert states[0].word == "better"
    check_refused(
        [("runs must be at least 20, got 8", lambda: decide_at_looks(study(8), PAIRS, schedule))],
        remedy=False,
    )


def test_equal_filters_are_told_apart_at_the_level_over_all_looks() -> None:
    """200 studies of three looks: a look at 5 % each would be wrong in one study of eight (the control)."""
    schedule, wrong, naive = LookSchedule(80), 0, 0
    pairs, rng = [("A", "B")], np.random.default_rng(0)
    arranged = study(80, 0, {"A": 0.0, "B": 0.0})
    for _ in range(200):
        errors = np.exp(0.5 * rng.standard_normal(arranged.keeps.shape))
        data = arranged._replace(values={"rmse": errors})
        wrong += decide_at_looks(data, pairs, schedule)[0].word in ("better", "worse")
        losses = compute_losses(data, "rmse")
        looks = [
            decide(compare_filters(data, losses[..., :n], pairs))[0].word for n in schedule.runs
        ]
        naive += any(word in ("better", "worse") for word in looks)
    limit = 0.05 + 2 * math.sqrt(0.05 * 0.95 / 200)
    assert wrong / 200 <= limit
    assert naive > wrong


def test_lines_say_what_is_decided_and_what_is_open() -> None:
    schedule = LookSchedule(40)
    states = decide_at_looks(study(20), PAIRS, schedule)
    line = format_look(1, schedule, states)
    assert line.startswith("look 1, 20 runs: 2 of 3 pairs decided; new: A better than B (ratio 0.")
    assert "open: B / C (ratio 0." in line
    assert describe_end(1, schedule, states) == ""
    assert "new" not in format_look(2, schedule, states, states)
    assert describe_end(2, schedule, states) == "1 of 3 pairs are open after max_runs=40."
    assert describe_end(1, schedule, states[:2]) == "all 2 pairs are decided after 20 runs."


def test_the_record_keeps_its_plan(tmp_path: Path) -> None:
    path, plan = tmp_path / "looks.json", {"until_decided.max_runs": 320, "jobs": ["a"]}
    LookRecord(path, plan).write(["look 1"], "all decided")
    record = LookRecord(path, plan)
    assert (record.looks, record.state) == (["look 1"], "all decided")
    level, sentence = find_level(tmp_path, 0.05)  # of the first of five looks
    assert level == pytest.approx(look_levels(LookSchedule(320).runs, 0.05)[0], abs=1e-4)
    assert "until look 1 of 5" in sentence
    assert find_level(tmp_path / "other", 0.05) == (0.05, "")
    check_refused(
        [
            (
                r"until_decided.max_runs must be 320, .* got 640",
                lambda: LookRecord(path, {**plan, "until_decided.max_runs": 640}),
            )
        ],
        remedy=False,
    )
    path.write_text(path.read_text().replace("look 1", "look 2"))
    check_refused([("got a damaged file", lambda: LookRecord(path, plan))], remedy=False)


def test_planned_pairs_are_those_of_the_papers() -> None:
    assert plan_installed_pairs(["rpf", "mcmc_rpf", "sir"]) == [
        ("mcmc_rpf", "sir"),
        ("mcmc_rpf", "rpf"),
    ]
    assert plan_installed_pairs(["sir", "ekf", "ukf"]) == [
        ("ekf", "sir"),
        ("ekf", "ukf"),
        ("sir", "ukf"),
    ]
    assert plan_installed_pairs(["sir"]) == []


def test_the_sentence_before_a_study() -> None:
    assert describe_study_size(5, 3, 4).startswith("5 runs can show nothing")
    sentence = describe_study_size(50, 3, 4)
    effects = detectable_effects(50, 3, 4)
    assert f"at least {np.exp(effects.error_same_worlds):.3g} in these 3 worlds" in sentence
    assert f"at least {np.exp(effects.error_new):.3g} in a new world" in sentence
    assert "requires at least 2 worlds" in describe_study_size(50, 1, 4)


@pytest.mark.parametrize(
    "law", [lambda r, n: r.standard_normal(n), lambda r, n: r.standard_t(2, n)]
)
def test_the_needed_runs_have_the_power(law: Callable[[Any, Any], np.ndarray]) -> None:
    """Two tests of one side on 2000 simulated studies; half of the runs lack the power."""
    rng, ratio, alpha = np.random.default_rng(3), 0.8, 0.002
    needed = int(count_needed_runs(0.4 * law(rng, 2000), ratio, alpha))

    def power(n: int) -> float:
        d = math.log(ratio) + 0.4 * law(rng, (2000, n))
        ranks = wilcoxon_signed_rank_rows(d, "less")[1] < alpha
        signs = scipy.stats.binom.cdf((d > 0).sum(1), n, 0.5) < alpha
        return float((ranks & signs).mean())

    assert 0.72 < power(needed) < 0.9  # the formula for ranks is one for large samples
    assert power(needed // 2) < 0.6
