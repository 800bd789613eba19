"""Runs of claims: what decides each, plans and prices, keys of `pfbench run`, stored values, verification, the page."""

import json
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from config_cases import GROUPS
from refusals import check_refused

from pfbench import job
from pfbench.claims import claim_lines, claim_runs
from pfbench.claims.claim_lines import (
    COLUMNS,
    DRAWS,
    JOINT_SEED,
    list_factor_levels,
    list_points,
    make_cell,
    read_claim_data,
    read_plans,
)
from pfbench.claims.claim_runs import (
    CLAIMS_STUDY,
    SEEDS,
    Batch,
    Cell,
    ClaimRuns,
    StoredValues,
    decide_claims,
    describe_sides,
    list_claim_cells,
    make_batch,
    write_values,
)
from pfbench.claims.ledger import conclude
from pfbench.claims.measures import Measure
from pfbench.claims.page import _format_ratio, _format_shown, _list_atoms, write_claims
from pfbench.claims.run_claims import (
    Task,
    _has_equal_mean,
    draw_records,
    find_measures,
    list_words,
    may_refuse,
    merge_tasks,
    price_claims,
    run_claim_task,
    verify_record,
)
from pfbench.claims.words import CONFIRMED, LOOKS, OPEN, REFUTED, WORDS
from pfbench.cli import claims as command
from pfbench.job.inputs import find_inputs
from pfbench.job.moved_clouds import measure_moved_clouds
from pfbench.job.readings import read_reading_table

PLANS = {plan.claim.id: plan for plan in read_plans()}
PAPERS = ("000", "001", "002", "003", "004")


def test_a_ratio_says_what_is_divided_by_what() -> None:
    """Of the comparison that is decided: where a larger figure is claimed, the rival stands first. By names, not keys."""
    sides = {
        claim: {describe_sides(c) for part in plan.parts.values() for c in part}
        for claim, plan in PLANS.items()
    }
    assert "acceptance rate, Resample-move PF / MCMC-RPF (printed)" in sides["C000-7"]
    assert (
        "largest error of position N from 500 s, COFM-AMSSRCPF (printed) / FMCPF" in sides["002-17"]
    )
    assert "RMS error of attitude N from 110 s, DMC-PF (printed) / UKF" in sides["003-C6"]
    assert "mean size of the error of attitude E from 110 s, DMC-PF (printed) / 22" in sides["003-C7"]  # fmt: skip
    assert "mean size of the error of attitude E from 110 s, UKF / DMC-PF (printed)" in sides["003-C7"]  # fmt: skip
    assert {text.partition(" / ")[2] for text in sides["002-12"]} == {
        "CPF (of position U from 500 s to 570 s)", "CPF (of position N from 900 s to 970 s)",
    }  # fmt: skip
    assert (
        "RMS error of position from 600 s to 660 s, CKF in an outage of 60 s of all but three satellites / CKF"
        in sides["002-40"]
    )
    assert not [text for texts in sides.values() for text in texts if "_target_" in text or "filter." in text]  # fmt: skip


def fill(claim: str, runs: int, value: Callable[[str, str], float]) -> ClaimRuns:
    """Fill listed readings with noise of 1 %, times a value of words and quantity; a job whose value is NaN failed."""
    plan, noise, records = PLANS[claim], np.random.default_rng(3).normal(1.0, 0.01, runs), []
    for cell, measures in list_claim_cells(plan).items():
        sizes = {name: value(" ".join(cell), name) for name in measures}
        failed = "ValueError: a density" if any(map(math.isnan, sizes.values())) else ""
        values = {name: list(size * noise) for name, size in sizes.items() if not failed}
        records.append(StoredValues(cell, 2001, 0, runs, "k", "c", 1.0, failed, (0,) * runs, values))  # fmt: skip
    return ClaimRuns(records)


