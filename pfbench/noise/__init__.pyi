"""Public names of `pfbench.noise` and the modules that define them."""

from pfbench.noise.base import NoiseRegime as NoiseRegime
from pfbench.noise.correlated import (
    GaussMarkovNoise as GaussMarkovNoise,
    NonLineOfSightNoise as NonLineOfSightNoise,
)
from pfbench.noise.distributions import (
    ErrorDistribution as ErrorDistribution,
    make_normal as make_normal,
)
from pfbench.noise.error_replay import ErrorReplay as ErrorReplay
from pfbench.noise.outage import MeasurementOutage as MeasurementOutage
from pfbench.noise.time_varying import (
    BiasStep as BiasStep,
    VarianceSurge as VarianceSurge,
)
from pfbench.noise.white import (
    GlintNoise as GlintNoise,
    LaplaceNoise as LaplaceNoise,
    NominalNoise as NominalNoise,
    OutlierNoise as OutlierNoise,
    StudentTNoise as StudentTNoise,
)
