"""The claims of the papers: their records are whole and name what there is, and verdicts follow planted effects."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy import stats
from statsmodels.stats.multitest import multipletests
from synthetic_results import METHODS, STATE, VERSIONS, Method, write

from pfbench import job
from pfbench.claims import (
    claim_records,
    claim_records as schema,
    measurements,
    page as claim_tables,
    page as claims_figures,
    page as claims_page,
    verdicts,
    verdicts as claim_samples,
)
from pfbench.claims.claim_records import Claim, ClaimTest
from pfbench.results import store
from pfbench.stats import intervals, rank_tests, study_size

IDS = [
    *(f"C000-{k}" for k in range(1, 10)),
    *(f"C001-{k}" for k in range(1, 11)),
    *(f"002-{k:02}" for k in range(1, 32)),
    *(f"003-C{k}" for k in range(1, 11)),
    *(f"004-C{k}" for k in range(1, 12)),
]
CONF, STUDIES = job.conf_dir(), job.experiments_dir()
ALL = claim_records.read_claims(CONF, STUDIES)
CELL = "flight/surge/ins_gnss"
LESS = ClaimTest("less", "s", CELL, "rmse", "a", "b", group="position")


# the records


def test_each_of_the_71_claims_has_one_record() -> None:
    assert len(IDS) == 71
    assert sorted(claim.id for claim in ALL) == sorted(IDS)
    assert all(claim.paper in claim.id for claim in ALL)


def test_each_claim_can_be_decided_or_says_why_not() -> None:
    for claim in ALL:
        assert any(claim.tests.values()) or claim.reasons or claim.evidence, claim.id
        assert claim.claim[0].isupper() or claim.claim[0].isdigit(), claim.id
        assert not claim.claim.endswith("."), claim.id


def test_nothing_is_left_open_for_a_reason_of_our_own() -> None:
    assert {reason for claim in ALL for reason, _ in claim.reasons.values()} <= {
        "not specified in the paper",
        "not run",
    }
    assert set(schema.REASONS) == {
        "not specified in the paper",
        "not run",
        "too few runs",
        "too many lost runs",
    }


def test_what_a_test_decides_names_a_test_that_is_there() -> None:
    shown = {claim.id: text for claim in ALL for _, text in claim.evidence.values()}
    assert set(shown) == {"002-01", "002-02"}
    for text in shown.values():
        ((path, name),) = re.findall(r'(tests/[\w/]+\.py), "([^"]+)"', text)
        assert f"def test_{name.replace(' ', '_')}(" in (STUDIES.parent / path).read_text()
    for _, text in next(claim for claim in ALL if claim.id == "C001-10").reasons.values():
        (path,) = re.findall(r"tests/[\w/]+\.py", text)
        assert (STUDIES.parent / path).is_file()


def swept(study: str) -> dict[str, set[str]]:
    """What each cell of a study runs: filters, with the settings that are swept in brackets; read without Hydra."""
    content = yaml.safe_load((STUDIES / f"{study}.yaml").read_text())
    chosen = {
        key.split("/")[-1]: value for part in content["defaults"] for key, value in part.items()
    }
    params = {
        key: str(values).split(",") for key, values in content["hydra"]["sweeper"]["params"].items()
    }
    ran: dict[str, set[str]] = {}
    for values in product(*params.values()):
        one = {**chosen, **dict(zip(params, values, strict=True))}
        model = chosen.get("model") or home(one["scenario"])
        several = [key for key in one if "." in key and len(params[key]) > 1]
        told = sorted(f"{key.removeprefix('filter.')}={one[key]}" for key in several)
        name = f"{one['filter']}[{','.join(told)}]" if told else one["filter"]
        ran.setdefault(f"{one['scenario']}/{one['noise']}/{model}", set()).add(name)
    return ran


def home(scenario: str) -> str:
    """The model that a scenario asks for, itself or by what it extends."""
    defaults = yaml.safe_load((CONF / "scenario" / f"{scenario}.yaml").read_text())["defaults"]
    asks = [
        value
        for part in defaults
        if isinstance(part, dict)
        for key, value in part.items()
        if "model" in key
    ]
    return (
        asks[0]
        if asks
        else home(next(part for part in defaults if isinstance(part, str) and part != "_self_"))
    )


def test_the_studies_hold_every_cell_that_the_claims_need() -> None:
    sides = {
        side
        for claim in ALL
        for tests in claim.tests.values()
        for test in tests
        for side in test.sides
    }
    ran = {study: swept(study) for study in {study for study, _, _ in sides}}
    missing = sorted(side for side in sides if side[2] not in ran[side[0]].get(side[1], ()))
    assert missing == []
    assert all(study.startswith("paper_") for study in ran)
    unused = {path.stem for path in STUDIES.glob("paper_*.yaml")} - set(ran)
    assert unused == set()


RECORD = """
- id: X-1
  paper: "000"
  claim: Better
  source: figure
  tests:
    - {is: less, study: quickstart, cell: flight_500s/nominal/ins_gnss, metric: rmse, group: position, a: sir, b: ekf}
