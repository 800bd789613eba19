"""Records of the papers' claims: conditions, metrics and tests that decide each of them.

The records are in claims.yaml. Values of `all` hold for every test of a claim. Lists within a test
represent as many tests, and `method` represents the filter as printed and as repaired. A claim that
a test of this repository decides without runs has `shown`, "holds" or "fails", and the name of that
test.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pfbench.results import metrics

FORMS = ("printed", "repaired")


PAPERS = {
    "000": "Yan et al. 2016, modified particle filter for SINS/SAR",
    "001": "Pu and Qin, QMC polymerisation for airborne passive location",
    "002": "COFM-AMSSRCPF 2024, SINS/GNSS",
    "003": "DMC reconstruction for SINS/GPS with a large azimuth error",
    "004": "Tian et al., chaos particle swarm with escape factor for GPS/INS",
}


NOT_STATED, NOT_RUN = "not specified in the paper", "not run"
NO_POWER, LOST = "too few runs", "too many lost runs"
REASONS = (NOT_STATED, NOT_RUN, NO_POWER, LOST)
MARKS = ("circular", "vacuous")


# Fields that each statistic requires besides a.
STATISTICS = {
    "less": "b",
    "greater": "b",
    "equal": "b",
    "no_worse": "b",
    "close": "b",
    "below": "high",
    "above": "low",
    "within": "low high",
    "near": "printed",
    "flat": "",
    "falls": "",
    "share": "low",
    "cost": "",
    "report": "",
}


# Metrics of claims that are not in the table of metrics; those of component errors first.
_ERROR_METRICS = ("mean_abs", "settled", "growth", "sd")


_RUN_METRICS = ("effective", "severely_overconfident")
_BY_SCOPE = {metric.name: metric.scope for metric in metrics.METRICS}
SCALED = (*(m for m, s in _BY_SCOPE.items() if s == "components"), *_ERROR_METRICS)
CLAIM_METRICS = tuple(dict.fromkeys((*_BY_SCOPE, *_ERROR_METRICS, *_RUN_METRICS)))
GROUPED = (*SCALED, *(m for m, s in _BY_SCOPE.items() if s == "group"))  # metrics of a group


CLAIM_GROUPS = (
    "attitude",
    "velocity",
    "position",
    "gyro_bias",
    "accelerometer_bias",
    "gyro_constant",
    "gyro_markov",
    "clock [m]",
    "clock [m/s]",
    "state [m]",
    "state [m/s]",
    "state",
)


@dataclass(frozen=True)
class ClaimTest:
    """Test that a claim asks for.

    Attributes:
        statistic: One of `STATISTICS`, see `claim_tests`.
        study: Experiment whose results are used.
        cell: Condition, as scenario/noise/model.
        metric: One of `CLAIM_METRICS`.
        a: Label of a filter.
        b: Label of the filter that a is compared with, or empty.
        b_cell: Condition of b, if it differs. Runs of the same number are paired.
        b_study: Experiment of b, if it differs.
        group: Group of the state, as named in reports.
        component: Component of the group, or "norm".
        start: First time included, in seconds.
        end: Last time included, in seconds.
        settled: Bound of the metric "settled", in displayed units.
        printed: Printed ratio of a to b, or the printed number of "near".
        low: Lower limit claimed, in displayed units. For "cost", of the ratio of two times or of
            one time in seconds.
        high: Upper limit claimed, as `low`.
        margin: Relative margin; in displayed units for "close", of the logarithm for "flat".
        decides: Whether the verdict depends on the test. If not, the page shows it only.
    """

    statistic: str
    study: str
    cell: str
    metric: str
    a: str
    b: str = ""
    b_cell: str = ""
    b_study: str = ""
    group: str = ""
    component: str = "norm"
    start: float = 0.0
    end: float = np.inf
    settled: float = np.nan
    printed: float = np.nan
    low: float = -np.inf
    high: float = np.inf
    margin: float = 0.1
    decides: bool = True

    @property
    def measure(self) -> str:
        """Name of the measured quantity, equal for both sides."""
        names = {"effective": "effective particles", "seconds_per_step": "time per step"}
        name = names.get(self.metric, self.metric).replace("_", " ")
        bound = f" at {self.settled:g}" if self.metric == "settled" else ""
        target = self.group if self.component == "norm" else self.component
        has_all_time = self.start == 0 and np.isinf(self.end)
        span = "" if has_all_time else f", {self.start:g} to {self.end:g} s"
        span = span.replace(" to inf s", " s to the end")
        words = (name + bound, target if self.metric in GROUPED else "")
        return " ".join(word for word in words if word) + span

    @property
    def sides(self) -> list[tuple[str, str, str]]:
        """Study, condition and label of a and, if there is one, of b."""
        b = (self.b_study or self.study, self.b_cell or self.cell, self.b)
        return [(self.study, self.cell, self.a), *([b] if self.b else [])]


@dataclass(frozen=True)
class Claim:
    """Claim of a paper.

    Attributes:
        id: Identifier, as "C000-1".
        paper: Key of `PAPERS`.
        claim: Words of the paper, shortened.
        source: Equation, figure, table or section.
        printed: Printed numbers as text; empty without numbers.
        tests: Tests by form, "printed" or "repaired", or "" if the claim is about no method of
            the paper.
        reasons: By form, or "", a reason and its explanation why that form cannot be decided.
        note: Interpretation of the words [ours].
        mark: "circular" or "vacuous" and its explanation, if the tests cannot support the claim;
            empty texts otherwise.
        evidence: By form, or "", "holds" or "fails" and the evidence, if no runs are needed.
    """

    id: str
    paper: str
    claim: str
    source: str
    printed: str
    tests: Mapping[str, tuple[ClaimTest, ...]]
    reasons: Mapping[str, tuple[str, str]]
    note: str = ""
    mark: tuple[str, str] = ("", "")
    evidence: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    @property
    def studies(self) -> list[str]:
        """Studies whose results the tests use."""
        tests = (test for tests in self.tests.values() for test in tests)
        return list(dict.fromkeys(side[0] for test in tests for side in test.sides))
