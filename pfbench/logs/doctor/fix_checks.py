"""Checks of fixes against the reference: axes, time offset, lever arm, shift, outliers, frozen fixes and codes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pfbench.files.table_file import Array
from pfbench.logs.doctor.axis_orders import BODY_ORDERS, name_axes
from pfbench.logs.doctor.finding import (
    REFUSE,
    TELL,
    WARN,
    Finding,
    Picture,
    describe_change,
    thin_curve,
)
from pfbench.logs.doctor.raw_log import RawLog, correlate_neighbours, dcm_of, interpolate_columns
from pfbench.logs.doctor.thresholds import (
    LEAST_OUTLIER,
    REFUSED_OFFSET,
    STANDARD_ERRORS,
    limit_of,
)
from pfbench.logs.units import find_units

_Mask = NDArray[np.bool_]
_MOST, _FEWEST, _LEAST_SHARE = 400, 12, 0.4  # compared fixes
_COARSE = np.unique(np.round(np.r_[np.arange(-25.0, 25.0, 0.5), np.arange(-1.5, 1.5, 0.1)], 3))
_GAIN = 0.8  # of the spread that an offset must leave at most
_CLIP, _MARGIN = 30.0, 12.0  # m of an increment, and variances of the noise
_NEIGHBOURS = 10  # fixes on each side of a local level
_MOST_OUTLIERS = 0.05  # share of fixes
_AXES = ("North", "East", "Down")
_FRAME = 0.3  # part of the distances that a turn or a unit may leave
_BLOCK_S, _FEWEST_OF_BLOCK = 10.0, 5  # s and fixes of a block
_REACH = 2.5  # median steps of the reference: longer ones are gaps


class FixErrors(NamedTuple):
    """Fixes against the reference at a time offset.

    Attributes:
        offset: Delay of the fixes that is used, s.
        error: Fix minus reference, m, [m, 3].
        inside: Fixes in the time of the reference, [m].
    """

    offset: float
    error: Array
    inside: _Mask


class JointFit(NamedTuple):
    """Fit of lever arm, time offset and constant shift, with standard errors.

    Attributes:
        lever: Lever arm, forward, right, down, m, [3].
        lever_error: Its standard errors, m, [3].
        offset: Delay of the fixes, s.
        offset_error: Its standard error, s.
        shift: Constant shift, m, [3].
        deviation: Standard deviation of the fixes, m, [3].
    """

    lever: Array
    lever_error: Array
    offset: float
    offset_error: float
    shift: Array
    deviation: Array


def check_fixes(log: RawLog, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check the fixes."""
    yield from check_codes(log)
    if len(log.fixes.time) < _FEWEST:
        return
    frame = list(_check_frame(log, facts))
    yield from frame
    if frame:
        return
    errors = _find_coarse_offset(log)
    errors = _prefer_axes(log, errors) if errors.offset else errors
    yield from _check_common_time(log, errors)
    if errors.inside.sum() < _FEWEST:
        return
    axes = list(_check_axes(log, errors, facts))
    yield from axes
    if axes:
        return
    jumps = find_jumps(errors.error, errors.inside)
    yield from _check_outliers(log, errors, jumps, facts)
    yield from _check_frozen(log, errors, facts)
    yield from _check_joint(log, errors, jumps.mask, facts)


def check_codes(log: RawLog) -> Iterator[Finding]:
    """Check that the column `fix` has the codes 0 and 1, if no program is stated."""
    if log.codes is None:
        return
    share = float((log.codes == 1).mean())
    numbers = {int(code) for code in np.unique(log.codes)}
    if share >= limit_of("fix codes") or not numbers - {0, 1}:
        return
    is_nmea = bool(numbers & {4, 5}) and numbers <= {
        0,
        1,
        2,
        4,
        5,
    }  # 3 and 6 are other things elsewhere
    name = log.names[1]
    causes = ("quality of NMEA: 4 RTK fixed, 5 RTK float", "quality of RTKLIB: 4 differential, 5 single")  # fmt: skip
    yield Finding(
        "fix codes", WARN, share, limit_of("fix codes"), "share of fixes",
        f"{name}: only {share:.0%} of the fixes have fix = 1, the codes are {sorted(numbers)}",
        "Set scenario.fix_codes to the program that wrote the column, or to the codes to use",
        {"fix_codes": "nmea"} if is_nmea else {}, causes if is_nmea else (),
        Picture("row", "fix", (thin_curve(name, np.arange(len(log.codes)), log.codes),)),
    )  # fmt: skip


