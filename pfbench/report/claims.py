"""What the papers claim, as records: each says which cells, measures and tests decide it, or why nothing can.

A law or a count that takes no runs is decided by a test of this repository: its record has `shown`, "holds" or "fails", and the
name of the test.

The records lie in claims.yaml, where values of `all` hold for every test of a claim, lists within a test stand for as many
tests, and `method` stands in turn for the filter as printed and as repaired. `evidence` measures, `rulings` decides, `ledger`
shows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

FILE = Path(__file__).with_name("claims.yaml")
FORMS = ("printed", "repaired")
PAPERS = {
    "000": "Yan et al. 2016, modified particle filter for SINS/SAR",
    "001": "Pu and Qin, QMC polymerisation for airborne passive location",
    "002": "COFM-AMSSRCPF 2024, SINS/GNSS",
    "003": "DMC reconstruction for SINS/GPS with a large azimuth error",
    "004": "Tian et al., chaos particle swarm with escape factor for GPS/INS",
}
REASONS = ("not stated", "not run", "no power", "lost")
SHOWN = ("holds", "fails")
STATISTICS = {  # and what each needs beside a
    "less": "b", "greater": "b", "equal": "b", "no_worse": "b", "close": "b", "below": "high", "above": "low",
    "within": "low high", "near": "printed", "flat": "", "falls": "", "share": "low", "cost": "", "report": "",
}  # fmt: skip
METRICS = (
    "rmse", "max_error", "mean_abs", "settled", "growth", "sd", "nees", "ess", "effective", "ancestors",
    "unique", "accepted", "iterations", "diverged", "seconds_per_step",
)  # fmt: skip
SCALED = ("rmse", "max_error", "mean_abs", "settled", "growth", "sd")  # of a block of components, in the unit shown
GROUPS = (
    "attitude", "velocity", "position", "gyro_bias", "accelerometer_bias", "gyro_constant", "gyro_markov", "clock [m]",
    "clock [m/s]", "state [m]", "state [m/s]", "state",
)  # fmt: skip


@dataclass(frozen=True)
class Comparison:
    """One comparison that a claim asks for.

    Attributes:
        statistic: one of `STATISTICS`, see `rulings`.
        study: experiment whose results are used.
        cell: scenario/noise/model.
        metric: one of `METRICS`.
        a: label of a filter.
        b: label that a is compared to, or nothing.
        b_cell, b_study: where b ran, when elsewhere; runs of the same number are paired.
        group: of the state, as the report names it.
        component: of the group, or "norm".
        start, end: seconds that count, both included.
        settled: bound of metric "settled", in the unit shown.
        printed: ratio of a to b, or for "near" the number, that the paper prints.
        low, high: limits of what is claimed, in the unit shown; of "cost", of the ratio of two times, or of one in seconds.
        margin: relative; of "close" in the unit shown, of "flat" of the logarithm.
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

    @property
    def measure(self) -> str:
        """What is measured, in words; the same for both sides."""
        what = {"effective": "effective particles", "seconds_per_step": "time per step"}.get(self.metric, self.metric)
        bound = f" at {self.settled:g}" if self.metric == "settled" else ""
        of_group = self.metric in (*SCALED, "nees")
        part = (self.group if self.component == "norm" else self.component) if of_group else ""
        span = "" if self.start == 0 and np.isinf(self.end) else f", {self.start:g} to {self.end:g} s"
        span = span.replace(" to inf s", " s to the end")
        return " ".join(word for word in (what.replace("_", " ") + bound, part) if word) + span

    @property
    def sides(self) -> list[tuple[str, str, str]]:
        """Study, cell and label of a and, where there is one, of b."""
        other = [(self.b_study or self.study, self.b_cell or self.cell, self.b)] if self.b else []
        return [(self.study, self.cell, self.a), *other]


@dataclass(frozen=True)
class Claim:
    """One claim of a paper.

    Attributes:
        id: as in the ledger, "C000-1".
        paper: key of `PAPERS`.
        claim: in the paper's words, shortened.
        source: equation, figure, table or section.
        printed: the numbers printed, as text; empty where there are none.
        tests: by form, "printed", "repaired", or "" where the claim is about no method of the paper's own.
        why: by form, or "", a reason and its explanation: why that form cannot be decided, or no experiment could decide.
        note: how the words were read [ours].
        shown: by form, or "", "holds" or "fails", and what shows it, where no experiment is needed.
    """

    id: str
    paper: str
    claim: str
    source: str
    printed: str
    tests: Mapping[str, tuple[Comparison, ...]]
    why: Mapping[str, tuple[str, str]]
    note: str = ""
    shown: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    @property
    def studies(self) -> list[str]:
        return list(dict.fromkeys(side[0] for tests in self.tests.values() for t in tests for side in t.sides))


def load(conf: Path | None = None, experiments: Path | None = None, path: Path = FILE) -> list[Claim]:
    """The records, checked.

    Args:
        conf: folder of configurations; with it the names of scenarios, regimes, models and filters are looked up.
        experiments: folder of studies; with it the names of studies are.
        path: another data file.

    Raises:
        ValueError: says which record is wrong, in what, and what there is instead.
    """
    rows = yaml.safe_load(path.read_text(encoding="utf-8"))
    found = [_claim(row) for row in rows]
    ids = [claim.id for claim in found]
    if twice := sorted({one for one in ids if ids.count(one) > 1}):
        raise ValueError(f"{path.name}: {', '.join(twice)} stands there more than once; each claim has one record")
    there = {group: _names(conf / group) for group in ("scenario", "noise", "model", "filter")} if conf else {}
    there |= {"study": _names(experiments)} if experiments else {}
    for claim in found:
        for test in (t for tests in claim.tests.values() for t in tests):
            _check(claim.id, test, there)
    return found


