"""The raw estimate: its error for a model with a closed form, and the divergence thresholds that follow from it."""

from __future__ import annotations

import re

import pytest
import torch
from checkout import ROOT
from scipy import stats

from pfbench import job
from pfbench.job.raw_estimate import RawEstimate, compute_raw_estimate
from pfbench.results.paper_block import read_paper_block


def test_the_raw_error_of_a_measured_position_is_that_of_a_normal_variable() -> None:
    """The sd is 1. The largest twentieth of the squares is left out."""
    limit = stats.chi2.ppf(0.95, 1)
    square = (0.95 - 2.0 * limit**0.5 * stats.norm.pdf(limit**0.5)) / 0.95
    plan = job.build_plan(job.compose(["scenario=linear_walk", "runs=100", "pcrb=false"]))
    with torch.no_grad():
        episode = plan.draw_episode(plan.runs)
        truth = plan.model.assemble(episode.truth)
        raw = compute_raw_estimate(plan.model, truth, episode.record, (0,))
    se = 0.5 / 4000**0.5  # relative, of 40 windows in 100 runs; squares vary by 0.97 of their mean
    assert raw.steps == 1
    assert raw.rmse == pytest.approx(square**0.5, rel=4 * se)
    assert raw.threshold == 5.0 * raw.rmse
    assert RawEstimate(raw.rmse, 1, 6.0 * raw.rmse).threshold == pytest.approx(3.0 * raw.rmse)


def test_a_scenario_has_the_threshold_of_the_table_or_none() -> None:
    """None where it does not tell the better of two correct filters from the worse of two wrong ones."""
    text = (ROOT / "docs" / "scenarios.md").read_text()
    lines = re.findall(r"^\| (\w+ \| .*) \|$", text, re.MULTILINE)
    rows = [line.split(" | ") for line in lines if "raw estimate" not in line]
    assert len(rows) > 40
    for name, _, _, _, _, cell, _, _, *shares in rows:
        stored = read_paper_block("scenario", name).get("divergence_threshold")
        assert stored == (None if "none" in cell else float(cell)), name
        ekf, sir, *wrong = (float(share) if share != "–" else 100.0 for share in shares)
        assert ("none" in cell) == (min(ekf, sir) > 10.0 or max(wrong) < 50.0), name
