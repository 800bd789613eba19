"""Public names of `pfbench.filter` and the modules that define them.

A file of conf/filter whose name ends in `_printed` keeps what a paper states, with its errors. What the
papers leave open is completed, see the table in docs/methods/README.md: the resampling scheme of
`sir_printed` and `rpf_printed`, the acceptance ratio of `mcmc_rpf_printed`, the cells of
`qmc_polymerised_printed`, the adaptive factor of `fm_mssrckf_printed`, the noise matrices of
`cofm_mssrckf_printed`, proposal and entropy of `cofm_amssrcpf_printed`, the numbers of
`dmc_reconstructed_printed`, and fitness and coefficients of `cpso_escape_printed`.
"""

from pfbench.filter.belief import (
    Filter as Filter,
    GaussianBelief as GaussianBelief,
    ParticleBelief as ParticleBelief,
    gather_ancestors as gather_ancestors,
    normalise_log_weights as normalise_log_weights,
)
from pfbench.filter.error_distributions.observation_updates import (
    MixtureObservationUpdate as MixtureObservationUpdate,
    StudentObservationUpdate as StudentObservationUpdate,
)
from pfbench.filter.exactness import is_every_part_exact as is_every_part_exact
from pfbench.filter.gaussian.covariance_matching import (
    MatrixNoiseAdaptation as MatrixNoiseAdaptation,
)
from pfbench.filter.gaussian.ensemble_kalman import (
    EnsembleKalmanFilter as EnsembleKalmanFilter,
    EnsembleTransformUpdate as EnsembleTransformUpdate,
    EnsembleUpdate as EnsembleUpdate,
    PerturbedObservationUpdate as PerturbedObservationUpdate,
)
from pfbench.filter.gaussian.gain_adaptation import (
    AdaptiveFactorGain as AdaptiveFactorGain,
    BoundedRatioGain as BoundedRatioGain,
)
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter as GaussianFilter
from pfbench.filter.gaussian.innovation import (
    GainAdaptation as GainAdaptation,
    NoiseAdaptation as NoiseAdaptation,
)
from pfbench.filter.gaussian.linearisation_rules import (
    CubaturePoints as CubaturePoints,
    LinearisationRule as LinearisationRule,
    SigmaPointLinearisation as SigmaPointLinearisation,
    TaylorLinearisation as TaylorLinearisation,
    UnscentedPoints as UnscentedPoints,
)
from pfbench.filter.gaussian.noise_adaptation import (
    ConstrainedNoiseAdaptation as ConstrainedNoiseAdaptation,
    FadingMemory as FadingMemory,
)
from pfbench.filter.gaussian.quadrature_points import (
    GaussHermitePoints as GaussHermitePoints,
    SparseGridPoints as SparseGridPoints,
)
from pfbench.filter.gaussian.spherical_radial import (
    AxisDegree3 as AxisDegree3,
    AxisDegree5 as AxisDegree5,
    RadialDegree3 as RadialDegree3,
    RadialDegree5 as RadialDegree5,
    RadialRule as RadialRule,
    SimplexDegree3 as SimplexDegree3,
    SimplexDegree5 as SimplexDegree5,
    SphericalRadialPoints as SphericalRadialPoints,
    SphericalRule as SphericalRule,
)
from pfbench.filter.guided.initial_guide import GuidedInitialProposal as GuidedInitialProposal
from pfbench.filter.guided.interval_guide import (
    GuidedIntervalProposal as GuidedIntervalProposal,
)
from pfbench.filter.guided.noise_guide import GuidedNoiseProposal as GuidedNoiseProposal
from pfbench.filter.guided.particle_guide import ParticleGuideProposal as ParticleGuideProposal
from pfbench.filter.guided.shared_guide import SharedGuideProposal as SharedGuideProposal
from pfbench.filter.learned.differentiable_resampling import (
    SoftResampler as SoftResampler,
    StopGradientResampler as StopGradientResampler,
)
from pfbench.filter.learned.features import Feature as Feature
from pfbench.filter.learned.gain import LearnedGain as LearnedGain
from pfbench.filter.learned.gain_filter import LearnedGainFilter as LearnedGainFilter
from pfbench.filter.learned.mcmc_kernel import LearnedRandomWalk as LearnedRandomWalk
from pfbench.filter.learned.networks import (
    DiagonalNormalHead as DiagonalNormalHead,
    LowRankNormalHead as LowRankNormalHead,
    NormalMixtureHead as NormalMixtureHead,
    SkipMlp as SkipMlp,
    SplineFlowHead as SplineFlowHead,
    ZukoFlowHead as ZukoFlowHead,
)
from pfbench.filter.learned.objectives import (
    EvidenceLowerBound as EvidenceLowerBound,
    ExpectedSquaredJump as ExpectedSquaredJump,
    InferenceCompilation as InferenceCompilation,
    Objective as Objective,
    StateErrorLoss as StateErrorLoss,
)
from pfbench.filter.learned.proposal import LearnedProposal as LearnedProposal
from pfbench.filter.loop import (
    FilterResult as FilterResult,
    MultiStepFilter as MultiStepFilter,
    run_filter as run_filter,
)
from pfbench.filter.manifold.chart_filter import InvariantFilter as InvariantFilter
from pfbench.filter.marginal.filter_bank import FilterBank as FilterBank
from pfbench.filter.marginal.gaussian_split import GaussianSplitFilter as GaussianSplitFilter
from pfbench.filter.marginal.rao_blackwellised import (
    RaoBlackwellisedFilter as RaoBlackwellisedFilter,
)
from pfbench.filter.moves.flow_kernels import (
    NoiseFlowGibbsKernel as NoiseFlowGibbsKernel,
    NoiseFlowKernel as NoiseFlowKernel,
    NoiseFlowStatKernel as NoiseFlowStatKernel,
    RandomWalk as RandomWalk,
)
from pfbench.filter.moves.metropolis import (
    KernelCycle as KernelCycle,
    McmcKernel as McmcKernel,
    MetropolisHastings as MetropolisHastings,
    Move as Move,
)
from pfbench.filter.moves.path_block_kernels import (
    LastStateKernel as LastStateKernel,
    PathBlockKernel as PathBlockKernel,
)
from pfbench.filter.moves.path_history import PathHistory as PathHistory
from pfbench.filter.moves.path_proposals import SmoothedSegment as SmoothedSegment
from pfbench.filter.moves.path_segments import SegmentProposal as SegmentProposal
from pfbench.filter.particle.auxiliary_weights import (
    AdditiveTempering as AdditiveTempering,
    AuxiliaryWeights as AuxiliaryWeights,
    LookAheadWeights as LookAheadWeights,
    PowerTempering as PowerTempering,
    TemperedPosterior as TemperedPosterior,
    TemperedWeights as TemperedWeights,
    Tempering as Tempering,
    UniformTempering as UniformTempering,
)
from pfbench.filter.particle.compiled_step import CallCounter as CallCounter
from pfbench.filter.particle.gaussian_particle_filter import (
    GaussianPredictionProposal as GaussianPredictionProposal,
    GaussianResampler as GaussianResampler,
)
from pfbench.filter.particle.particle_count import (
    CountLimits as CountLimits,
    EssStepCount as EssStepCount,
    EssTargetCount as EssTargetCount,
    ParticleCount as ParticleCount,
)
from pfbench.filter.particle.particle_filter import (
    ParticleFilter as ParticleFilter,
    Stage as Stage,
)
from pfbench.filter.particle.point_sets import (
    HaltonPoints as HaltonPoints,
    PointSet as PointSet,
    SobolPoints as SobolPoints,
)
from pfbench.filter.particle.proposals import (
    BootstrapProposal as BootstrapProposal,
    InitialProposal as InitialProposal,
    Proposal as Proposal,
    ProposalSample as ProposalSample,
)
from pfbench.filter.particle.regularised_resampling import (
    GaussianSmoothing as GaussianSmoothing,
    RegularisedResampler as RegularisedResampler,
    SmoothingKernel as SmoothingKernel,
)
from pfbench.filter.particle.resampling import (
    EssResampler as EssResampler,
    Resampler as Resampler,
    ResamplingScheme as ResamplingScheme,
)
from pfbench.filter.particle.resampling_schemes import Systematic as Systematic
from pfbench.filter.particle.sqmc import (
    HilbertSortedResampler as HilbertSortedResampler,
    SqmcProposal as SqmcProposal,
    SqmcScheme as SqmcScheme,
)
from pfbench.filter.particle.thompson_taylor import (
    ThompsonTaylorResampler as ThompsonTaylorResampler,
)
from pfbench.filter.particle.weight_update import (
    FlooredWeightUpdate as FlooredWeightUpdate,
    WeightUpdate as WeightUpdate,
)
from pfbench.filter.polymerised.partition import (
    AxisAlignedCells as AxisAlignedCells,
    CellPartition as CellPartition,
    WhitenedCells as WhitenedCells,
)
from pfbench.filter.polymerised.placement import (
    ParticlePlacement as ParticlePlacement,
    PooledCovariancePlacement as PooledCovariancePlacement,
    ScaledCentrePlacement as ScaledCentrePlacement,
)
from pfbench.filter.polymerised.resampler import (
    CellAllocation as CellAllocation,
    PolymerisedResampler as PolymerisedResampler,
    ProportionalAllocation as ProportionalAllocation,
    UnchangedAllocation as UnchangedAllocation,
)
from pfbench.filter.reconstructed.dmc_controller import (
    DmcController as DmcController,
    DmcResponse as DmcResponse,
    StaticResponse as StaticResponse,
)
from pfbench.filter.reconstructed.proposal import (
    ReconstructedNoiseProposal as ReconstructedNoiseProposal,
    ReconstructedProposal as ReconstructedProposal,
)
from pfbench.filter.reconstructed.weight_correction import (
    MarginalRatioCorrection as MarginalRatioCorrection,
    NoWeightCorrection as NoWeightCorrection,
    TransitionRatioCorrection as TransitionRatioCorrection,
    WeightCorrection as WeightCorrection,
)
from pfbench.filter.robust.hypotheses import NoiseHypotheses as NoiseHypotheses
from pfbench.filter.robust.innovation_gate import InnovationGate as InnovationGate
from pfbench.filter.robust.m_estimation import (
    CorrentropyUpdate as CorrentropyUpdate,
    HuberUpdate as HuberUpdate,
)
from pfbench.filter.robust.multiple_models import (
    GaussianSumFilter as GaussianSumFilter,
    InteractingModelFilter as InteractingModelFilter,
    MixtureKalmanFilter as MixtureKalmanFilter,
)
from pfbench.filter.robust.noise_learning import (
    SageHusaAdaptation as SageHusaAdaptation,
    VariationalNoiseAdaptation as VariationalNoiseAdaptation,
)
from pfbench.filter.robust.particle_weights import RobustWeightUpdate as RobustWeightUpdate
from pfbench.filter.robust.scaled_noise import ScaledNoise as ScaledNoise
from pfbench.filter.robust.student_update import StudentUpdate as StudentUpdate
from pfbench.filter.robust.variational_covariances import (
    VariationalCovarianceAdaptation as VariationalCovarianceAdaptation,
)
from pfbench.filter.robust.weighted_likelihood import (
    WeightedLikelihoodUpdate as WeightedLikelihoodUpdate,
)
from pfbench.filter.robust.windowed_noise import WindowedNoiseAdaptation as WindowedNoiseAdaptation
from pfbench.filter.smoothing.backward_samplers import (
    BackwardSampler as BackwardSampler,
    ExactBackwardSampler as ExactBackwardSampler,
    MetropolisBackwardSampler as MetropolisBackwardSampler,
    RejectionBackwardSampler as RejectionBackwardSampler,
)
from pfbench.filter.smoothing.backward_sampling import sample_trajectories as sample_trajectories
from pfbench.filter.smoothing.conditional_smc import ConditionalSmcKernel as ConditionalSmcKernel
from pfbench.filter.smoothing.gaussian_smoother import smooth as smooth
from pfbench.filter.smoothing.iterated_smoother import smooth_iteratively as smooth_iteratively
from pfbench.filter.smoothing.noise_space import NoiseSpace as NoiseSpace
from pfbench.filter.smoothing.path_kernels import (
    CrankNicolsonKernel as CrankNicolsonKernel,
    PathKernel as PathKernel,
    PathLaplace as PathLaplace,
    fit_path_laplace as fit_path_laplace,
    sample_smoothed_paths as sample_smoothed_paths,
)
from pfbench.filter.swarm.chaotic_sequences import (
    ChaoticPerturbation as ChaoticPerturbation,
    ChaoticPoints as ChaoticPoints,
    IntervalStart as IntervalStart,
    PriorStart as PriorStart,
    SwarmStart as SwarmStart,
)
from pfbench.filter.swarm.swarm_coordinates import (
    AllComponents as AllComponents,
    Fitness as Fitness,
    LikelihoodFitness as LikelihoodFitness,
    ObservedComponents as ObservedComponents,
    PosteriorFitness as PosteriorFitness,
    SwarmCoordinates as SwarmCoordinates,
)
from pfbench.filter.swarm.swarm_limits import (
    ChiSquareStopping as ChiSquareStopping,
    SwarmLimits as SwarmLimits,
)
from pfbench.filter.swarm.swarm_proposal import SwarmProposal as SwarmProposal
from pfbench.filter.swarm.swarm_weighting import (
    MixtureWeighting as MixtureWeighting,
    PrintedWeighting as PrintedWeighting,
    SwarmWeighting as SwarmWeighting,
)
from pfbench.filter.swarm.velocity_update import (
    GaussianVelocity as GaussianVelocity,
    InertiaVelocity as InertiaVelocity,
    VelocityUpdate as VelocityUpdate,
)
