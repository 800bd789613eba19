"""The comparison with peers: the fused C loop and pfbench filter alike, and whoever computes something else is found out."""

from __future__ import annotations

import shutil
import sys
from types import SimpleNamespace as Work

import numpy as np
import pytest
import torch
from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import compare
import fused
import house
import problems
import scaling
from race import Result, race

SEEDS = range(24)
PEERS = compare.HERE.parent / ".venv-peers" / "bin" / "python"


def work(kind: str) -> Work:
    return Work(**problems.make(kind, 8, 200)._asdict())


@pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="no C compiler")
@pytest.mark.parametrize("kind", ["growth", "volatility", "radar"])
def test_the_c_loop_and_pfbench_estimate_the_same(kind: str) -> None:
    """Mean evidence and mean path over seeds, in standard errors; both are biased alike."""
    told = []
    for run in (fused.sir(work(kind)), house.sir(work(kind), torch.float32)):
        answers = [run(seed + 1) for seed in SEEDS]
        rows = [
            np.concatenate([np.ravel(log_z), np.ravel(np.asarray(mean))]) for log_z, mean in answers
        ]
        told.append(np.stack(rows))
    off = told[0].mean(0) - told[1].mean(0)
    error = np.sqrt(sum(rows.var(0, ddof=1) for rows in told) / len(SEEDS))
    assert np.abs(off / error).max() < 4.5  # of up to 33 numbers


def result(evidence: np.ndarray, error: float = 1.0) -> Result:
    qualities = {
        "evidence": evidence,
        "normalised": np.full_like(evidence, error),
        "position": evidence,
    }
    return Result(np.ones(9), np.ones(9), qualities, {}, 0.0)


def draws(seed: int, runs: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((9, runs))


@pytest.mark.parametrize("runs", [1, 100])
def test_a_contestant_that_computes_something_else_is_found_out(runs: int) -> None:
    names = [compare.FLOAT32, compare.JAX, compare.LIMIT]
    alike = {who: result(draws(seed, runs)) for seed, who in enumerate(names)}
    assert [text for text in compare.disagreements(alike, exact=False) if "evidence" in text] == []
    off = {**alike, compare.JAX: result(draws(1, runs) + (4.0 if runs == 1 else 1.0))}
    assert any(
        "JAX" in text and "log evidence" in text for text in compare.disagreements(off, exact=False)
    )


def test_who_has_no_evidence_is_compared_by_errors_alone() -> None:
    found = {
        who: result(draws(seed, 1)) for seed, who in enumerate((compare.FLOAT32, compare.LIMIT))
    }
    found[compare.PYRO] = result(np.full((9, 1), np.nan))
    assert not any(
        "evidence" in text and "Pyro" in text for text in compare.disagreements(found, exact=False)
    )


def test_filters_that_draw_nothing_agree_to_rounding() -> None:
    names = compare.GAUSSIAN[:2]
    same = {who: result(np.full((9, 5), 1.0 + 1e-4 * k)) for k, who in enumerate(names)}
    assert compare.disagreements(same, exact=True) == []
    other = {who: result(np.full((9, 5), 1.0 + 0.1 * k)) for k, who in enumerate(names)}
    assert len(compare.disagreements(other, exact=True)) == 2


def test_every_contestant_has_a_script_and_peers_are_known_as_such() -> None:
    for who in {who for case in compare.CASES for who in case.contestants}:
        assert (compare.HERE / who.words[0]).exists(), who.label
        assert compare.peer(who) == who.words[0].startswith("peer"), who.label


@pytest.mark.slow
@pytest.mark.skipif(not PEERS.exists(), reason="no .venv-peers, see the Makefile")
@pytest.mark.parametrize("name", ["W1, N = 1e3", "W3, N = 1e4", "W5"])
def test_peers_compute_the_same(name: str) -> None:
    case = next(case for case in compare.CASES if case.name == name)
    there = [who for who in case.contestants if who.place == "jax"]
    work = compare.work(case._replace(runs=4, particles=500), 0.1)
    results = race(work, there, {"jax": str(PEERS)}, rounds=2 if name == "W5" else 60)
    found = {who: result for who, result in zip(there, results, strict=True) if result is not None}
    assert list(found) == there
    assert compare.disagreements(found, exact=name == "W5") == []


def test_the_exponent_is_that_of_the_upper_half() -> None:
    flat, steep = [(n, 50.0) for n in (1, 2, 4)], [(n, 2.0 * n**1.5) for n in (8, 16, 32)]
    assert scaling.slope(flat + steep) == pytest.approx(1.5)