"""
WRONG = {
    "unknown filter": (
        "a: sir",
        "a: sri",
        r"X-1: filter must be one of apf, ckf.*got filter='sri'",
    ),
    "unknown scenario": (
        "flight_500s/",
        "t999/",
        r"X-1: scenario must be one of .*flight_500s.*got scenario='t999'",
    ),
    "unknown noise": ("/nominal/", "/normal/", r"X-1: noise must be .*got noise='normal'"),
    "unknown model": ("/ins_gnss,", "/ins_gps,", r"X-1: model must be .*got model='ins_gps'"),
    "unknown study": (
        "quickstart",
        "slowstart",
        r"X-1: study must be .*quickstart.*got study='slowstart'",
    ),
    "unknown group": (
        "group: position",
        "group: place",
        r"X-1: group must be one of attitude.*got group='place'",
    ),
    "unknown metric": (
        "metric: rmse",
        "metric: rsme",
        r"X-1: metric must be one of rmse.*got metric='rsme'",
    ),
    "unknown statistic": (
        "is: less",
        "is: better",
        r"X-1: is must be one of less.*got is='better'",
    ),
    "unknown key": (
        "b: ekf}",
        "b: ekf, margn: 1}",
        r"X-1: keys of a test must be fields of a test, got \['margn'\]",
    ),
    "no other side": (", b: ekf}", "}", r"X-1: b must be given for a test with is=less"),
    "half a cell": (
        "flight_500s/nominal/ins_gnss",
        "flight_500s/nominal",
        r"X-1: cell must be scenario/noise/model.*got cell=flight_500s/nominal",
    ),
    "no tests": (
        RECORD[RECORD.index("  tests:") :],
        "  note: none",
        r"X-1: a record must have `tests`, or a reason",
    ),
    "unknown paper": ('"000"', '"999"', r"X-1: paper must be .*got paper='999'"),
    "shown and tested": (
        "  tests:",
        "  shown: 'holds: it is a count'\n  tests:",
        r"X-1: a record with `shown` must not",
    ),
    "bad outcome": (
        "  tests:",
        "  shown: 'true: it is a count'\n  tests:",
        r"X-1: shown must begin with one of holds.*shown='true: ",
    ),
    "bad reason": (
        "  tests:",
        "  why: because\n  tests:",
        r"X-1: why must begin with one of not specified.*why='because'",
    ),
    "uneven lists": (
        "b: ekf",
        "b: [ekf, ukf], from: [1, 2, 3]",
        r"X-1: lists of one test must have equal length, got \[2, 3\]",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_record_is_told_by_name(case: str, tmp_path: Path) -> None:
    old, new, message = WRONG[case]
    assert old in RECORD
    (tmp_path / "good.yaml").write_text(RECORD)
    claim_records.read_claims(CONF, STUDIES, tmp_path / "good.yaml")
    (tmp_path / "bad.yaml").write_text(RECORD.replace(old, new))
    with pytest.raises(ValueError, match=message):
        claim_records.read_claims(CONF, STUDIES, tmp_path / "bad.yaml")


def test_an_id_stands_once(tmp_path: Path) -> None:
    (tmp_path / "twice.yaml").write_text(RECORD + RECORD)
    with pytest.raises(ValueError, match="id must be unique, got X-1 more than once"):
        claim_records.read_claims(path=tmp_path / "twice.yaml")


def test_lists_stand_side_by_side_and_method_for_each_form(tmp_path: Path) -> None:
    text = RECORD.replace("  tests:", "  forms: {printed: rpf, repaired: apf}\n  tests:")
    text = text.replace("a: sir, b: ekf", "a: 'method[particles=9]', b: [ekf, ukf], from: [0, 5]")
    (tmp_path / "lists.yaml").write_text(text)
    (claim,) = claim_records.read_claims(CONF, STUDIES, tmp_path / "lists.yaml")
    seen = {form: [(t.a, t.b, t.start) for t in tests] for form, tests in claim.tests.items()}
    assert seen == {
        "printed": [("rpf[particles=9]", "ekf", 0.0), ("rpf[particles=9]", "ukf", 5.0)],
        "repaired": [("apf[particles=9]", "ekf", 0.0), ("apf[particles=9]", "ukf", 5.0)],
    }


# the statistics, on frames with a planted effect


def frame(tests: ClaimTest | list[ClaimTest], **values: Any) -> pd.DataFrame:
    """Rows as `gather` makes them, the same values under every measure."""
    several = tests if isinstance(tests, list) else [tests]
    parts = []
    for test in {t.measure: t for t in several}.values():
        for label, one in values.items():
            where = next(
                (side for t in several for side in t.sides if side[2] == label),
                (test.study, test.cell, label),
            )
            head = {
                "study": where[0],
                "cell": where[1],
                "label": label,
                "measure": test.measure,
                "seed": 1,
                "unit": "m",
            }
            numbers = np.asarray(one, dtype=float)
            parts.append(
                pd.DataFrame(
                    {
                        **head,
                        "run": np.arange(numbers.size),
                        "lost": np.isinf(numbers),
                        "value": numbers,
                    }
                )
            )
    return pd.concat(parts, ignore_index=True)


def claim(*tests: ClaimTest, id: str = "X-1", **forms: ClaimTest) -> Claim:  # noqa: A002
    return Claim(
        id, "000", "", "", "", {form: (test,) for form, test in forms.items()} or {"": tests}, {}
    )


def ruled(test: ClaimTest, **values: Any) -> verdicts.ClaimVerdict:
    (ruling,) = verdicts.decide_claims([claim(test)], frame(test, **values))
    return ruling


def losses(seed: int, ratio: float, runs: int = 60, scatter: float = 0.2) -> dict[str, np.ndarray]:
    """Two filters on shared worlds, a `ratio` times b but for its own scatter."""
    rng = np.random.default_rng(seed)
    b = np.exp(0.5 * rng.standard_normal(runs))
    return {"a": ratio * b * np.exp(scatter * rng.standard_normal(runs)), "b": b}


def only(seed: int, level: float, scatter: float = 0.1, runs: int = 60) -> dict[str, np.ndarray]:
    return {"a": level * np.exp(scatter * np.random.default_rng(seed).standard_normal(runs))}


def alone(statistic: str, **settings: Any) -> ClaimTest:
    return replace(LESS, statistic=statistic, b="", **settings)


YES, NO, OPEN = "reproduced", "not reproduced", "undecided"
PLANTED = {
    "less": (LESS, losses(1, 0.7), losses(1, 1.3)),
    "less, no effect": (LESS, losses(2, 0.7), losses(2, 1.0, scatter=0.05)),
    "greater": (replace(LESS, statistic="greater"), losses(3, 1.4), losses(3, 0.8)),
    "equal": (
        replace(LESS, statistic="equal"),
        losses(4, 1.02, scatter=0.1),
        losses(4, 1.3, scatter=0.1),
    ),
    "equal, below": (
        replace(LESS, statistic="equal"),
        losses(4, 0.98, scatter=0.1),
        losses(4, 0.7, scatter=0.1),
    ),
    "no worse": (replace(LESS, statistic="no_worse"), losses(5, 0.5), losses(5, 1.4)),
    "close": (replace(LESS, statistic="close", margin=0.5), losses(6, 1.0), losses(6, 3.0)),
    "below": (alone("below", high=2.0), only(7, 1.5), only(7, 2.5)),
    "above": (alone("above", low=2.0), only(8, 2.5), only(8, 1.5)),
    "within, low": (alone("within", low=110, high=180), only(9, 150), only(9, 90)),
    "within, high": (alone("within", low=110, high=180), only(9, 150), only(9, 220)),
    "near": (alone("near", printed=22.0, margin=0.2), only(10, 21), only(10, 30)),
    "near, below": (alone("near", printed=22.0, margin=0.2), only(10, 23), only(10, 15)),
    "flat": (
        alone("flat", metric="growth", margin=0.1),
        {"a": 0.02 * np.sin(np.arange(60))},
        {"a": 0.3 + np.arange(60) / 60},
    ),
    "falls": (
        alone("falls", metric="growth"),
        {"a": -0.3 - np.arange(60) / 60},
        {"a": 0.3 + np.arange(60) / 60},
    ),
    "share": (
        alone("share", metric="severely_overconfident", low=0.05),
        {"a": np.arange(60) < 20},
        {"a": np.zeros(100)},
    ),
    "cost": (
        replace(LESS, statistic="cost", high=1.0),
        {"a": [0.8], "b": [1.0]},
        {"a": [1.3], "b": [1.0]},
    ),
    "cost, printed": (
        replace(LESS, statistic="cost", printed=12.45),
        {"a": [9.0], "b": [1.0]},
        {"a": [2.0], "b": [1.0]},
    ),
    "cost, printed below 1": (
        replace(LESS, statistic="cost", printed=0.1),
        {"a": [0.12], "b": [1.0]},
        {"a": [2.0], "b": [1.0]},
    ),
    "cost, alike": (
        replace(LESS, statistic="cost", low=0.77, high=1.3),
        {"a": [1.0], "b": [1.0]},
        {"a": [0.5], "b": [1.0]},
    ),
    "printed ratio": (replace(LESS, printed=0.6), losses(11, 0.65), losses(11, 0.95, scatter=0.02)),
    "printed ratio, too much": (replace(LESS, printed=0.6), losses(11, 0.5), losses(11, 0.2)),
}


@pytest.mark.parametrize("case", PLANTED)
def test_a_planted_effect_turns_the_verdict(case: str) -> None:
    test, there, gone = PLANTED[case]
    assert (ruled(test, **there).verdict, ruled(test, **gone).verdict) == (YES, NO)


def test_every_statistic_is_planted() -> None:
    assert {test.statistic for test, _, _ in PLANTED.values()} | {"report"} == set(
        schema.STATISTICS
    )


@pytest.mark.parametrize(
    "case", [case for case in PLANTED if "cost" not in case and case != "share"]
)
def test_too_few_runs_decide_nothing(case: str) -> None:
    test, there, _ = PLANTED[case]
    few = ruled(test, **{label: np.asarray(values)[:3] for label, values in there.items()})
    assert (few.verdict, few.reason) == (OPEN, "too few runs")


@pytest.mark.parametrize("ratio", [1 / 1.1, 1.1])
def test_equivalence_needs_both_sides(ratio: float) -> None:
    assert ruled(replace(LESS, statistic="equal"), **losses(21, ratio, scatter=0.1)).verdict == OPEN
    assert ruled(alone("near", printed=1.0), **only(22, ratio)).verdict == OPEN


def test_one_timing_within_a_tenth_decides_nothing() -> None:
    test = replace(LESS, statistic="cost", high=1.0)
    assert (
        ruled(test, a=[1.05], b=[1.0]).reason
        == ruled(test, a=[0.95], b=[1.0]).reason
        == "too few runs"
    )


def test_the_verdict_on_times_says_that_there_is_one_timing_or_their_range() -> None:
    test = replace(LESS, statistic="cost", high=1.0)
    note = "time per step: one timing per job, no interval"
    assert [ruled(test, a=[value], b=[1.0]).note for value in (0.8, 0.95, 1.3)] == [note] * 3
    assert ruled(test, a=[0.8]).note == ""  # nothing was timed
    assert ruled(LESS, **losses(1, 0.7)).note == ""
    tests = [
        replace(test, cell=f"flight/{noise}/ins_gnss") for noise in ("surge", "nominal", "burst")
    ]
    rows = pd.concat(
        [frame(one, a=[ratio], b=[1.0]) for one, ratio in zip(tests, (0.8, 0.5, 0.9), strict=True)]
    )
    (found,) = verdicts.decide_claims([claim(*tests)], rows)
    assert (found.verdict, found.note) == (
        YES,
        "time per step of a to b: 0.5 to 0.9 over 3 conditions, one timing per job",
    )


def test_a_claim_that_a_test_shows_is_decided_without_runs() -> None:
    nothing = frame(LESS, a=[1.0])
    record = replace(
        claim(LESS),
        tests={},
        evidence={"": ("holds", "tests/filter/gaussian/test_linearisation_rules.py counts it")},
    )
    (found,) = verdicts.decide_claims([record], nothing)
    assert (found.verdict, found.reason, found.note) == (
        YES,
        "",
        "tests/filter/gaussian/test_linearisation_rules.py counts it",
    )
    against = replace(
        record,
        evidence={"": ("fails", "tests/filter/gaussian/test_linearisation_rules.py counts it")},
    )
    assert verdicts.decide_claims([against], nothing)[0].verdict == NO
    forms = replace(record, evidence={"printed": ("fails", "one"), "repaired": ("holds", "two")})
    (found,) = verdicts.decide_claims([forms], nothing)
    assert (found.verdict, found.note) == (
        "reproduced only as repaired",
        "as printed: one; as repaired: two",
    )


def test_a_circular_or_vacuous_claim_is_not_reproduced_whatever_its_tests_show() -> None:
    marked = {claim.id: claim.mark[0] for claim in ALL if claim.mark[0]}
    circular = {"002-25": "circular", **{f"004-C{k}": "circular" for k in (1, 2, 3)}}
    assert marked == {"002-08": "vacuous", **circular}
    holds = frame(LESS, **normal(-1.0, 0.1, 40))
    assert verdicts.decide_claims([claim(LESS)], holds)[0].verdict == YES  # the control
    record = replace(claim(LESS), mark=("circular", "set from the claim"))
    (verdict,) = verdicts.decide_claims([record], holds)
    assert (verdict.verdict, verdict.reason) == ("undecided", "circular")
    assert verdict.note == "set from the claim"
    assert verdict.findings[""][0].outcome == "holds"


def normal(middle: float, scatter: float, runs: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Ratios whose logarithms have this median and deviation exactly."""
    d = np.random.default_rng(seed).standard_normal(runs)
    d = middle + scatter * (d - np.median(d)) / d.std(ddof=1)
    return {"a": np.exp(d), "b": np.ones(runs)}


