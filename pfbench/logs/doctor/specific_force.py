"""Checks of force and rate against the reference: axes and conventions, biases and scales."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pfbench.files.table_file import Array
from pfbench.logs.doctor.alignment import Alignment
from pfbench.logs.doctor.axis_orders import (
    BODY_ORDERS,
    CONVENTIONS,
    LEVEL_ORDERS,
    axes_matrix,
    convert_angles,
    name_axes,
)
from pfbench.logs.doctor.changes import find_change
from pfbench.logs.doctor.finding import REFUSE, WARN, Finding, Picture, thin_curve
from pfbench.logs.doctor.force_windows import (
    DOWN,
    ForceFit,
    ForceWindows,
    fit_force,
    integrate_force,
)
from pfbench.logs.doctor.raw_log import (
    RawImu,
    RawLog,
    RawReference,
    correlate_neighbours,
    dcm_of,
    interpolate_columns,
    take_rows,
)
from pfbench.logs.doctor.thresholds import (
    CLEAR_AXES,
    LEAST_ACCELERATION,
    STANDARD_ERRORS,
    limit_of,
)
from pfbench.logs.doctor.turn_search import TurnSearch, remove_line, turns_between

_EQUAL, _ALONE = (
    1.3,
    3.0,
)  # times the least residual, of explanations that fit as well, and the next largest turn
_FORCE_SPREAD, _CLEAR_FORCE = 0.3, 0.5  # m/s^2, of a window, and one that shows a direction
_LEAST_SPEED, _AHEAD = (
    2.0,
    0.9,
)  # m/s, and mean cosine between yaw and course of a vehicle that drives forward
_FEWEST, _FEWEST_FORCE, _FEWEST_RATE = (
    20,
    8,
    16,
)  # windows for scales, and of a block of the force and of the rate
_LEAST_RATE, _SCALE_ERROR, _SCALE_ERRORS = (
    0.05,
    0.02,
    6.0,
)  # rad/s, 1, standard errors: motion and accuracy that show a scale
_DELAYS, _DELAY_S = (
    np.linspace(-0.2, 0.2, 5),
    600.0,
)  # s of the force, and of the log that is compared


# what is wrong, the corrections that mend it, and what the force leaves then, (m/s^2)^2
Cause = tuple[str, dict[str, Any], float]
_LEVEL = ["e", "n", "-d"]
_ROS: dict[str, Any] = {
    "mounting": {"imu": ["x", "-y", "-z"]}, "level_axes": {"reference": _LEVEL, "gnss": _LEVEL},
    "attitude": "forward_left_up",
}  # fmt: skip


def check_force_and_rate(aligned: Alignment, facts: dict[str, Any]) -> tuple[RawLog, list[Finding]]:
    """Check axes, biases and scales.

    Returns the log with the axes of the likeliest explanation, and findings.
    """
    windows = integrate_force(aligned.log, aligned.dcm, aligned.offset)
    if windows is None:
        return aligned.log, []
    fit, is_rate = fit_force(windows), aligned.rate_ratio > limit_of("axes")
    causes, least = _list_causes(aligned, windows, fit, is_rate)
    horizontal = float(np.sqrt(np.square(windows.change[:, :2]).mean()))
    ratio = fit.cost / max(least, 1e-12)
    facts.update(
        {
            "rate axes": aligned.rate_ratio,
            "force axes": ratio,
            "horizontal acceleration [m/s^2]": horizontal,
        }
    )
    is_force = ratio > CLEAR_AXES and horizontal > LEAST_ACCELERATION
    # a part of exchanged axes is a turn about the vertical, and a motion along a line allows exchanged axes for a heading
    if turned := _find_rotation(aligned, windows, facts) or _find_heading(aligned, windows, fit, least, facts):  # fmt: skip
        finding, log = turned
        return log, [finding]
    if is_rate or is_force:
        finding = _describe_axes(aligned, windows, ratio, causes)
        return _mend(aligned.log, finding.settings.get("corrections", {})), [finding]
    return aligned.log, [
        *_check_force_delay(aligned, facts),
        *_check_force_errors(aligned, windows, fit, facts),
        *_check_rate_errors(aligned, facts),
    ]


def _find_rotation(aligned: Alignment, windows: ForceWindows, facts: dict[str, Any]) -> tuple[Finding, RawLog] | None:  # fmt: skip
    """Find a sensor that is turned by an angle that no order of axes explains.

    Turns and force are fitted together: a bias can take the place of a tilt in the force, but turns the axis of no turn.

    Returns the finding, and the log with the sensor turned back.
    """
    true, measured = aligned.pair
    orders = [m for m in BODY_ORDERS if np.linalg.det(m) > 0.0]
    rates = [float(np.square(measured @ m.T - true).sum()) for m in orders]
    forces = [fit_force(windows, m).cost for m in orders]
    spread = 1.4826 * float(np.median(np.abs(measured @ orders[int(np.argmin(rates))].T - true))) + 1e-4  # fmt: skip

    def residuals(vector: Array, start: Array) -> Array:
        matrix = Rotation.from_rotvec(vector).as_matrix() @ start
        force = windows.change - np.einsum("nijk,jk->ni", windows.products, matrix) - windows.gravity * DOWN  # fmt: skip
        return np.concatenate([((measured @ matrix.T - true) / spread).ravel(), force.ravel() / _FORCE_SPREAD])  # fmt: skip

    starts = [orders[0], orders[int(np.argmin(rates))], orders[int(np.argmin(forces))]]
    fits = [(least_squares(residuals, np.zeros(3), loss="soft_l1", args=(m,)), m) for m in starts]
    fit, start = min(fits, key=lambda pair: pair[0].cost)
    matrix = Rotation.from_rotvec(fit.x).as_matrix() @ start
    trace = max(float(np.trace(matrix @ m.T)) for m in orders)
    angle = float(np.rad2deg(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))))
    facts["turn of the sensor [deg]"] = round(angle, 2)
    # orders with other signs explain a mirrored gyro or heading better than a turn does
    least = min(float(np.square(measured @ m.T - true).sum()) for m in BODY_ORDERS)
    gains = (
        least / max(float(np.square(measured @ matrix.T - true).sum()), 1e-300),
        min(forces) / max(fit_force(windows, matrix).cost, 1e-12),
    )
    if (
        angle < limit_of("mounting") or max(gains) < limit_of("axes") or min(gains) < 1.0 / _EQUAL
        or _find_force_change(windows, fit_force(windows, matrix))  # which no turn explains
    ):  # fmt: skip
        return None
    log, names = aligned.log, aligned.log.names
    angles = [round(float(a), 2) for a in Rotation.from_matrix(matrix).as_euler("ZYX", degrees=True)[::-1]]  # fmt: skip
    finding = Finding(
        "mounting", REFUSE, angle, limit_of("mounting"), "deg",
        f"{names[0]}: the sensor is turned by roll, pitch, yaw {angles} deg against the attitude of {names[2]}, {angle:.1f} deg "
        "from any order of axes",
        f"Set +scenario.corrections.mounting.imu={angles}", {"corrections": {"mounting": {"imu": angles}}},
        ("a sensor that is tilted or turned", f"an attitude of {names[2]} in another frame, as a magnetic yaw"),
        _force_picture(windows),
    )  # fmt: skip
    return finding, _mend(log, finding.settings["corrections"])


def _find_heading(
    aligned: Alignment, windows: ForceWindows, plain: ForceFit, least: float, facts: dict[str, Any]
) -> tuple[Finding, RawLog] | None:
    """Find a yaw of the reference that is off by a constant: turns agree, and the force moves in another direction.

    Returns the finding, and the log with the yaw corrected.
    """
    log = aligned.log
    predicted, expected = (a[plain.keep, :2] @ [1.0, 1j] for a in (windows.change - plain.residual, windows.change))  # fmt: skip
    angle = float(np.angle(np.vdot(predicted, expected)))
    turn = Rotation.from_euler("z", angle).as_matrix()
    turned = windows._replace(products=np.einsum("ij,njkl->nikl", turn, windows.products), rotation=turn @ windows.rotation)  # fmt: skip
    fit = fit_force(turned)
    degrees = np.rad2deg(angle)
    facts["turn of the heading [deg]"] = round(degrees, 2)
    if (
        fit.cost >= min(plain.cost / CLEAR_AXES, least, limit_of("rest of the force") ** 2)
        or aligned.rate_ratio > limit_of("axes")
        or abs((degrees + 45.0) % 90.0 - 45.0)
        < limit_of("mounting")  # orders of axes have their own check
    ):
        return None
    change = _find_heading_change(turned, fit)
    moves = f", and {change[2]}" if change else ""
    finding = Finding(
        "heading", WARN if change else REFUSE, degrees, limit_of("mounting"), "deg",
        f"{log.names[2]}: yaw is {-degrees:.1f} deg off{moves}: it turns as the gyroscope does, and the force moves in another direction",
        "Use the part without the change: a correction is one number for the whole log" if change
        else f"Set +scenario.corrections.bias.reference.yaw={-angle:.5f}",
        {} if change else {"corrections": {"bias": {"reference": {"yaw": round(-angle, 5)}}}},
        ("magnetic or grid North", "a velocity in another frame than the attitude"), _force_picture(windows),
    )  # fmt: skip
    return finding, log._replace(reference=log.reference._replace(angles=np.add(log.reference.angles, [0.0, 0.0, angle])))  # fmt: skip


def _find_heading_change(windows: ForceWindows, fit: ForceFit) -> tuple[int, float, str] | None:
    """Find a change of the direction in which the force moves, deg, that no constant yaw explains."""
    expected, predicted = (a[:, :2] @ [1.0, 1j] for a in (windows.change, windows.change - fit.residual))  # fmt: skip
    used = fit.keep & (np.abs(predicted) > _CLEAR_FORCE)
    change = find_change(
        windows.time[used],
        np.rad2deg(np.angle(predicted * expected.conj()))[used, None],
        _FEWEST_FORCE,
        "deg",
    )
    return change if change and change[1] > limit_of("heading") else None


def _drives_forward(log: RawLog) -> bool:
    """Return whether the recorded yaw is the course where a vehicle moves."""
    north, east = log.reference.velocity[:, :2].T
    moves = np.hypot(north, east) > _LEAST_SPEED
    off = log.reference.angles[moves, 2] - np.arctan2(east, north)[moves]
    return bool(moves.any() and np.cos(off).mean() > _AHEAD)


def _list_causes(
    aligned: Alignment, windows: ForceWindows, fit: ForceFit, is_rate: bool
) -> tuple[list[Cause], float]:
    """List the explanations of axes that fit as well as the best, simple ones first.

    Other conventions are tried if the recorded axes do not fit. If the rate does not fit either, no explanation of force or
    reference alone is one.

    Returns them, and what the force leaves with the best.
    """
    log, gyro, limit = aligned.log, aligned.rate_axes.T, limit_of("axes")
    imu, _, reference = log.names
    body = min(BODY_ORDERS, key=lambda m: fit_force(windows, m).cost)
    level = min(LEVEL_ORDERS, key=lambda m: fit_force(windows, level=m).cost)
    names, others = name_axes(level, is_level=True), list[Cause]()
    enu = " (East, North, Up under the names of North, East, Down)" if names == _LEVEL else ""
    orders: list[Cause] = [
        (f"{reference}: North, East, Down are the axes {', '.join(names)}{enu}", {"level_axes": {"reference": names}}, fit_force(windows, level=level).cost),
        (f"{imu}: fx, fy, fz alone have other axes, {_join(body)}", {"mounting": {"accelerometer": name_axes(body)}}, fit_force(windows, body).cost),
    ]  # fmt: skip
    if not is_rate and fit.cost >= limit_of("rest of the force") ** 2:
        # with these, turns agree, and only gravity points the other way: a bias can hide it
        ros = _mend(log, _ROS)
        turned = integrate_force(ros, dcm_of(ros.reference.angles), aligned.offset)
        others = [("all tables: East, North, Up and forward, left, up, as in ROS", _ROS, fit_force(turned).cost)] if turned else []  # fmt: skip
    least = min(cost for *_, cost in (*others, *orders))
    if max(fit.cost / max(least, 1e-12), aligned.rate_ratio) > limit:
        others += sorted(_try_conventions(aligned), key=lambda cause: cause[2])
        least = min(cost for *_, cost in (*others, *orders))
    if is_rate:
        axes = _find_mounting(aligned, windows)
        orders = [
            (f"{imu}: forward, right, down are the axes {_join(axes)}", {"mounting": {"imu": name_axes(axes)}}, fit_force(windows, axes).cost),
            (f"{imu}: wx, wy, wz alone have other axes, {_join(gyro)}", {"mounting": {"gyroscope": name_axes(gyro)}}, fit.cost),
        ]  # fmt: skip
    return [cause for cause in (*others, *orders) if cause[2] < _EQUAL * least], least


def _try_conventions(aligned: Alignment) -> Iterator[Cause]:
    """Yield the conventions of the attitude with which turns are those of the rate."""
    (true, measured), log = aligned.pair, aligned.log
    least = max(float(((measured - true @ aligned.rate_axes.T) ** 2).sum()), 1e-300)
    is_course = _drives_forward(log)  # a recorded yaw that is the course is right
    for name, (text, _) in CONVENTIONS.items():
        dcm = dcm_of(convert_angles(name, log.reference.angles))
        turns = remove_line(turns_between(dcm, aligned.nodes)[aligned.used])
        windows = integrate_force(log, dcm, aligned.offset)
        is_like = float(np.square(measured - turns).sum()) < _EQUAL * least
        if windows and is_like and not ("yaw" in name and is_course):
            yield f"{log.names[2]}: {text}", {"attitude": name}, fit_force(windows).cost


def _describe_axes(aligned: Alignment, windows: ForceWindows, ratio: float, causes: list[Cause]) -> Finding:  # fmt: skip
    """Describe axes that disagree, with all explanations that fit as well as the best."""
    imu, _, reference = aligned.log.names
    corrections = causes[0][1] if causes else {}
    unknown = f"No single change explains both: the best axes of the rate are {_join(aligned.rate_axes.T)}. Check the axes of both tables"  # fmt: skip
    return Finding(
        "axes", REFUSE, max(ratio, aligned.rate_ratio), limit_of("axes"), "times the least residual",
        f"{imu} and {reference}: axes disagree, residuals of the rate are {aligned.rate_ratio:.1f} and of the force {ratio:.1f} times "
        "those of the best axes",
        f"Set scenario.corrections: {corrections}" if causes else unknown, {"corrections": corrections} if causes else {}, tuple(text for text, *_ in causes), _force_picture(windows),
    )  # fmt: skip


def _mend(log: RawLog, corrections: Mapping[str, Any]) -> RawLog:
    """Apply axes and conventions of corrections to a log."""
    imu, reference, fixes = log.imu, log.reference, log.fixes
    for sensor, axes in corrections.get("mounting", {}).items():
        matrix = axes_matrix(sensor, axes)
        force = imu.force if sensor == "gyroscope" else imu.force @ matrix.T
        imu = imu._replace(force=force, rate=imu.rate if sensor == "accelerometer" else imu.rate @ matrix.T)  # fmt: skip
    if "attitude" in corrections:
        reference = reference._replace(angles=convert_angles(corrections["attitude"], reference.angles))  # fmt: skip
    level = corrections.get("level_axes", {})
    if "reference" in level:
        turn = axes_matrix("reference", level["reference"], is_level=True).T
        reference = reference._replace(velocity=reference.velocity @ turn, position=reference.position @ turn)  # fmt: skip
    if "gnss" in level:
        fixes = fixes._replace(
            position=fixes.position @ axes_matrix("gnss", level["gnss"], is_level=True).T
        )
    return log._replace(imu=imu, reference=reference, fixes=fixes)


def _find_mounting(aligned: Alignment, windows: ForceWindows) -> Array:
    """Return the body axes, to the true ones, that fit the force best among those that fit the rate."""
    true, measured = aligned.pair
    residuals = np.array([float(((measured - true @ m.T) ** 2).sum()) for m in BODY_ORDERS])
    accepted = np.flatnonzero(residuals < _EQUAL * residuals.min())
    axes = (BODY_ORDERS[i].T for i in accepted)
    return min(axes, key=lambda matrix: fit_force(windows, matrix).cost)


def _join(axes: Array) -> str:
    return f"[{', '.join(name_axes(axes))}]"


def _force_picture(windows: ForceWindows) -> Picture:
    """Draw the horizontal acceleration that the force gives, and that of the reference."""
    predicted = np.einsum("nijj->ni", windows.products)
    axis = int(np.argmax(np.square(windows.change[:, :2]).mean(0)))
    curves = (("reference", windows.change), ("imu", predicted))
    return Picture(
        "t [s]",
        f"acceleration {('North', 'East')[axis]} [m/s^2]",
        tuple(thin_curve(label, windows.time, values[:, axis]) for label, values in curves),
    )


def _check_force_delay(aligned: Alignment, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check that force and rate of the IMU have one clock, in the first minutes of a long log."""
    log, time = aligned.log, aligned.log.reference.time
    first = time <= time[0] + _DELAY_S
    start = log._replace(reference=RawReference(*take_rows(log.reference, first)))
    delayed = {float(delay): integrate_force(start, aligned.dcm[first], aligned.offset + delay) for delay in _DELAYS}  # fmt: skip
    costs = {delay: fit_force(windows).cost for delay, windows in delayed.items() if windows}
    best = min(costs, key=lambda delay: costs[delay], default=0.0)
    ratio = costs.get(0.0, 0.0) / max(costs.get(best, 0.0), 1e-12)
    facts["residual of the force over that of a delayed one"] = ratio
    if ratio > limit_of("force clock"):
        late, name = "late" if best > 0.0 else "early", log.names[0]
        yield Finding(
            "force clock", WARN, ratio, limit_of("force clock"), "times the least residual",
            f"{name}: fx, fy, fz are about {abs(best):.2f} s {late} against wx, wy, wz, whose turns agree with {log.names[2]}",
            "Join force and rate of one time in a row: no key moves the force alone",
            explanations=("a filter of the force", "columns of two messages", f"velocities of {log.names[2]} that are delayed"),
            picture=_force_picture(cast("ForceWindows", delayed[0.0])),
        )  # fmt: skip


