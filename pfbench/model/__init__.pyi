"""Public names of `pfbench.model` and the modules that define them."""

from pfbench.core.normal import (
    independent_normal as independent_normal,
    normal_batch as normal_batch,
)
from pfbench.model.azimuth_errors import (
    ErrorEquations as ErrorEquations,
    ExactErrorEquations as ExactErrorEquations,
    PrintedErrorEquations as PrintedErrorEquations,
)
from pfbench.model.base import (
    ModelWrapper as ModelWrapper,
    StateSpaceModel as StateSpaceModel,
    StaticModel as StaticModel,
)
from pfbench.model.ins_gnss import InsGnss as InsGnss
from pfbench.model.linear_gaussian import (
    LinearGaussian as LinearGaussian,
    linear_walk as linear_walk,
    local_level as local_level,
)
from pfbench.model.nonlinear_dynamics import (
    Lorenz63 as Lorenz63,
    Pendulum as Pendulum,
)
from pfbench.model.passive_location import (
    PassiveLocation as PassiveLocation,
    PlatformInputs as PlatformInputs,
    compute_level_attitude as compute_level_attitude,
)
from pfbench.model.pseudorange_errors import (
    LosNlosRangeError as LosNlosRangeError,
    NormalExponentialMixture as NormalExponentialMixture,
    NormalRangeError as NormalRangeError,
    PseudorangeError as PseudorangeError,
    UrbanInputs as UrbanInputs,
)
from pfbench.model.sins_gnss_tight import SinsGnssTight as SinsGnssTight
from pfbench.model.sins_gnss_tight_nl import SinsGnssTightNl as SinsGnssTightNl
from pfbench.model.sins_gps_azimuth import (
    Discretisation as Discretisation,
    SinsGpsAzimuth as SinsGpsAzimuth,
    TrapezoidDiscretisation as TrapezoidDiscretisation,
)
from pfbench.model.sins_sar import SinsSar as SinsSar
from pfbench.model.strapdown.aided import StrapdownAided as StrapdownAided
from pfbench.model.strapdown.tight import StrapdownTight as StrapdownTight
from pfbench.model.strapdown.total import StrapdownTotal as StrapdownTotal
from pfbench.model.strapdown.tuning import (
    AidedTuning as AidedTuning,
    RangeErrorModel as RangeErrorModel,
    StrapdownTuning as StrapdownTuning,
    TightTuning as TightTuning,
)
from pfbench.model.terrain.random_terrain import (
    RandomTerrain as RandomTerrain,
    TerrainWaves as TerrainWaves,
    compute_elevation as compute_elevation,
    compute_slope as compute_slope,
)
from pfbench.model.terrain.terrain_aided import (
    TerrainAided as TerrainAided,
    TerrainInputs as TerrainInputs,
)
from pfbench.model.textbook import (
    Benes as Benes,
    StochasticVolatility as StochasticVolatility,
    UnivariateGrowth as UnivariateGrowth,
)
from pfbench.model.urban_gnss import (
    UrbanGnss as UrbanGnss,
    UrbanTuning as UrbanTuning,
    range_change as range_change,
)