def test_what_lacks_power_says_the_runs_that_it_takes() -> None:
    """By hand, from the closed forms of `power`: for the claim at the corrected level, or against it by the sign test."""
    other = replace(LESS, a="n")
    for middle in (-0.2, -0.02, 0.05):
        values = normal(middle, 0.5, 20)
        rows = frame([LESS, other], **values, n=np.exp(np.linspace(-1, 1.1, 20)))
        found = verdicts.decide_claims([claim(LESS, other)], rows)[0].findings[""][0]
        assert (found.outcome, found.reason, found.family) == ("open", "too few runs", 2)
        for_it = study_size.required_runs(-middle / 0.5, 2 * 0.05 / 2) if middle < 0 else np.inf
        beyond = middle + np.log(1.1)  # worth the name is a tenth
        against_it = (
            study_size.required_runs(beyond / 0.5, 0.05 / 2, efficiency=2 / np.pi)
            if beyond > 0
            else np.inf
        )
        assert found.needed == pytest.approx(min(for_it, against_it), abs=1)
        assert (
            f"{found.needed:.0f} runs per condition required for power 0.8 at this effect"
            in claims_page.format_required_runs(found)
        )
    assert np.isnan(ruled(LESS, **losses(1, 0.7)).findings[""][0].needed)  # it was decided
    assert np.isnan(
        ruled(replace(LESS, statistic="cost", high=1.0), a=[1.05], b=[1.0]).findings[""][0].needed
    )
    share = alone("share", metric="severely_overconfident", low=0.05)
    (found,) = ruled(share, a=np.arange(20) < 2).findings[""]
    assert found.needed == study_size.required_runs_proportion(0.1, 0.05, 0.05)


