"""Navigation: Earth, attitude, sensors, mechanisation and ranging: the public names of this folder, imported on first use."""

from pfbench.core.lazy_import import lazy_attributes

__all__ = [
    "AidingSensor",
    "AlignmentErrors",
    "BroadcastConstellation",
    "Constellation",
    "CosineRamp",
    "CycloidRamp",
    "GnssReceiver",
    "ImuErrors",
    "ManoeuvreTrajectory",
    "PlausibleLimits",
    "ProcessNoiseInflation",
    "RampTrajectory",
    "RangingReceiver",
    "ReceiverClock",
    "SarSensor",
    "TrajectorySource",
    "TrajectoryStart",
    "WalkerConstellation",
    "accelerate",
    "climb",
    "cruise",
    "turn",
]

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "aiding": (
            "AidingSensor",
            "GnssReceiver",
            "AlignmentErrors",
            "ProcessNoiseInflation",
        ),
        "gnss.broadcast_orbits": ("BroadcastConstellation",),
        "gnss.orbits": (
            "Constellation",
            "WalkerConstellation",
        ),
        "gnss.ranging": ("RangingReceiver",),
        "gnss.receiver_clock": ("ReceiverClock",),
        "imu_errors": ("ImuErrors",),
        "manoeuvres": (
            "ManoeuvreTrajectory",
            "accelerate",
            "cruise",
            "climb",
            "turn",
        ),
        "plausible_limits": ("PlausibleLimits",),
        "ramps": (
            "CosineRamp",
            "CycloidRamp",
            "RampTrajectory",
        ),
        "sar": ("SarSensor",),
        "trajectory": (
            "TrajectoryStart",
            "TrajectorySource",
        ),
    },
)
