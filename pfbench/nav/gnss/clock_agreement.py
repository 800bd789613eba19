"""Agreement of the clock offsets of broadcast ephemerides with their drifts.

Clock offsets that are in another unit in all records leave neighbours within the tolerance. The
offsets of all satellites together then do not change as the drifts state.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

CLOCK_SCALES = (0.8, 1.25)  # least and largest ratio of changes of offset and drift [ours]
CHANGE_NOISE = 2e-9  # s; a day of 372 changes of GPS clocks leaves 1.1 ns [ours]
_SIGNIFICANT = 5.0  # standard deviations
_LONGEST = 14400.0  # s between compared ephemerides


def describe_clock_scale(table: pd.DataFrame, name: str) -> tuple[str, ...]:
    """Describe clock offsets that do not change as their drifts state.

    Args:
        table: Ephemerides with RINEX names, `name` and `toc`, ordered by satellite and time.
        name: Name of the file.

    Returns:
        One note, or none.
    """
    first, second = table.iloc[:-1], table.iloc[1:]
    span = second["toc"].to_numpy() - first["toc"].to_numpy()
    is_pair = (first["name"].to_numpy() == second["name"].to_numpy()) & (span > 0.0)
    is_pair &= span <= _LONGEST
    drift = 0.5 * (first["af1"].to_numpy() + second["af1"].to_numpy())
    expected = (drift * span)[is_pair]
    change = (second["af0"].to_numpy() - first["af0"].to_numpy())[is_pair]
    reach = float(np.sqrt((expected * expected).sum()))
    if not reach > 0.0:
        return ()
    scale = float((expected * change).sum()) / reach**2
    # one step of a clock must not decide
    noise = max(CHANGE_NOISE, float(np.sqrt(np.mean((change - scale * expected) ** 2))))
    if CLOCK_SCALES[0] < scale < CLOCK_SCALES[1] or abs(scale - 1.0) * reach < _SIGNIFICANT * noise:
        return ()
    return (
        f"{name}: clock offsets change {scale:.3g} times as fast as their drifts state, between "
        f"{int(is_pair.sum())} pairs of ephemerides. Check the units of af0 and af1",
    )