def _check_force_errors(
    aligned: Alignment, windows: ForceWindows, fit: ForceFit, facts: dict[str, Any]
) -> Iterator[Finding]:
    """Check scale and bias of the force, which are not judged where the bias changes."""
    name, _, truth = aligned.log.names
    facts["rest of the force"] = float(np.sqrt(np.square(fit.residual[fit.keep]).sum(1).mean()))
    is_slow = facts.get("imu rate", np.inf) < limit_of("imu rate")  # motion between samples is lost
    change = None if is_slow else _find_force_change(windows, fit)
    if change:
        yield Finding(
            "accelerometer bias drift", WARN, change[1], limit_of("accelerometer bias drift"), "m/s^2",
            f"{name}: the bias of f{'xyz'[change[0]]} {change[2]}",
            "Record again, or use the part without the change: a correction is one number for the whole log",
            explanations=("a sensor that warms up or was hit", "a saturated axis", "an attitude that changes"),
            picture=_force_picture(windows),
        )  # fmt: skip
        return
    measured = np.linalg.norm(np.einsum("nijj->ni", windows.products), axis=1)
    needed = np.linalg.norm(windows.change - windows.gravity * DOWN, axis=1)
    scale = float(np.median(measured / np.maximum(needed, 1e-9)))
    bias, memory = -fit.bias, correlate_neighbours(fit.residual[fit.keep])
    a = windows.rotation[fit.keep].reshape(-1, 3)
    variance = np.diag(np.linalg.inv(a.T @ a + 1e-9 * np.eye(3))) * fit.residual[fit.keep].var()
    error = np.sqrt(variance * (1.0 + memory) / (1.0 - memory))
    facts.update({"force scale": scale, "accelerometer bias [m/s^2]": bias.round(3).tolist()})
    if abs(scale - 1.0) > limit_of("force scale") and windows.gravity:
        yield Finding(
            "force scale", WARN, scale - 1.0, limit_of("force scale"), "1",
            f"{name}: fx, fy, fz are {scale:.3f} times the force that {truth} and gravity need",
            "Set scenario.corrections.scale, or correct the scale factor",
            {"corrections": {"scale": {"imu": dict.fromkeys(("fx", "fy", "fz"), round(1.0 / scale, 5))}}},
            ("a scale factor", "another gravity", f"an accelerometer bias of {bias.round(2).tolist()} m/s^2"),
            _force_picture(windows),
        )  # fmt: skip
    elif (
        np.linalg.norm(bias) > limit_of("accelerometer bias")
        and (np.abs(bias) > STANDARD_ERRORS * error).any()
    ):
        yield Finding(
            "accelerometer bias", WARN, float(np.linalg.norm(bias)), limit_of("accelerometer bias"), "m/s^2",
            f"{name}: accelerometer bias {bias.round(2).tolist()} m/s^2, forward, right, down, within "
            f"{(2.0 * error).round(2).tolist()}",
            "Set scenario.corrections.bias, or the nominal bias scenario.tuning.accelerometer_bias",
            # more than half of gravity is not a bias: subtracting it would hide other axes
            {"corrections": {"bias": {"imu": _by_column("f", bias)}}} if np.linalg.norm(bias) < 5.0 else {},
            ("a bias", "an attitude of the sensor that differs from that of the reference"), _force_picture(windows),
        )  # fmt: skip