def test_a_share_is_tested_from_one_side() -> None:
    share = alone("share", metric="severely_overconfident", low=0.5)
    for count in (3, 14):
        (result,) = ruled(share, a=np.arange(20) < count).findings[""]
        assert result.p == pytest.approx(stats.binom.sf(count - 1, 20, 0.5))
        assert result.p_fails == pytest.approx(min(1.0, 2 * stats.binom.cdf(count, 20, 0.5)))
    open_one = ruled(LESS, **normal(-0.1, 0.5, 20))
    assert claim_tables.claims_table([open_one])["runs required"].iloc[0] > 20
    assert (
        "required for power 0.8 at this effect"
        in claims_page.rows_by_paper([open_one])[0]["rows"][0]["lines"][0]["more"]
    )


@pytest.mark.parametrize(("middle", "outcome"), [(-0.12, "holds"), (0.0, "fails")])
def test_so_many_runs_decide_as_often_as_said(middle: float, outcome: str) -> None:
    (few,) = ruled(LESS, **normal(middle, 0.2, 6)).findings[""]
    assert few.outcome == "open"
    rng, trials = np.random.default_rng(23), 150
    hits = 0
    for _ in range(trials):
        d = middle + 0.2 * rng.standard_normal(int(few.needed))
        hits += ruled(LESS, a=np.exp(d), b=np.ones(d.size)).findings[""][0].outcome == outcome
    # order statistics jump: their interval is wider than its level asks, by a few per cent of power
    assert hits / trials == pytest.approx(0.8, abs=4 * np.sqrt(0.16 / trials) + 0.03)


