"""Public names of `pfbench.core` and the modules that define them."""

from pfbench.core.chart import (
    AngleBlock as AngleBlock,
    Chart as Chart,
    EuclideanBlock as EuclideanBlock,
    LieGroupBlock as LieGroupBlock,
    QuaternionBlock as QuaternionBlock,
    wrap_angle as wrap_angle,
)
from pfbench.core.parameter_checks import (
    require as require,
    require_range as require_range,
    require_ranges as require_ranges,
)
from pfbench.core.random_stream import PhiloxStream as PhiloxStream, RandomStream as RandomStream
from pfbench.core.record import (
    Episode as Episode,
    MeasurementChannels as MeasurementChannels,
    Record as Record,
    map_inputs as map_inputs,
)
from pfbench.core.simulate import NumberSource as NumberSource