def test_a_claim_whose_central_reading_cannot_run_has_the_numbers_of_one_that_can() -> None:
    """And says which one."""
    plan = PLANS["C000-1"]
    runs = fill("C000-1", 20, lambda cell, _: math.nan if "mcmc_rpf_printed" in cell and "noise_1" not in cell else 1.0)  # fmt: skip
    decisions = decide_claims([plan], runs)
    decided = decisions["C000-1", "published", "direction"]
    assert next(iter(decided.outcomes.values())) == "cannot run"
    name, shown = decided.first
    assert (name, shown.ratio, shown.runs) == ("noise_1", 1.0, 20)
    assert "Process noise of 1 %" in _format_shown(conclude(plan, decisions), decided)


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ((1.0, 0.976, 1.012), "1.000 [0.976, 1.012]"),
        ((1.00275, 0.99765, 1.0201), "1.003 [0.998, 1.020]"),
        ((0.9962, 0.99604, 0.99634), "0.99620 [0.99604, 0.99634]"),
        ((395.2, 324.1, 492.0), "395 [324, 492]"),
        ((0.0273, 0.0203, 0.09), "0.027 [0.020, 0.090]"),
        ((0.00342, 0.0021, 0.5), "0.003 [0.002, 0.500]"),
        ((1.0, 1.0, 1.0), "1.00 [1.00, 1.00]"),
        ((23.4, 2.1, math.inf), "23 [2, above 10 000]"),
        ((2e-5, 1e-6, 0.5), "below 0.001 [below 0.001, 0.500]"),
    ],
)
def test_a_ratio_and_its_interval_have_the_decimals_that_their_width_needs(numbers: tuple[float, float, float], text: str) -> None:  # fmt: skip
    assert _format_ratio(*numbers) == text


@pytest.mark.parametrize(
    ("ratio", "label", "fifth", "any_amount"),
    [
        (0.96, "depends on much", REFUTED, CONFIRMED),
        (0.7, CONFIRMED, CONFIRMED, CONFIRMED),
        (1.04, REFUTED, REFUTED, REFUTED),
    ],
)
def test_much_is_a_factor_with_two_levels_and_both_are_atoms(
    ratio: float, label: str, fifth: str, any_amount: str
) -> None:
    """Of "significantly enhances": 4 % in all runs are better, and not a fifth."""
    plan = PLANS["002-31"]
    runs = fill("002-31", 50, lambda cell, _: 1.0 if "tempering.strength=0.0" in cell else ratio)
    decisions = decide_claims([plan], runs)
    assert conclude(plan, decisions).label == label
    atoms = _list_atoms("002-31", decisions)
    assert len(atoms) == 2 * 2 * 2  # two quantities, two meanings of much, two columns
    assert {a["word"] for a in atoms if "a fifth better" in a["text"]} == {fifth}
    assert {a["word"] for a in atoms if "a fifth better" not in a["text"]} == {any_amount}


def test_what_a_paper_does_not_plot_is_beside_the_claim() -> None:
    """Of 004-C6: attitude, which no figure shows, is decided and does not count."""
    plan = PLANS["004-C6"]
    sizes = {True: 2.0, False: 0.5}
    runs = fill("004-C6", 30, lambda cell, name: sizes["attitude" in name] if "filter=sir" in cell else 1.0)  # fmt: skip
    decisions = decide_claims([plan], runs)
    assert conclude(plan, decisions).word == CONFIRMED
    words = {atom["text"]: atom["word"] for atom in _list_atoms("004-C6", decisions)}
    assert [word for text, word in words.items() if "attitude" in text and "beside the claim" in text] == [REFUTED]  # fmt: skip
    assert len(words) == 3


def test_losses_of_track_that_nobody_has_decide_nothing() -> None:
    plan = PLANS["004-C15"]

    def decide_by(lost: float) -> set[str]:
        records = [
            StoredValues(cell, 2001, 0, 30, "k", "c", 1.0, "", (0,) * 30, {name: [1.0, lost] * 15 for name in measures})
            for cell, measures in list_claim_cells(plan).items()
        ]  # fmt: skip
        return {decided.word for decided in decide_claims([plan], ClaimRuns(records)).values()}

    assert decide_by(1.0) == {"untestable"}
    assert "untestable" not in decide_by(2.0)


