"""Settings that nothing can work with are refused where a filter is made: key, requirement, value and remedy."""

import math
from typing import Any

import pytest
import torch
from refusals import Refusal, check_refused

from pfbench import filter as f
from pfbench.core import PhiloxStream
from pfbench.filter.gaussian.noise_adaptation import ScalarNoiseAdaptation
from pfbench.filter.moves.path_proposals import PriorSegment
from pfbench.model import linear_walk

EKF = f.GaussianFilter(f.TaylorLinearisation())
ESS = f.EssResampler(f.Systematic())


def counted(count: Any) -> Any:
    """Start a filter whose number of particles changes among 50 slots."""
    draws = PhiloxStream(1, torch.arange(2))
    return f.ParticleFilter(50, particle_count=count).init(linear_walk(1.0, 0.5, 1.0), 2, draws)


REFUSED: dict[str, list[Refusal]] = {
    "particles": [
        ("particles must be a whole number of at least 2, got 1", lambda: f.ParticleFilter(1)),
        ("particles must be a whole number of at least 2, got 0", lambda: f.ParticleFilter(0)),
        ("particles must be a whole number of at least 2, got -5", lambda: f.ParticleFilter(-5)),
        ("minimum=200", lambda: f.CountLimits(200, 300, 100)),
        ("particle_count.increment must be at least 0, got -1", lambda: f.EssStepCount(-1)),
        (r"ess_threshold must be in \[0, 1\], got 1\.5", lambda: f.EssStepCount(ess_threshold=1.5)),
        ("particle_count.limits.maximum must be at most .*got 200", lambda: counted(f.EssStepCount())),
    ],
    "weights": [
        (r"tempering\.strength must be .*got -0\.1", lambda: f.PowerTempering(-0.1)),
        (r"tempering\.strength must be .*got -1\.0", lambda: f.AdditiveTempering(-1.0)),
        (r"tempering\.strength must be .*got 1\.1", lambda: f.UniformTempering(1.1)),
        (r"tempering\.strength must be .*got nan", lambda: f.UniformTempering(math.nan)),
        ("likelihood_power .*got 0", lambda: f.LookAheadWeights(0.0)),
        ("likelihood_power .*got 1.5", lambda: f.LookAheadWeights(1.5)),
        ("likelihood_power .*got nan", lambda: f.LookAheadWeights(math.nan)),
    ],
    "resampling": [
        ("skip must be at least 0, got -1", lambda: f.HaltonPoints(-1)),
        ("ess_threshold .*got -0.1", lambda: f.EssResampler(f.Systematic(), -0.1)),
        ("ess_threshold .*got 1.1", lambda: f.EssResampler(f.Systematic(), 1.1)),
        ("ess_threshold .*got nan", lambda: f.EssResampler(f.Systematic(), math.nan)),
        ("scale .*got 0", lambda: f.RegularisedResampler(ESS, 0.0)),
        ("scale .*got -1", lambda: f.RegularisedResampler(ESS, -1.0)),
        ("scale .*got nan", lambda: f.RegularisedResampler(ESS, math.nan)),
    ],
    "points": [
        (r"beta must be at least 0, got -1\.0\. Use 2", lambda: f.UnscentedPoints(beta=-1.0)),
        (r"alpha must be positive, got 0\.0", lambda: f.UnscentedPoints(0.0)),
        (r"kappa must be above -2, got -2\.0\. More than -d", lambda: f.UnscentedPoints(1.0, 2.0, -2.0)(2)),
        ("linearisation.largest_angle must be positive, got 0", lambda: f.SigmaPointLinearisation(f.CubaturePoints(), largest_angle=0.0)),
    ],
    "ensemble": [
        (r"filter\.particles must be .*, got 1", lambda: f.EnsembleKalmanFilter(1)),
        (r"filter\.inflation must be .*, got 0\.0", lambda: f.EnsembleKalmanFilter(10, inflation=0.0)),
        (r"filter\.inflation must be .*, got -1\.0", lambda: f.EnsembleKalmanFilter(10, inflation=-1.0)),
        (r"filter\.inflation must be .*, got nan", lambda: f.EnsembleKalmanFilter(10, inflation=math.nan)),
    ],
    "noise adaptation": [
        ("fading_factor must be at least 1, got 0.9", lambda: f.FadingMemory(0.9)),
        ("forgetting_factor must be in .0, 1., got 0", lambda: f.ConstrainedNoiseAdaptation(forgetting_factor=0.0)),
        ("decay must be in .0, 1., got 1.5", lambda: f.ConstrainedNoiseAdaptation(decay=1.5)),
        ("max_r_factor must be at least 1, got 0.5", lambda: f.ConstrainedNoiseAdaptation(max_r_factor=0.5)),
        ("max_q_factor must be at least 1, got 0.0", lambda: f.ConstrainedNoiseAdaptation(max_q_factor=0.0)),
        ("deadband must be at least 0, got -1", lambda: f.ConstrainedNoiseAdaptation(deadband=-1.0)),
        ("ScalarNoiseAdaptation.max_r_factor must be at least 1, got 0.1", lambda: ScalarNoiseAdaptation(max_r_factor=0.1)),
        ("ScalarNoiseAdaptation.forgetting_factor must be in .0, 1., got 2", lambda: ScalarNoiseAdaptation(forgetting_factor=2.0)),
        ("MatrixNoiseAdaptation.forgetting_factor must be in .0, 1., got 0", lambda: f.MatrixNoiseAdaptation(0.0)),
        ("threshold must be positive, got 0", lambda: f.AdaptiveFactorGain(0.0)),
        ("min_factor must be in .0, 1., got 0", lambda: f.AdaptiveFactorGain(1.5, 0.0)),
        ("min_ratio=2", lambda: f.BoundedRatioGain(1.0, 2.0)),
        ("iterations must be a whole number of at least 1, got 0", lambda: f.GaussianFilter(EKF.linearisation, iterations=0)),
        ("iterations must be a whole number of at least 1, got 1.5", lambda: f.GaussianFilter(EKF.linearisation, iterations=1.5)),
        ("iterations must be 1 with .*, got 2", lambda: f.GaussianFilter(EKF.linearisation, (f.FadingMemory(1.1),), iterations=2)),
    ],
    "noise learning": [
        (r"SageHusaAdaptation.forgetting_factor must be in \(0, 1\), got 1", lambda: f.SageHusaAdaptation(1.0)),
        (r"SageHusaAdaptation.max_gain must be in \(0, 1\], got 0", lambda: f.SageHusaAdaptation(max_gain=0.0)),
        (r"SageHusaAdaptation.min_factor must be in \(0, 1\], got 2", lambda: f.SageHusaAdaptation(min_factor=2.0)),
        ("VariationalNoiseAdaptation.prior_count must be .*got inf", lambda: f.VariationalNoiseAdaptation(prior_count=math.inf)),
        ("VariationalNoiseAdaptation.iterations must be .* at least 1, got 0", lambda: f.VariationalNoiseAdaptation(iterations=0)),
    ],
    "robust updates": [
        (r"InnovationGate.probability must be in \(0, 1\], got 1.5", lambda: f.InnovationGate(1.5)),
        ("InnovationGate.patience must be a whole number of at least 0, got -1", lambda: f.InnovationGate(patience=-1)),
        ("InnovationGate.patience must be .* got 2.5", lambda: f.InnovationGate(patience=2.5)),
        (r"groups must be a whole number for each component, got \[\[0, 5\]\]", lambda: f.InnovationGate(groups=[[0, 5]])),
        ("grouping must be all, sensor, component or satellite, got range", lambda: f.HuberUpdate(grouping="range")),
        ("HuberUpdate.threshold must be positive, got 0", lambda: f.HuberUpdate(0.0)),
        (r"HuberUpdate.efficiency must be in \(0, 1\), got 1", lambda: f.HuberUpdate(efficiency=1.0)),
        ("CorrentropyUpdate.iterations must be .* of at least 1, got 0", lambda: f.CorrentropyUpdate(iterations=0)),
        ("StudentUpdate.dof must be positive, got 0", lambda: f.StudentUpdate(0.0)),
        ("StudentUpdate.iterations must be .* at least 1, got 0", lambda: f.StudentUpdate(iterations=0)),
        ("distance must be mahalanobis or plain, got imq", lambda: f.WeightedLikelihoodUpdate("imq")),
        ("threshold must be a number in the unit", lambda: f.WeightedLikelihoodUpdate("plain")),
        ("grouping must be sensor or component with", lambda: f.WeightedLikelihoodUpdate("plain", 4.0)),
        ("WeightedLikelihoodUpdate.efficiency must be", lambda: f.WeightedLikelihoodUpdate(efficiency=0.0)),
        ("ScaledNoise.q_factor must be positive, got -1", lambda: f.ScaledNoise(q_factor=-1.0)),
        ("filter.noise_adaptations must contain at most one .*InnovationGate and HuberUpdate", lambda: f.GaussianFilter(EKF.linearisation, (f.InnovationGate(), f.HuberUpdate()))),
        ("weight_update.update must be a robust update, got ScaledNoise", lambda: f.RobustWeightUpdate(f.ScaledNoise())),
        ("weight_update.update.weight_prior must be false .*CorrentropyUpdate", lambda: f.RobustWeightUpdate(f.CorrentropyUpdate(weight_prior=True))),
        ("filter.moves must be empty with .*got 1 with RobustWeightUpdate", lambda: f.ParticleFilter(9, moves=(f.MetropolisHastings(f.LastStateKernel(f.RandomWalk())),), weight_update=f.RobustWeightUpdate(f.HuberUpdate()))),
    ],
    "hypotheses": [
        ("process_factors must be at least two positive", lambda: f.NoiseHypotheses(process_factors=(1.0,))),
        ("measurement_factors must be at least two positive", lambda: f.NoiseHypotheses(measurement_factors=(1.0, 0.0))),
        ("measurement_factors must be as many", lambda: f.NoiseHypotheses(measurement_factors=(1.0, 2.0, 3.0))),
        *(("transition must be 2 rows of 2 probabilities", lambda rows=rows: f.NoiseHypotheses(transition=rows))
          for rows in ([[0.9, 0.2], [0.5, 0.5]], [[1.1, -0.1], [0.5, 0.5]], [[1.0, 0.0]], [0.9, 0.1], 0.5)),
        ("one stationary distribution", lambda: f.NoiseHypotheses(transition=[[1.0, 0.0], [0.0, 1.0]])),
        ("branches must be a whole number", lambda: f.GaussianSumFilter(branches=0)),
        (r"filter\.branches must be a whole number of at least 1", lambda: f.FilterBank(branches=0)),
        (r"filter\.overlap must be in \(0, 1\), got 0\.0.* Use 0\.6", lambda: f.FilterBank(overlap=0.0)),
        (r"filter\.overlap must be in \(0, 1\), got 1\.0.* Use 0\.6", lambda: f.FilterBank(overlap=1.0)),
        (r"filter\.overlap must be in \(0, 1\), got nan.* Use 0\.6", lambda: f.FilterBank(overlap=math.nan)),
    ],
    "charts": [
        (r"filter\.chart must be left or right, got up", lambda: f.InvariantFilter(EKF, "up")),
        ("filter.filter must be GaussianFilter or ParticleFilter", lambda: f.InvariantFilter(f.InvariantFilter(EKF, "left"))),
        (r"got ukf\. Select it by name as filter@filter\.filter=ukf", lambda: f.InvariantFilter("ukf")),
    ],
    "guides": [
        ("proposal.weight_model must be ", lambda: f.SharedGuideProposal(EKF, weight_model="both")),
        ("proposal.guide_state must be ", lambda: f.SharedGuideProposal(EKF, guide_state="none")),
        ("proposal.covariance_factor must be ", lambda: f.SharedGuideProposal(EKF, covariance_factor=0.0)),
    ],
    "moves": [
        ("mcmc_steps must be at least 0, got -1", lambda: f.MetropolisHastings(f.LastStateKernel(), -1)),
        ("scale must be positive, got 0.0", lambda: f.RandomWalk(0.0)),
        ("scale must be positive, got nan", lambda: f.RandomWalk(math.nan)),
        ("lag must be at least 1, got 0", lambda: f.NoiseFlowKernel(0)),
        (r"noise_refresh must be in \[0, 1\), got 1.0", lambda: f.NoiseFlowKernel(3, noise_refresh=1.0)),
        ("block_length must be at least 0, got -1", lambda: f.PathBlockKernel(-1, PriorSegment())),
    ],
    "polymerised": [
        (r"ess_threshold must be in \[0, 1\], got 1\.2", lambda: f.PolymerisedResampler(ess_threshold=1.2)),
        (r"axes must be .*, got \[0, 0\]", lambda: f.PolymerisedResampler(axes=[0, 0])),
        (r"axes must be .*, got \[\]", lambda: f.PolymerisedResampler(axes=[])),
        ("cell_size=0.0", lambda: f.WhitenedCells(0.0)),
        ("cell_size=7.0", lambda: f.WhitenedCells(7.0)),
        ("cells_per_axis must be at least 1, got 0", lambda: f.AxisAlignedCells(0)),
        (r"min_scale must be in \[-1, 1\), got 1.0", lambda: f.ScaledCentrePlacement(1.0)),
        (r"min_scale must be in \[-1, 1\), got -1.5", lambda: f.ScaledCentrePlacement(-1.5)),
        ("neighbours must be at least 2, got 1", lambda: f.ThompsonTaylorResampler(ESS, 1)),
    ],
    "learned": [
        (r"defensive_fraction must be in \[0, 1\), got 1\.0", lambda: f.LearnedProposal(f.DiagonalNormalHead, defensive_fraction=1.0)),
        (r"proposal\.defensive_fraction must be in \[0, 1\), got -0\.1", lambda: f.LearnedProposal(f.DiagonalNormalHead, defensive_fraction=-0.1)),
        ("memory must be at least 0, got -1", lambda: f.LearnedProposal(f.DiagonalNormalHead, memory=-1)),
    ],
}  # fmt: skip


@pytest.mark.parametrize("part", REFUSED)
def test_settings_of_no_use_are_refused_with_a_remedy(part: str) -> None:
    check_refused(REFUSED[part])
