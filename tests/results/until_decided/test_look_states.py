"""States of pairs at looks: those of planned looks, and e-values that hold at every look."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from decision_cases import make_study

from pfbench.results.paper_block import plan_installed_pairs
from pfbench.stats.decision import MetricRule
from pfbench.stats.pair_states import (
    LookRecord,
    LookSchedule,
    average_over_conditions,
    decide_pairs,
    describe_end,
    format_look,
)
from pfbench.stats.sequential_looks import LookPlan, decide_at_looks, is_complete
from pfbench.stats.study_runs import select_pair, to_study_runs
from pfbench.stats.study_size import describe_study_size, detectable_effects

PAIRS = [("A", "B"), ("A", "C"), ("B", "C")]
ANY_TIME = LookSchedule("e_values", 160)


def study(runs: int = 40, **settings: Any) -> Any:
    effects = {"A": -0.4, "B": 0.0, "C": 0.0}
    return make_study(effects, worlds=2, runs=runs, world_sd=0.0, run_sd=0.5, **settings)


def test_schedules() -> None:
    assert LookSchedule().runs == LookPlan().runs == (20, 40, 80, 160, 320)
    assert LookSchedule("looks", 50).runs == (20, 40, 50)
    assert LookSchedule("e_values", 70).runs == (20, 40, 60, 70)
    assert LookSchedule("looks", 20).runs == (20,)
    assert LookSchedule("looks", 50).parts(3) == [(0, 20), (20, 20), (40, 10)]
    for mode, runs, key in (
        ("often", 40, "mode"),
        ("looks", 19, "max_runs"),
        ("looks", 9.5, "max_runs"),
    ):
        with pytest.raises(ValueError, match=f"until_decided.{key} must be"):
            LookSchedule(mode, runs)  # type: ignore[arg-type]


@pytest.mark.parametrize("runs", [20, 40, 80])
def test_states_are_the_decisions_at_planned_looks(runs: int) -> None:
    table = study(80, lost={"B": 0.1})
    table = table[table.run < runs]
    schedule = LookSchedule("looks", 80)
    expected = decide_at_looks(table, PAIRS, LookPlan(runs=(20, 40, 80)))
    states = decide_pairs(table, PAIRS, schedule)
    assert [(s.a, s.b, s.word) for s in states] == [(d.a, d.b, d.pair_word) for d in expected[1::2]]
    assert any(s.is_open for s in states) == (not is_complete(expected))
    assert states[0].word == "better"
    error = expected[1]
    assert states[0].interval == f"ratio {np.exp(error.low):.3g} to {np.exp(error.high):.3g}"


@pytest.mark.parametrize("mode", ["looks", "e_values"])
def test_a_score_decides_by_its_own_scale_and_direction(mode: Any) -> None:
    """A log score is better where it is higher, and its interval is a difference."""
    rule = MetricRule("log score per step", "difference", higher_is_better=True)
    table = study(80)
    table = table.assign(value=np.log(table["value"]))  # A has the smallest values
    schedule = LookSchedule(mode, 80)
    (by_ratio,) = decide_pairs(study(80), [("A", "B")], schedule)
    (state,) = decide_pairs(table, [("A", "B")], schedule, rule=rule)
    assert (by_ratio.word, state.word) == ("better", "worse")
    assert state.interval.startswith("difference 0.")


def test_lines_say_what_is_decided_and_what_is_open() -> None:
    schedule = LookSchedule("looks", 40)
    states = decide_pairs(study(20), PAIRS, schedule)
    line = format_look(1, schedule, states)
    assert line.startswith("look 1, 20 runs: 2 of 3 pairs decided; new: A better than B (ratio 0.")
    assert "open: B / C (ratio 0." in line
    assert describe_end(1, schedule, states) == ""
    assert "new" not in format_look(2, schedule, states, states)
    assert describe_end(2, schedule, states) == "1 of 3 pairs are open after max_runs=40."
    assert describe_end(1, schedule, states[:2]) == "all 2 pairs are decided after 20 runs."


def test_e_values_hold_at_every_look() -> None:
    """The error of eight looks together; a study with an effect is decided, and stays decided."""
    wrong = 0
    for seed in range(120):
        null = make_study({"A": 0.0, "B": 0.0}, worlds=1, runs=160, world_sd=0.0, seed=seed)
        (state,) = decide_pairs(null, [("A", "B")], ANY_TIME)
        wrong += state.word in ("better", "worse")
    assert wrong <= 120 * 0.05 + 3 * np.sqrt(120 * 0.05 * 0.95)
    words = [
        decide_pairs(study(160)[lambda t, n=n: t.run < n], PAIRS, ANY_TIME)[0].word
        for n in ANY_TIME.runs
    ]
    first = words.index("better")
    assert set(words[first:]) == {"better"}


def test_a_lost_run_lies_at_its_end() -> None:
    """The lost runs of a decide, although its other errors are smaller; equal losses are ties."""
    table = study(160, lost={"A": 0.9})
    (state,) = decide_pairs(table, [("A", "B")], ANY_TIME)
    assert (state.word, state.is_open) == ("worse", False)
    pair = select_pair(to_study_runs(study(4)), "A", "B")
    keeps = np.ones(pair.present.shape, dtype=bool)
    keeps[:, :, 0] = False
    one = keeps.copy()
    one[:, :, 1] = False
    d = average_over_conditions(pair._replace(keeps_a=keeps, keeps_b=one))
    assert d[0] == 0
    assert d[1] == -np.inf
    assert np.isfinite(d[2:]).all()


def test_a_run_without_all_conditions_is_left_out() -> None:
    pair = select_pair(to_study_runs(study(4)), "A", "B")
    present = pair.present.copy()
    present[0, 0, 2] = False
    d = average_over_conditions(pair)
    fewer = average_over_conditions(pair._replace(present=present))
    np.testing.assert_array_equal(fewer, np.delete(d, 2))


def test_the_record_keeps_its_plan(tmp_path: Path) -> None:
    path, plan = tmp_path / "looks.json", {"until_decided.max_runs": 320, "jobs": ["a"]}
    LookRecord(path, plan).write(["look 1"], "all decided")
    record = LookRecord(path, plan)
    assert (record.looks, record.state) == (["look 1"], "all decided")
    with pytest.raises(ValueError, match=r"until_decided.max_runs must be 320, .* got 640"):
        LookRecord(path, {**plan, "until_decided.max_runs": 640})
    path.write_text(path.read_text().replace("look 1", "look 2"))
    with pytest.raises(ValueError, match="got a damaged file"):
        LookRecord(path, plan)


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
