"""Checks of fixes against the reference: axes, time offset, lever arm, shift, outliers, frozen fixes and codes."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pfbench.files.table_file import Array
from pfbench.logs.doctor.axis_orders import BODY_ORDERS, name_axes
from pfbench.logs.doctor.bad_samples import list_stretches
from pfbench.logs.doctor.changes import describe_change_of
from pfbench.logs.doctor.finding import (
    REFUSE,
    TELL,
    WARN,
    Finding,
    Picture,
    describe_change,
    thin_curve,
)
from pfbench.logs.doctor.motion_search import MotionSearch, extent_of
from pfbench.logs.doctor.raw_log import (
    RawLog,
    correlate_neighbours,
    dcm_of,
    interpolate_columns,
    take_rows,
)
from pfbench.logs.doctor.thresholds import (
    LEAST_OUTLIER,
    REFUSED_OFFSET,
    STANDARD_ERRORS,
    limit_of,
)
from pfbench.logs.doctor.turn_search import remove_line
from pfbench.logs.units import find_units

_Mask = NDArray[np.bool_]
_FEWEST, _NEIGHBOURS = 12, 10  # compared fixes, and those on each side of a local level
_LATEST, _GAIN = (
    25.0,
    0.8,
)  # s, more than the leap seconds, and the part of the spread that an offset must leave at most
_GROUND = np.array([1.0, 1.0, 0.0])
_CLIP, _MARGIN = 30.0, 12.0  # m of an increment, and variances of the noise
_MOST_OUTLIERS, _HELD = (
    0.05,
    0.1,
)  # share of fixes, and of the limit: motion during other fixes of a receiver that freezes
_AXES = ("North", "East", "Down")
_FRAME, _LEAST_FRAME = (
    0.3,
    0.5,
)  # part of the distances that a turn or a unit may leave, and m of them
_BLOCK_S, _FEWEST_OF_BLOCK = 10.0, 5  # s and fixes of a block
_CLEAR, _REACH = (
    3.0,
    2.5,
)  # median deviations of a shift, and median steps of the reference: longer ones are gaps


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
    """Fit of the fixes.

    Attributes:
        solution: Lever arm forward, right, down, m; delay, s; shift, m; and what else is fitted, [7 or more].
        sd: Standard errors.
        deviation: Standard deviation of the fixes, m, [3].
    """

    solution: Array
    sd: Array
    deviation: Array


def check_fixes(log: RawLog, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check the fixes."""
    yield from check_codes(log)
    if len(log.fixes.time) < _FEWEST:
        return
    frame = list(check_frame(log, facts))
    yield from frame
    if frame:
        return
    errors = _find_coarse_offset(log)
    if errors.inside.sum() < _FEWEST:
        return
    axes = list(_check_axes(log, errors, facts))
    yield from axes
    if axes:
        return
    frozen = yield from _check_frozen(log, errors, facts)
    if frozen.any():  # which look late
        log = log._replace(fixes=take_rows(log.fixes, ~frozen))
        errors = _find_coarse_offset(log)
    outliers = yield from _check_outliers(log, errors, facts)
    yield from _check_joint(log, errors, outliers, facts)


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


def compare_at(log: RawLog, offset: float) -> FixErrors:
    """Compare the fixes with the reference at an offset."""
    at, time = log.fixes.time - offset, log.reference.time
    inside = (at >= time[0]) & (at <= time[-1])
    return FixErrors(offset, log.fixes.position - reference_at(log, at), inside)


def _fit_frame(log: RawLog, plain: FixErrors) -> tuple[complex, Array, Array, bool]:
    """Fit turn and scale of the fixes jointly with lever arm, offset and shift.

    Returns the factor, fixes and reference without means as complex numbers, and whether the factor explains the fixes, and
    no order of axes does.
    """
    used, error = plain.inside & ~find_jumps(plain.error, plain.inside)[2], plain.error[:, :2]
    true = log.fixes.position - plain.error
    path = true - true[used].mean(0)
    forms = np.stack([path * [1.0, 1.0, 0.0], path[:, [1, 0, 2]] * [-1.0, 1.0, 0.0]], -1)
    design = np.concatenate([_make_design(log, log.fixes.time), forms], -1)
    for _ in range(3):
        solution = _fit_jointly(plain.error[used], design[used]).solution
        rest = np.linalg.norm(error - (design @ solution)[:, :2], axis=1)
        used &= rest <= 4.0 * np.median(rest[used]) + 1e-9
    before, after, drifted = (
        float(np.sqrt(np.square(a).sum(-1).mean()))
        for a in (error[used] - error[used].mean(0), rest[used, None], remove_line(error[used]))
    )
    measured, expected = (a[used] - a[used].mean(0) for a in (log.fixes.position, true))
    ordered = min(float(np.sqrt(np.square((measured - expected @ m.T)[:, :2]).sum(1).mean())) for m in BODY_ORDERS)  # fmt: skip
    is_explained = after <= min(_FRAME * before, 2.0 * ordered, drifted) and before > _LEAST_FRAME
    if is_explained and (late := _find_coarse_offset(log)).offset:  # a clock can look like a frame
        is_explained = after <= extent_of(late.error[late.inside, :2])
    level = np.array([1.0, 1j])
    return complex(1.0 + solution[7], solution[8]), measured[:, :2] @ level, expected[:, :2] @ level, is_explained  # fmt: skip