# what decides a claim


def test_each_claim_has_comparisons_or_a_word_with_a_reason() -> None:
    assert len(PLANS) == 88
    for plan in PLANS.values():
        assert bool(plan.parts) != bool(plan.word)
        assert not plan.word or (plan.word in WORDS and len(plan.reason.split()) > 2)
        for comparisons in plan.parts.values():
            for c in comparisons:
                sides = [side for side in (c.a, c.b) if side.filter]
                assert sides
                assert all(side.filter in GROUPS["filter"] for side in sides), plan.claim.id
                assert c.kind != "size" or 0 < c.printed < 1
    assert [c.kind for c in PLANS["002-40"].parts["published", "direction"]] == ["within", "better"]
    for paper, settings in read_claim_data()["papers"].items():
        # no repair of the method of paper 003 is admitted
        assert set(settings["method"]) == set(COLUMNS[: 1 if paper == "003" else 2])
        assert set(settings.get("instead", {})) | set(settings.get("only", {})) <= set(
            read_reading_table(paper)
        )


def test_a_claim_has_the_central_reading_single_levels_and_joint_draws() -> None:
    for plan in PLANS.values():
        points = list_points(plan)
        assert points[0].name == "central"
        readings = read_reading_table(plan.claim.paper)
        levels = {level for point in points for level in point.levels.values()} & set(readings)
        assert not any(readings[name]["class"] == "fitted" for name in levels)
        factors = {readings[name]["factor"] for name in levels} - {"none"}
        fitted = {"interval"}  # has no other level
        assert plan.toy or plan.word or factors == set(plan.claim.factors) - fitted
        assert len(points[-1].levels) == len(list_factor_levels(plan))
        assert len({tuple(p.levels) for p in points}) == 1
        drawn = [point.draw for point in points if point.draw >= 0]
        assert drawn == list(range(DRAWS if plan.is_drawn and list_factor_levels(plan) else 0))


def test_joint_draws_are_uniform_on_the_grid_and_the_same_for_all_claims_of_a_paper() -> None:
    """Each level of a factor as often as any other, within four standard errors, and without regard to other factors."""
    plan, other = PLANS["C001-7"], PLANS["C001-9"]
    drawn = [p.levels for p in list_points(plan) if p.draw >= 0]
    for factor, levels in list_factor_levels(plan).items():
        share = 1 / len(levels)
        error = math.sqrt(share * (1 - share) / DRAWS)
        for level in levels:
            assert abs(sum(p[factor] == level for p in drawn) / DRAWS - share) < 4 * error
    together = sum(p["grid"] == "central" and p["speed"] == "central" for p in drawn) / DRAWS
    assert abs(together - 1 / 8) < 4 * math.sqrt(1 / 8 * 7 / 8 / DRAWS)
    for mine, theirs in zip(drawn, [p.levels for p in list_points(other) if p.draw >= 0], strict=True):  # fmt: skip
        assert all(mine[factor] == theirs[factor] for factor in mine.keys() & theirs.keys())


def test_a_level_that_does_not_concern_a_filter_is_left_out_of_its_job() -> None:
    plan = PLANS["002-18"]
    (c,) = plan.parts["published", "direction"]
    points = {point.name: point for point in list_points(plan)}
    assert make_cell(plan, points["each"], c.b) == ("reading/002=each", "filter=cpf_each")
    joint = points["central"]._replace(
        levels={
            "adaptation": "adaptation_095",
            "weights": "weights_model",
            "receiver": "receiver_3",
        }
    )
    assert make_cell(plan, joint, c.b)[0] == "reading/002=receiver_3_and_weights_model"
    assert make_cell(plan, joint, c.a)[0] == "reading/002=adaptation_095_and_receiver_3_and_weights_model"  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("paper", PAPERS)
