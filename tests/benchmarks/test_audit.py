"""The audit of public claims: copied rows, sources, verdicts computed a second time, and the page of them."""

import io
import math
import sys

import numpy as np
import pandas as pd
import pytest
from checkout import ROOT
from scipy.stats import binomtest, t as student, trim_mean, wilcoxon

from pfbench.report import is_equal_drawing

sys.path.insert(0, str(ROOT / "experiments" / "audit"))  # scripts, not a package
import audit

ENTRIES, AUDITED = audit.read_audit()


def read_rows(key: str) -> pd.DataFrame:
    return pd.read_csv(
        io.StringIO(ENTRIES["tables"][key]["rows"].strip()),
        sep=r"\s*\|\s*", engine="python", dtype=str, index_col=0,
    )  # fmt: skip


def log_ratios(key: str, a: str, b: str) -> np.ndarray:
    """Mean log ratio of each drive, [n], 1000 for a failed one; without drives that a program did not run."""
    rows = read_rows(key)[[a, b]].drop(index="mean", errors="ignore").replace({"x": "inf", "-": "nan"})  # fmt: skip
    logs = np.log(rows.astype(float).dropna())
    return (logs[a] - logs[b]).fillna(0.0).clip(-1e3, 1e3).groupby(level=0, sort=False).mean().to_numpy()  # fmt: skip


def trimmed_p(d: np.ndarray) -> float:
    """p-value of Yuen's test for one sample, two-sided; of the signs where failed drives remain after trimming."""
    cut, h = len(d) // 5, len(d) - 2 * (len(d) // 5)
    middle = np.clip(d, *np.sort(d)[[cut, len(d) - cut - 1]])
    if np.abs(middle).max() == 1e3:
        return float(binomtest((d < 0).sum(), (d != 0).sum()).pvalue)
    return 2 * float(student.sf(abs(trim_mean(d, 0.2)) / math.sqrt(len(d) * middle.var() / h / (h - 1)), h - 1))  # fmt: skip


@pytest.mark.parametrize("one", AUDITED, ids=lambda one: one.claim["key"])
def test_verdicts_of_a_claim_are_those_of_a_second_computation(one: audit.Audited) -> None:
    """By tests of scipy. The ends of an interval are where the signed-rank test of shifted ratios stops."""
    for pair in one.pairs:
        v, d = pair.verdict, log_ratios(one.claim["table"], pair.verdict.a, pair.verdict.b)
        centre = np.median([(x + y) / 2 for i, x in enumerate(d) for y in d[i:]])
        p = [
            wilcoxon(d, zero_method="zsplit").pvalue, trimmed_p(d),
            binomtest((d < 0).sum(), (d != 0).sum(), alternative="less" if centre > -1e-9 else "greater").pvalue,
        ]  # fmt: skip
        word = "better" if max(p) < 0.05 and centre < 0 else "equal" if v.low > 1 / 1.05 and v.high < 1.05 else "not decided"  # fmt: skip
        assert (v.word, v.n, pair.smaller, pair.agrees) == (
            word if len(d) >= 10 else "not decided", len(d), (d < 0).sum(),
            len(d) >= 10 and word == one.claim["says"].replace("smaller", "better"),
        )  # fmt: skip
        if len(d) >= 10 and math.isfinite(v.ratio):
            assert [v.p, v.evidence.p_trimmed, v.evidence.p_sign, v.ratio] == pytest.approx([*p, math.exp(centre)], rel=1e-6)  # fmt: skip
            is_exact = v.low > 1e-9 and len(d) <= 50 and len(np.unique(d.round(9))) == len(d)
            for end, out in ((v.low, -1e-6), (v.high, 1e-6)) if is_exact else ():
                assert wilcoxon(d - math.log(end) - out).pvalue < 0.05 <= wilcoxon(d - math.log(end) + out).pvalue  # fmt: skip


@pytest.mark.parametrize("key", ENTRIES["tables"])
def test_a_table_has_a_source_and_its_printed_means(key: str) -> None:
    """Two percent, or a unit of the last digit: papers round, and one printed mean is off by 1 %."""
    assert all(ENTRIES["sources"][ENTRIES["tables"][key]["source"]][k] for k in ("name", "address", "version", "licence"))  # fmt: skip
    for _, column in read_rows(key).items() if "mean" in read_rows(key).index else ():
        mean, values = column["mean"], [float(x) for x in column.drop("mean") if x not in "x-"]
        digit = 10.0 ** -len(mean.partition(".")[2])
        assert mean == "-" or np.mean(values) == pytest.approx(float(mean), rel=0.02, abs=1.01 * digit)  # fmt: skip


def test_the_page_is_that_of_the_stored_claims() -> None:
    assert audit.PAGE.read_text() == audit.page()
    assert is_equal_drawing(audit.PICTURE.read_bytes(), audit.picture())


def test_the_turn_of_a_track_is_measured() -> None:
    time = np.arange(0.0, 20.0, 0.1)
    path = 5 * np.cos(time / 3) + 1j * time
    reference, track = (np.column_stack([time, z.real, z.imag]) for z in (path, path * np.exp(-2j) + 3))  # fmt: skip
    assert audit.measure_turn(track[1:-1], reference)[::2] == pytest.approx((math.degrees(2.0), 0.0), abs=1e-6)  # fmt: skip
