"""Parameter inference with probabilistic programs: names imported on first use."""

from pfbench.core.lazy_import import lazy_attributes

__all__ = [
    "WELL_MIXED",
    "FilterLikelihood",
    "GaussianHmmLikelihood",
    "MarginalLikelihood",
    "ParameterPosterior",
    "ParameterisedModel",
    "PmmhSettings",
    "SbcRanks",
    "SortedResampler",
    "SwitchingNoise",
    "latent_program",
    "normal_guide",
    "nuts",
    "plot_posterior",
    "pmmh",
    "program",
    "repeat_runs",
    "sbc_histograms",
    "simulate",
    "simulation_based_calibration",
    "smc2",
    "svi",
]

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "correlated_numbers": ("SortedResampler",),
        "ibis_smc2": ("smc2",),
        "marginal_likelihood": (
            "FilterLikelihood",
            "GaussianHmmLikelihood",
            "MarginalLikelihood",
        ),
        "nuts_svi": (
            "normal_guide",
            "nuts",
            "svi",
        ),
        "parameter_posterior": (
            "WELL_MIXED",
            "ParameterPosterior",
            "plot_posterior",
        ),
        "parameterised_model": ("ParameterisedModel",),
        "particle_mcmc": (
            "PmmhSettings",
            "pmmh",
        ),
        "posterior_estimate": ("repeat_runs",),
        "prior_predictive": ("simulate",),
        "pyro_program": (
            "latent_program",
            "program",
        ),
        "sbc": (
            "SbcRanks",
            "sbc_histograms",
            "simulation_based_calibration",
        ),
        "switching": ("SwitchingNoise",),
    },
)
