"""Parameter inference with models as probabilistic programs: the public names of this folder, imported on first use."""

from pfbench.core.lazy_import import lazy_attributes

__all__ = [
    "FilterLikelihood",
    "GaussianHmmLikelihood",
    "MarginalLikelihood",
    "ParameterPosterior",
    "ParameterisedModel",
    "SbcRanks",
    "SortedResampler",
    "SwitchingNoise",
    "normal_guide",
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
        "nuts_svi": (
            "svi",
            "normal_guide",
        ),
        "parameter_posterior": (
            "ParameterPosterior",
            "plot_posterior",
        ),
        "pmmh": (
            "SortedResampler",
            "pmmh",
            "repeat_runs",
        ),
        "program": (
            "MarginalLikelihood",
            "FilterLikelihood",
            "GaussianHmmLikelihood",
            "ParameterisedModel",
            "program",
            "simulate",
        ),
        "sbc": (
            "SbcRanks",
            "simulation_based_calibration",
            "sbc_histograms",
        ),
        "smc2": ("smc2",),
        "switching": ("SwitchingNoise",),
    },
)