def _find_force_change(windows: ForceWindows, fit: ForceFit) -> tuple[int, float, str] | None:
    """Find a change of the bias of the force that clean logs do not show."""
    body = np.einsum("nji,nj->ni", windows.rotation, fit.residual)
    change = find_change(windows.time, -body, _FEWEST_FORCE, "m/s^2")
    return change if change and change[1] > limit_of("accelerometer bias drift") else None


def _by_column(letter: str, values: Array) -> dict[str, float]:
    return {f"{letter}{axis}": round(float(v), 5) for axis, v in zip("xyz", values, strict=True)}


def _check_rate_errors(aligned: Alignment, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check bias and scale of the rate by the turns of windows, to second order."""
    measured, true, window, time = _compare_turns(aligned)
    if len(measured) <= _FEWEST:
        return
    name, scales = aligned.log.names[0], list(_find_rate_scales(measured, true, window))
    facts["gyro scale"] = {f"w{axis}": round(scale, 4) for axis, scale, _ in scales}
    wrong = [
        (axis, scale, error)
        for axis, scale, error in scales
        if abs(scale - 1.0) > max(limit_of("gyro scale"), _SCALE_ERRORS * error)
    ]
    factors = _scale_all(scales, {axis: scale for axis, scale, _ in wrong})
    rates = np.rad2deg((measured / [*factors.values()] - true) / window)  # a scale, not a bias
    bias = np.median(rates, 0)
    facts["rest of the rate"] = float(np.sqrt(np.square(rates - bias).sum(1).mean()))
    facts["gyro bias [deg/s]"] = bias.round(4).tolist()
    axis = int(np.argmax(np.abs(bias)))
    picture = Picture(
        "t [s]", f"rate of imu minus reference about {'xyz'[axis]} [deg/s]",
        (thin_curve("difference", time, rates[:, axis]),),
    )  # fmt: skip
    change = find_change(time, rates, _FEWEST_RATE, "deg/s")
    facts["change of the gyro bias [deg/s]"] = round(change[1], 3) if change else 0.0
    if change and change[1] > limit_of("gyro bias drift"):
        yield Finding(
            "gyro bias drift", WARN, change[1], limit_of("gyro bias drift"), "deg/s",
            f"{name}: the bias of w{'xyz'[change[0]]} {change[2]}",
            "Let the sensor warm up, or record in shorter parts: a correction of the bias is one number for the whole log",
            explanations=("a sensor that warms up", "a reference whose attitude drifts"),
            picture=picture._replace(ylabel=f"rate of imu minus reference about {'xyz'[change[0]]} [deg/s]",
                                     curves=(thin_curve("difference", time, rates[:, change[0]]),)),
        )  # fmt: skip
    elif abs(bias[axis]) > limit_of("gyro bias"):
        yield Finding(
            "gyro bias", WARN, float(bias[axis]), limit_of("gyro bias"), "deg/s",
            f"{name}: gyro bias {bias.round(2).tolist()} deg/s, forward, right, down",
            "Set scenario.corrections.bias, or the nominal bias scenario.tuning.gyro_bias_deg_s",
            {"corrections": {"bias": {"imu": _by_column("w", np.deg2rad(bias))}}}, picture=picture,
        )  # fmt: skip
    yield from _check_attitude_jump(aligned.log.names[2], rates - bias, time, window)
    if wrong:
        axis_name, scale, error = max(wrong, key=lambda entry: abs(entry[1] - 1.0))
        texts = ", ".join(f"w{a} {s:.3f}" for a, s, _ in wrong)
        yield Finding(
            "gyro scale", WARN, scale - 1.0, limit_of("gyro scale"), "1",
            f"{name}: scale factors against {aligned.log.names[2]}: {texts}, within {2.0 * error:.3f}",
            "Set scenario.corrections.scale, or correct the scale factors",
            {"corrections": {"scale": {"imu": {f"w{a}": round(1.0 / s, 5) for a, s in factors.items() if s != 1.0}}}},
            ("scale factors of the gyroscope", "a reference that smooths its turns"),
            Picture(f"turn of the reference about {axis_name} [rad]", "turn of the imu [rad]",
                    (thin_curve("windows", true[:, "xyz".index(axis_name)], measured[:, "xyz".index(axis_name)]),)),
        )  # fmt: skip


def _scale_all(scales: list[tuple[str, float, float]], wrong: dict[str, float]) -> dict[str, float]:
    """Return the scale of each axis, 1 for a right one; one that is not clear has that of two which agree, if it is nearer."""
    values, clear = [*wrong.values()], {axis: scale for axis, scale, _ in scales}
    common = float(np.mean(values)) if len(values) > 1 and np.ptp(values) < _SCALE_ERROR else 1.0
    return {
        axis: wrong.get(axis, min(1.0, common, key=lambda s: abs(s - clear.get(axis, common))))
        for axis in "xyz"
    }


def _check_attitude_jump(name: str, rates: Array, time: Array, window: float) -> Iterator[Finding]:
    """Check for one window in which the attitude turns and the gyro does not."""
    sizes = window * np.linalg.norm(rates, axis=1)
    i, second = int(sizes.argmax()), float(np.partition(sizes, -2)[-2])
    if sizes[i] > max(limit_of("attitude jump"), _ALONE * second):
        yield Finding(
            "attitude jump", WARN, float(sizes[i]), limit_of("attitude jump"), "deg",
            f"{name}: roll, pitch, yaw jump by {np.round(-window * rates[i], 1).tolist()} deg, forward, right, down, near "
            f"t = {time[i]:.1f}, and the gyroscope does not turn",
            "Use the part before or after it: no correction has two frames",
            explanations=("a filter that starts anew", "a heading that is set"),
            picture=Picture("t [s]", "turn of imu minus reference [deg]", (thin_curve("windows", time, sizes),), (float(time[i]),)),
        )  # fmt: skip


def _compare_turns(aligned: Alignment) -> tuple[Array, Array, float, Array]:
    """Return turns of the IMU, with coning to second order, and of the reference, rad, [p, 3], window, s, and times."""
    search: TurnSearch = aligned.search
    at = search.nodes + aligned.offset
    used = (at[:-1] >= search.time[0]) & (at[1:] <= search.time[-1]) & search.usable
    used &= ~_find_holes(aligned.log.imu, at)
    middle = 0.5 * (search.angle[1:] + search.angle[:-1])
    cone = np.vstack([np.zeros(3), np.cumsum(np.cross(middle, np.diff(search.angle, axis=0)), 0)])
    angle, sums = (interpolate_columns(at, search.time, a) for a in (search.angle, cone))
    step = np.diff(angle, axis=0)
    measured = step + 0.5 * (np.diff(sums, axis=0) - np.cross(angle[:-1], step))
    true = turns_between(aligned.dcm, aligned.nodes)
    return measured[used], true[used], float(np.median(np.diff(at))), search.nodes[:-1][used]


def _find_holes(imu: RawImu, at: Array) -> NDArray[np.bool_]:
    """Find the windows between times [m + 1] in which no new sample came for a while: gaps and held values, [m]."""
    is_new = np.r_[True, (np.diff(np.hstack([imu.force, imu.rate]), axis=0) != 0.0).any(1)]
    time = np.append(imu.time[is_new], imu.time[-1])
    step = np.diff(time)
    holes = np.flatnonzero(step > max(limit_of("imu gap"), 3.0 * float(np.median(step))))
    return np.asarray(((at[1:, None] > time[holes]) & (at[:-1, None] < time[holes + 1])).any(1))


def _find_rate_scales(measured: Array, true: Array, window: float) -> Iterator[tuple[str, float, float]]:  # fmt: skip
    """Yield axis, scale and standard error where the motion shows a scale."""
    a = np.column_stack([true, np.ones(len(true))])
    fit = np.linalg.lstsq(a, measured, rcond=None)[0]
    rest = measured - a @ fit
    inverse = np.linalg.pinv(a.T @ a)
    motion = np.sqrt(np.square(true - true.mean(0)).mean(0)) / window
    for j, axis in enumerate("xyz"):
        memory = min(correlate_neighbours(rest[:, j : j + 1]), 0.95)
        error = np.sqrt(inverse[j, j] * rest[:, j].var() * (1.0 + memory) / (1.0 - memory))
        if motion[j] > _LEAST_RATE and error < _SCALE_ERROR:
            yield axis, float(fit[j, j]), float(error)
