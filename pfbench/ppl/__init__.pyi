"""Public names of `pfbench.ppl` and the modules that define them."""

from pfbench.ppl.ibis_smc2 import smc2 as smc2
from pfbench.ppl.likelihood import (
    FilterLikelihood as FilterLikelihood,
    GaussianHmmLikelihood as GaussianHmmLikelihood,
    MarginalLikelihood as MarginalLikelihood,
    repeat_runs as repeat_runs,
)
from pfbench.ppl.nuts_svi import (
    normal_guide as normal_guide,
    nuts as nuts,
    svi as svi,
)
from pfbench.ppl.parameter_posterior import (
    WELL_MIXED as WELL_MIXED,
    ParameterPosterior as ParameterPosterior,
    SbcRanks as SbcRanks,
    plot_posterior as plot_posterior,
    sbc_histograms as sbc_histograms,
    simulation_based_calibration as simulation_based_calibration,
)
from pfbench.ppl.parameterised_model import ParameterisedModel as ParameterisedModel
from pfbench.ppl.particle_mcmc import (
    GibbsSample as GibbsSample,
    PmmhSettings as PmmhSettings,
    particle_gibbs as particle_gibbs,
    pmmh as pmmh,
)
from pfbench.ppl.pyro_program import (
    latent_program as latent_program,
    program as program,
    simulate as simulate,
)
from pfbench.ppl.step_program import (
    GuideProposal as GuideProposal,
    PyroModel as PyroModel,
)
