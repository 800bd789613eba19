"""Alignment of IMU and reference by their turns: unit of the attitude, time offset, its drift, unit and axes of the rate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pfbench.files.table_file import Array
from pfbench.logs.doctor.axis_orders import BODY_ORDERS
from pfbench.logs.doctor.finding import (
    REFUSE,
    WARN,
    Finding,
    Picture,
    describe_change,
    thin_curve,
)
from pfbench.logs.doctor.force_windows import fit_force, integrate_force
from pfbench.logs.doctor.raw_log import RawLog, dcm_of, interpolate_columns
from pfbench.logs.doctor.thresholds import REFUSED_OFFSET, STANDARD_ERRORS, limit_of
from pfbench.logs.doctor.turn_search import (
    FEWEST_TURNS,
    TURN_WINDOW,
    TurnSearch,
    select_nodes,
    turns_between,
)
from pfbench.logs.units import DEGREE, UNIT_FACTORS

_GAIN, _EQUAL = (
    0.15,
    0.05,
)  # of the score by another unit, and of the score less the miss of the size
_CERTAIN = 0.9  # score at which no other unit is tried, and that of a piece of the log
_PIECE, _FEWEST_PIECES, _MOST_PIECES = 15.0, 3, 8  # s, and number of pieces for the drift
_NO_TURN, _LEAST_TURN = (
    1e-5,
    0.03,
)  # rad; RMS turn of a window of an attitude that does not change, of a piece with an offset
_LEAST_COST, _CLEAR_COST = (
    0.01,
    0.5,
)  # (m/s^2)^2 of a wrong attitude, and the part that the true one may leave
_COLUMNS = ("roll", "pitch", "yaw")
_STRAIGHT = 0.35  # part of the spread that a drift may leave
# columns and names of units of the attitude
_RADIANS = ("", "")
_UNITS = {_RADIANS: 1.0} | {
    (columns, unit): factor
    for unit, factor in (UNIT_FACTORS["angle"] | UNIT_FACTORS["rare angle"]).items()
    for columns in (", ".join(_COLUMNS), "yaw")
}


@dataclass(frozen=True)
class Alignment:
    """IMU and reference on one clock.

    Attributes:
        log: Log with the attitude and the rate in their units.
        offset: Delay of the IMU, s.
        dcm: Rotations of the reference, [k, 3, 3].
        nodes: Rows of the reference between windows, [m + 1].
        search: Turns of the IMU.
        pair: Turns of reference and IMU without their means, [p, 3].
        used: Windows of the pair, [m].
        rate_axes: Axes of the gyroscope that fit best.
        rate_ratio: Residual of the recorded axes over that of the best ones.
    """

    log: RawLog
    offset: float
    dcm: Array
    nodes: NDArray[np.intp]
    search: TurnSearch
    pair: tuple[Array, Array]
    used: NDArray[np.bool_]
    rate_axes: Array
    rate_ratio: float

    @property
    def ratio(self) -> float:
        """Turns of the IMU over those of the reference."""
        true, measured = self.pair
        return float(np.sqrt((measured**2).sum() / max(float((true**2).sum()), 1e-300)))


def align_clocks(log: RawLog, facts: dict[str, Any]) -> tuple[Alignment | None, list[Finding]]:
    """Align the IMU with the reference.

    Returns the alignment, None without common motion, and findings.
    """
    nodes = select_nodes(log.reference.time, TURN_WINDOW)
    if len(nodes) <= FEWEST_TURNS:
        return None, []
    search = TurnSearch.over(log.imu, log.reference.time[nodes])
    unit, offset, score = _find_unit(log, search, nodes)
    facts.update({"imu offset [s]": offset, "score of turns": score})
    log, findings = _convert_attitude(log, unit, score)
    dcm = dcm_of(log.reference.angles)
    turns = turns_between(dcm, nodes)
    pair = search.pairs(turns, offset)
    if score < limit_of("common motion"):
        strangers = [_describe_strangers(log, search, turns, score)]
        return None, [*findings, *(strangers if _has_turns(search, turns) else [])]
    if pair is None:
        return None, findings
    aligned = Alignment(log, offset, dcm, nodes, search, pair[:2], pair[2], np.eye(3), 1.0)
    if wrong := _find_scale(aligned):
        converted, finding = wrong
        mended, more = align_clocks(converted, facts)
        return mended, [*findings, finding, *more]
    findings += _describe_offset(log, search, turns, (offset, score), facts)
    aligned, more = _convert_rate(aligned, facts)
    return _fit_rate_axes(aligned), [*findings, *more]


def _unit_of(ratio: float) -> float:
    """Return degrees in place of a ratio near them."""
    near = [unit for unit in (1.0 / DEGREE, DEGREE) if 0.7 < ratio / unit < 1.4]
    return near[0] if near else ratio


def _find_scale(aligned: Alignment) -> tuple[RawLog, Finding] | None:
    """Find an attitude with which the force explains the motion much better, where turns differ by a factor.

    Turns alone do not tell a heading in another unit from rates in another unit.

    Returns the log in its unit, and the finding.
    """
    log, factor = aligned.log, _unit_of(aligned.ratio)
    if 1.0 / limit_of("unit of rate") < factor < limit_of("unit of rate"):
        return None
    plain, results = _find_force_cost(log, aligned.offset), []
    for unit in ("yaw", "roll, pitch, yaw"):
        scales = [factor if name in unit else 1.0 for name in _COLUMNS]
        scaled = log._replace(
            reference=log.reference._replace(angles=log.reference.angles * scales)
        )
        results.append((_find_force_cost(scaled, aligned.offset), unit, scaled))
    cost, unit, scaled = min(results, key=lambda result: result[0])
    if not (plain > _LEAST_COST and cost < _CLEAR_COST * plain):
        return None
    text = f"{log.names[2]}: {unit} turn{'s' * (unit == 'yaw')} {1.0 / aligned.ratio:.3g} times as much as {log.names[0]}, and with it the force does not explain the motion: another unit"
    return scaled, _describe_unit(
        log, unit, (plain / max(cost, 1e-12), 1.0 / _CLEAR_COST, "times the least residual"), text, factor
    )  # fmt: skip


def _find_force_cost(log: RawLog, offset: float) -> float:
    """Return what the best axes of the force leave of the acceleration of the reference, (m/s^2)^2; 0 without windows."""
    windows = integrate_force(log, dcm_of(log.reference.angles), offset)
    return min(fit_force(windows, axes).cost for axes in BODY_ORDERS) if windows else 0.0


def _convert_rate(aligned: Alignment, facts: dict[str, Any]) -> tuple[Alignment, list[Finding]]:
    """Convert the rate to the unit of the reference, and name another unit."""
    (true, measured), log, ratio = aligned.pair, aligned.log, aligned.ratio
    facts["rate over that of the reference"] = ratio
    if 1.0 / limit_of("unit of rate") < ratio < limit_of("unit of rate"):
        return aligned, []
    factor = 1.0 / _unit_of(ratio)
    converted = replace(
        aligned,
        log=log._replace(imu=log.imu._replace(rate=log.imu.rate * factor)),
        search=replace(aligned.search, angle=aligned.search.angle * factor),
        pair=(true, factor * measured),
    )
    return converted, [_describe_rate_unit(log, aligned.pair, ratio)]


def _fit_rate_axes(aligned: Alignment) -> Alignment:
    """Find the axes of the rate that fit best."""
    true, measured = aligned.pair
    residuals = [float(((measured - true @ m.T) ** 2).sum()) for m in BODY_ORDERS]
    best = int(np.argmin(residuals))
    return replace(
        aligned, rate_axes=BODY_ORDERS[best], rate_ratio=residuals[0] / max(residuals[best], 1e-300)
    )


def _has_turns(search: TurnSearch, turns: Array) -> bool:
    """Return whether the reference or the IMU turns enough to be compared."""
    measured = np.diff(interpolate_columns(search.nodes, search.time, search.angle), axis=0)
    size = (np.square(a - a.mean(0)).sum(1).mean() for a in (turns, measured))
    return max(size) > _LEAST_TURN**2


def _find_unit(
    log: RawLog, search: TurnSearch, nodes: NDArray[np.intp]
) -> tuple[tuple[str, str], float, float]:
    """Return columns in another unit and its name, '' for none, with the offset and the score of their turns.

    A yaw within a turn is in radians: a short log without turns can agree with any unit. Units that agree equally are
    distinguished by the size of the turns, of a gyroscope in rad/s or in deg/s, and then by the force.
    """
    results = []
    is_within_a_turn = float(np.abs(log.reference.angles[:, 2]).max()) <= 2.0 * np.pi
    for unit in _UNITS:
        turns = turns_between(dcm_of(_in_radians(log.reference.angles, unit)), nodes)
        offset, score = search.find(turns)
        pair = search.pairs(turns, offset)
        size = np.linalg.norm(pair[1]) / max(float(np.linalg.norm(pair[0])), 1e-300) if pair else 0.0  # fmt: skip
        miss = min(abs(np.log(max(size * f, 1e-300))) for f in (1.0, DEGREE))
        results.append((unit, offset, score, score - miss))
        if unit == _RADIANS and (score > _CERTAIN or is_within_a_turn):
            break
    equal = [r for r in results if r[3] > max(result[3] for result in results) - _EQUAL]
    best = (
        min(equal, key=lambda r: _find_force_cost(_convert_attitude(log, r[0], r[2])[0], r[1]))
        if len(equal) > 1
        else equal[0]
    )
    return best[:3] if best[2] > results[0][2] + _GAIN else results[0][:3]


def _in_radians(angles: Array, unit: tuple[str, str]) -> Array:
    """Convert the columns that are in a unit."""
    return angles * [_UNITS[unit] if name in unit[0] else 1.0 for name in _COLUMNS]


def _convert_attitude(log: RawLog, unit: tuple[str, str], score: float) -> tuple[RawLog, list[Finding]]:  # fmt: skip
    """Convert the attitude to radians, and name the columns in another unit."""
    if unit == _RADIANS:
        return log, []
    reference, (columns, name) = log.reference, unit
    text = f"{log.names[2]}: {columns} {'is' if columns == 'yaw' else 'are'} in {name}: turns then agree with the IMU to a score of {score:.3f}"
    finding = _describe_unit(log, columns, (score, _CERTAIN, "score"), text, _UNITS[unit])
    return log._replace(reference=reference._replace(angles=_in_radians(reference.angles, unit))), [finding]  # fmt: skip


def _describe_unit(
    log: RawLog, unit: str, evidence: tuple[float, float, str], text: str, factor: float
) -> Finding:
    """Describe columns of the attitude in another unit, with statistic, threshold and unit of the evidence."""
    yaw = thin_curve("yaw", log.reference.time, log.reference.angles[:, 2])
    return Finding(
        "unit of attitude", REFUSE, *evidence, text,
        f"Multiply by {factor:.10g}, or set scenario.corrections.scale",
        {"corrections": {"scale": {"reference": dict.fromkeys(unit.split(", "), factor)}}},
        picture=Picture("t [s]", "yaw as recorded", (yaw,)),
    )  # fmt: skip


def _turn_picture(log: RawLog, search: TurnSearch, turns: Array, offset: float) -> Picture:
    """Draw the turn rates of both about the axis that turns most."""
    step = np.diff(search.nodes)
    axis = int(np.argmax(np.square(turns).sum(0)))
    at = search.nodes + offset
    measured = np.diff(interpolate_columns(at, search.time, search.angle), axis=0)
    middle = 0.5 * (search.nodes[1:] + search.nodes[:-1])
    return Picture(
        "t [s]", f"turn rate about {'xyz'[axis]} [rad/s]",
        (
            thin_curve(log.names[2], middle, turns[:, axis] / step),
            thin_curve(log.names[0], middle, measured[:, axis] / step),
        ),
    )  # fmt: skip


def _describe_strangers(log: RawLog, search: TurnSearch, turns: Array, score: float) -> Finding:
    moves = np.square(turns - turns.mean(0)).sum(1).mean() > _NO_TURN**2
    evidence = f"show no common turn at any offset up to 25 s: the best score is {score:.2f}"
    causes: tuple[str, ...] = ("another clock", "a wrong attitude", "a log without turns")
    if not moves:
        evidence = "disagree: roll, pitch, yaw do not turn, and wx, wy, wz do"
        causes = ("an attitude in another unit", "an attitude that was not recorded")
    return Finding(
        "common motion", REFUSE, score, limit_of("common motion"), "score",
        f"{log.names[0]} and {log.names[2]} {evidence}",
        "Check that both tables are of one drive, and that the clocks differ by less than 25 s" if moves
        else "Check roll, pitch, yaw",
        explanations=causes,
        picture=_turn_picture(log, search, turns, 0.0),
    )  # fmt: skip


def _describe_rate_unit(log: RawLog, pair: tuple[Array, Array], ratio: float) -> Finding:
    factor, is_degrees = 1.0 / _unit_of(ratio), _unit_of(ratio) != ratio
    true, measured = pair
    axis, rows = int(np.argmax(np.square(true).sum(0))), np.arange(len(true))
    return Finding(
        "unit of rate", REFUSE, ratio, limit_of("unit of rate"), "times the reference",
        f"{log.names[0]}: wx, wy, wz are {ratio:.3g} times the turns of the reference: they {'are in deg/s' if is_degrees else 'have another unit'}",
        f"Multiply by {factor:.10g}, or set scenario.corrections.scale",
        {"corrections": {"scale": {"imu": dict.fromkeys(("wx", "wy", "wz"), factor)}}},
        picture=Picture("window", f"turn about {'xyz'[axis]}", (
            thin_curve(log.names[2], rows, true[:, axis]), thin_curve(log.names[0], rows, measured[:, axis]),
        )),
    )  # fmt: skip


def _describe_offset(
    log: RawLog,
    search: TurnSearch,
    turns: Array,
    at: tuple[float, float],
    facts: dict[str, Any],
) -> Iterator[Finding]:
    """Describe the offset of the clock, and how it moves."""
    offset, score = at
    pieces = _offsets_of_pieces(search, turns, offset)
    spread = float(np.ptp(pieces[:, 1])) if len(pieces) > 1 else 0.0
    facts["imu offset spread [s]"] = spread
    half = 0.5 * float(np.median(np.diff(log.imu.time)))  # of a sample: slower samples show less
    unclear = STANDARD_ERRORS * float(np.median(pieces[:, 2])) if len(pieces) else np.inf
    name, moves = log.names[0], spread > max(limit_of("imu clock drift"), half, unclear)
    step = _find_step(log, search, turns, offset) if moves else None
    shift: Any = round(offset, 4)
    if moves:
        line = np.polyfit(pieces[:, 0], pieces[:, 1], 1)
        rest = float(np.abs(pieces[:, 1] - np.polyval(line, pieces[:, 0])).max())
        is_drift = step is None and len(pieces) > 2 and rest < _STRAIGHT * spread
        ends = (float(log.imu.time[0]), float(log.imu.time[-1]))
        shift = step or [[round(t, 3), round(float(np.polyval(line, t)), 4)] for t in ends]
        kind = f"a drift of {line[0] * 1e6:.0f} ppm" if is_drift else "a slip of the clock"
        where = f" by {step[1][1] - step[0][1]:+.3f} s at t = {step[0][0]:.3f}" if step else ""
        yield Finding(
            "imu clock drift", WARN, spread, limit_of("imu clock drift"), "s",
            f"{name}: the time offset against {log.names[2]} moves by {spread:.3f} s: {kind}{where}",
            "Correct t, or set scenario.corrections.shift_s.imu to the nodes [t, offset]",
            {"corrections": {"shift_s": {"imu": shift}}} if step or is_drift else {},
            picture=Picture("t [s]", "offset [s]", (("offset of pieces", pieces[:, 0], pieces[:, 1]),)),
        )  # fmt: skip
        shift = shift if step or is_drift else round(offset, 4)
    if abs(offset) > max(limit_of("imu clock"), half):
        late = "late" if offset > 0.0 else "early"
        yield Finding(
            "imu clock", REFUSE if abs(offset) > REFUSED_OFFSET else WARN, offset, limit_of("imu clock"), "s",
            f"{name}: t is {abs(offset):.3f} s {late} against {log.names[2]}: turns agree to a score of {score:.3f}, and "
            f"{search.score(turns, 0.0):.3f} without the offset",
            f"{describe_change(offset)}, or set +scenario.corrections.shift_s.imu={offset:.3f}",
            {"corrections": {"shift_s": {"imu": shift}}},
            ("a delay of the IMU", f"a delay of {log.names[2]} of the other sign"),
            _turn_picture(log, search, turns, 0.0),
        )  # fmt: skip


def _offsets_of_pieces(search: TurnSearch, turns: Array, offset: float) -> Array:
    """Return middle, offset and its standard error of the pieces of the log that turn enough, [q, 3]."""
    first, last = search.nodes[0], search.nodes[-1]
    count = int(np.clip((last - first) / _PIECE, _FEWEST_PIECES, _MOST_PIECES))
    edges = np.linspace(first, last, count + 1)
    pieces = []
    for a, b in pairwise(edges):
        stretch = (search.nodes[:-1] >= a) & (search.nodes[1:] <= b)
        if (stretch & search.usable).sum() < FEWEST_TURNS:
            continue
        turn = turns[stretch] - turns[stretch].mean(0)
        if np.sqrt(np.square(turn).sum(1).mean()) < _LEAST_TURN:
            continue
        lag, score = search.find(turns, offset, stretch)
        if score > _CERTAIN:
            pieces.append((0.5 * (a + b), lag, search.find_error(turns, lag, stretch)))
    return np.array(pieces).reshape(-1, 3)


def _find_step(log: RawLog, search: TurnSearch, turns: Array, offset: float) -> list[list[float]] | None:  # fmt: skip
    """Find a jump of the clock: a long interval of the IMU whose excess is that of the offsets around it."""
    time = log.imu.time
    interval = np.diff(time)
    typical = float(np.median(interval))
    i = int(interval.argmax())
    excess = float(interval[i]) - typical
    if excess < limit_of("imu clock drift"):
        return None
    lags = []
    for stretch in (search.nodes[1:] + offset < time[i], search.nodes[:-1] + offset > time[i + 1]):
        if (stretch & search.usable).sum() < FEWEST_TURNS:
            return None
        lag, score = search.find(turns, offset, stretch, reach=1.5)
        if score < _CERTAIN:
            return None
        lags.append(lag)
    before, after = lags
    if abs(after - before - excess) > max(0.02, 0.2 * excess):
        return None
    return [[round(float(time[i]), 6), round(before, 4)], [round(float(time[i + 1]), 6), round(before + excess, 4)]]  # fmt: skip