def test_each_cell_composes_and_builds_its_filter(paper: str) -> None:
    """A planted silent choice: a setting of a reading or a claim that the filter does not have."""
    cells = {cell for plan in PLANS.values() if plan.claim.paper == paper for cell in list_claim_cells(plan)}  # fmt: skip
    for cell in sorted(cells)[:: max(len(cells) // 40, 1)]:
        config = job.compose([*cell, "runs=2"])
        names = [word.removeprefix("filter=") for word in cell if word.startswith("filter=")]
        assert config.choices["filter"] in (names or [config.choices["filter"]])
        for group in ("scenario", "model", "noise", "filter"):
            assert job.instantiate(config.values[group]) is not None, (cell, group)


def test_no_key_of_a_line_is_ignored() -> None:
    """A planted misspelling, such as `metrics`, would decide another quantity in silence."""
    lines = read_claim_data()["claims"]
    assert set(lines) == set(PLANS)
    assert {key for line in lines.values() for key in line} == set(["compare", "windows", "toy", "method", "word", "why", "proved", "without"])  # fmt: skip
    side = {"metric", "group", "component", "from", "to", "settled"}
    known = {*side, *(f"b_{key}" for key in side), *["a", "b", "worlds", "printed", "level", "form", "pairs", "rows", "kind", "within", "beside"]}  # fmt: skip
    rows = [row for line in lines.values() for row in line.get("compare", ())]
    assert {key for row in rows for part in (row, *row.get("rows", ())) for key in part} <= known


# stored values


def store(cell: Cell, batch: Batch, values: dict[str, Any], **changes: Any) -> StoredValues:
    lost = tuple(0 for _ in range(batch.runs))
    record = StoredValues(cell, *batch, "k" * 16, "abc", 10.0, "", lost, values)
    return replace(record, **changes)


def draw_values(
    plan_id: str, ratio: float, runs: int = 0, true: str = ""
) -> Iterator[StoredValues]:
    """Yield values of the cells of a claim, in which a is `ratio` times b; those of joint draws with the numbers of runs.

    In joint draws that have the level `true`, it is 0.6 times b.
    """
    plan = PLANS[plan_id]
    points = [p for p in list_points(plan) if p.draw < 0 or (runs and p.draw < LOOKS[1])]
    is_a = {make_cell(plan, p, c.a) for part in plan.parts.values() for c in part for p in points}
    for k, (cell, measures) in enumerate(list_claim_cells(plan, points).items()):
        for batch in {make_batch(plan.claim.paper, p, "first") for p in points}:
            n = runs if batch.seed == JOINT_SEED else batch.runs
            g = np.random.default_rng([k, batch.seed])
            size = (0.6 if true and true in cell[0] else ratio) if cell in is_a else 1.0
            draws = {name: list(size * np.exp(0.2 * g.standard_normal(n))) for name in measures}
            yield store(cell, batch._replace(runs=n), draws)


def test_values_are_stored_whole_and_found_by_their_words(tmp_path: Path) -> None:
    batch = Batch(2001, 0, 3)
    record = store(("a=b", "c=d"), batch, {"x": [1.0, math.inf, math.nan]}, lost=(0, 0, 1))
    folder = tmp_path / CLAIMS_STUDY
    write_values(folder, record)
    (folder / f"damaged{claim_runs.VALUES_SUFFIX}").write_text('{"cell": ')
    runs = ClaimRuns.read(tmp_path, tmp_path / "none")
    assert runs.has(record.cell, batch, ["x"])
    assert not runs.has(record.cell, batch, ["y"])
    assert not runs.has(record.cell, batch._replace(seed=2002))
    series = runs.join(record.cell, "x")
    assert series is not None
    assert list(series[2]) == [False, False, True]
    assert series[1][1] == math.inf


def test_runs_of_joint_draws_are_those_of_a_fresh_seed_without_repetition() -> None:
    listed, *_, drawn = list_points(PLANS["004-C6"])
    first, more = (make_batch("004", drawn, stage) for stage in ("first", "more"))
    assert first.seed == more.seed == JOINT_SEED
    assert more.first_run == first.first_run + first.runs
    assert make_batch("004", listed, "first").seed == SEEDS[0] != JOINT_SEED


@pytest.mark.parametrize(("ratio", "word"), [(0.6, CONFIRMED), (1.4, REFUTED)])
def test_a_planted_effect_in_stored_values_gives_the_word_of_its_claim(
    ratio: float, word: str
) -> None:
    plans = [PLANS["004-C10"]]
    line = conclude(plans[0], decide_claims(plans, ClaimRuns(list(draw_values("004-C10", ratio)))))
    assert (line.word, line.repaired) == (word, word)
    assert conclude(plans[0], decide_claims(plans, ClaimRuns([]))).reason == "not run"


def test_a_proof_decides_the_readings_that_it_covers() -> None:
    """On the linear model a rule is not better; the readings of another heading still run."""
    plan = PLANS["002-32"]
    decision = decide_claims([plan], ClaimRuns([]))["002-32", "published", "direction"]
    assert decision.word == OPEN
    assert decision.outcomes == {
        "central": "false",
        "heading_45": "not run",
        "heading_80": "not run",
    }
    worse, better = (decide_claims([plan], ClaimRuns(list(draw_values("002-32", ratio)))) for ratio in (1.2, 0.8))  # fmt: skip
    assert worse["002-32", "published", "direction"].word == REFUTED
    assert better["002-32", "published", "direction"].factor == "heading"


def test_joint_draws_decide_by_their_share_and_the_factor_that_explains_it() -> None:
    """C001-9 true at one level of the speed, in half of the draws; and in none."""
    plan = PLANS["C001-9"]
    some, none = (
        conclude(plan, decide_claims([plan], ClaimRuns(list(draw_values("C001-9", 1.6, 30, true)))))
        for true in ("speed_200", "")
    )
    assert some.decision is not None
    assert (some.label, some.decision.is_drawn) == ("depends on speed", True)
    assert some.decision.explained > 0.95
    assert (none.word, none.repaired) == (REFUTED, REFUTED)
    assert none.reason == "true in 0 and false in 100 of 100 joint readings, a share of 0 to 5 %"


def test_no_word_changes_with_the_order_of_the_files() -> None:
    records = [*draw_values("003-C10", 0.7), *draw_values("003-C4", 1.0)]
    plans = [PLANS["003-C10"], PLANS["003-C4"]]
    first, again = (decide_claims(plans[::k], ClaimRuns(records[::k])) for k in (1, -1))
    assert {k: d.word for k, d in first.items()} == {k: d.word for k, d in again.items()}


def test_a_run_of_two_overlapping_jobs_counts_once() -> None:
    long = StoredValues(("a",), 2001, 0, 3, "k", "c", 1.0, "", (0, 1, 0), {"x": [1.0, 2.0, 3.0]})
    short = replace(long, runs=2, lost=(0, 1), values={"x": [1.0, 2.0]})
    series = ClaimRuns([long, short]).join(("a",), "x")
    assert [list(column) for column in series or ()][1:] == [[1.0, 2.0, 3.0], [0, 1, 0]]


# plans


def test_the_cheapest_claim_is_first_and_one_whose_word_stands_is_not_run() -> None:
    plans = [PLANS["004-C5"], PLANS["C001-9"], PLANS["C001-10"]]
    empty = ClaimRuns([])
    prices = price_claims(plans, empty, decide_claims(plans, empty))
    assert [(p.plan.claim.id, p.draws, p.stage) for p in prices] == [("C001-9", LOOKS[0], "first"), ("004-C5", LOOKS[0], "first")]  # fmt: skip
    assert prices[0].seconds < prices[1].seconds
    decided = ClaimRuns(list(draw_values("C001-9", 0.6, 30)))
    assert price_claims(plans[1:2], decided, decide_claims(plans, decided)) == []
    open_ = ClaimRuns(list(draw_values("C001-9", 1.0, 30)))
    (price,) = price_claims(plans[1:2], open_, decide_claims(plans, open_))
    assert (price.draws, price.stage) == (LOOKS[1], "more")  # the first look cannot refute
    tasks = merge_tasks([*prices[0].tasks, *prices[0].tasks], list(PLANS.values()))
    assert len(tasks) == len({(t.cell, t.batch) for t in prices[0].tasks})
    assert max(len(task.measures) for task in tasks) > 1  # the quantities of all claims of the cell


def test_the_jobs_of_a_form_that_may_refuse_are_the_first_of_a_claim() -> None:
    """They take seconds; in between, those of the other filters would be run before the claim is decided."""
    plans, empty = [PLANS["C000-1"]], ClaimRuns([])
    (price,) = price_claims(plans, empty, decide_claims(plans, empty))
    refusing = [may_refuse(task) for task in price.tasks]
    assert 3 < sum(refusing) < len(refusing)
    assert refusing == sorted(refusing, reverse=True)


def test_cells_are_verified_by_a_seed_at_least_three_a_paper() -> None:
    cells = [(f"reading/{paper}=central", f"filter=f{k}") for paper in PAPERS for k in range(9)]
    measures = {cell: {"x": Measure("rmse")} for cell in cells}
    values = {"x": [1.0]}
    runs = ClaimRuns([store(cell, Batch(2001, 0, 1), values, seconds=1.0) for cell in cells])
    drawn = draw_records(runs, 5, measures)
    assert drawn == draw_records(runs, 5, measures)
    assert drawn != draw_records(runs, 6, measures)
    assert len(drawn) == 20
    for paper in PAPERS:
        assert sum(r.cell[0].startswith(f"reading/{paper}") for r in drawn) >= 3
    long = [store(cell, Batch(2001, 0, 1), values, seconds=100.0) for cell in cells[:8]]
    assert draw_records(ClaimRuns(long), 5, measures) == []
    assert (
        draw_records(runs, 5, {}) == []
    )  # jobs that no claim uses any more would be equal to anything


# runs: a cheap claim in seconds


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a cell of paper 001 have twelve runs."""
    data, runs = read_claim_data(), {"listed": 12, "first": 12, "more": 2}
    papers = {k: {**v, "runs": runs} for k, v in data["papers"].items()}
    for module in (claim_lines, claim_runs):
        monkeypatch.setattr(module, "read_claim_data", lambda: {**data, "papers": papers})


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_a_cheap_claim_is_run_decided_verified_and_shown(tmp_path: Path) -> None:
    results = str(tmp_path / "results")
    plan = PLANS["C001-5"]
    plans, empty = [plan], ClaimRuns([])
    prices = price_claims(plans, empty, decide_claims(plans, empty))
    first = [t for t in prices[0].tasks if "scenario=passive_1" in t.cell][:2]
    tasks = merge_tasks(first, list(PLANS.values()))
    records = [run_claim_task(task, results) for task in tasks]
    assert not any(record.failed for record in records)
    for task, record in zip(tasks, records, strict=True):  # the key of `pfbench run`
        config = job.compose(list_words(task.cell, task.batch, "elsewhere"))
        assert job.job_key(config.values, find_inputs(config.values, config.trusted)) == record.key
        assert set(record.values) == set(task.measures)
    measures = find_measures(list(PLANS.values()))
    assert verify_record(records[0], measures[records[0].cell], results).fault == ""
    former = replace(records[0], values={**records[0].values, "a former quantity": [1.0] * 12})
    assert verify_record(former, measures[records[0].cell], results).fault == ""
    name = next(iter(records[0].values))
    planted = replace(records[0], values={name: [2 * v for v in records[0].values[name]]})
    assert "stored" in verify_record(planted, measures[records[0].cell], results).fault
    assert "the key is" in verify_record(replace(records[0], key="0" * 16), {}, results).fault
    assert run_claim_task(tasks[0], results).key == records[0].key  # resumes
    page = write_claims(results, tmp_path / "reports")
    assert "C001-5" in page.read_text()
    again = write_claims(tmp_path / "none", tmp_path / "reports")  # from the stored values
    assert len(ClaimRuns.read(Path(results), tmp_path / "none").records) == len(records)
    published = ClaimRuns.read(tmp_path / "none", tmp_path / "reports")
    assert {r.key for r in published.records} == {r.key for r in records}
    assert not [t for t in tasks if not published.has(t.cell, t.batch, list(t.measures))]
    assert f"{len(records)} jobs" in again.read_text()


def test_an_error_of_a_form_that_does_not_refuse_is_a_fault(tmp_path: Path) -> None:
    """A planted admission fault: a job that fails must not count as a form that cannot run."""
    cell = ("reading/001=central", "filter=sir", "filter.no_such_key=1")
    record = run_claim_task(Task("001", cell, Batch(2001, 0, 2), {}), str(tmp_path))
    assert record.failed
    assert ClaimRuns.read(tmp_path, tmp_path / "none").records == []


def test_runs_of_particles_agree_if_their_mean_difference_is_within_its_error() -> None:
    g = np.random.default_rng(1)
    shifts = [0.0, 0.3]  # beside a spread of 0.1
    passed = [
        np.mean([_has_equal_mean(5 + shift + 0.1 * g.standard_normal(20), 5 * np.ones(20)) for _ in range(500)])
        for shift in shifts
    ]  # fmt: skip
    assert passed[0] > 0.99
    assert passed[1] < 0.01
    assert not _has_equal_mean(np.array([1.0, np.inf, 1.0]), np.ones(3))


# the command


def test_words_of_the_command_are_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    for words, message in (
        (["run", "C009"], r"ID must be a claim such as C001-7 or a paper such as 001, got C009"),
        (["run", "hours=0"], r"hours must be positive, got 0"),
        (["run", "workers=3"], r"workers must be a whole number in .1, 2., got 3"),
        (["run", "hour=2"], r"key must be one of hours"),
    ):
        with pytest.raises(ValueError, match=message):
            command.report_claims(words)
    monkeypatch.setattr("pfbench.job.plan.read_versions", lambda: {"commit": "abc-dirty"})
    check_refused(
        [(r"the code must be committed.*got abc-dirty", lambda: command.check_committed(False))],
        remedy=False,
    )
    command.check_committed(True)


def test_a_timing_has_the_price_of_its_runs_and_fewer_of_filters_that_take_hours() -> None:
    """Each is run once, and takes as long again to be timed in turn: five minutes, or three runs."""
    empty = ClaimRuns([])
    timed = {
        task.timed: task
        for claim in ("C001-8", "002-28")
        for price in price_claims([PLANS[claim]], empty, decide_claims([PLANS[claim]], empty))
        for task in price.tasks
        if task.timed
    }
    each = {pair for pair in timed if any("_each" in word for word in sum(pair, ()))}
    assert each
    assert each < timed.keys()
    for pair, task in timed.items():
        seconds = [claim_runs.estimate_seconds(task.paper, cell, empty) for cell in set(pair)]
        assert task.seconds > 2.0 * task.batch.runs * sum(seconds) > 0.0
        fewest, most = (3, 9) if pair in each else (50, 300)
        assert fewest <= task.batch.runs <= most


def test_a_dry_run_prints_prices_and_runs_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    places = [f"results_dir={tmp_path}", f"reports_dir={tmp_path}"]
    command.report_claims(["run", "C001-7", "dry=true", *places])
    printed = capsys.readouterr().out
    assert re.search(r"C001-7 +50 draws, first runs +\d+ jobs", printed)
    assert "plan: 1 claims" in printed
    assert list(tmp_path.iterdir()) == []


def test_a_new_clone_runs_only_what_is_not_published(tmp_path: Path) -> None:
    places = {"": tmp_path, "published": Path(__file__).parents[2] / "reports"}
    prices = [
        command.SelectedClaims(command.select_plans(["C000-7"]), tmp_path, folder).list_prices()
        for folder in places.values()
    ]  # fmt: skip
    assert [price.draws for price in prices[0]] == [0]
    assert prices[1] == []


# the page


def test_the_page_says_what_is_not_run_and_at_what_price(tmp_path: Path) -> None:
    page = write_claims(tmp_path, tmp_path / "out")
    text = page.read_text()
    assert text.count('class="square ') == 2 * 88 + len(WORDS) + 1  # of the key, with those not run
    shown = {word: text.count(f'class="square {word}"') + text.count(f'class="square {word} far"') for word in (*WORDS, "not-run")}  # fmt: skip
    counts = {word.replace(" ", "-"): int(n) for n, word in re.findall(r"</i>(\d+) ([a-z ]+)</span>", text)}  # fmt: skip
    assert shown == {word: 2 * n + 1 for word, n in counts.items()}
    assert counts["not-run"] > counts["open"] == 0
    assert re.search(r"C001-5: open: not run, price \d+ (s|min)", text)
    assert "Nothing has run yet" in text
    first = text[text.index("<main>") : text.index("<details")]
    assert not re.search(r"\de[+-]?\d", first)  # no scientific notation on the first screen
    cells = re.findall(r"<td[^>]*>(.*?)</td>", first)
    assert len(cells) == 7 * 5
    assert all(len(re.sub(r"<[^>]+>", "", cell).split()) <= 12 for cell in cells)
    words = json.loads((page.parent / "words.json").read_text())
    assert set(words.values()) <= set(WORDS)
    assert (page.parent / "report.md").read_text().count("C000-1") > 1


def test_objections_stand_at_their_claims_and_in_the_list_and_corrections_on_the_page(tmp_path: Path) -> None:  # fmt: skip
    page, data = write_claims(tmp_path, tmp_path / "out"), read_claim_data()
    assert {name for key in ("disputed", "amended") for row in data[key] for name in row["claims"]} <= set(PLANS)  # fmt: skip
    text, report = page.read_text(), (page.parent / "report.md").read_text()
    for row in data["disputed"]:
        assert text.count(row["what"].replace("'", "&#39;")) == len(row["claims"]) + 1
    for row in data["amended"]:
        assert all(row["what"] in form and row["before"] in form for form in (text, report))


def test_a_sentence_of_a_paper_names_proofs_of_that_paper() -> None:
    from pfbench.claims import read_proofs

    proofs = {proof.id: proof.paper for proof in read_proofs()}
    for paper, settings in read_claim_data()["papers"].items():
        named = re.findall(r"P\d+", settings["sentence"])
        assert named
        assert {proofs[name] for name in named} == {paper}


def test_resampling_keeps_the_mean_likelihood_of_a_cloud_and_the_printed_shift_lowers_it() -> None:
    """Systematic resampling keeps weighted means on average; eq. 18 widens the cloud (P10)."""
    world = ["scenario=passive_1", "noise=nominal", "particles=200", "seed=11", "runs=12"]
    resampled = np.log(measure_moved_clouds([*world, "filter=sir"]))
    error = resampled.std(ddof=1) / math.sqrt(len(resampled))
    assert abs(resampled.mean()) < 4 * error
    assert error < 0.05
    never = measure_moved_clouds([*world, "filter=sir", "filter.resampler.ess_threshold=0.0"])
    assert never == pytest.approx(np.ones(12))
    assert measure_moved_clouds([*world, "filter=qmc_polymerised_printed"]).min() > 1.0
