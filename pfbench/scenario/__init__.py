"""Scenarios: simulated and recorded episodes.

The public names of this folder are imported on first use.
"""

from pfbench.core.lazy_import import lazy_attributes

__all__ = [
    "BaroMagSensors",
    "EmitterPrior",
    "FixHoldout",
    "FixReceiver",
    "LogFiles",
    "ModelSimulation",
    "PassiveLocationScenario",
    "PseudorangeReceiver",
    "QuadratureEmitterPrior",
    "RawGnssReceiver",
    "RecordedAidedFlight",
    "RecordedDrive",
    "RecordedFlights",
    "RecordedTrajectory",
    "RecordedWalk",
    "RecordingRegime",
    "Scenario",
    "SimulatedFlight",
    "UrbanDrive",
    "estimate_mixture",
    "estimate_normal",
    "find_dataset",
    "range_residuals",
    "read_drive",
    "read_log",
    "select_stretch",
]

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "base": ("Scenario",),
        "emitter_prior": ("EmitterPrior",),
        "model_simulation": ("ModelSimulation",),
        "oracle_noise": ("RecordingRegime",),
        "passive_location": ("PassiveLocationScenario",),
        "quadrature_prior": ("QuadratureEmitterPrior",),
        "recorded.aided_flight": (
            "BaroMagSensors",
            "RecordedAidedFlight",
        ),
        "recorded.assembly": ("FixReceiver",),
        "recorded.drive": (
            "RecordedDrive",
            "RecordedFlights",
        ),
        "recorded.fix_holdout": ("FixHoldout",),
        "recorded.log_reader": ("read_log",),
        "recorded.log_tables": ("find_dataset",),
        "recorded.navigation_log": ("LogFiles",),
        "recorded.raw_gnss_walk": (
            "RawGnssReceiver",
            "RecordedWalk",
        ),
        "recorded.trajectory_file": ("RecordedTrajectory",),
        "recorded.urban_drive": (
            "PseudorangeReceiver",
            "UrbanDrive",
        ),
        "recorded.urban_error_fit": (
            "range_residuals",
            "estimate_normal",
            "estimate_mixture",
        ),
        "recorded.urban_log": (
            "read_drive",
            "select_stretch",
        ),
        "simulated_flight": ("SimulatedFlight",),
    },
)
