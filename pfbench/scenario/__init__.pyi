"""Public names of `pfbench.scenario` and the modules that define them."""

from pfbench.scenario.base import Scenario as Scenario
from pfbench.scenario.emitter_prior import EmitterPrior as EmitterPrior
from pfbench.scenario.model_simulation import ModelSimulation as ModelSimulation
from pfbench.scenario.passive_location import PassiveLocationScenario as PassiveLocationScenario
from pfbench.scenario.quadrature_prior import QuadratureEmitterPrior as QuadratureEmitterPrior
from pfbench.scenario.recorded.aided_flight import (
    BaroMagSensors as BaroMagSensors,
    RecordedAidedFlight as RecordedAidedFlight,
)
from pfbench.scenario.recorded.assembly import FixReceiver as FixReceiver
from pfbench.scenario.recorded.drive import (
    RecordedDrive as RecordedDrive,
    RecordedFlights as RecordedFlights,
)
from pfbench.scenario.recorded.fix_holdout import FixHoldout as FixHoldout
from pfbench.scenario.recorded.log_reader import read_log as read_log
from pfbench.scenario.recorded.log_tables import find_dataset as find_dataset
from pfbench.scenario.recorded.navigation_log import LogFiles as LogFiles
from pfbench.scenario.recorded.raw_gnss_walk import (
    RawGnssReceiver as RawGnssReceiver,
    RecordedWalk as RecordedWalk,
)
from pfbench.scenario.recorded.trajectory_file import RecordedTrajectory as RecordedTrajectory
from pfbench.scenario.recorded.urban_drive import (
    PseudorangeReceiver as PseudorangeReceiver,
    UrbanDrive as UrbanDrive,
)
from pfbench.scenario.recorded.urban_error_fit import (
    estimate_mixture as estimate_mixture,
    estimate_normal as estimate_normal,
    range_residuals as range_residuals,
)
from pfbench.scenario.recorded.urban_log import (
    read_drive as read_drive,
    select_stretch as select_stretch,
)
from pfbench.scenario.recording_regime import RecordingRegime as RecordingRegime
from pfbench.scenario.simulated_flight import SimulatedFlight as SimulatedFlight
from pfbench.scenario.terrain_flight import TerrainFlight as TerrainFlight
