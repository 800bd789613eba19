"""Claims of the papers as records: conditions, metrics, tests and choices, read from claims.yaml with checks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pfbench.results import metrics

# --------------------------------------------------------------------------------------------------
# Claims read from claims.yaml, with checks of their keys and names.

FILE = Path(__file__).with_name("claims.yaml")
SHOWN = ("holds", "fails")
_NUMBERS = ("start", "end", "settled", "printed", "low", "high", "margin")
_FIELD_OF_KEY = {"is": "statistic", "from": "start", "to": "end"}
_REQUIRED_KEYS = {"id", "paper", "claim", "source"}
_OPTIONAL_KEYS = {"printed", "forms", "why", "shown", "all", "tests", "note", "mark"}


def read_claims(
    conf: Path | None = None, experiments: Path | None = None, path: Path = FILE
) -> list[Claim]:
    """Read and check the records.

    Args:
        conf: Folder of configurations, to check names of scenarios, regimes, models and filters.
        experiments: Folder of experiments, to check names of studies.
        path: Data file.

    Returns:
        The claims, in the order of the file.

    Raises:
        ValueError: if a record is wrong. The message names the record, the fault and the options.
    """
    claims = [_parse_claim(row) for row in yaml.safe_load(path.read_text(encoding="utf-8"))]
    ids = [claim.id for claim in claims]
    if twice := sorted({name for name in ids if ids.count(name) > 1}):
        raise ValueError(f"{path.name}: id must be unique, got {', '.join(twice)} more than once.")
    folders = ("scenario", "noise", "model", "filter")
    options = {group: _yaml_names(conf / group) for group in folders} if conf else {}
    options |= {"study": _yaml_names(experiments)} if experiments else {}
    for claim in claims:
        for test in (test for tests in claim.tests.values() for test in tests):
            _check_test(claim.id, test, options)
    return claims


def _parse_claim(row: Mapping[str, Any]) -> Claim:
    """Parse one record."""
    name = row.get("id", "a record without id")
    if missing := _REQUIRED_KEYS - set(row):
        raise ValueError(f"{name}: a record must have {sorted(missing)}. Add them.")
    if unknown := set(row) - _REQUIRED_KEYS - _OPTIONAL_KEYS:
        options = sorted(_REQUIRED_KEYS | _OPTIONAL_KEYS)
        raise ValueError(f"{name}: keys must be among {options}, got {sorted(unknown)}.")
    _check_option(name, "paper", row["paper"], PAPERS)
    reasons, evidence = (
        {form: _parse_reason(name, key, text, options) for form, text in _by_form(row, key).items()}
        for key, options in (("why", REASONS), ("shown", SHOWN))
    )
    if evidence and (reasons or row.get("tests")):
        raise ValueError(f"{name}: a record with `shown` must not have `tests` or `why`.")
    forms: Mapping[str, str] = {} if evidence else row.get("forms", {"": ""})
    testable = {form: method for form, method in forms.items() if not {form, ""} & set(reasons)}
    tests = {form: tuple(_parse_tests(row, form, method)) for form, method in testable.items()}
    if not reasons and not evidence and not any(tests.values()):
        raise ValueError(f"{name}: a record must have `tests`, or a reason `why` it has none.")
    for form in sorted(set(forms) | set(reasons) | set(evidence)):
        _check_option(name, "form", form, (*FORMS, ""))
    # Values that are reported without a decision are measured too.
    reported = {"": tuple(_parse_tests(row, "", ""))} if "" in reasons and row.get("tests") else {}
    texts = {key: str(row[key]).strip() for key in ("id", "paper", "claim", "source")}
    printed = "" if row.get("printed") is None else str(row["printed"])
    note = str(row.get("note", "")).strip()
    mark = _parse_reason(name, "mark", row["mark"], MARKS) if "mark" in row else ("", "")
    return Claim(
        **texts,
        printed=printed,
        tests=tests or reported,
        reasons=reasons,
        note=note,
        mark=mark,
        evidence=evidence,
    )


def _by_form(row: Mapping[str, Any], key: str) -> dict[str, str]:
    """Return texts by form; one text without forms is under ""."""
    value = row.get(key, {})
    return {"": value} if isinstance(value, str) else dict(value)


def _parse_reason(name: str, key: str, text: str, options: Sequence[str]) -> tuple[str, str]:
    """Divide a text at its first colon into one of the options and its explanation."""
    reason, _, explanation = text.strip().partition(": ")
    if reason not in options or not explanation:
        raise ValueError(
            f"{name}: {key} must begin with one of {', '.join(options)} and a colon, "
            f"got {key}={text!r}. Add an explanation after it."
        )
    return reason, explanation


def _parse_tests(row: Mapping[str, Any], form: str, method: str) -> Iterator[ClaimTest]:
    """Parse the tests of one form; lists of equal length are taken side by side."""
    options = {item.name for item in fields(ClaimTest)}
    for entry in row.get("tests", ()):
        keys = {**row.get("all", {}), **entry}
        if keys.pop("form", form) != form:
            continue
        values = {_FIELD_OF_KEY.get(key, key): value for key, value in keys.items()}
        if unknown := set(values) - options:
            raise ValueError(
                f"{row['id']}: keys of a test must be fields of a test, got {sorted(unknown)}. "
                f"Choose from {sorted(options)}."
            )
        if missing := {"statistic", "study", "cell", "metric", "a"} - set(values):
            raise ValueError(f"{row['id']}: a test must have {sorted(missing)}. Add them.")
        lengths = {len(value) for value in values.values() if isinstance(value, list)}
        if len(lengths) > 1:
            raise ValueError(
                f"{row['id']}: lists of one test must have equal length, got {sorted(lengths)}."
            )
        for k in range(max(lengths, default=1)):
            single = {key: v[k] if isinstance(v, list) else v for key, v in values.items()}
            sides = {s: re.sub(r"^method(?=\[|$)", method, single.get(s, "")) for s in ("a", "b")}
            numbers = {key: float(single[key]) for key in single if key in _NUMBERS}
            yield ClaimTest(**{**single, **sides, **numbers})


def _yaml_names(folder: Path) -> list[str]:
    """List the names of the YAML files of a folder."""
    return sorted(path.stem for path in folder.glob("*.yaml"))


def _check_test(claim: str, test: ClaimTest, options: Mapping[str, Sequence[str]]) -> None:
    """Raise ValueError if a test names something unknown, or lacks a field."""
    _check_option(claim, "is", test.statistic, STATISTICS)
    _check_option(claim, "metric", test.metric, CLAIM_METRICS)
    if test.metric in GROUPED:
        _check_option(claim, "group", test.group, CLAIM_GROUPS)
    for need in STATISTICS[test.statistic].split():
        value = getattr(test, need)
        if not value or (not isinstance(value, str) and not np.isfinite(value)):
            raise ValueError(f"{claim}: {need} must be given for a test with is={test.statistic}.")
    if (test.metric == "settled") == np.isnan(test.settled):
        raise ValueError(f"{claim}: settled must be given for metric=settled, and only for it.")
    for study, cell, label in test.sides:
        names = cell.split("/")
        if len(names) != 3 or not label:
            got = f"cell={cell} and filter={label!r}"
            raise ValueError(
                f"{claim}: cell must be scenario/noise/model with a filter, got {got}."
            )
        keys = ("scenario", "noise", "model", "filter", "study")
        values = (*names, label.partition("[")[0], study)
        for key, value in zip(keys, values, strict=True):
            if key in options:
                _check_option(claim, key, value, options[key])


def _check_option(
    claim: str, key: str, value: str, options: Sequence[str] | Mapping[str, Any]
) -> None:
    """Raise ValueError if a value is not among the options."""
    if value not in options:
        listed = ", ".join(map(str, options))
        raise ValueError(f"{claim}: {key} must be one of {listed}, got {key}={value!r}.")


# --------------------------------------------------------------------------------------------------
# Records of the papers' claims: conditions, metrics and tests that decide each of them.
#
# The records are in claims.yaml. Values of `all` hold for every test of a claim. Lists within a test
# represent as many tests, and `method` represents the filter as printed and as repaired. A claim that
# a test of this repository decides without runs has `shown`, "holds" or "fails", and the name of that
# test.

FORMS = ("printed", "repaired")


PAPERS = {
    "000": "Yan et al. 2016, modified particle filter for SINS/SAR",
    "001": "Pu and Qin, QMC polymerisation for airborne passive location",
    "002": "COFM-AMSSRCPF 2024, SINS/GNSS",
    "003": "DMC reconstruction for SINS/GPS with a large azimuth error",
    "004": "Tian et al., chaos particle swarm with escape factor for GPS/INS",
}


NOT_STATED, NOT_RUN = "not specified in the paper", "not run"
HOLDS, FAILS = "holds", "fails"
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


# --------------------------------------------------------------------------------------------------
# Choices of this project in the configurations of a claim's studies, where a paper states no value.
#
# The configurations mark them with `[ours]` in a comment.

_MARK = "[ours]"
_GROUPS = ("scenario", "noise", "model")


def list_choices(claim: Claim, conf: Path, experiments: Path) -> list[str]:
    """List the choices of this project in the studies of a claim.

    Returns choices of the experiments, then of scenarios, regimes, models and filters; none twice.
    """
    files: dict[Path, None] = {}
    tests = [test for tests in claim.tests.values() for test in tests]
    for study in claim.studies:
        files[experiments / f"{study}.yaml"] = None
    for test in tests:
        for _, cell, label in test.sides:
            for group, name in zip(_GROUPS, cell.split("/"), strict=True):
                files |= dict.fromkeys(_inherited_files(conf / group, name))
            filters = _inherited_files(conf / "filter", label.partition("[")[0])
            files |= dict.fromkeys(filters)
    return list(dict.fromkeys(text for path in files for text in _marked_choices(path)))


def _inherited_files(folder: Path, name: str) -> Iterator[Path]:
    """Yield the file of a configuration and those of the same group that it extends."""
    path = folder / f"{name}.yaml"
    if not path.is_file():
        return
    yield path
    for parent in _read(path).get("defaults", ()):
        if isinstance(parent, str) and parent != "_self_":
            yield from _inherited_files(folder, parent)


def _read(path: Path) -> dict[str, Any]:
    """Read a configuration without interpolation."""
    return dict(yaml.safe_load(path.read_text(encoding="utf-8")) or {})


def _marked_choices(path: Path) -> Iterator[str]:
    """Yield the marked choices of a file: keys with values and remarks, and sentences of its head."""
    if not path.is_file():
        return
    for line in path.read_text(encoding="utf-8").splitlines():
        setting, _, remark = line.partition("#")
        if _MARK not in remark:
            continue
        remark = re.sub(r"\s+", " ", remark.partition(_MARK)[0]).strip(" .;,")
        if setting.strip():
            yield f"{setting.strip()} ({remark})" if remark else setting.strip()
        else:
            yield f"{path.stem}: {remark}"