def test_the_order_of_rows_and_of_claims_changes_nothing() -> None:
    tests = [test for test, _, _ in PLANTED.values() if test.b and test.statistic != "cost"]
    several = [claim(test, id=f"X-{k}") for k, test in enumerate(tests)]
    rows = frame(tests, **losses(12, 0.8))
    first = verdicts.decide_claims(several, rows)
    for seed in range(3):
        shuffled = rows.sample(frac=1, random_state=seed)
        assert verdicts.decide_claims(several, shuffled) == first
    backwards = verdicts.decide_claims(several[::-1], rows)
    assert [r.verdict for r in backwards[::-1]] == [r.verdict for r in first]


def test_runs_are_paired_by_their_number() -> None:
    world = np.exp(2 * np.random.default_rng(13).standard_normal(40))
    paired = frame(LESS, a=0.8 * world, b=world)
    assert verdicts.decide_claims([claim(LESS)], paired)[0].verdict == YES
    apart = paired.copy()
    ours = apart.label == "a"
    apart.loc[ours, "run"] = (apart.loc[ours, "run"] * 7 + 3) % 40
    assert verdicts.decide_claims([claim(LESS)], apart)[0].verdict == OPEN


def test_lost_runs_count_against_who_lost_them() -> None:
    values = losses(14, 0.7)
    hurt = values["a"].copy()
    hurt[:40] = np.inf
    found = ruled(LESS, a=hurt, b=values["b"])
    assert found.verdict == NO
    assert found.findings[""][0].effect == np.inf
    assert found.findings[""][0].lost_a == 40
    other = ruled(LESS, a=values["a"], b=hurt)
    assert (other.verdict, other.findings[""][0].effect) == (YES, 0.0)


def test_where_both_are_lost_nothing_is_decided() -> None:
    gone = np.full(60, np.inf)
    for statistic in ("less", "equal", "close"):
        found = ruled(replace(LESS, statistic=statistic), a=gone, b=gone)
        assert (found.verdict, found.reason) == (OPEN, "too many lost runs")
    assert ruled(alone("near", printed=1.0), a=gone).reason == "too many lost runs"
    assert ruled(alone("below", high=1.0), a=gone).verdict == NO  # it did not stay below


def test_what_did_not_run_is_said() -> None:
    found = ruled(LESS, a=[1.0, 2.0])
    assert (found.verdict, found.reason) == (OPEN, "not run")
    assert verdicts.decide_claims(ALL[:5], frame(LESS, a=[1.0]))[0].reason == "not run"


def test_holm_goes_over_all_comparisons_of_a_paper() -> None:
    values = losses(15, 0.93, runs=40)
    nothing = {
        f"n{k}": values["b"] * np.exp(np.random.default_rng(k).standard_normal(40))
        for k in range(20)
    }
    others = [replace(LESS, a=label) for label in nothing]
    rows = frame([LESS, *others], **values, **nothing)
    (one,) = verdicts.decide_claims([claim(LESS)], rows)
    assert one.verdict == YES
    many = verdicts.decide_claims(
        [claim(LESS), *(claim(test, id=f"N-{k}") for k, test in enumerate(others))], rows
    )
    assert many[0].findings[""][0].family == 21
    assert many[0].findings[""][0].p == one.findings[""][0].p
    assert many[0].verdict == OPEN
    elsewhere = [replace(claim(test, id=f"N-{k}"), paper="001") for k, test in enumerate(others)]
    assert verdicts.decide_claims([claim(LESS), *elsewhere], rows)[0].verdict == YES


def test_holm_is_that_of_statsmodels() -> None:
    p = np.random.default_rng(20).random(30) ** 3
    p[3] = p[17]
    assert rank_tests.holm(p) == pytest.approx(multipletests(p, method="holm")[1])
    assert rank_tests.holm([]).size == 0


def test_forms_are_told_apart() -> None:
    printed, repaired = LESS, replace(LESS, a="c")
    both = claim(printed=printed, repaired=repaired)

    def verdict(a: float, c: float, runs: int = 60) -> tuple[str, str]:
        values = losses(16, a)
        other = losses(16, c)["a"][:runs]
        (found,) = verdicts.decide_claims([both], frame([printed, repaired], **values, c=other))
        return found.verdict, found.reason

    assert verdict(0.6, 0.6) == (YES, "")
    assert verdict(0.6, 1.5) == ("reproduced only as printed", "")
    assert verdict(1.5, 0.6) == ("reproduced only as repaired", "")
    assert verdict(1.5, 1.5) == (NO, "")
    assert verdict(1.5, 0.6, runs=3) == verdict(0.6, 0.6, runs=3) == (OPEN, "too few runs")
    stated = replace(
        both, tests={"repaired": (repaired,)}, reasons={"printed": ("not run", "it has no density")}
    )
    rows = frame([printed, repaired], **losses(16, 1.0), c=losses(16, 0.6)["a"])
    (found,) = verdicts.decide_claims([stated], rows)
    assert (found.verdict, found.note) == (
        "reproduced only as repaired",
        "as printed: it has no density",
    )


