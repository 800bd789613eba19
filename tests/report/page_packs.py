"""Packs of report pages with invented numbers, of any size and with any gap."""

import base64
import gzip
import itertools
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from pfbench.report.study_page.page_writer import render_page

FAMILIES = ("kalman", "particle", "gaussian", "guided", "swarm")
COLOURS = {
    "kalman": ("#0b4f8a", "#4f9be8"),
    "particle": ("#a33c00", "#f09050"),
    "gaussian": ("#04703f", "#4cc38a"),
    "guided": ("#5d3a9b", "#b093f0"),
    "swarm": ("#a01266", "#f07ac0"),
}
MARKERS = "os^Dv<>Pp*"
LIMIT = 50.0  # of the worlds, error of a filter that loses track
METRICS = (("rmse", "RMS error", "m"), ("final", "Last quarter", "m"), ("crps", "CRPS", "m"))


def build_pack(
    filters: int = 6,
    worlds: int = 2,
    regimes: int = 2,
    runs: int = 20,
    *,
    seed: int = 1,
    equal: bool = False,
    lost: Collection[int] = (),
    missing: Collection[tuple[int, int, int]] = (),
    names: dict[int, str] | None = None,
    instants: int = 60,
    carried: int = 10,
    plane: bool = True,
    numbered: bool = False,
) -> dict[str, Any]:
    """Build a pack.

    Args:
        filters: Number of filters. Every third one is proposed.
        worlds: Number of worlds.
        regimes: Number of noise regimes.
        runs: Runs of a cell.
        seed: Seed of the invented numbers.
        equal: Give all filters the same numbers.
        lost: Filters that lose all runs.
        missing: Filter, world and regime that were not run.
        names: Names by number of the filter.
        instants: Instants of a curve.
        carried: Runs of a cell whose tracks are in the pack.
        plane: Whether the worlds have a plane.
        numbered: Labels of the filters are whole numbers, in falling order.
    """
    rng = np.random.default_rng(seed)
    shape = (filters, worlds, regimes)
    bias = np.zeros((filters, 1, 1)) if equal else rng.normal(0, 0.4, (filters, 1, 1))
    level = bias + rng.normal(0, 0 if equal else 0.15, shape) + np.linspace(1, 5, worlds)[:, None]
    noise = rng.normal(0, 0.3, (1 if equal else filters, worlds, regimes, runs))
    errors = np.exp(level[..., None] + noise)
    for i in lost:
        errors[i] = np.nan
    for i in missing:
        errors[i] = np.nan
    keys = [str(filters - i) if numbered else f"f{i}" for i in range(filters)]
    built = _Numbers(keys, errors, set(lost), rng)
    cells = list(itertools.product(range(worlds), range(regimes)))
    tracks = (
        {_cell(c): built.tracks(c, min(carried, runs), plane) for c in cells} if carried else {}
    )
    return {
        "study": "invented",
        "title": "Invented study",
        "generated": {"commit": "0" * 7, "date": "2026-01-31", "version": "0.0"},
        "alpha": 0.05,
        "margin": 0.05,
        "warnings": [],
        "failures": [],
        "filters": [{**_look(i, names or {}), "key": key} for i, key in enumerate(keys)],
        "worlds": [
            {"key": f"w{i}", "name": f"World {i}", "words": f"Words of world {i}.", "unit": "m",
             "limit": LIMIT, "family": f"w{i}"} for i in range(worlds)
        ],
        "regimes": [
            {"key": f"r{i}", "name": ("Nominal", "Outliers", "Heavy tails", "Outage")[i % 4],
             "words": ""} for i in range(regimes)
        ],
        "cells": [
            {"world": f"w{c[0]}", "regime": f"r{c[1]}", "noise": f"r{c[1]}", "model": "", "runs": runs,
             "particles": 100, "seed": 1} for c in cells
        ],
        "metrics": [
            {"key": key, "name": name, "unit": unit, "direction": "lower", "caption": f"{name} of a run."}
            for key, name, unit in METRICS
        ],
        "baselines": keys[: built.baselines],
        "budgets": [
            {"key": "particles", "name": "Same N", "reason_missing": None},
            {"key": "time", "name": "Same time", "reason_missing": "This study has no runs of that budget."},
        ],
        "views": built.views(worlds, regimes),
        "planned": built.planned(worlds, regimes),
        "curves": {_cell(c): built.curves(c, instants) for c in cells},
        "calibration": built.calibration(worlds, regimes),
        "runs": {
            _cell(c): {"unit": "m", "name": "RMS error", "numbers": list(range(runs)),
                       "values": {k: [_short(v) for v in errors[i][c]] for i, k in enumerate(keys)
                                  if (i, *c) not in missing}} for c in cells
        },
        "tracks": tracks,
        "sweeps": [built.sweep()] if filters > 2 else [],
        "replay": "pfbench replay study=invented scenario={world} noise={noise} filter={filter} run={run}",
        "downloads": [{"name": "Verdicts (CSV)", "href": "verdicts.csv", "bytes": 1234, "group": "Numbers"}],
        "methods": {
            "filters": filters, "scenarios": [f"World {i}" for i in range(worlds)], "worlds": worlds,
            "regimes": [f"Regime {i}" for i in range(regimes)], "runs": [runs], "steps": [60], "seeds": [1],
            "particles": {}, "budgets": ["particles"], "metric": "RMS error", "alpha": 0.05, "margin": 0.05,
            "rounds": 0, "is_recorded": False, "has_threshold": True, "is_complete": not missing, "tuned": {},
            "software": {name: ["1"] for name in ("pfbench", "commit", "python", "torch", "numpy", "dtype",
                                                  "device", "threads")},
        },
        "bibtex": "@misc{a,\n title = {A},\n}",
        "filter_notes": [
            {"filter": key, "particles": "100", "is_exact": i % 2 == 0, "runs": runs, "lost": 0, "diverged": None,
             "has_bounded_weights": (True, False, None)[i % 3], "collapsed": i, "severely_overconfident": 0} for i, key in enumerate(keys)
        ],
        "choices": [{"text": "the noise is inflated", "filters": "all filters"}],
        "provenance": [["commit", "0" * 7], ["device", "cpu"]],
    }  # fmt: skip


