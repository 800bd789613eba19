"""Public names of `pfbench.noise` and the modules that define them."""

from pfbench.noise.base import (
    AddedErrors as AddedErrors,
    ErrorDistribution as ErrorDistribution,
    GlintNoise as GlintNoise,
    LaplaceNoise as LaplaceNoise,
    NoiseRegime as NoiseRegime,
    NominalNoise as NominalNoise,
    OutlierNoise as OutlierNoise,
    StudentTNoise as StudentTNoise,
    make_normal as make_normal,
)
from pfbench.noise.correlated import (
    GaussMarkovNoise as GaussMarkovNoise,
    NonLineOfSightNoise as NonLineOfSightNoise,
)
from pfbench.noise.error_replay import ErrorReplay as ErrorReplay
from pfbench.noise.time_windows import (
    BiasStep as BiasStep,
    MeasurementOutage as MeasurementOutage,
    RandomOutage as RandomOutage,
    VarianceSurge as VarianceSurge,
)
