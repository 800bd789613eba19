"""Public names of `pfbench.scenario` and the modules that define them."""

from pfbench.scenario.base import RecordingRegime as RecordingRegime, Scenario as Scenario
from pfbench.scenario.diagnosis.finding import Finding as Finding, LogDiagnosis as LogDiagnosis
from pfbench.scenario.diagnosis.inspection import inspect_log as inspect_log
from pfbench.scenario.flights import (
    SimulatedFlight as SimulatedFlight,
    TerrainFlight as TerrainFlight,
)
from pfbench.scenario.passive_location import (
    EmitterPrior as EmitterPrior,
    PassiveLocationScenario as PassiveLocationScenario,
    QuadratureEmitterPrior as QuadratureEmitterPrior,
)
from pfbench.scenario.recorded.aligned_log import AlignedLog as AlignedLog
from pfbench.scenario.recorded.constrained import ConstrainedDrive as ConstrainedDrive
from pfbench.scenario.recorded.corrections import LogCorrections as LogCorrections
from pfbench.scenario.recorded.drive import (
    BaroMagSensors as BaroMagSensors,
    FixHoldout as FixHoldout,
    RecordedAidedFlight as RecordedAidedFlight,
    RecordedDrive as RecordedDrive,
    RecordedFlights as RecordedFlights,
)
from pfbench.scenario.recorded.log_reader import read_log as read_log
from pfbench.scenario.recorded.log_tables import LogFiles as LogFiles, find_dataset as find_dataset
from pfbench.scenario.recorded.odometer import (
    Odometer as Odometer,
    RecordedOdometer as RecordedOdometer,
    SimulatedOdometer as SimulatedOdometer,
)
from pfbench.scenario.recorded.raw_gnss import (
    RawGnssReceiver as RawGnssReceiver,
    RecordedWalk as RecordedWalk,
)
from pfbench.scenario.recorded.rinex_source import RinexSource as RinexSource
from pfbench.scenario.recorded.signal_weights import SignalWeights as SignalWeights
from pfbench.scenario.recorded.start_alignment import StartAlignment as StartAlignment
from pfbench.scenario.recorded.time_grid import FixReceiver as FixReceiver
from pfbench.scenario.recorded.trajectory_file import RecordedTrajectory as RecordedTrajectory
from pfbench.scenario.recorded.urban import (
    PseudorangeReceiver as PseudorangeReceiver,
    UrbanDrive as UrbanDrive,
    read_drive as read_drive,
    select_stretch as select_stretch,
)
from pfbench.scenario.recorded.urban_error_fit import (
    estimate_mixture as estimate_mixture,
    estimate_normal as estimate_normal,
    range_residuals as range_residuals,
)
from pfbench.scenario.recorded.user_log import UserLog as UserLog
from pfbench.scenario.recorded.user_raw_log import (
    UserInsLog as UserInsLog,
    UserRawLog as UserRawLog,
)
from pfbench.scenario.simulated import ModelSimulation as ModelSimulation
