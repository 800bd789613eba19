"""Errors of a run without parts that a record shows one draw of, such as an offset or a slow oscillation."""

from __future__ import annotations

import numpy as np
from scipy.signal.windows import dpss

from pfbench.stats.error_measures import Array
from pfbench.stats.time_blocks import BLOCKS

_LEAST_ROWS = 4  # epochs of each recentred component


def remove_nuisance(error: Array, path: Array) -> Array:
    """Remove offset, drift, all that is slower than two blocks, and a turn and a scale of the path.

    Slepian sequences span what is slower, whatever its period and phase: Schuler oscillations of a record of less than
    21 h, too. A yaw error turns the path about the vertical, and the scale of an odometer stretches it.

    Shapes: error [..., T, 3], path [T, 3].
    """
    steps = error.shape[-2]
    cycles = min(BLOCKS / 2, steps / (2 * _LEAST_ROWS))
    slow = dpss(steps, cycles, max(int(2 * cycles) + 1, 1))
    lines = np.column_stack([np.ones(steps), np.linspace(-1.0, 1.0, steps), *slow])
    basis = np.linalg.qr(lines[:, : max(steps // _LEAST_ROWS, min(steps, 2))])[0]
    centred = path - path.mean(0)
    forms = np.stack([centred, centred[:, [1, 0, 2]] * [-1.0, 1.0, 0.0]])
    rest, forms = (a - basis @ (basis.T @ a) for a in (error, forms))
    forms = forms.reshape(2, -1)
    share = np.linalg.norm(forms, axis=1) / max(float(np.linalg.norm(centred)), 1e-300)
    forms = np.linalg.qr(forms[share > 1e-6].T)[0]  # less is rounding
    flat = rest.reshape(*rest.shape[:-2], -1)
    return np.asarray((flat - (flat @ forms) @ forms.T).reshape(rest.shape))