def test_one_comparison_that_fails_decides_against_the_claim() -> None:
    good, bad, short = LESS, replace(LESS, a="c"), replace(LESS, a="d")
    values = {**losses(17, 0.6), "c": losses(17, 1.5)["a"], "d": losses(17, 0.6)["a"][:3]}
    rows = frame([good, bad, short], **values)
    assert verdicts.decide_claims([claim(good, bad, short)], rows)[0].verdict == NO
    assert verdicts.decide_claims([claim(good, short)], rows)[0].reason == "too few runs"


def test_what_is_not_stated_is_measured_all_the_same() -> None:
    test = alone("report")
    record = replace(claim(test), reasons={"": ("not specified in the paper", "lost table")})
    (found,) = verdicts.decide_claims([record], frame(test, **only(18, 3.0)))
    assert (found.verdict, found.reason, found.note) == (
        OPEN,
        "not specified in the paper",
        "lost table",
    )
    assert found.findings[""][0].effect == pytest.approx(3.0, rel=0.1)
    assert claims_page.format_result(found.findings[""][0]).endswith("m")


def test_the_interval_of_the_median_covers_as_often_as_it_says() -> None:
    for n in (1, 5, 6, 9, 20, 60):
        low, high, _ = intervals.order_statistic_interval(np.arange(n, dtype=float), 0.95)
        if n < 6:  # 1 - 2 / 2^5 < 0.95: no interval of five numbers is wide enough
            assert (low, high) == (-np.inf, np.inf)
            continue
        k = int(
            low
        )  # order statistics k + 1 and n - k: the median is outside when k or fewer signs are one way
        assert high == n - 1 - k
        assert 2 * stats.binom.cdf(k, n, 0.5) <= 0.05 < 2 * stats.binom.cdf(k + 1, n, 0.5)


def test_false_claims_are_as_rare_as_the_level() -> None:
    rng, n, alpha = np.random.default_rng(19), 500, 0.05
    drawn = (np.exp(rng.standard_normal((2, 25))) for _ in range(n))
    wrong = sum(
        claim_samples.region_p_value(claim_samples.sample_claim_test(LESS, a, b)) <= alpha
        for a, b in drawn
    )
    assert wrong / n == pytest.approx(alpha, abs=4 * np.sqrt(alpha * (1 - alpha) / n))


# what is read from results


@pytest.fixture
def study(tmp_path: Path) -> Path:
    for method in METHODS:
        write(tmp_path / "s", method, runs=20, steps=60)
    return tmp_path


def result(folder: Path, label: str) -> store.JobResult:
    return next(r for r in store.list_results(folder / "s") if r.meta["label"] == label)


def test_measures_are_of_the_seconds_asked_for(study: Path) -> None:
    test = ClaimTest(
        "report",
        "s",
        CELL,
        "rmse",
        "ukf",
        group="position",
        component="position_N",
        start=20,
        end=30,
    )
    found = result(study, "ukf")
    error, time = found.data["error"][..., 7].astype(float), found.data["time"]
    inside = (time >= 20) & (time <= 30)
    assert inside.sum() == 11
    assert measurements.measure_claim_test(found, test) == pytest.approx(
        np.sqrt((error[:, inside] ** 2).mean(1))
    )
    assert measurements.measure_claim_test(
        found, replace(test, metric="max_error")
    ) == pytest.approx(np.abs(error[:, inside]).max(1))
    assert measurements.measure_claim_test(
        found, replace(test, metric="mean_abs")
    ) == pytest.approx(np.abs(error[:, inside]).mean(1))
    rows = measurements.load_claim_measurements([claim(test)], study)
    assert rows.value.to_numpy() == pytest.approx(np.sqrt((error[:, inside] ** 2).mean(1)))
    assert set(rows.unit) == {"m"}


def test_measures_are_in_the_unit_shown_and_lost_runs_stay(study: Path) -> None:
    test = ClaimTest("report", "s", CELL, "rmse", "sir", group="attitude")
    found = result(study, "sir")
    error = found.data["error"][..., :3].astype(float)
    value = measurements.measure_claim_test(found, test)
    assert value[7] == np.inf
    kept = np.arange(20) != 7
    assert value[kept] == pytest.approx(
        np.degrees(np.sqrt((error[kept] ** 2).sum(-1).mean(1))) * 60
    )
    rows = measurements.load_claim_measurements([claim(test)], study)
    assert (rows.unit.unique().tolist(), rows.lost.sum()) == (["arcmin"], 1)
    share = measurements.measure_claim_test(found, replace(test, metric="ess"))
    assert share * 200 == pytest.approx(
        measurements.measure_claim_test(found, replace(test, metric="effective")), nan_ok=True
    )
    assert np.isnan(share[7])
    assert (
        measurements.measure_claim_test(found, replace(test, metric="severely_overconfident"))[7]
        == 1
    )
    assert np.isnan(
        measurements.measure_claim_test(found, replace(test, metric="accepted"))
    ).all()  # nothing was moved
    assert measurements.measure_claim_test(
        found, replace(test, metric="seconds_per_step")
    ) == pytest.approx(np.full(20, 4e-3))


