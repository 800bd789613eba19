"""Standard deviations of raw measurements by elevation and signal strength."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.files.table_file import Array

_STRENGTH = 45.0  # dB-Hz; of `cn0_sd`
_LOWEST = 0.05  # least sine of an elevation, of 3 degrees


@dataclass(frozen=True)
class SignalWeights:
    """Standard deviations by elevation e and carrier-to-noise density C.

    sd^2 = (elevation_sd / sin e)^2 + cn0_sd^2 10^(-(C - 45 dB-Hz) / 10). The first term represents atmosphere and
    multipath [Dach et al. 2015, "Bernese GNSS Software"], the second one is thermal noise [Langley 1997,
    "GPS receiver system noise"; Hartinger and Brunner 1999, SIGMA-epsilon]. The same for range rates.

    Attributes:
        elevation_sd: Of a range at the zenith, m. 0 omits the term.
        cn0_sd: Of a range at 45 dB-Hz, m. 0 omits the term.
        rate_elevation_sd: Of a range rate at the zenith, m/s.
        rate_cn0_sd: Of a range rate at 45 dB-Hz, m/s.

    Raises:
        ValueError: If a number is negative.
    """

    elevation_sd: float = 0.5
    cn0_sd: float = 0.5
    rate_elevation_sd: float = 0.05
    rate_cn0_sd: float = 0.05

    def __post_init__(self) -> None:
        rule = "[0, inf) Use 0 to omit a term."
        require_ranges(
            "scenario.receiver.weights", self, **{item.name: rule for item in fields(self)}
        )
        pairs = (("elevation_sd", "cn0_sd"), ("rate_elevation_sd", "rate_cn0_sd"))
        for pair in pairs:
            require(
                max(getattr(self, name) for name in pair) > 0.0,
                f"scenario.receiver.weights: {' or '.join(pair)}",
                "be positive",
                "0 for both",
                "Set one of them.",
            )

    def sd(self, elevation: Array, cn0: Array) -> tuple[Array, Array]:
        """Compute the standard deviations of ranges and range rates.

        Args:
            elevation: rad, [n].
            cn0: dB-Hz, [n]. NaN counts as 45.

        Returns:
            Standard deviations, m and m/s, [n] each.
        """
        growth = 1.0 / np.sin(elevation).clip(_LOWEST)
        noise = 10.0 ** (-(np.where(np.isnan(cn0), _STRENGTH, cn0) - _STRENGTH) / 20.0)
        return (
            np.hypot(self.elevation_sd * growth, self.cn0_sd * noise),
            np.hypot(self.rate_elevation_sd * growth, self.rate_cn0_sd * noise),
        )
