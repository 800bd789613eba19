"""Public names of `pfbench.ppl` and the modules that define them."""

from pfbench.ppl.correlated_numbers import SortedResampler as SortedResampler
from pfbench.ppl.ibis_smc2 import smc2 as smc2
from pfbench.ppl.marginal_likelihood import (
    FilterLikelihood as FilterLikelihood,
    GaussianHmmLikelihood as GaussianHmmLikelihood,
    MarginalLikelihood as MarginalLikelihood,
)
from pfbench.ppl.nuts_svi import (
    normal_guide as normal_guide,
    nuts as nuts,
    svi as svi,
)
from pfbench.ppl.parameter_posterior import (
    WELL_MIXED as WELL_MIXED,
    ParameterPosterior as ParameterPosterior,
    plot_posterior as plot_posterior,
)
from pfbench.ppl.parameterised_model import ParameterisedModel as ParameterisedModel
from pfbench.ppl.particle_mcmc import (
    PmmhSettings as PmmhSettings,
    pmmh as pmmh,
)
from pfbench.ppl.posterior_estimate import repeat_runs as repeat_runs
from pfbench.ppl.prior_predictive import simulate as simulate
from pfbench.ppl.pyro_program import (
    latent_program as latent_program,
    program as program,
)
from pfbench.ppl.sbc import (
    SbcRanks as SbcRanks,
    sbc_histograms as sbc_histograms,
    simulation_based_calibration as simulation_based_calibration,
)
from pfbench.ppl.switching import SwitchingNoise as SwitchingNoise