def test_growth_is_that_of_an_exponential(study: Path) -> None:
    found = result(study, "ekf")
    time = found.data["time"]
    error = np.zeros_like(found.data["error"])
    error[..., 6:] = np.exp(-0.01 * time)[None, :, None]
    made = store.JobResult(found.meta, {**found.data, "error": error})
    test = ClaimTest("falls", "s", CELL, "growth", "ekf", group="position", start=20)
    assert measurements.measure_claim_test(made, test) == pytest.approx(
        np.full(20, -0.01 * 40), rel=1e-5
    )


def test_accepted_is_a_mean_over_the_steps_with_moves(study: Path) -> None:
    found = result(study, "sir")
    hit = found.data["resampled"].astype(bool)
    made = store.JobResult(found.meta, {**found.data, "accepted_0": np.where(hit, 0.25, 0.0)})
    test = ClaimTest("report", "s", CELL, "accepted", "sir")
    value = measurements.measure_claim_test(made, test)
    assert value[~np.isnan(value)] == pytest.approx(0.25)


def test_a_label_with_settings_finds_its_job_whatever_else_ran(tmp_path: Path) -> None:
    plain = METHODS[2]
    for scale in (0.5, 1.0):
        write(tmp_path / "s", plain, runs=8, steps=10, config={"moves": [{"scale": scale}]})
    test = ClaimTest("report", "s", CELL, "rmse", "sir[moves.0.scale=0.5]", group="position")
    assert len(measurements.load_claim_measurements([claim(test)], tmp_path)) == 8
    assert (
        len(
            measurements.load_claim_measurements(
                [claim(replace(test, a="sir[moves.0.scale=2.0]"))], tmp_path
            )
        )
        == 0
    )
    with pytest.raises(ValueError, match="several jobs are sir"):
        measurements.load_claim_measurements([claim(replace(test, a="sir"))], tmp_path)


def test_a_group_that_a_result_lacks_is_told(study: Path) -> None:
    test = ClaimTest("report", "s", CELL, "rmse", "ekf", group="clock [m]")
    with pytest.raises(
        ValueError,
        match=re.escape("must be one of attitude, velocity, position, got no group 'clock [m]'"),
    ):
        measurements.load_claim_measurements([claim(test)], study)
    assert "velocity" in STATE["groups"]


# the page


def test_the_page_shows_every_claim(tmp_path: Path) -> None:
    page = claims_page.write_claims(tmp_path / "none", tmp_path / "reports", 0.05, CONF, STUDIES)
    text = page.read_text()
    for claim_id in IDS:
        assert text.count(f'<tr id="{claim_id}"') == 1
    assert "http" not in text  # it works offline
    markdown = (page.parent / "report.md").read_text()
    assert len(re.findall(r"^### .+: undecided: ", markdown, re.M)) == 69  # without a single run
    assert len(re.findall(r"^### 002-0[12]: reproduced$", markdown, re.M)) == 2
    assert ">Jobs<" not in text
    assert {"verdicts.json", "tables"} <= {path.name for path in page.parent.iterdir()}


def test_the_page_has_the_numbers_and_a_link_to_the_study(study: Path) -> None:
    test = ClaimTest(
        "less", "s", CELL, "rmse", "cofm_amssrcpf", "ekf", group="position", printed=0.6
    )
    found = verdicts.decide_claims(
        [claim(test)], measurements.load_claim_measurements([claim(test)], study)
    )
    assert found[0].verdict == YES
    (line,) = claims_page.rows_by_paper(found, {"s": set()})[0]["rows"][0]["lines"]
    assert (line["link"], line["drawn"]) == ("../s/index.html", False)
    assert re.fullmatch(r"0\.6\d+ \[0\.\d+, 0\.\d+\], printed 0\.600", line["said"])
    assert (
        claims_page.rows_by_paper(found)[0]["rows"][0]["lines"][0]["link"] == ""
    )  # no page, no link
    assert claim_tables.count_verdicts(found).set_index("paper").loc["all", "claims"] == 1