class _Numbers:
    """Invented numbers of all parts of a pack."""

    def __init__(self, keys: list[str], errors: Any, lost: set[int], rng: Any) -> None:
        self.keys, self.errors, self.lost, self.rng = keys, errors, lost, rng
        self.are_equal = len(errors) > 1 and np.array_equal(errors[0], errors[1], equal_nan=True)
        self.baselines = 3 if errors[..., 0].size <= 300 else 2
        self.cost = np.exp(rng.normal(1, 1, len(keys)))
        self.coverage = rng.uniform(0.3, 0.95, len(keys))

    def views(self, worlds: int, regimes: int) -> dict[str, Any]:
        scopes = itertools.product(["all", *range(worlds)], ["all", *range(regimes)])
        views: dict[str, Any] = {}
        scopes = list(scopes)
        by_metric = {"rmse": self.errors}
        for metric, *_ in METRICS[1:]:
            factors = np.exp(self.rng.normal(0, 0.1, self.errors.shape))
            by_metric[metric] = self.errors * (1 if self.are_equal else factors)
        for (metric, *_), (w, r) in itertools.product(METRICS, scopes):
            for b in range(min(self.baselines, len(self.keys))):
                name = (metric, _key("w", w), _key("r", r), self.keys[b])
                views[name] = self.view(by_metric[metric], w, r, b)
        return views

    def view(self, picked: Any, w: Any, r: Any, b: int) -> dict[str, Any]:
        if w != "all":
            picked = picked[:, w : w + 1]
        if r != "all":
            picked = picked[:, :, r : r + 1]
        count, runs = picked.shape[1] * picked.shape[2], picked.shape[3]
        log = np.log(picked)
        log[sorted(self.lost)] = np.log(LIMIT)
        means = log.mean(axis=(1, 2, 3))  # NaN for a filter that lacks a condition
        sd = 0.3 / np.sqrt(runs)
        order = sorted(range(len(self.keys)), key=lambda i: (np.isnan(means[i]), means[i], i))
        rows = [self.row(i, k, means, b, sd, count, runs) for k, i in enumerate(order)]
        better = [row for row in rows if row["verdict"] == "better"]
        best = (
            f" (best: [[Filter {order[0]}]], {better[0]['ratio']:.2f} of its error)"
            if better
            else ""
        )
        return {
            "sentence": f"Of {len(rows) - 1} filters, {len(better)} are better than [[Filter {b}]]{best}. "
            "Best proposed method: [[Filter 0]].",
            "small_print": f"{len(self.keys)} filters; intervals 95 %, jointly; one seed.",
            "rows": rows,
        }

    def row(
        self, i: int, k: int, means: Any, b: int, sd: float, count: int, runs: int
    ) -> dict[str, Any]:
        gap, single = means[i] - means[b], count == 1
        is_lost, is_missing = i in self.lost, bool(np.isnan(means[i]))
        word, words = self.decide(i, b, gap, sd, runs)
        if is_lost:
            share = "100 % of runs" if single else f"{count}/{count}"
            word = "loses track" if single and i != b else word
            words = ", ".join(
                (*([words] if word != "loses track" else []), f"loses track in {share}")
            )
        spread = np.exp(np.array([0, -2, 2]) * sd)
        value = np.exp(means[i]) * spread if single else [np.nan] * 3
        ratio = np.exp(gap) * (spread if i != b else np.ones(3))
        if runs < 10 and i != b:
            ratio[1:] = 0.0, np.inf
        coverage = None if is_lost or is_missing else self.coverage[i]
        return {
            "filter": self.keys[i], "rank": None if is_missing else k + 1,
            "value": _short(value[0]), "low": _short(value[1]), "high": _short(value[2]),
            "unit": "m" if single else None,
            "ratio": _short(ratio[0]), "ratio_low": _short(ratio[1]), "ratio_high": _short(ratio[2]),
            "p": None if i == b or is_missing else 0.01, "verdict": word, "words": words,
            "track": _short(0.0 if is_lost else 1 - 0.03 * i), "lost": 20 if is_lost else 0,
            "lost_conditions": count if is_lost else 0,
            "coverage": coverage and _short(coverage), "nees": _short(1 / self.coverage[i]),
            "calibration": "too low" if coverage and coverage < 0.85 else None, "ms": _short(self.cost[i]),
        }  # fmt: skip

    def decide(self, i: int, b: int, gap: float, sd: float, runs: int) -> tuple[str, str]:
        if i == b:
            return "baseline", "baseline"
        if np.isnan(gap):
            return "missing", "not run in all conditions"
        if self.are_equal:
            return "identical", "identical, all runs agree"
        if runs < 10:
            return "not decided", f"not decided, {runs} runs, 10 are required"
        if abs(gap) < sd / 2:
            return "equal", "equal within 5 %"
        word = "not decided" if abs(gap) < 2 * sd else "better" if gap < 0 else "worse"
        return word, word

    def planned(self, worlds: int, regimes: int) -> list[dict[str, Any]]:
        pairs = [(i, i + 1) for i in range(0, len(self.keys) - 1, 3)]
        found = []
        for k, (a, b) in enumerate(pairs):
            gaps = np.log(self.errors[a] / self.errors[b]).mean(-1).mean(-1)
            if np.isnan(gaps).any():
                continue
            runs = self.errors.shape[-1]
            mean, sd = gaps.mean(), 0.3 / np.sqrt(runs)
            word, words = self.decide(a, b, mean, sd, runs)
            has_interval = runs >= 10 or self.are_equal
            found.append({
                "a": self.keys[a], "b": self.keys[b], "kind": ("paper", "tuned", "")[k % 3], "word": word,
                "words": words,
                "estimate": _short(np.exp(mean)), "low": _short(np.exp(mean - 2 * sd)) if has_interval else None,
                "high": _short(np.exp(mean + 2 * sd)) if has_interval else None,
                "p": 0.01, "reason": words.partition(", ")[2] or None,
                "new_world": None if worlds < 2 else {"estimate": _short(np.exp(mean)), "worlds": worlds,
                    "low": _short(np.exp(mean - 0.5)), "high": _short(np.exp(mean + 0.5)), "word": "not decided"},
                "cells": [{"world": f"w{w}", "regime": "all", "name": f"World {w}", "estimate": _short(np.exp(g)),
                           "low": _short(np.exp(g - sd)), "high": _short(np.exp(g + sd))}
                          for w, g in enumerate(gaps)],
            })  # fmt: skip
        return found

    def curves(self, cell: tuple[int, int], instants: int) -> dict[str, Any]:
        t = np.linspace(0, 500, instants)
        filters = {}
        for i, key in enumerate(self.keys):
            if np.isnan(self.errors[i][cell]).all():
                continue
            shape = (
                np.nanmedian(self.errors[i][cell])
                * (1 + 4 * np.exp(-t / 80))
                * (1 + 0.1 * np.sin(t / 37 + i))
            )
            filters[key] = {name: [_short(v * factor * np.exp(self.rng.normal(0, 0.06))) for v in shape]
                            for name, factor in (("median", 1.0), ("q10", 0.6), ("q90", 1.7))}  # fmt: skip
        return {"t": t.round(1).tolist(), "unit": "m", "group": "position", "filters": filters}

    def calibration(self, worlds: int, regimes: int) -> dict[str, Any]:
        scopes = itertools.product(["all", *range(worlds)], ["all", *range(regimes)])
        return {
            (_key("w", w), _key("r", r)): {
                key: {"c50": _short(0.55 * c), "c90": _short(c), "nees_ratio": _short(1 / c)}
                for i, (key, c) in enumerate(zip(self.keys, self.coverage, strict=True))
                if i not in self.lost
            }
            for w, r in scopes
        }

    def sweep(self) -> dict[str, Any]:
        return {
            "name": "particles", "unit": "", "world": "w0", "regime": "r0", "value_unit": "m",
            "caption": "RMS error against the number of particles.",
            "ticks": None,
            "lines": [{"filter": key, "name": f"Line {i}", "points": [
                {"x": x, "value": 5 / x**0.3 * (i + 1), "low": 4.5 / x**0.3 * (i + 1),
                 "high": 5.5 / x**0.3 * (i + 1)} for x in (50, 100, 200, 500, 1000)]}
                for i, key in enumerate(self.keys[:3])],
        }  # fmt: skip

    def tracks(self, cell: tuple[int, int], carried: int, plane: bool) -> dict[str, Any]:
        t = np.linspace(0, 500, 40)
        truth = np.stack([3000 * np.sin(t / 150), 40 * t], -1)
        keys = [k for i, k in enumerate(self.keys) if not np.isnan(self.errors[i][cell]).all()]
        offset = {
            k: {
                str(j): self.rng.normal(0, self.errors[self.keys.index(k)][cell][j], (40, 2)).round(
                    2
                )
                for j in range(carried)
            }
            for k in keys
        }
        error = {
            k: {j: [_short(v) for v in np.linalg.norm(e, axis=-1)] for j, e in r.items()}
            for k, r in offset.items()
        }
        built = {
            "t": t.round(1).tolist(), "unit": "m", "numbers": list(range(carried)),
            "note": f"The page carries {carried} runs of this cell.", "error": error,
            "traces": [{"name": "ESS", "unit": "", "log": False,
                        "filters": {k: {str(j): self.rng.uniform(5, 100, 40).round(1).tolist()
                                        for j in range(carried)} for k in keys[:2]}}],
        }  # fmt: skip
        if plane:
            built["truth"] = {"all": truth.round(1).tolist()}
            built["plane"] = {k: {j: e.tolist() for j, e in r.items()} for k, r in offset.items()}
        return built


def write(pack: dict[str, Any], folder: Path) -> Path:
    """Write the page of a pack to a folder; return the path of index.html."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in render_page(pack).items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "index.html"


def unpack(text: str) -> dict[str, Any]:
    """Return the data of a page: JSON in gzip and base 64."""
    return dict(json.loads(gzip.decompress(base64.b64decode(text))))


def _short(value: float) -> float | None:
    """Round to four digits; None if it is not a number."""
    return float(f"{value:.4g}") if np.isfinite(value) else None


def _key(letter: str, index: Any) -> str:
    return "all" if index == "all" else f"{letter}{index}"


def _cell(cell: tuple[int, int]) -> tuple[str, str]:
    return f"w{cell[0]}", f"r{cell[1]}"


def _look(i: int, names: dict[int, str]) -> dict[str, Any]:
    family = FAMILIES[i % 5]
    light, dark = COLOURS[family]
    return {
        "key": f"f{i}", "name": names.get(i, f"Filter {i}"), "long": f"Long name of filter {i}", "family": family,
        "proposed": i % 3 == 0, "colour": light, "dark": dark, "marker": MARKERS[i // 5 % len(MARKERS)],
        "cite": None,
    }  # fmt: skip
