"""Claims read from claims.yaml, with checks of their keys and names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pfbench.claims.schema import (
    CLAIM_GROUPS,
    CLAIM_METRICS,
    FORMS,
    GROUPED,
    MARKS,
    PAPERS,
    REASONS,
    STATISTICS,
    Claim,
    ClaimTest,
)

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
