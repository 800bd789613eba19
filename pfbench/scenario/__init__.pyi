"""Public names of `pfbench.scenario` and the modules that define them."""

from pfbench.logs.doctor.finding import Finding as Finding, LogDiagnosis as LogDiagnosis
from pfbench.logs.doctor.inspection import inspect_log as inspect_log
from pfbench.logs.worlds.constrained import ConstrainedDrive as ConstrainedDrive
from pfbench.logs.worlds.corrections import LogCorrections as LogCorrections
from pfbench.logs.worlds.drive import (
    BaroMagSensors as BaroMagSensors,
    FixHoldout as FixHoldout,
    RecordedAidedFlight as RecordedAidedFlight,
    RecordedDrive as RecordedDrive,
    RecordedFlights as RecordedFlights,
)
from pfbench.logs.worlds.log_reader import read_log as read_log
from pfbench.logs.worlds.log_tables import LogFiles as LogFiles, find_dataset as find_dataset
from pfbench.logs.worlds.odometer import (
    Odometer as Odometer,
    RecordedOdometer as RecordedOdometer,
    SimulatedOdometer as SimulatedOdometer,
)
from pfbench.logs.worlds.raw_gnss import (
    RawGnssReceiver as RawGnssReceiver,
    RecordedWalk as RecordedWalk,
)
from pfbench.logs.worlds.rinex_source import RinexSource as RinexSource
from pfbench.logs.worlds.signal_weights import SignalWeights as SignalWeights
from pfbench.logs.worlds.start_alignment import StartAlignment as StartAlignment
from pfbench.logs.worlds.time_grid import FixReceiver as FixReceiver
from pfbench.logs.worlds.trajectory_file import RecordedTrajectory as RecordedTrajectory
from pfbench.logs.worlds.urban import (
    PseudorangeReceiver as PseudorangeReceiver,
    UrbanDrive as UrbanDrive,
    read_drive as read_drive,
    select_stretch as select_stretch,
)
from pfbench.logs.worlds.user_log import AlignedLog as AlignedLog, UserLog as UserLog
from pfbench.logs.worlds.user_raw_log import (
    UserInsLog as UserInsLog,
    UserRawLog as UserRawLog,
)
from pfbench.scenario.base import RecordingRegime as RecordingRegime, Scenario as Scenario
from pfbench.scenario.flights import (
    SimulatedFlight as SimulatedFlight,
    TerrainFlight as TerrainFlight,
)
from pfbench.scenario.passive_location import (
    EmitterPrior as EmitterPrior,
    PassiveLocationScenario as PassiveLocationScenario,
    QuadratureEmitterPrior as QuadratureEmitterPrior,
)
from pfbench.scenario.simulated import ModelSimulation as ModelSimulation