def _claim(row: Mapping[str, Any]) -> Claim:
    missing = {"id", "paper", "claim", "source"} - set(row)
    unknown = set(row) - {"id", "paper", "claim", "source", "printed", "forms", "why", "shown", "all", "tests", "note"}
    name = row.get("id", "a record without id")
    if missing or unknown:
        raise ValueError(f"{name}: lacks {sorted(missing)}, does not know {sorted(unknown)}")
    if row["paper"] not in PAPERS:
        raise ValueError(f"{name}: paper={row['paper']!r}; give one of {', '.join(PAPERS)}, in quotes")
    why = {form: _begun(name, "why", text, REASONS) for form, text in _by_form(row.get("why", {})).items()}
    shown = {form: _begun(name, "shown", text, SHOWN) for form, text in _by_form(row.get("shown", {})).items()}
    if shown and (why or row.get("tests")):
        raise ValueError(f"{name}: what is shown without an experiment has neither tests nor a reason `why`")
    forms: Mapping[str, str] = {} if shown else row.get("forms", {"": ""})
    tests = {form: tuple(_tests(row, form, method)) for form, method in forms.items() if form not in why and "" not in why}
    if not why and not shown and not any(tests.values()):
        raise ValueError(f"{name}: it has neither tests nor a reason `why` nothing decides it")
    if wrong := (set(forms) | set(why) | set(shown)) - {*FORMS, ""}:
        raise ValueError(f"{name}: forms are {', '.join(FORMS)}, not {', '.join(sorted(wrong))}")
    # what is reported without a decision is measured all the same
    reported = {"": tuple(_tests(row, "", ""))} if "" in why and row.get("tests") else {}
    texts = {key: str(row[key]).strip() for key in ("id", "paper", "claim", "source")}
    printed = "" if row.get("printed") is None else str(row["printed"])
    note = str(row.get("note", "")).strip()
    return Claim(**texts, printed=printed, tests=tests or reported, why=why, note=note, shown=shown)


def _by_form(why: Any) -> dict[str, str]:
    return {"": why} if isinstance(why, str) else dict(why)


def _begun(name: str, key: str, text: str, known: Sequence[str]) -> tuple[str, str]:
    """The word that a text begins with, one of those known, and what follows its colon."""
    word, _, rest = text.strip().partition(": ")
    if word not in known or not rest:
        raise ValueError(f"{name}: {key}={text!r}; begin with one of {', '.join(known)} and a colon, then say it")
    return word, rest


def _tests(row: Mapping[str, Any], form: str, method: str) -> Iterator[Comparison]:
    """The tests of one form; lists of equal length are taken side by side."""
    known = {part.name for part in fields(Comparison)}
    for given in row.get("tests", ()):
        one = {**row.get("all", {}), **given}
        if one.pop("form", form) != form:
            continue
        one = {{"is": "statistic", "from": "start", "to": "end"}.get(key, key): value for key, value in one.items()}
        if unknown := set(one) - known:
            raise ValueError(f"{row['id']}: a test does not know {sorted(unknown)}; it has {sorted(known)}")
        if missing := {"statistic", "study", "cell", "metric", "a"} - set(one):
            raise ValueError(f"{row['id']}: a test lacks {sorted(missing)}")
        lengths = {len(value) for value in one.values() if isinstance(value, list)}
        if len(lengths) > 1:
            raise ValueError(f"{row['id']}: lists of {sorted(lengths)} values in one test; give each as many")
        for k in range(max(lengths, default=1)):
            single = {key: value[k] if isinstance(value, list) else value for key, value in one.items()}
            sides = {key: re.sub(r"^method(?=\[|$)", method, single.get(key, "")) for key in ("a", "b")}
            numbers = {key: float(single[key]) for key in single if key in _NUMBERS}
            yield Comparison(**{**single, **sides, **numbers})


_NUMBERS = ("start", "end", "settled", "printed", "low", "high", "margin")


def _names(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.yaml"))


def _check(claim: str, test: Comparison, there: Mapping[str, Sequence[str]]) -> None:
    """Raises ValueError where a test names what there is not, or lacks what its statistic needs."""
    _among(claim, "is", test.statistic, STATISTICS)
    _among(claim, "metric", test.metric, METRICS)
    if test.metric in (*SCALED, "nees"):
        _among(claim, "group", test.group, GROUPS)
    for need in STATISTICS[test.statistic].split():
        value = getattr(test, need)
        if not value or (not isinstance(value, str) and not np.isfinite(value)):
            raise ValueError(f"{claim}: a test that is {test.statistic} needs {need}")
    if (test.metric == "settled") == np.isnan(test.settled):
        raise ValueError(f"{claim}: metric settled needs settled=, the bound to stay within; other metrics must not have it")
    for study, cell, label in test.sides:
        names = cell.split("/")
        if len(names) != 3 or not label:
            raise ValueError(f"{claim}: cell={cell}, filter={label!r}; give scenario/noise/model and the label of a filter")
        named = zip(("scenario", "noise", "model", "filter", "study"), (*names, label.partition("[")[0], study), strict=True)
        for group, name in named:
            if group in there:
                _among(claim, group, name, there[group])


def _among(claim: str, key: str, value: str, known: Sequence[str] | Mapping[str, Any]) -> None:
    if value not in known:
        raise ValueError(f"{claim}: {key}={value!r} is not known; there are {', '.join(known)}")