def check_frame(log: RawLog, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check that the fixes are not turned about the vertical, or in another unit, against the reference.

    A turn or a factor explains them if it leaves a small part of the distances that remain after a shift.
    """
    plain = compare_at(log, 0.0)
    if plain.inside.sum() < _FEWEST:
        return
    factor, measured, expected, is_explained = _fit_frame(log, plain)
    scale, turn = float(np.abs(factor)), float(np.rad2deg(np.angle(factor)))
    facts["turn and scale of fixes"] = [round(turn, 3), round(scale, 4)]
    quarter = abs((turn + 45.0) % 90.0 - 45.0)  # orders of axes have their own check
    is_turned, is_scaled = quarter > limit_of("fix turn"), abs(scale - 1.0) > limit_of("fix scale")
    if not is_explained:
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
        starts = at[0] + _BLOCK_S * np.flatnonzero(full)
        start, axis = float(starts[i]), int(np.argmax(np.ptp(means, axis=0)))
        is_short = (size > 0.5 * size[i]).sum() < 2
        change = describe_change_of(np.append(starts, starts[-1] + _BLOCK_S), means[:, axis], "m")
        yield Finding(
            "slow errors", WARN, float(size[i]), largest, "m",
            f"{log.names[1]}: the fixes are {size[i]:.1f} m off for {_BLOCK_S:g} s from t = {start:.1f}, beyond lever arm, "
            f"offset and shift{'' if is_short else f': {_AXES[axis]} {change}'}",
            "Nothing that was tried explains this: shift, turn, unit, axes, lever arm and clock",
            explanations=("reflections", "fixes that drift", f"a jump or another frame of {log.names[2]}"),
            picture=Picture("t [s]", "fix minus reference, horizontal [m]", (
                thin_curve(log.names[1], at, np.linalg.norm(rest[:, :2], axis=1)),
            ), (start,)),
        )  # fmt: skip


def _find_coarse_offset(log: RawLog) -> FixErrors:
    """Find the offset at which the fixes move over the ground as the reference; 0 if it gains little."""
    fixes, reference = log.fixes, log.reference
    motion = MotionSearch(fixes.time, fixes.position * _GROUND, reference.time, lambda at: reference_at(log, at) * _GROUND)  # fmt: skip
    spread, shift = motion.search(-_LATEST, _LATEST)
    late = compare_at(
        log, -shift if np.isfinite(spread) and spread <= _GAIN * motion.spread(0.0) else 0.0
    )
    return _prefer_axes(log, late) if late.offset else late


def _compare_increments(log: RawLog, errors: FixErrors) -> tuple[Array, Array, Array, Array] | None:
    """Compare the motion of fixes and reference over about two seconds for all orders of axes; None with few fixes.

    Returns the motion of both, m, [p, 3], the ends, s, [p], and the clipped squared differences of each order, m^2, [48].
    """
    time = log.fixes.time
    rows = np.flatnonzero(errors.inside)[:: max(1, round(2.0 / float(np.median(np.diff(time)))))]
    if len(rows) <= 9:
        return None
    measured = np.diff(log.fixes.position[rows], axis=0)
    true = np.diff(reference_at(log, time[rows] - errors.offset), axis=0)
    squares = (np.square(measured - true @ m.T).sum(1) for m in BODY_ORDERS)
    costs = np.array([float(np.minimum(square, _CLIP**2).sum()) for square in squares])
    return measured, true, time[rows][1:], costs


def _prefer_axes(log: RawLog, late: FixErrors) -> FixErrors:
    """Return the comparison without an offset, if other axes explain the fixes better than the offset."""
    plain = compare_at(log, 0.0)
    with_offset, without = (_compare_increments(log, errors) for errors in (late, plain))
    if without is None:
        return late
    with_offset = with_offset or without
    other_axes = float(without[3].min()) / len(without[2])
    same_axes = float(with_offset[3][0]) / len(with_offset[2])
    return plain if limit_of("fix axes") * other_axes < same_axes else late


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


def find_jumps(error: Array, inside: _Mask) -> tuple[Array, Array, _Mask]:
    """Find fixes that are far from both neighbours, compared with 21 fixes around.

    Args:
        error: Fix minus reference, m, [m, 3].
        inside: Fixes in the time of the reference, [m].

    Returns:
        Smaller distance of each error to those of its neighbours, and local level, m, [m]; mask of the outliers, [m].
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
    return size, level, mask


def _check_outliers(log: RawLog, errors: FixErrors, facts: dict[str, Any]) -> Generator[Finding, None, _Mask]:  # fmt: skip
    """Check for single wrong fixes; return their mask, [m]."""
    (size, level, wrong), time = find_jumps(errors.error, errors.inside), log.fixes.time
    facts["jump of a fix"] = float((size / level)[errors.inside].max())
    if wrong.any():
        i = int(np.argmax(np.where(wrong, size, 0.0)))
        yield Finding(
            "fix outliers", TELL, float(size[i] / level[i]), limit_of("fix outliers"), "times the level",
            f"{log.names[1]}: {int(wrong.sum())} fixes jump there and back, the largest by {size[i]:.0f} m in "
            f"{log.row(1, i)} (t = {time[i]:.2f})",
            "Remove these rows, or set scenario.corrections.drop=[outliers]",
            {"corrections": {"drop": ["outliers"]}},
            picture=Picture("t [s]", "fix minus reference, horizontal [m]", (
                thin_curve(log.names[1], time[errors.inside], np.linalg.norm(errors.error[errors.inside, :2], axis=1)),
            ), (float(time[i]),)),
        )  # fmt: skip
    return wrong


def find_frozen(position: Array, motion: Array) -> _Mask:
    """Find fixes that equal the fix before while the reference moves.

    Args:
        position: Fixes, m, [m, 3].
        motion: Motion of the reference between fixes, m, [m - 1].

    Returns:
        Mask of repeated fixes, [m].
    """
    stretches = list_stretches((np.diff(position, axis=0) == 0.0).all(1))
    runs = [(first, last, motion[first:last].sum()) for first, last in stretches.tolist()]
    largest = max((distance for _, _, distance in runs), default=0.0)
    frozen = np.zeros(len(position), bool)
    for first, last, distance in runs if largest > limit_of("frozen fixes") else ():
        frozen[first + 1 : last + 1] = distance > _HELD * limit_of(
            "frozen fixes"
        )  # slower ones, too
    return frozen


def _check_frozen(
    log: RawLog, errors: FixErrors, facts: dict[str, Any]
) -> Generator[Finding, None, _Mask]:
    """Check for fixes that do not move; return their mask, [m]."""
    time, position = log.fixes.time, log.fixes.position
    motion = np.linalg.norm(np.diff(reference_at(log, time - errors.offset), axis=0), axis=1)
    frozen = find_frozen(position, motion)
    distance = float(motion[frozen[1:]].sum())
    facts["frozen while moving [m]"] = distance
    if frozen.any():
        i = int(np.argmax(frozen))
        yield Finding(
            "frozen fixes", WARN, distance, limit_of("frozen fixes"), "m",
            f"{log.names[1]}: {int(frozen.sum())} fixes equal the one before while the reference moves {distance:.1f} m, "
            f"the first is {log.row(1, i)} (t = {time[i]:.2f})",
            "Remove these rows, or set scenario.corrections.drop=[frozen]",
            {"corrections": {"drop": ["frozen"]}},
            picture=Picture("t [s]", "fix North [m]", (thin_curve(log.names[1], time, position[:, 0]),), (float(time[i]),)),
        )  # fmt: skip
    return frozen


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
    lever, lever_error = fit.solution[:3], fit.sd[:3]
    offset, error_of_offset = errors.offset + float(fit.solution[3]), float(fit.sd[3])
    middle = np.median(error[used], 0)
    facts.update(
        {
            "fix offset [s]": [round(offset, 4), round(error_of_offset, 4)],
            "lever arm [m]": [lever.round(3).tolist(), lever_error.round(3).tolist()],
            "fix shift [m]": middle.round(3).tolist(),
            "fix deviation [m]": fit.deviation.round(3).tolist(),
        }
    )
    is_late = abs(offset) > max(limit_of("gnss clock"), STANDARD_ERRORS * error_of_offset)
    if is_late:
        yield _describe_late(log, errors, offset, error_of_offset)
    large = np.abs(lever) > np.maximum(limit_of("lever arm"), STANDARD_ERRORS * lever_error)
    if large[:2].any():
        yield _describe_lever(log, fit, error, at)
    yield from check_shift(log, error, used)
    lasting = errors.inside & ~outliers  # the fit leaves out fixes that are far off for a while
    rest = error - effects @ fit.solution
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
    """Fit lever arm, offset, shift and other effects, [m, 3, 7 or more], to differences, [m, 3]."""
    deviation = 1.4826 * np.median(np.abs(error - np.median(error, 0)), 0) + 0.01
    regular = np.diag([1e-4] * 4 + [1e-6] * (a.shape[-1] - 4))
    for _ in range(4):
        scaled = (a / deviation[:, None]).reshape(-1, a.shape[-1])
        information = scaled.T @ scaled + regular
        solution: Array = np.linalg.solve(
            information, scaled.T @ (error / deviation).reshape(-1)
        ).astype(float)
        rest = error - a @ solution
        deviation = rest.std(0) + 0.005
    memory = correlate_neighbours(rest)  # errors of receivers last longer than a fix
    variance = np.diag(np.linalg.inv(information)) * (1.0 + memory) / (1.0 - memory)
    return JointFit(solution, np.sqrt(variance), np.asarray(deviation))


def _describe_late(log: RawLog, errors: FixErrors, offset: float, error: float) -> Finding:
    late, name, time = "late" if offset > 0.0 else "early", log.names[1], log.fixes.time
    leap, plain = (
        " (leap seconds between UTC and GPS time)" if abs(abs(offset) - 18.0) < 0.1 else "",
        compare_at(log, 0.0),
    )
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
    lever, lever_error = fit.solution[:3], fit.sd[:3]
    arm = [float(v) for v in lever.round(3)]
    if lever_error[2] > 0.3 * max(abs(arm[2]), limit_of("lever arm")):
        arm[2] = 0.0  # a vehicle that does not tilt does not show it
    dcm = dcm_of(log.reference.angles).reshape(-1, 9)
    body = np.einsum(
        "nji,nj->ni",
        interpolate_columns(at, log.reference.time, dcm).reshape(-1, 3, 3),
        error - fit.solution[4:],
    )
    return Finding(
        "lever arm", TELL, float(np.abs(lever[:2]).max()), limit_of("lever arm"), "m",
        f"{log.names[1]}: the antenna is {lever.round(2).tolist()} m forward, right, down of the position of "
        f"{log.names[2]}, within {(2.0 * lever_error).round(2).tolist()}",
        f"Set scenario.corrections.lever_arm={arm}{'' if arm[2] else '. The motion does not show it downwards: measure it'}", {"corrections": {"lever_arm": arm}},
        ("a lever arm of the antenna", "an offset of the point to which the reference refers"),
        Picture("t [s]", "fix minus reference in body axes [m]", (
            thin_curve("forward", log.fixes.time, body[:, 0]), thin_curve("right", log.fixes.time, body[:, 1]),
        )),
    )  # fmt: skip


def check_shift(log: RawLog, error: Array, used: _Mask) -> Iterator[Finding]:
    """Check for a constant shift of the fixes against the reference, by their differences [m, 3]."""
    middle = np.median(error[used], 0)
    scatter = np.median(np.abs(error[used] - middle), 0)
    clear = np.where(np.abs(middle) > _CLEAR * scatter, np.abs(middle), 0.0)
    axis, shift = int(np.argmax(clear)), [float(v) for v in middle.round(3)]
    causes = ("heights above the geoid", "another datum", "a wrong position of the base station")
    if clear[axis] > limit_of("fix shift"):
        yield Finding(
            "fix shift", WARN, float(middle[axis]), limit_of("fix shift"), "m",
            f"{log.names[1]}: the fixes are shifted by {middle[axis]:+.1f} m {_AXES[axis]} against {log.names[2]}",
            f"Set scenario.corrections.offset_m={shift}", {"corrections": {"offset_m": shift}},
            causes if axis == 2 else causes[1:],
            Picture("t [s]", f"fix minus reference {_AXES[axis]} [m]", (thin_curve(log.names[1], log.fixes.time, error[:, axis]),)),
        )  # fmt: skip