def reference_at(log: RawLog, at: Array) -> Array:
    """Interpolate the position of the reference, m, [m, 3]. Shapes: at [m]."""
    return interpolate_columns(at, log.reference.time, log.reference.position)


def _compare(log: RawLog, offset: float) -> FixErrors:
    """Compare the fixes with the reference at an offset."""
    at, time = log.fixes.time - offset, log.reference.time
    inside = (at >= time[0]) & (at <= time[-1])
    return FixErrors(offset, log.fixes.position - reference_at(log, at), inside)


def _check_frame(log: RawLog, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check that the fixes are not turned about the vertical, or in another unit, against the reference.

    A turn or a factor explains them if it leaves a small part of the distances that remain after a shift.
    """
    plain = _compare(log, 0.0)
    used = np.flatnonzero(plain.inside)
    if len(used) < _FEWEST:
        return
    for _ in range(3):
        fixes, error = (a[used, :2] @ [1.0, 1j] for a in (log.fixes.position, plain.error))
        measured, expected = (z - z.mean() for z in (fixes, fixes - error))
        factor = np.vdot(expected, measured) / max(np.vdot(expected, expected).real, 1e-9)
        rest = np.abs(measured - factor * expected)
        keep = rest <= 4.0 * np.median(rest) + 1e-9
        before = float(np.sqrt(np.square(np.abs(measured - expected)[keep]).mean()))
        after, used = float(np.sqrt(np.square(rest[keep]).mean())), used[keep]
    scale, turn = float(np.abs(factor)), float(np.rad2deg(np.angle(factor)))
    facts["turn and scale of fixes"] = [round(turn, 3), round(scale, 4)]
    quarter = abs((turn + 45.0) % 90.0 - 45.0)  # orders of axes have their own check
    is_turned, is_scaled = quarter > limit_of("fix turn"), abs(scale - 1.0) > limit_of("fix scale")
    if after > _FRAME * before or before < limit_of("fix shift") * _FRAME:
        return
    name, units = log.names[1], find_units("length", scale, limit_of("fix scale"))
    picture = Picture("North [m]", "East [m]", tuple(
        thin_curve(label, z.real, z.imag) for label, z in ((name, measured), (log.names[2], expected))
    ))  # fmt: skip
    unit, value = next(iter(units.items()), ("another unit or map", 1.0 / scale))
    if is_scaled:
        yield Finding(
            "fix scale", REFUSE, scale - 1.0, limit_of("fix scale"), "1",
            f"{name}: the fixes move {scale:.4g} times as far as {log.names[2]}: {'they are in ' + unit if units else unit}",
            f"Multiply pn, pe, pd by {value:.7g}, or set scenario.corrections.scale",
            {"corrections": {"scale": {"gnss": dict.fromkeys(("pn", "pe", "pd"), value)}}}, picture=picture,
        )  # fmt: skip
    if is_turned:
        yield Finding(
            "fix turn", REFUSE, turn, limit_of("fix turn"), "deg",
            f"{name}: North and East of the fixes are turned by {turn:.2f} deg against those of {log.names[2]}",
            f"Use the same grid in both, or set +scenario.corrections.level_axes.gnss=[{turn:.3f}]",
            {"corrections": {"level_axes": {"gnss": [round(turn, 3)]}}},
            ("grid North in place of true or magnetic North",), picture,
        )  # fmt: skip


def _check_slow(log: RawLog, at: Array, rest: Array, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check for errors of the fixes that last: blocks of ten seconds far from the others."""
    block = np.floor((at - at[0]) / _BLOCK_S).astype(int)
    counts, sums = np.bincount(block), [np.bincount(block, axis) for axis in rest.T[:2]]
    full = counts >= _FEWEST_OF_BLOCK
    means: Array = np.stack(sums, -1)[full] / counts[full, None]
    if len(means) < 2:
        return
    size = np.linalg.norm(means - np.median(means, 0), axis=1)
    noise = float(np.linalg.norm(np.diff(rest[:, :2], axis=0).std(0))) / np.sqrt(
        2.0 * _FEWEST_OF_BLOCK
    )
    i, largest = int(size.argmax()), max(limit_of("slow errors"), STANDARD_ERRORS * noise)
    facts["slow error of fixes [m]"] = float(size[i])
    if size[i] > largest:
        start = float(at[0] + _BLOCK_S * np.flatnonzero(full)[i])
        yield Finding(
            "slow errors", WARN, float(size[i]), largest, "m",
            f"{log.names[1]}: the fixes are {size[i]:.1f} m off for {_BLOCK_S:g} s from t = {start:.1f}, beyond lever arm, "
            "offset and shift",
            "Nothing that was tried explains this: shift, turn, unit, axes, lever arm and clock",
            explanations=("reflections", "fixes that drift", f"a jump or another frame of {log.names[2]}"),
            picture=Picture("t [s]", "fix minus reference, horizontal [m]", (
                thin_curve(log.names[1], at, np.linalg.norm(rest[:, :2], axis=1)),
            ), (start,)),
        )  # fmt: skip


def _find_coarse_offset(log: RawLog) -> FixErrors:
    """Find the offset at which the fixes move as the reference, to 0.05 s; 0 if it gains little."""
    time, position = log.fixes.time, log.fixes.position
    used = np.linspace(0, len(time) - 1, min(len(time), _MOST)).astype(int)

    def spread(offset: float) -> float:
        at = time[used] - offset
        inside = (at >= log.reference.time[0]) & (at <= log.reference.time[-1])
        if inside.sum() < max(_FEWEST, _LEAST_SHARE * len(used)):
            return np.inf
        level = (position[used][inside] - reference_at(log, at[inside]))[:, :2]
        return float(np.median(np.linalg.norm(level - np.median(level, 0), axis=1)))

    spreads = np.array([spread(float(a)) for a in _COARSE])
    best, plain = float(_COARSE[spreads.argmin()]), spread(0.0)
    if not np.isfinite(spreads.min()) or spreads.min() > _GAIN * plain:
        return _compare(log, 0.0)
    fine = best + np.arange(-0.5, 0.501, 0.05)
    return _compare(log, float(fine[int(np.argmin([spread(float(a)) for a in fine]))]))


def _check_common_time(log: RawLog, errors: FixErrors) -> Iterator[Finding]:
    """Check that the tables have a time in common."""
    times = (log.imu.time, log.fixes.time, log.reference.time)
    common = float(min(t[-1] for t in times) - max(t[0] for t in times))
    if common >= limit_of("overlap") or errors.offset:
        return
    spans = ", ".join(
        f"{name} t = {t[0]:.1f} to {t[-1]:.1f}" for name, t in zip(log.names, times, strict=True)
    )
    yield Finding(
        "overlap", REFUSE, common, limit_of("overlap"), "s",
        f"the tables have {max(common, 0.0):.1f} s in common: {spans}",
        "Use the same clock in all tables", explanations=("different clocks", "parts of different drives"),
        picture=Picture("t [s]", "table", tuple(
            (name, np.array([t[0], t[-1]]), np.array([i, i])) for i, (name, t) in enumerate(zip(log.names, times, strict=True))
        )),
    )  # fmt: skip


class Increments(NamedTuple):
    """Motion over about two seconds.

    Attributes:
        measured: Motion of the fixes, m, [p, 3].
        true: Motion of the reference, m, [p, 3].
        time: Ends of the increments, s, [p].
        costs: Clipped squared differences with each order of axes, m^2, [48].
    """

    measured: Array
    true: Array
    time: Array
    costs: Array


def _compare_increments(log: RawLog, errors: FixErrors) -> Increments | None:
    """Compare the motion of fixes and reference for all orders of axes; None with few fixes."""
    time = log.fixes.time
    rows = np.flatnonzero(errors.inside)[:: max(1, round(2.0 / float(np.median(np.diff(time)))))]
    if len(rows) <= 9:
        return None
    measured = np.diff(log.fixes.position[rows], axis=0)
    true = np.diff(reference_at(log, time[rows] - errors.offset), axis=0)
    squares = (np.square(measured - true @ m.T).sum(1) for m in BODY_ORDERS)
    costs = np.array([float(np.minimum(square, _CLIP**2).sum()) for square in squares])
    return Increments(measured, true, time[rows][1:], costs)


def _prefer_axes(log: RawLog, late: FixErrors) -> FixErrors:
    """Return the comparison without an offset, if other axes explain the fixes better than the offset."""
    plain = _compare(log, 0.0)
    with_offset, without = (_compare_increments(log, errors) for errors in (late, plain))
    if without is None:
        return late
    with_offset = with_offset or without
    other_axes = float(without.costs.min()) / len(without.time)
    same_axes = float(with_offset.costs[0]) / len(with_offset.time)
    is_better = limit_of("fix axes") * other_axes < same_axes
    return plain if is_better else late


def _check_axes(log: RawLog, errors: FixErrors, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check the axes of the fixes by increments over two seconds."""
    increments = _compare_increments(log, errors)
    if increments is None:
        return
    measured, true, middle, costs = increments
    best = int(np.argmin(costs))
    noise = float(np.median(np.abs(np.diff(errors.error[errors.inside], axis=0))))
    ratio = costs[0] / max(costs[best], 1e-12) if costs[0] > 0.0 else 1.0
    facts["fix axes"] = min(ratio, 1e6)
    if costs[0] <= limit_of("fix axes") * costs[best] + _MARGIN * noise**2 or not best:
        return
    names = name_axes(BODY_ORDERS[best].T, is_level=True)
    change = np.abs(BODY_ORDERS[best] - np.eye(3)).sum(1)
    axis = int(np.argmax(change * np.square(true).sum(0)))
    yield Finding(
        "fix axes", REFUSE, ratio, limit_of("fix axes"), "times the least residual",
        f"{log.names[1]}: North, East, Down of {log.names[2]} are the columns {', '.join(names)} of the fixes",
        f"Correct order and signs, or set +scenario.corrections.level_axes.gnss=[{','.join(names)}]",
        {"corrections": {"level_axes": {"gnss": names}}},
        picture=Picture("t [s]", f"motion {_AXES[axis]} in two seconds [m]", (
            thin_curve(log.names[1], middle, measured[:, axis]),
            thin_curve(log.names[2], middle, true[:, axis]),
        )),
    )  # fmt: skip


# --------------------------------------------------------------------------------------------------
# Single wrong fixes and fixes that do not move.


class Jumps(NamedTuple):
    """Jumps of fixes there and back.

    Attributes:
        size: Smaller distance of each error to those of its neighbours, m, [m].
        level: Local level, m, [m].
        mask: Outliers, [m].
    """

    size: Array
    level: Array
    mask: _Mask


def find_jumps(error: Array, inside: _Mask) -> Jumps:
    """Find fixes that are far from both neighbours, compared with 21 fixes around.

    Args:
        error: Fix minus reference, m, [m, 3].
        inside: Fixes in the time of the reference, [m].

    Returns:
        Jumps.
    """
    size = np.zeros(len(error))
    step = np.linalg.norm(np.diff(error, axis=0), axis=1)
    size[1:-1] = np.minimum(step[:-1], step[1:])
    padded = np.pad(size, _NEIGHBOURS, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEIGHBOURS + 1)
    level = np.maximum(np.nanmedian(windows, 1), np.median(size[inside]) + 1e-3)
    mask = inside & (size > np.maximum(LEAST_OUTLIER, limit_of("fix outliers") * level))
    if mask.mean() > _MOST_OUTLIERS:  # another kind of error
        mask = np.zeros_like(mask)
    return Jumps(size, level, mask)


def _check_outliers(log: RawLog, errors: FixErrors, jumps: Jumps, facts: dict[str, Any]) -> Iterator[Finding]:  # fmt: skip
    """Check for single wrong fixes."""
    facts["jump of a fix"] = float((jumps.size / jumps.level)[errors.inside].max())
    if not jumps.mask.any():
        return
    i = int(np.argmax(np.where(jumps.mask, jumps.size, 0.0)))
    time = log.fixes.time
    yield Finding(
        "fix outliers", TELL, float(jumps.size[i] / jumps.level[i]), limit_of("fix outliers"), "times the level",
        f"{log.names[1]}: {int(jumps.mask.sum())} fixes jump there and back, the largest by {jumps.size[i]:.0f} m in "
        f"{log.row(1, i)} (t = {time[i]:.2f})",
        "Remove these rows, or set scenario.corrections.drop=[outliers]",
        {"corrections": {"drop": ["outliers"]}},
        picture=Picture("t [s]", "fix minus reference, horizontal [m]", (
            thin_curve(log.names[1], time[errors.inside], np.linalg.norm(errors.error[errors.inside, :2], axis=1)),
        ), (float(time[i]),)),
    )  # fmt: skip


def find_frozen(position: Array, motion: Array) -> _Mask:
    """Find fixes that equal the fix before while the reference moves.

    Args:
        position: Fixes, m, [m, 3].
        motion: Motion of the reference between fixes, m, [m - 1].

    Returns:
        Mask of repeated fixes, [m].
    """
    is_equal = (np.diff(position, axis=0) == 0.0).all(1)
    frozen = np.zeros(len(position), bool)
    edges = np.flatnonzero(np.diff(np.r_[False, is_equal, False].astype(int)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if motion[first:last].sum() > limit_of("frozen fixes"):
            frozen[first + 1 : last + 1] = True
    return frozen


def _check_frozen(log: RawLog, errors: FixErrors, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check for fixes that do not move."""
    time, position = log.fixes.time, log.fixes.position
    motion = np.linalg.norm(np.diff(reference_at(log, time - errors.offset), axis=0), axis=1)
    frozen = find_frozen(position, motion)
    distance = float(motion[frozen[1:]].sum())
    facts["frozen while moving [m]"] = distance
    if not frozen.any():
        return
    i = int(np.argmax(frozen))
    yield Finding(
        "frozen fixes", WARN, distance, limit_of("frozen fixes"), "m",
        f"{log.names[1]}: {int(frozen.sum())} fixes equal the one before while the reference moves {distance:.1f} m, "
        f"the first is {log.row(1, i)} (t = {time[i]:.2f})",
        "Remove these rows, or set scenario.corrections.drop=[frozen]",
        {"corrections": {"drop": ["frozen"]}},
        picture=Picture("t [s]", "fix minus reference, horizontal [m]", (
            thin_curve(log.names[1], time[errors.inside], np.linalg.norm(errors.error[errors.inside, :2], axis=1)),
        ), (float(time[i]),)),
    )  # fmt: skip


# --------------------------------------------------------------------------------------------------
# Lever arm, time offset and constant shift in one fit.


def _check_joint(log: RawLog, errors: FixErrors, outliers: _Mask, facts: dict[str, Any]) -> Iterator[Finding]:  # fmt: skip
    """Check lever arm, time offset and shift."""
    error, time = errors.error, log.reference.time
    off = np.linalg.norm(error - np.median(error[errors.inside], 0), axis=1)
    used = errors.inside & ~outliers & (off < 6.0 * np.median(off[errors.inside]) + 3.0)
    at = log.fixes.time - errors.offset
    used &= np.interp(at, 0.5 * (time[1:] + time[:-1]), np.diff(time)) < _REACH * np.median(
        np.diff(time)
    )
    if used.sum() < 20:
        return
    effects = _make_design(log, at)
    fit = _fit_jointly(error[used], effects[used])
    offset, error_of_offset = errors.offset + fit.offset, fit.offset_error
    middle = np.median(error[used], 0)
    facts.update(
        {
            "fix offset [s]": [round(offset, 4), round(error_of_offset, 4)],
            "lever arm [m]": [fit.lever.round(3).tolist(), fit.lever_error.round(3).tolist()],
            "fix shift [m]": middle.round(3).tolist(),
            "fix deviation [m]": fit.deviation.round(3).tolist(),
        }
    )
    is_late = abs(offset) > max(limit_of("gnss clock"), STANDARD_ERRORS * error_of_offset)
    if is_late:
        yield _describe_late(log, errors, offset, error_of_offset)
    large = np.abs(fit.lever) > np.maximum(limit_of("lever arm"), STANDARD_ERRORS * fit.lever_error)
    if large[:2].any():
        yield _describe_lever(log, fit, error, at)
    if np.abs(middle).max() > limit_of("fix shift"):
        yield _describe_shift(log, error, middle)
    lasting = errors.inside & ~outliers  # the fit leaves out fixes that are far off for a while
    rest = error - effects @ np.r_[fit.lever, fit.offset, fit.shift]
    yield from _check_slow(log, at[lasting], rest[lasting], facts)


def _make_design(log: RawLog, at: Array) -> Array:
    """Make the effects of lever arm, offset and shift on the fixes at times [m], [m, 3, 7]."""
    reference = log.reference
    dcm = dcm_of(reference.angles).reshape(-1, 9)
    a = np.zeros((len(at), 3, 7))
    a[:, :, :3] = interpolate_columns(at, reference.time, dcm).reshape(-1, 3, 3)
    a[:, :, 3] = -interpolate_columns(at, reference.time, reference.velocity)
    a[:, :, 4:] = np.eye(3)
    return a


def _fit_jointly(error: Array, a: Array) -> JointFit:
    """Fit lever arm, offset and shift by their effects [m, 3, 7] to differences [m, 3]."""
    deviation = 1.4826 * np.median(np.abs(error - np.median(error, 0)), 0) + 0.01
    regular = np.diag([1e-4] * 4 + [1e-6] * 3)
    for _ in range(4):
        scaled = (a / deviation[:, None]).reshape(-1, 7)
        information = scaled.T @ scaled + regular
        solution: Array = np.linalg.solve(
            information, scaled.T @ (error / deviation).reshape(-1)
        ).astype(float)
        rest = error - a @ solution
        deviation = rest.std(0) + 0.005
    memory = correlate_neighbours(rest)  # errors of receivers last longer than a fix
    variance = np.diag(np.linalg.inv(information)) * (1.0 + memory) / (1.0 - memory)
    sd = np.sqrt(variance)
    return JointFit(
        solution[:3],
        sd[:3],
        float(solution[3]),
        float(sd[3]),
        solution[4:],
        np.asarray(deviation),
    )


def _describe_late(log: RawLog, errors: FixErrors, offset: float, error: float) -> Finding:
    late = "late" if offset > 0.0 else "early"
    name, time = log.names[1], log.fixes.time
    leap = " (leap seconds between UTC and GPS time)" if abs(abs(offset) - 18.0) < 0.1 else ""
    plain = _compare(log, 0.0)
    return Finding(
        "gnss clock", REFUSE if abs(offset) > REFUSED_OFFSET else WARN, offset, limit_of("gnss clock"), "s",
        f"{name}: t is {abs(offset):.3f} s {late} against {log.names[2]}, within {2.0 * error:.3f} s{leap}",
        f"{describe_change(offset)}, or set +scenario.corrections.shift_s.gnss={offset:.3f}",
        {"corrections": {"shift_s": {"gnss": round(offset, 4)}}},
        ("a delay of the receiver", f"a delay of {log.names[2]} of the other sign"),
        Picture("t [s]", "fix minus reference, horizontal [m]", (
            thin_curve("as recorded", time[plain.inside], np.linalg.norm(plain.error[plain.inside, :2], axis=1)),
            thin_curve("with the offset", time[errors.inside], np.linalg.norm(errors.error[errors.inside, :2], axis=1)),
        )),
    )  # fmt: skip


def _describe_lever(log: RawLog, fit: JointFit, error: Array, at: Array) -> Finding:
    lever = [float(v) for v in fit.lever.round(3)]
    if fit.lever_error[2] > 0.3 * max(abs(lever[2]), limit_of("lever arm")):
        lever[2] = 0.0  # a vehicle that does not tilt does not show it
    dcm = dcm_of(log.reference.angles).reshape(-1, 9)
    body = np.einsum(
        "nji,nj->ni",
        interpolate_columns(at, log.reference.time, dcm).reshape(-1, 3, 3),
        error - fit.shift,
    )
    return Finding(
        "lever arm", TELL, float(np.abs(fit.lever[:2]).max()), limit_of("lever arm"), "m",
        f"{log.names[1]}: the antenna is {fit.lever.round(2).tolist()} m forward, right, down of the position of "
        f"{log.names[2]}, within {(2.0 * fit.lever_error).round(2).tolist()}",
        f"Set scenario.corrections.lever_arm={lever}", {"corrections": {"lever_arm": lever}},
        ("a lever arm of the antenna", "an offset of the point to which the reference refers"),
        Picture("t [s]", "fix minus reference in body axes [m]", (
            thin_curve("forward", log.fixes.time, body[:, 0]), thin_curve("right", log.fixes.time, body[:, 1]),
        )),
    )  # fmt: skip


def _describe_shift(log: RawLog, error: Array, middle: Array) -> Finding:
    axis = int(np.argmax(np.abs(middle)))
    shift = [float(v) for v in middle.round(3)]
    causes = ("heights above the geoid", "another datum", "a wrong position of the base station")
    return Finding(
        "fix shift", WARN, float(middle[axis]), limit_of("fix shift"), "m",
        f"{log.names[1]}: the fixes are shifted by {middle[axis]:+.1f} m {_AXES[axis]} against {log.names[2]}",
        f"Set scenario.corrections.offset_m={shift}", {"corrections": {"offset_m": shift}},
        causes if axis == 2 else causes[1:],
        Picture("t [s]", f"fix minus reference {_AXES[axis]} [m]", (thin_curve(log.names[1], log.fixes.time, error[:, axis]),)),
    )  # fmt: skip
