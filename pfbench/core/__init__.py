"""Data, charts, random streams, distributions and numerical checks of all other folders.

The public names of this folder are imported on first use.
"""

from pfbench.core.lazy_import import lazy_attributes

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "random_stream": (
            "RandomStream",
            "PhiloxStream",
        ),
        "record": (
            "Episode",
            "MeasurementChannels",
            "Record",
            "map_inputs",
        ),
    },
)

__all__ = __dir__()
