"""The proposal of the initial state: unbiased evidence by any guide, and particles that survive sharp first measurements."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from config_cases import composed
from filter_cases import method_of
from refusals import check_refused

from pfbench import job
from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    CubaturePoints,
    FadingMemory,
    GaussianFilter,
    GuidedInitialProposal,
    MetropolisHastings,
    NoiseFlowKernel,
    ParticleFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    run_filter,
)
from pfbench.filter.particle.compiled_filter import CompiledParticleFilter
from pfbench.model.linear_gaussian import LinearGaussian
from pfbench.noise.base import NominalNoise
from pfbench.testing import check_evidence, run_kalman_filter

GUIDE = GaussianFilter(TaylorLinearisation())
CKF = GaussianFilter(SigmaPointLinearisation(CubaturePoints()))
# a wide start and measurements much sharper than it, with small noise: what decides is who survives the first steps
SHARP = LinearGaussian(
    [[1.0, 1.0], [0.0, 1.0]], [[0.0], [0.1]], [[1.0, 0.0]], [0.2], [0.0, 0.0], [5.0, 2.0]
)
Y = torch.tensor([[3.1], [4.0], [5.2], [6.1]], dtype=torch.float64)


@pytest.mark.parametrize("steps", [1, 3])
def test_the_evidence_is_unbiased(steps: int) -> None:
    check_evidence(
        ParticleFilter(40, initial_proposal=GuidedInitialProposal(GUIDE, steps)), SHARP, Y
    )


def test_a_guide_of_another_covariance_changes_the_noise_and_not_the_mean() -> None:
    guide = GuidedInitialProposal(GUIDE, 2, prior_fraction=0.5, covariance_factor=0.3)
    check_evidence(ParticleFilter(60, initial_proposal=guide), SHARP, Y)


def test_a_ratio_that_leaves_out_the_mixture_is_seen() -> None:
    class Careless(GuidedInitialProposal):
        is_exact = False

        def __call__(self, model: Any, record: Record, n: int, draws: Any) -> Any:
            x, log_ratio = super().__call__(model, record, n, draws)
            return x, torch.zeros_like(log_ratio)

    with pytest.raises(AssertionError, match="evidence is unbiased"):
        check_evidence(ParticleFilter(40, initial_proposal=Careless(GUIDE, 3)), SHARP, Y)


def test_log_evidences_scatter_less_than_from_the_prior() -> None:
    runs = 300
    record = Record(Y.expand(runs, -1, -1))
    exact = float(run_kalman_filter(SHARP, Y).log_evidence.sum())
    draws = PhiloxStream(2, torch.arange(runs))
    scatter = [
        (
            run_filter(ParticleFilter(50, initial_proposal=p), SHARP, record, draws).log_evidence
            - exact
        )
        .exp()
        .std()
        for p in (None, GuidedInitialProposal(GUIDE, 1), GuidedInitialProposal(GUIDE, 4))
    ]
    assert scatter[2] < 0.5 * scatter[1] < 0.5 * scatter[0], scatter


def test_compiled_and_separate_runs_start_at_the_same_particles() -> None:
    record = Record(Y.expand(3, -1, -1))
    method = ParticleFilter(30, initial_proposal=GuidedInitialProposal(GUIDE, 2))
    draws = PhiloxStream(2, torch.arange(3))
    whole = run_filter(method, SHARP, record, draws)
    compiled = CompiledParticleFilter(method).init_from_record(SHARP, record, draws)
    alone = run_filter(
        method, SHARP, record.select_runs(slice(2, 3)), PhiloxStream(2, torch.tensor([2]))
    )
    torch.testing.assert_close(compiled.x, method.init_from_record(SHARP, record, draws).x)
    torch.testing.assert_close(alone.mean, whole.mean[2:])


def test_what_has_no_initial_proposal_says_why() -> None:
    guide = GuidedInitialProposal(GUIDE)
    check_refused(
        [
            (
                "initial_proposal needs the record",
                lambda: ParticleFilter(10, initial_proposal=guide).init(
                    SHARP, 1, PhiloxStream(0, torch.arange(1))
                ),
            ),
            (
                "without moves",
                lambda: ParticleFilter(
                    10, moves=(MetropolisHastings(NoiseFlowKernel(3)),), initial_proposal=guide
                ),
            ),
        ],
        remedy=False,
    )
    for name, value in (("steps", 0), ("steps", 2.5), ("passes", -1), ("prior_fraction", 1.0)):
        with pytest.raises(ValueError, match=rf"initial_proposal\.{name} must .*got {value}\. Use"):
            GuidedInitialProposal(GUIDE, **{name: value})
    adapts = GaussianFilter(TaylorLinearisation(), noise_adaptations=[FadingMemory()])
    for other in (adapts, ParticleFilter(10)):
        with pytest.raises(ValueError, match="must be a Gaussian filter without adaptations"):
            GuidedInitialProposal(other)  # type: ignore[arg-type]


def test_the_configured_filter_is_sir_with_this_start() -> None:
    """More of its particles fit the first measurement of passive location, whose start is wide."""
    named, sir = method_of("guided_start"), method_of("sir")
    assert named == replace(sir, initial_proposal=GuidedInitialProposal(CKF))
    assert named.is_exact
    chosen = composed("scenario=passive_1")
    model, runs = job.instantiate(chosen["model"]), torch.arange(20)
    record = job.instantiate(chosen["scenario"]).draw(NominalNoise(), runs, 3).record
    draws, first = PhiloxStream(2, runs), record.select_steps(slice(0, 1))
    ess = [
        float(run_filter(replace(m, particles=300), model, first, draws).trace["ess"].mean())
        for m in (named, sir)
    ]
    assert ess[0] > 3.0 * ess[1], ess