def page_of(folder: Path, out: Path, *tests: ClaimTest) -> tuple[str, str]:
    """The page of one claim, as Markdown and as HTML."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(claims_page, "read_claims", lambda *_: [claim(*tests)])
        patch.setattr(claims_figures, "claim_figures", lambda _: [])
        path = claims_page.write_claims(folder, out)
    return (path.parent / "report.md").read_text(), path.read_text()


def test_a_page_without_results_replaces_no_verdict(study: Path, tmp_path: Path) -> None:
    """The same page may be written again, and a page without verdicts by one with them."""
    test = ClaimTest("less", "s", CELL, "rmse", "cofm_amssrcpf", "ekf", group="position")
    out = tmp_path / "out"
    for folder in (tmp_path / "none", study, study):
        page_of(folder, out, test)
    for path in out.rglob("measurements.parquet"):
        path.unlink()
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(
        ValueError, match=r"verdicts\.json, got none for 1 of 1 claims.*reports_dir="
    ):
        page_of(tmp_path / "none", out, test)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_the_page_says_what_each_claims_study_ran_with(study: Path, tmp_path: Path) -> None:
    test = ClaimTest("less", "s", CELL, "rmse", "cofm_amssrcpf", "sir", group="position")
    write(
        study / "s", Method("apf", 1.3, 0.8, 999), runs=20, steps=60
    )  # in the study, and not in the claim
    for text in page_of(study, tmp_path / "out", test):
        assert "s: 20 runs per filter. Budget: particles (N = 200 in each particle filter)." in text
        assert "All studies ran at one commit, 0123abc." in text
        assert "Commit 0123abc" not in text
        assert "N = 999" not in text
    table = pd.read_csv(tmp_path / "out" / "claims" / "tables" / "studies.csv")
    assert table.iloc[0].to_dict() == {
        "study": "s", "jobs": 2, "runs": 20, "budget": "particles (N = 200 in each particle filter)", "commit": "0123abc",
    }  # fmt: skip


def test_the_page_says_which_commit_each_study_ran_at_where_they_differ(
    study: Path, tmp_path: Path
) -> None:
    for method in METHODS[:2]:
        write(study / "t", method, runs=30, steps=60, versions={**VERSIONS, "commit": "feed123"})
    one = ClaimTest("less", "s", CELL, "rmse", "ukf", "ekf", group="position")
    for text in page_of(study, tmp_path / "out", one, replace(one, study="t")):
        assert "The studies ran at different commits, 0123abc, feed123" in text
        assert (
            "s: 20 runs per filter. Budget: particles (without particle filters). Commit 0123abc."
            in text
        )
        assert (
            "t: 30 runs per filter. Budget: particles (without particle filters). Commit feed123."
            in text
        )
    both = measurements.claim_job_metadata([claim(one, replace(one, study="t"))], study)
    (line,) = claim_tables.describe_jobs(claim(one), both)  # of its own studies alone
    assert line.startswith("s: 20 runs")


def test_anchors_are_those_of_the_figures_on_a_page_that_is_there(tmp_path: Path) -> None:
    page = (
        '<section id="table"><figure id="cost"></figure><figure id="paper_000_2_a_b"><img></figure>'
    )
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "index.html").write_text(page)
    there = claims_page.report_anchors(["s", "t"], tmp_path)
    assert there == {"s": {"cost", "paper_000_2_a_b"}}


def test_a_claim_links_to_the_papers_own_figure_where_it_is_drawn_anew() -> None:
    known = {one.id: one for one in ALL}
    cell = "sar_flight_nominal_sins_sar"
    page = {
        f"paper_000_2_{cell}_attitude",
        f"paper_000_3_{cell}_position",
        "paper_001_2",
        "paper_001_4",
    }

    def link(name: str, form: str) -> list[str]:
        return [
            claims_figures.figure_anchor(known[name], test, page)
            for test in known[name].tests[form]
        ]

    assert set(link("C000-1", "repaired")) == {f"paper_000_2_{cell}_attitude"}
    assert set(link("C000-2", "repaired")) == {f"paper_000_3_{cell}_position"}
    assert link("C000-3", "printed") == [
        f"paper_000_2_{cell}_attitude",
        f"paper_000_3_{cell}_position",
    ]
    assert set(link("C001-6", "")) == {"paper_001_2"}
    assert set(link("C001-4", "")) == {"paper_001_4"}
    assert set(link("C001-7", "printed")) == {""}  # the abstract: no figure


def test_figures_are_read_from_a_source() -> None:
    assert claims_figures.figure_numbers("figures 2, 4 and 5") == {2, 4, 5}
    assert claims_figures.figure_numbers("figures 12 to 14") == {12, 13, 14}
    assert claims_figures.figure_numbers("figure 3, section 4") == {3}
    assert claims_figures.figure_numbers("eqs. 33 to 35, table 1") == set()


def test_printed_numbers_stand_beside_measured_ones() -> None:
    ratio, level = replace(LESS, printed=0.6), alone("near", printed=22.0)
    values = losses(11, 0.65)
    (found,) = verdicts.decide_claims([claim(ratio)], frame(ratio, **values))
    (other,) = verdicts.decide_claims([claim(level, id="X-2")], frame(level, **only(10, 44.0)))
    made = {
        drawing.name: drawing.make() for drawing in claims_figures.claim_figures([found, other])
    }
    axis = made["printed_ratios"].axes[0]
    points = {
        one.get_marker(): float(one.get_xdata()[0])
        for one in axis.lines
        if len(one.get_xdata()) == 1
    }
    assert points == {"x": 0.6, "o": pytest.approx(found.findings[""][0].effect)}
    assert [text.get_text() for text in axis.get_yticklabels()] == ["X-1: a / b, position"]
    bar = next(
        one.get_xdata()
        for one in axis.lines
        if len(one.get_xdata()) == 2 and one.get_xdata()[0] != one.get_xdata()[1]
    )
    assert tuple(bar) == (found.findings[""][0].low, found.findings[""][0].high)
    shown = other.findings[""][0]
    assert shown.low < shown.effect < shown.high
    assert shown.effect == pytest.approx(44, rel=0.1)  # in its unit, beside the printed number
    points = [
        float(one.get_xdata()[0])
        for one in made["printed_levels"].axes[0].lines
        if one.get_marker() == "o"
    ]
    assert points == [pytest.approx(2.0, rel=0.1)]
    assert claims_figures.claim_figures([]) == []
