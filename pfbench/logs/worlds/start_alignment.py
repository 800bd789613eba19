"""Start of a log without a reference: level from the specific force, heading from the course of the fixes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from pfbench.core import chart
from pfbench.core.parameter_checks import require_ranges
from pfbench.logs.worlds.log_tables import Array, NavigationLog
from pfbench.model.strapdown_tuning import StrapdownTuning
from pfbench.nav.attitude import quaternion_from_dcm
from pfbench.nav.strapdown import rotate

_FEWEST = 5  # fixes of a window: a parabola has three coefficients
_WINDOWS = (2.0, 3.0, 4.0, 6.0, 8.0, 11.0, 15.0)  # s that are tried
_DEGREE = np.pi / 180.0
_UP, _FORWARD = np.array([0.0, 0.0, 1.0]), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


class StartEstimate(NamedTuple):
    """Start of the filters, in right-forward-up and East-North-Up axes.

    Attributes:
        time: Time of the start, s.
        state: Attitude quaternion, velocity, m/s, and position, m, [10].
        sd: Standard deviations about right, forward, up, rad, of velocity and of position, [9].
        note: Sentence for the report.
    """

    time: float
    state: Array
    sd: Array
    note: str


class _Parabola(NamedTuple):
    """Parabolas through the fixes of a window: values at its end, [3], and their standard deviations.

    Attributes:
        position: m.
        velocity: m/s.
        acceleration: m/s^2.
        course: Velocity at the middle, m/s.
        sd: Standard deviations of these four, [4, 3].
    """

    position: Array
    velocity: Array
    acceleration: Array
    course: Array
    sd: Array


class _Turned(NamedTuple):
    """Samples of the IMU in the body axes of the first one: time, s, [n], turn to them, [n, 4], force and forward axis, [n, 3]."""

    time: Array
    turn: torch.Tensor
    force: Array
    forward: Array


@dataclass(frozen=True)
class StartAlignment:
    """Search for the first window of fixes that gives level and heading.

    In a window the gyro turns all samples into the body axes at its end. The mean specific force less the
    acceleration of the fixes is upward. The mean forward axis has the course of the fixes. Noise of the fixes,
    biases of the tuning and the side slip give standard deviations. The filters start at the end of the window, and
    use later fixes only.

    Attributes:
        heading_deg: Heading at the first fix, clockwise from North, deg. None to take it from the course.
        heading_sd_deg: Standard deviation of `heading_deg`, deg.
        side_slip_deg: Standard deviation of the angle between course and heading, deg. The vehicle drives forward.
        largest_sd_deg: Largest standard deviation of level and heading of a start, deg.
        search_s: Time from the first fix that is searched, s.

    Raises:
        ValueError: If a number is out of its range.
    """

    heading_deg: float | None = None
    heading_sd_deg: float = 5.0
    side_slip_deg: float = 3.0
    largest_sd_deg: float = 10.0
    search_s: float = 120.0

    def __post_init__(self) -> None:
        require_ranges(
            "scenario.alignment", self,
            heading_deg="null or [-360, 360] Count it clockwise from North.", heading_sd_deg="(0, 180]",
            side_slip_deg="[0, 90]", largest_sd_deg="(0, 45] A filter does not converge from a larger error.",
            search_s="(0, inf]",
        )  # fmt: skip

    def find(self, log: NavigationLog, tuning: StrapdownTuning, start: float | None) -> StartEstimate:  # fmt: skip
        """Find the start.

        Args:
            log: Log with fixes; its reference is not read.
            tuning: Noise of the fixes, and biases with their standard deviations.
            start: Earliest time, s. None for that of the log.

        Returns:
            The first start whose level and heading are certain enough.

        Raises:
            ValueError: If there is none. The message has the best one.
        """
        low = max(log.imu.time[0], -np.inf if start is None else start)
        inside = np.isfinite(log.fixes.position).all(1) & (log.fixes.time >= low) & (log.fixes.time <= log.imu.time[-1])  # fmt: skip
        first = log.fixes.time[inside][0] if inside.any() else low
        inside &= log.fixes.time <= first + self.search_s
        time, position = log.fixes.time[inside], log.fixes.position[inside]
        samples: _Turned | None = None
        tried: list[StartEstimate] = []
        for end in range(_FEWEST - 1, len(time)):
            samples = samples or _turn_samples(log, time, tuning)
            windows = [
                self._level(samples, time[window], position[window], log.gravity, tuning)
                for window in _list_windows(time, end)
            ]
            best = min(windows, key=_spread, default=None)
            if best is not None and best.sd[:3].max() <= self.largest_sd_deg * _DEGREE:
                return best
            tried += [best] if best is not None else []
        raise ValueError(
            _explain_failure(min(tried, key=_spread, default=None), self, len(time), first)
        )

    def _level(self, samples: _Turned, time: Array, position: Array, gravity: float, tuning: StrapdownTuning) -> StartEstimate:  # fmt: skip
        """Return the start at the end of a window of fixes."""
        fit, span = _fit_parabolas(time, position, tuning), time[-1] - time[0]
        rows = slice(*np.searchsorted(samples.time, [time[0] - 1e-9, time[-1] + 1e-9]))
        at = samples.time[rows]
        x = 2.0 * (at - at[0]) / (at[-1] - at[0]) - 1.0
        # least squares weigh acceleration and velocity of a window by these kernels
        force = ((1.0 - x**2) ** 2) @ samples.force[rows] / ((1.0 - x**2) ** 2).sum()
        forward = (1.0 - x**2) @ samples.forward[rows] / (1.0 - x**2).sum()
        course, slip = fit.course * [1.0, 1.0, 0.0], self.side_slip_deg * _DEGREE
        speed = float(np.linalg.norm(course))
        aim = np.hypot(np.arctan2(fit.sd[3, :2].max(), speed), slip)
        drift = tuning.gyro_bias_sd_deg_s * _DEGREE * 0.5 * span
        if self.heading_deg is not None:
            angle = self.heading_deg * _DEGREE
            course, forward = np.array([np.sin(angle), np.cos(angle), 0.0]), samples.forward[0]
            aim, drift_up = self.heading_sd_deg * _DEGREE, tuning.gyro_bias_sd_deg_s * _DEGREE * (time[-1] - samples.time[0])  # fmt: skip
        else:
            drift_up = drift
        level = [fit.acceleration + gravity * _UP, course if speed > 0.0 else _UP[[2, 0, 1]]]
        q = _find_attitude(samples.turn[rows][-1], [force, forward], level)
        tilt = np.sqrt((fit.sd[2, :2].max() ** 2 + tuning.accelerometer_bias_sd**2) / gravity**2 + drift**2)  # fmt: skip
        heading = np.hypot(aim, drift_up)
        sd = np.concatenate([[tilt, tilt, heading], fit.sd[1], fit.sd[0]])
        note = _describe_start(time, q, (heading, tilt), float(np.linalg.norm(fit.velocity)))
        return StartEstimate(
            float(time[-1]), np.concatenate([q, fit.velocity, fit.position]), sd, note
        )


def _find_attitude(turn: torch.Tensor, body: list[Array], level: list[Array]) -> Array:
    """Return the attitude quaternion, [4], with two directions in level axes and in the body axes before a turn."""
    back = torch.cat([turn[:1], -turn[1:]])
    turned = [rotate(back, torch.from_numpy(a)).numpy() for a in body]
    return np.asarray(quaternion_from_dcm(torch.from_numpy(_triad(level) @ _triad(turned).T)))


def _describe_start(time: Array, q: Array, sd: tuple[float, float], speed: float) -> str:
    """Describe a start from a window of fixes; sd is of heading and level, rad."""
    north = rotate(torch.from_numpy(q), _FORWARD).numpy()
    heading = np.rad2deg(np.arctan2(north[0], north[1])) % 360
    return (
        f"start at t = {time[-1]:.2f} from {len(time)} fixes since t = {time[0]:.2f}, which are not used again: heading "
        f"{heading:.0f} deg with a standard deviation of {sd[0] / _DEGREE:.1f}, level {sd[1] / _DEGREE:.1f} deg, speed {speed:.1f} m/s"
    )


def _list_windows(time: Array, end: int) -> list[slice]:
    """List the windows that end at a fix."""
    begins = sorted({int(np.searchsorted(time, time[end] - size - 1e-6)) for size in _WINDOWS})
    return [
        slice(begin, end + 1)
        for begin in begins
        if end - begin + 1 >= _FEWEST and time[end] - time[begin] >= 0.9 * _WINDOWS[0]
    ]


def _spread(start: StartEstimate) -> float:
    """Return the size of the standard deviations of the attitude, rad."""
    return float(np.linalg.norm(start.sd[:3]))


def _explain_failure(best: StartEstimate | None, alignment: StartAlignment, fixes: int, first: float) -> str:  # fmt: skip
    """Describe why no start was found."""
    got = f"{fixes} fixes from t = {first:.1f} on" if best is None else (
        f"at best {best.sd[2] / _DEGREE:.0f} deg of heading and {best.sd[0] / _DEGREE:.0f} deg of level at t = {best.time:.1f}"
    )  # fmt: skip
    return (
        f"the log must show level and heading within {alignment.largest_sd_deg:g} deg in {alignment.search_s:g} s of fixes, "
        f"got {got}. Set scenario.start_s to a time at which it moves, or scenario.alignment.heading_deg."
    )


def _fit_parabolas(time: Array, position: Array, tuning: StrapdownTuning) -> _Parabola:
    """Fit parabolas to the fixes of a window; their noise is that of the tuning or of the residuals, the larger one."""
    since = time - time[-1]
    design = np.stack([np.ones_like(since), since, 0.5 * since**2], -1)
    covariance = np.linalg.inv(design.T @ design)
    values = covariance @ design.T @ position
    residual = np.sqrt(np.square(position - design @ values).sum(0) / (len(time) - 3))
    noise = np.maximum(residual, np.array(tuning.position_sd))
    middle = np.array([0.0, 1.0, 0.5 * since[0]])
    variance = [*np.diag(covariance), middle @ covariance @ middle]
    sd = np.sqrt(variance)[:, None] * noise
    return _Parabola(values[0], values[1], values[2], middle @ values, sd)


def _turn_samples(log: NavigationLog, time: Array, tuning: StrapdownTuning) -> _Turned:
    """Turn the samples between the first and the last fix into the body axes of the first sample."""
    imu, (low, high) = log.imu, np.searchsorted(log.imu.time, [time[0] - 1e-9, time[-1] + 1e-9])
    rows, bias = slice(max(low - 1, 0), high), tuning.bias.numpy()
    at, rate = imu.time[rows], imu.rate[rows] - bias[:3]
    angle = torch.from_numpy(0.5 * np.diff(at)[:, None] * (rate[1:] + rate[:-1]))
    turn = torch.cat([torch.tensor([[1.0, 0.0, 0.0, 0.0]]), chart.quaternion_from_rotation_vector(angle)])  # fmt: skip
    shift = 1
    while shift < len(turn):  # products of all turns before each sample, by doubling
        turn = torch.cat([turn[:shift], chart.quaternion_multiply(turn[:-shift], turn[shift:])])
        shift *= 2
    force = rotate(turn, torch.from_numpy(imu.force[rows] - bias[3:]))
    return _Turned(at, turn, force.numpy(), rotate(turn, _FORWARD.expand(len(turn), 3)).numpy())


def _triad(vectors: list[Array]) -> Array:
    """Return the axes of two directions as columns, [3, 3]; the first direction is exact."""
    first = vectors[0] / np.linalg.norm(vectors[0])
    third = np.cross(first, vectors[1])
    third /= np.linalg.norm(third)
    return np.stack([first, np.cross(third, first), third], -1)
