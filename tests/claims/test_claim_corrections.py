"""Error rates of "holds" and "fails", tests that do not decide, and the choices beside a verdict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pfbench import job
from pfbench.claims import verdicts, verdicts as claim_samples
from pfbench.claims.claim_records import Claim, ClaimTest, list_choices, read_claims
from pfbench.stats.intervals import order_statistic_interval

CONF, STUDIES = job.conf_dir(), job.experiments_dir()
LESS = ClaimTest("less", "s", "flight/surge/ins_gnss", "rmse", "a", "b", group="position")


def claim(*tests: ClaimTest) -> Claim:
    return Claim("x", "000", "A claim", "figure 1", "", {"": tests}, {})


def frame(values: dict[str, np.ndarray]) -> pd.DataFrame:
    head = {"study": "s", "cell": LESS.cell, "measure": LESS.measure, "seed": 1, "unit": "m"}
    tables = [
        pd.DataFrame({**head, "label": name, "run": range(len(v)), "lost": False, "value": v})
        for name, v in values.items()
    ]
    return pd.concat(tables, ignore_index=True)


@pytest.mark.parametrize("worth", [0.0, 0.1])
@pytest.mark.parametrize("middle", [-0.3, 0.0, 0.2])
def test_the_p_value_of_failing_inverts_the_interval_of_order_statistics(
    worth: float, middle: float
) -> None:
    d = middle + 0.3 * np.random.default_rng(1).standard_normal(30)
    s = claim_samples.ClaimSample(d, -0.05, 0.05, worth, True, np.inf)
    p = claim_samples.exclusion_p_value(s)
    for alpha in (0.001, 0.01, 0.05, 0.2, 0.5):
        interval = order_statistic_interval(d, 1 - alpha)
        is_above = interval.low >= 0.05 - worth if worth else interval.low > 0.05
        is_below = interval.high <= -0.05 + worth if worth else interval.high < -0.05
        assert (p <= alpha) == (is_above or is_below)


def test_failing_is_corrected_over_the_claims_of_a_paper() -> None:
    """A claim that fails alone does not fail among others, as it would not hold among others."""
    d = np.where(np.arange(20) < 4, -1.0, 0.01 * np.arange(20))  # 4 of 20 runs show the effect
    values = {"a": np.exp(d), "b": np.ones(20)}
    alone = verdicts.decide_claims([claim(LESS)], frame(values))[0]
    result = alone.findings[""][0]
    assert result.p_fails == pytest.approx(2 * stats.binom.cdf(4, 20, 0.5)) == result.p_fails_holm
    assert alone.verdict == "not reproduced"
    others = {f"c{k}": np.exp(0.1 * (-1.0) ** np.arange(20)) for k in range(4)}
    claims = [claim(LESS), *(claim(replace(LESS, a=name)) for name in others)]
    among = verdicts.decide_claims(claims, frame({**values, **others}))[0]
    assert among.findings[""][0].p_fails_holm == pytest.approx(5 * result.p_fails)
    assert (among.verdict, among.reason) == ("undecided", "too few runs")


def test_a_claim_that_is_true_at_its_edge_fails_at_the_level() -> None:
    rng, edge = np.random.default_rng(2), 0.1
    samples = edge + rng.standard_normal((1000, 41))
    claimed = [claim_samples.ClaimSample(d, -np.inf, edge, 0.0, False, np.inf) for d in samples]
    failed = sum(claim_samples.exclusion_p_value(s) <= 0.05 for s in claimed)
    exact = stats.binom.cdf(stats.binom.ppf(0.025, 41, 0.5) - 1, 41, 0.5)  # at most 2.5 %
    assert abs(failed - 1000 * exact) <= 3.3 * np.sqrt(1000 * exact)


def test_a_test_beside_the_verdict_does_not_decide() -> None:
    rng = np.random.default_rng(3)
    values = {"a": np.exp(-1 + 0.1 * rng.standard_normal(40)), "b": np.ones(40)}
    values["worse"] = np.exp(1 + 0.1 * rng.standard_normal(40))
    against = replace(LESS, a="worse")
    beside = replace(against, decides=False)
    assert verdicts.decide_claims([claim(LESS, against)], frame(values))[0].verdict == (
        "not reproduced"
    )
    (verdict,) = verdicts.decide_claims([claim(LESS, beside)], frame(values))
    assert verdict.verdict == "reproduced"
    decided, shown = verdict.findings[""]
    assert (decided.outcome, shown.outcome) == ("holds", "fails")
    assert decided.family == shown.family == 1
    assert decided.p_holm == decided.p


def test_the_choices_of_a_claim_are_the_marked_values_of_its_files(tmp_path: Path) -> None:
    for group in ("scenario", "noise", "model", "filter"):
        (tmp_path / group).mkdir()
    (tmp_path / "scenario" / "parent.yaml").write_text("height: 2.0   # [km] not printed [ours]\n")
    (tmp_path / "scenario" / "flight.yaml").write_text(
        "# One flight [ours].\ndefaults:\n  - parent\n  - _self_\nspeed: 20.0  # [m/s]\n"
    )
    (tmp_path / "filter" / "a.yaml").write_text("scheme: systematic  # no scheme [ours]\n")
    (tmp_path / "s.yaml").write_text("runs: 1000   # [ours]\n")
    assert list_choices(claim(LESS), tmp_path, tmp_path) == [
        "runs: 1000",
        "flight: One flight",
        "height: 2.0 ([km] not printed)",
        "scheme: systematic (no scheme)",
    ]


def test_claims_of_paper_001_are_decided_at_the_printed_speed_with_sir_in_each_step() -> None:
    claims = {c.id: c for c in read_claims(CONF, STUDIES)}
    for name in (f"C001-{k}" for k in range(1, 10)):
        for test in (t for tests in claims[name].tests.values() for t in tests):
            assert test.decides == ("_printed/" in test.cell), name
            assert "sir" not in (test.a, test.b)
    for name in ("C001-5", "C001-6"):
        studies = {t.study for t in claims[name].tests[""] if t.decides}
        assert studies == {"paper_001", "paper_001_seed_2", "paper_001_seed_3"}
    choices = list_choices(claims["C001-5"], CONF, STUDIES)
    assert "carrier_frequency: 10.0e+9 ([Hz] not printed)" in choices
