"""Public names of `pfbench.filter` and the modules that define them.

A file of conf/filter whose name ends in `_literal` repairs nothing of a paper, and refuses to run where equations
are lost in print (`UnprintedFilter`). One that ends in `_printed` is that form with the list `paper.completions`:
each value that the paper does not state, and each printed symbol that is read otherwise, with a reason.
"""

from pfbench.filter.belief import (
    Filter as Filter,
    GaussianBelief as GaussianBelief,
    ParticleBelief as ParticleBelief,
    gather_ancestors as gather_ancestors,
    normalise_log_weights as normalise_log_weights,
)
from pfbench.filter.exactness import is_every_part_exact as is_every_part_exact
from pfbench.filter.gaussian.ensemble_kalman import (
    EnsembleKalmanFilter as EnsembleKalmanFilter,
    EnsembleTransformUpdate as EnsembleTransformUpdate,
    EnsembleUpdate as EnsembleUpdate,
    PerturbedObservationUpdate as PerturbedObservationUpdate,
)
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter as GaussianFilter
from pfbench.filter.gaussian.innovation import (
    GainAdaptation as GainAdaptation,
    NoiseAdaptation as NoiseAdaptation,
)
from pfbench.filter.gaussian.invariant import InvariantFilter as InvariantFilter
from pfbench.filter.gaussian.linearisation_rules import (
    AxisDegree3 as AxisDegree3,
    AxisDegree5 as AxisDegree5,
    CubaturePoints as CubaturePoints,
    LinearisationRule as LinearisationRule,
    RadialDegree3 as RadialDegree3,
    RadialDegree5 as RadialDegree5,
    RadialRule as RadialRule,
    SigmaPointLinearisation as SigmaPointLinearisation,
    SimplexDegree3 as SimplexDegree3,
    SimplexDegree5 as SimplexDegree5,
    SphericalRadialPoints as SphericalRadialPoints,
    SphericalRule as SphericalRule,
    TaylorLinearisation as TaylorLinearisation,
    UnscentedPoints as UnscentedPoints,
)
from pfbench.filter.gaussian.noise_adaptation import (
    AdaptiveFactorGain as AdaptiveFactorGain,
    BoundedRatioGain as BoundedRatioGain,
    ConstrainedNoiseAdaptation as ConstrainedNoiseAdaptation,
    FadingMemory as FadingMemory,
    MatrixNoiseAdaptation as MatrixNoiseAdaptation,
)
from pfbench.filter.gaussian.raw_fix import RawFix as RawFix
from pfbench.filter.guided.guides import (
    ParticleGuideProposal as ParticleGuideProposal,
    SharedGuideProposal as SharedGuideProposal,
)
from pfbench.filter.guided.initial_guide import GuidedInitialProposal as GuidedInitialProposal
from pfbench.filter.guided.noise_guide import GuidedNoiseProposal as GuidedNoiseProposal
from pfbench.filter.guided.twisted import (
    TwistedParticleFilter as TwistedParticleFilter,
    TwistedProposal as TwistedProposal,
    TwistedWeights as TwistedWeights,
)
from pfbench.filter.learned.differentiable_resampling import (
    SoftResampler as SoftResampler,
    StopGradientResampler as StopGradientResampler,
)
from pfbench.filter.learned.gain_filter import (
    LearnedGain as LearnedGain,
    LearnedGainFilter as LearnedGainFilter,
)
from pfbench.filter.learned.networks import (
    DiagonalNormalHead as DiagonalNormalHead,
    NormalMixtureHead as NormalMixtureHead,
    SkipMlp as SkipMlp,
)
from pfbench.filter.learned.objectives import (
    EvidenceLowerBound as EvidenceLowerBound,
    InferenceCompilation as InferenceCompilation,
    Objective as Objective,
    StateErrorLoss as StateErrorLoss,
)
from pfbench.filter.learned.proposal import Feature as Feature, LearnedProposal as LearnedProposal
from pfbench.filter.loop import (
    FilterResult as FilterResult,
    MultiStepFilter as MultiStepFilter,
    run_filter as run_filter,
)
from pfbench.filter.marginal.filter_bank import (
    FilterBank as FilterBank,
    GaussianSplitFilter as GaussianSplitFilter,
)
from pfbench.filter.marginal.rao_blackwellised import (
    RaoBlackwellisedFilter as RaoBlackwellisedFilter,
)
from pfbench.filter.moves.metropolis import (
    McmcKernel as McmcKernel,
    MetropolisHastings as MetropolisHastings,
    Move as Move,
    PathHistory as PathHistory,
)
from pfbench.filter.moves.path_kernels import (
    LastStateKernel as LastStateKernel,
    LikelihoodRatioKernel as LikelihoodRatioKernel,
    NoiseFlowKernel as NoiseFlowKernel,
    NoiseFlowStatKernel as NoiseFlowStatKernel,
    PathBlockKernel as PathBlockKernel,
    RandomWalk as RandomWalk,
)
from pfbench.filter.moves.path_proposals import (
    SegmentProposal as SegmentProposal,
    SmoothedSegment as SmoothedSegment,
)
from pfbench.filter.particle.gaussian_particle_filter import (
    GaussianPredictionProposal as GaussianPredictionProposal,
    GaussianResampler as GaussianResampler,
)
from pfbench.filter.particle.particle_count import (
    CountLimits as CountLimits,
    EssStepCount as EssStepCount,
)
from pfbench.filter.particle.particle_filter import ParticleFilter as ParticleFilter
from pfbench.filter.particle.regularised_resampling import (
    EpanechnikovSmoothing as EpanechnikovSmoothing,
    GaussianSmoothing as GaussianSmoothing,
    RegularisedResampler as RegularisedResampler,
    SmoothingKernel as SmoothingKernel,
    ThompsonTaylorResampler as ThompsonTaylorResampler,
)
from pfbench.filter.particle.resampling import (
    Multinomial as Multinomial,
    Residual as Residual,
    Stratified as Stratified,
)
from pfbench.filter.particle.sqmc import (
    HaltonPoints as HaltonPoints,
    HilbertSortedResampler as HilbertSortedResampler,
    SobolPoints as SobolPoints,
    SqmcProposal as SqmcProposal,
    SqmcScheme as SqmcScheme,
)
from pfbench.filter.particle.stages import (
    AuxiliaryWeights as AuxiliaryWeights,
    BayesWeightUpdate as BayesWeightUpdate,
    BootstrapProposal as BootstrapProposal,
    EssResampler as EssResampler,
    FixedCount as FixedCount,
    IidPoints as IidPoints,
    InitialProposal as InitialProposal,
    ParticleCount as ParticleCount,
    PointSet as PointSet,
    PosteriorWeights as PosteriorWeights,
    Proposal as Proposal,
    ProposalSample as ProposalSample,
    Resampler as Resampler,
    ResamplingScheme as ResamplingScheme,
    Systematic as Systematic,
    WeightUpdate as WeightUpdate,
)
from pfbench.filter.particle.taken_steps import CallCounter as CallCounter
from pfbench.filter.particle.weights import (
    AdditiveTempering as AdditiveTempering,
    LookAheadWeights as LookAheadWeights,
    PowerLikelihoodUpdate as PowerLikelihoodUpdate,
    PowerTempering as PowerTempering,
    TemperedPosterior as TemperedPosterior,
    TemperedWeights as TemperedWeights,
    Tempering as Tempering,
    UniformTempering as UniformTempering,
)
from pfbench.filter.proposed.dmc_controller import (
    DmcController as DmcController,
    DmcResponse as DmcResponse,
    OneStepResponse as OneStepResponse,
    StaticResponse as StaticResponse,
)
from pfbench.filter.proposed.polymerised import (
    AxisAlignedCells as AxisAlignedCells,
    CellAllocation as CellAllocation,
    CellPartition as CellPartition,
    ParticlePlacement as ParticlePlacement,
    PolymerisedResampler as PolymerisedResampler,
    PooledCovariancePlacement as PooledCovariancePlacement,
    ProportionalAllocation as ProportionalAllocation,
    ScaledCentrePlacement as ScaledCentrePlacement,
    UnchangedAllocation as UnchangedAllocation,
    WhitenedCells as WhitenedCells,
)
from pfbench.filter.proposed.reconstructed import (
    MarginalRatioCorrection as MarginalRatioCorrection,
    NoWeightCorrection as NoWeightCorrection,
    ReconstructedNoiseProposal as ReconstructedNoiseProposal,
    ReconstructedProposal as ReconstructedProposal,
    TransitionRatioCorrection as TransitionRatioCorrection,
    WeightCorrection as WeightCorrection,
)
from pfbench.filter.proposed.swarm import (
    ChiSquareStopping as ChiSquareStopping,
    SwarmLimits as SwarmLimits,
    SwarmProposal as SwarmProposal,
)
from pfbench.filter.proposed.swarm_coordinates import (
    AllComponents as AllComponents,
    Fitness as Fitness,
    LikelihoodFitness as LikelihoodFitness,
    ObservedComponents as ObservedComponents,
    PosteriorFitness as PosteriorFitness,
    PrintedFitness as PrintedFitness,
    SwarmCoordinates as SwarmCoordinates,
)
from pfbench.filter.proposed.swarm_motion import (
    ChaoticPerturbation as ChaoticPerturbation,
    ChaoticPoints as ChaoticPoints,
    GaussianVelocity as GaussianVelocity,
    InertiaVelocity as InertiaVelocity,
    IntervalStart as IntervalStart,
    PriorStart as PriorStart,
    SwarmStart as SwarmStart,
    VelocityUpdate as VelocityUpdate,
)
from pfbench.filter.proposed.swarm_weighting import (
    MixtureWeighting as MixtureWeighting,
    PrintedWeighting as PrintedWeighting,
    SwarmWeighting as SwarmWeighting,
)
from pfbench.filter.proposed.unprinted import UnprintedFilter as UnprintedFilter
from pfbench.filter.robust.hypotheses import NoiseHypotheses as NoiseHypotheses
from pfbench.filter.robust.multiple_models import (
    GaussianSumFilter as GaussianSumFilter,
    InteractingModelFilter as InteractingModelFilter,
    MixtureKalmanFilter as MixtureKalmanFilter,
)
from pfbench.filter.robust.noise_learning import (
    SageHusaAdaptation as SageHusaAdaptation,
    VariationalNoiseAdaptation as VariationalNoiseAdaptation,
)
from pfbench.filter.robust.observation_updates import (
    MixtureObservationUpdate as MixtureObservationUpdate,
    StudentObservationUpdate as StudentObservationUpdate,
)
from pfbench.filter.robust.particle_weights import RobustWeightUpdate as RobustWeightUpdate
from pfbench.filter.robust.updates import (
    CorrentropyUpdate as CorrentropyUpdate,
    HuberUpdate as HuberUpdate,
    InnovationGate as InnovationGate,
    ScaledNoise as ScaledNoise,
    StudentUpdate as StudentUpdate,
    WeightedLikelihoodUpdate as WeightedLikelihoodUpdate,
)
from pfbench.filter.smoothing.backward_sampling import (
    BackwardSampler as BackwardSampler,
    ExactBackwardSampler as ExactBackwardSampler,
    MetropolisBackwardSampler as MetropolisBackwardSampler,
    RejectionBackwardSampler as RejectionBackwardSampler,
    sample_trajectories as sample_trajectories,
    smooth_particles as smooth_particles,
)
from pfbench.filter.smoothing.gaussian_smoother import (
    smooth as smooth,
    smooth_iteratively as smooth_iteratively,
)
from pfbench.filter.smoothing.noise_space import (
    ConditionalSmcKernel as ConditionalSmcKernel,
    CrankNicolsonKernel as CrankNicolsonKernel,
    NoiseSpace as NoiseSpace,
    PathKernel as PathKernel,
    PathLaplace as PathLaplace,
    fit_path_laplace as fit_path_laplace,
    sample_smoothed_paths as sample_smoothed_paths,
)
