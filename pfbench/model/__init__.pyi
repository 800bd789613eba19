"""Public names of `pfbench.model` and the modules that define them."""

from pfbench.core.density import (
    independent_normal as independent_normal,
    normal_batch as normal_batch,
)
from pfbench.logs.sky.raw_gnss import (
    RawGnss as RawGnss,
    RawGnssInputs as RawGnssInputs,
    RawGnssTuning as RawGnssTuning,
)
from pfbench.model.azimuth import (
    Discretisation as Discretisation,
    ErrorEquations as ErrorEquations,
    EulerDiscretisation as EulerDiscretisation,
    ExactErrorEquations as ExactErrorEquations,
    PrintedErrorEquations as PrintedErrorEquations,
    SinsGpsAzimuth as SinsGpsAzimuth,
    TrapezoidDiscretisation as TrapezoidDiscretisation,
)
from pfbench.model.base import (
    ModelWrapper as ModelWrapper,
    StateSpaceModel as StateSpaceModel,
    StaticModel as StaticModel,
)
from pfbench.model.chaotic import (
    ChaoticSystem as ChaoticSystem,
    DoublePendulum as DoublePendulum,
    Lorenz63 as Lorenz63,
    Lorenz96 as Lorenz96,
)
from pfbench.model.constraints import Constraints as Constraints
from pfbench.model.earth_form import (
    EarthForm as EarthForm,
    FlatEarth as FlatEarth,
    RotatingEarth as RotatingEarth,
)
from pfbench.model.ins_gnss import InsGnss as InsGnss
from pfbench.model.linear_gaussian import (
    LinearGaussian as LinearGaussian,
    linear_walk as linear_walk,
    local_level as local_level,
)
from pfbench.model.passive_location import (
    PassiveLocation as PassiveLocation,
    PlatformInputs as PlatformInputs,
    compute_level_attitude as compute_level_attitude,
)
from pfbench.model.sins_sar import SinsSar as SinsSar
from pfbench.model.strapdown import (
    StrapdownAided as StrapdownAided,
    StrapdownTight as StrapdownTight,
    StrapdownTotal as StrapdownTotal,
)
from pfbench.model.strapdown_blocks import StrapdownBlocks as StrapdownBlocks
from pfbench.model.strapdown_tuning import (
    AidedTuning as AidedTuning,
    RangeErrorModel as RangeErrorModel,
    StrapdownTuning as StrapdownTuning,
    TightTuning as TightTuning,
)
from pfbench.model.terrain import (
    RandomTerrain as RandomTerrain,
    TerrainAided as TerrainAided,
    TerrainInputs as TerrainInputs,
    TerrainWaves as TerrainWaves,
    compute_elevation as compute_elevation,
    compute_slope as compute_slope,
)
from pfbench.model.textbook import (
    Benes as Benes,
    Pendulum as Pendulum,
    StochasticVolatility as StochasticVolatility,
    UnivariateGrowth as UnivariateGrowth,
)
from pfbench.model.tight_coupling import (
    SinsGnssTight as SinsGnssTight,
    SinsGnssTightNl as SinsGnssTightNl,
)
from pfbench.model.urban_gnss import (
    LosNlosRangeError as LosNlosRangeError,
    NormalExponentialMixture as NormalExponentialMixture,
    NormalRangeError as NormalRangeError,
    PseudorangeError as PseudorangeError,
    UrbanGnss as UrbanGnss,
    UrbanInputs as UrbanInputs,
    UrbanTuning as UrbanTuning,
    range_change as range_change,
)
