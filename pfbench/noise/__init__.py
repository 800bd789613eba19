"""Noise regimes: how measurement errors behave in a scenario: the public names of this folder, imported on first use."""

from pfbench.core.lazy_import import lazy_attributes

__all__ = [
    "BiasStep",
    "ErrorDistribution",
    "ErrorReplay",
    "GaussMarkovNoise",
    "GlintNoise",
    "LaplaceNoise",
    "MeasurementOutage",
    "NoiseRegime",
    "NominalNoise",
    "NonLineOfSightNoise",
    "OutlierNoise",
    "StudentTNoise",
    "VarianceSurge",
    "make_normal",
]

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "distributions": (
            "ErrorDistribution",
            "make_normal",
        ),
        "base": ("NoiseRegime",),
        "correlated": (
            "GaussMarkovNoise",
            "NonLineOfSightNoise",
        ),
        "error_replay": ("ErrorReplay",),
        "outage": ("MeasurementOutage",),
        "time_varying": (
            "VarianceSurge",
            "BiasStep",
        ),
        "white": (
            "NominalNoise",
            "StudentTNoise",
            "LaplaceNoise",
            "OutlierNoise",
            "GlintNoise",
        ),
    },
)
