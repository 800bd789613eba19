"""Public names of `pfbench.nav` and the modules that define them."""

from pfbench.nav.aiding import (
    AidingSensor as AidingSensor,
    AlignmentErrors as AlignmentErrors,
    GnssReceiver as GnssReceiver,
    ProcessNoiseInflation as ProcessNoiseInflation,
)
from pfbench.nav.gnss.broadcast_orbits import BroadcastConstellation as BroadcastConstellation
from pfbench.nav.gnss.orbits import (
    Constellation as Constellation,
    WalkerConstellation as WalkerConstellation,
)
from pfbench.nav.gnss.ranging import RangingReceiver as RangingReceiver
from pfbench.nav.gnss.receiver_clock import ReceiverClock as ReceiverClock
from pfbench.nav.imu_errors import ImuErrors as ImuErrors
from pfbench.nav.manoeuvres import (
    ManoeuvreTrajectory as ManoeuvreTrajectory,
    accelerate as accelerate,
    climb as climb,
    cruise as cruise,
    turn as turn,
)
from pfbench.nav.plausible_limits import PlausibleLimits as PlausibleLimits
from pfbench.nav.ramps import (
    CosineRamp as CosineRamp,
    CycloidRamp as CycloidRamp,
    RampTrajectory as RampTrajectory,
)
from pfbench.nav.sar import SarSensor as SarSensor
from pfbench.nav.trajectory import (
    TrajectorySource as TrajectorySource,
    TrajectoryStart as TrajectoryStart,
)
