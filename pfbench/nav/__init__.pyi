"""Public names of `pfbench.nav` and the modules that define them."""

from pfbench.logs.sky.broadcast_orbits import BroadcastConstellation as BroadcastConstellation
from pfbench.logs.sky.plausible_limits import PlausibleLimits as PlausibleLimits
from pfbench.nav.aiding import (
    AidingSensor as AidingSensor,
    AlignmentErrors as AlignmentErrors,
    GnssReceiver as GnssReceiver,
    ProcessNoiseInflation as ProcessNoiseInflation,
    SarSensor as SarSensor,
)
from pfbench.nav.imu_errors import ImuErrors as ImuErrors
from pfbench.nav.manoeuvres import (
    CosineRamp as CosineRamp,
    CycloidRamp as CycloidRamp,
    ManoeuvreTrajectory as ManoeuvreTrajectory,
    RampTrajectory as RampTrajectory,
    accelerate as accelerate,
    climb as climb,
    cruise as cruise,
    turn as turn,
)
from pfbench.nav.orbits import (
    Constellation as Constellation,
    WalkerConstellation as WalkerConstellation,
)
from pfbench.nav.ranging import RangingReceiver as RangingReceiver, ReceiverClock as ReceiverClock
from pfbench.nav.trajectory import (
    TrajectorySource as TrajectorySource,
    TrajectoryStart as TrajectoryStart,
)
