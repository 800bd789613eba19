"""Corrections of an own log that its reader applies and says: clocks, units, axes, biases, lever arm, wrong rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from pfbench.core.parameter_checks import require
from pfbench.logs.doctor.axis_orders import CONVENTIONS, axes_matrix, convert_angles
from pfbench.logs.doctor.bad_samples import find_stuck, mend_samples
from pfbench.logs.doctor.fix_checks import find_frozen, find_jumps
from pfbench.logs.worlds.imu_gaps import CUT, cut_longest
from pfbench.logs.worlds.log_frames import GEODETIC_COLUMNS
from pfbench.logs.worlds.log_tables import (
    Array,
    GnssLog,
    LogTable,
    ReferenceLog,
    convert_column,
    swap_frd_rfu,
)
from pfbench.logs.worlds.time_grid import interpolate
from pfbench.nav.strapdown import rotate

Tables = dict[str, LogTable]
LogTables = tuple[LogTable, LogTable, LogTable | None]  # IMU, fixes and, if there is one, reference
Vector = Sequence[float] | None
ColumnGroups = Sequence[tuple[str, ...]]  # of columns
_TABLES = ("imu", "gnss", "reference")
_FORCE, _RATE, _ANGLES = ("fx", "fy", "fz"), ("wx", "wy", "wz"), ("roll", "pitch", "yaw")
_POSITION, _VELOCITIES = ("pn", "pe", "pd"), (("vn", "ve", "vd"), ("vn_d", "ve_d", "vd_d"))
_SENSORS = {"imu": (_FORCE, _RATE), "accelerometer": (_FORCE,), "gyroscope": (_RATE,)}
_LEVEL = {
    "gnss": ("gnss", (_POSITION, *_VELOCITIES)),
    "reference": ("reference", (_POSITION, *_VELOCITIES)),
    "reference_velocity": ("reference", _VELOCITIES),
}
_DROPS = ("spikes", "stuck", "outliers", "frozen")
_TIMES = ("sort", "even")
_LONG_STEP = 0.1  # s; even times do not cross longer intervals
_EVEN_ROWS = 101  # of a local line


@dataclass(frozen=True)
class LogCorrections:
    """Corrections of the tables, in the order of the attributes. The tables are imu, gnss and reference.

    Attributes:
        times: By table: sort (by t, with the first row of each time) or even (evenly spaced, too).
        scale: Factors by table and column.
        mounting: By imu, accelerometer or gyroscope: the recorded axes that are forward, right, down, such as
            [x, -y, -z]. Three numbers are the angles of the sensor in the body, roll, pitch, yaw, deg.
        level_axes: By gnss, reference or reference_velocity: the recorded axes that are North, East, Down, such as
            [e, n, -d]. One number is the turn of the frame about the vertical, deg.
        attitude: Convention of the recorded attitude, such as yaw_from_east. None for that of the tables.
        bias: Values that are subtracted, by table and column.
        shift_s: Delay of the clock by table, s, which is subtracted from t. Nodes [t, delay] for one that changes.
        drop: Wrong rows that are left out: spikes, stuck, outliers, frozen.
        gaps: refuse, or longest for the longest part between gaps of the IMU.
        offset_m: Constant shift of the fixes that is subtracted, North, East, Down, m. None for zero.
        lever_arm: Antenna from the IMU, forward, right, down, m. None for zero. The fixes are moved to the
            IMU with the attitude of the reference.

    Raises:
        ValueError: If a correction is not one of these. The message names key, value and remedy.
    """

    times: Mapping[str, str] = field(default_factory=dict)
    scale: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    mounting: Mapping[str, Sequence[str | float]] = field(default_factory=dict)
    level_axes: Mapping[str, Sequence[str | float]] = field(default_factory=dict)
    attitude: str | None = None
    bias: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    shift_s: Mapping[str, float | Sequence[Sequence[float]]] = field(default_factory=dict)
    drop: Sequence[str] = ()
    gaps: str = "refuse"
    offset_m: Vector = None
    lever_arm: Vector = None

    def __post_init__(self) -> None:
        for key, allowed in (
            ("times", _TABLES), ("scale", _TABLES), ("bias", _TABLES), ("shift_s", _TABLES),
            ("mounting", tuple(_SENSORS)), ("level_axes", tuple(_LEVEL)),
        ):  # fmt: skip
            _check_mapping(key, getattr(self, key) or {}, "by name")
            _check_names(key, getattr(self, key) or {}, allowed)
        for key, names, allowed in (
            ("drop", self.drop or (), _DROPS), ("times", [*(self.times or {}).values()], _TIMES), ("gaps", (self.gaps,), CUT),
            ("attitude", () if self.attitude is None else (self.attitude,), tuple(CONVENTIONS)),
        ):  # fmt: skip
            _check_names(key, names, allowed)
        for sensor, axes in (self.mounting or {}).items():
            axes_matrix(sensor, axes)
        for frame, axes in (self.level_axes or {}).items():
            axes_matrix(frame, axes, is_level=True)
        for key in ("offset_m", "lever_arm"):
            value = getattr(self, key)
            is_vector = value is None or (len(value) == 3 and np.isfinite(np.array(value, float)).all())  # fmt: skip
            require(is_vector, f"scenario.corrections.{key}", "be 3 finite numbers in m", value, "Set null for none.")  # fmt: skip
        for key in ("scale", "bias"):
            for table, values in (getattr(self, key) or {}).items():
                _check_mapping(f"{key}.{table}", values, "by column")
                wrong = [c for c, v in values.items() if not (isinstance(v, int | float) and np.isfinite(v) and (v or key == "bias"))]  # fmt: skip
                require(
                    not wrong, f"scenario.corrections.{key}.{table}.{''.join(wrong[:1])}",
                    "be a finite number, and a factor not 0", [values[c] for c in wrong], "Set a number.",
                )  # fmt: skip
        for table, shift in (self.shift_s or {}).items():
            _nodes_of(table, shift)

    def correct_tables(self, inertial: LogTable, gnss: LogTable, truth: LogTable | None) -> tuple[LogTables, tuple[str, ...]]:  # fmt: skip
        """Correct the tables as recorded.

        Args:
            inertial: IMU table.
            gnss: Table of fixes.
            truth: Reference table, None for a log without one.

        Returns:
            Corrected tables, and a note for each correction.
        """
        tables = {"imu": inertial, "gnss": gnss} | ({"reference": truth} if truth else {})
        notes: list[str] = []
        for name, order in (self.times or {}).items():
            tables[name] = _sort(tables[name], notes)
            if order == "even":
                tables[name] = _even(tables[name], notes)
        for name, groups, change, note in self._list_changes(tables):
            for columns in groups:
                tables[name] = _apply(tables[name], columns, change)
            notes.append(f"{tables[name].name}: {note}")
        for name, shift in (self.shift_s or {}).items():
            tables[name] = _shift(tables[name], *_nodes_of(name, shift), notes)
        if {"spikes", "stuck"} & set(self.drop or ()):
            tables["imu"] = _drop_samples(tables["imu"], self.drop, notes)
        if self.gaps == "longest":
            tables["imu"], cut = cut_longest(tables["imu"], convert_column(tables["imu"], "t"))
            notes += cut
        return (tables["imu"], tables["gnss"], tables.get("reference")), tuple(notes)

    def _list_changes(self, tables: Tables) -> Iterator[tuple[str, ColumnGroups, Any, str]]:
        """Yield table, groups of columns, function of their numbers and note of the factors, axes, convention and biases."""
        for name, factors in (self.scale or {}).items():
            yield name, (tuple(factors),), lambda v, a=factors: v * [*a.values()], f"columns multiplied by {dict(factors)}"  # fmt: skip
        turned = [
            ("imu", _SENSORS[sensor], axes_matrix(sensor, axes), f"forward, right, down of the {sensor} are {list(axes)}")
            for sensor, axes in (self.mounting or {}).items()
        ] + [
            (name, [g for g in groups if g is _POSITION or tables[name].has(g)], axes_matrix(frame, axes, is_level=True),
             f"North, East, Down of the {frame} are {list(axes)}")
            for frame, axes in (self.level_axes or {}).items() for name, groups in (_LEVEL[frame],)
        ]  # fmt: skip
        for name, groups, matrix, note in turned:
            yield name, groups, lambda v, a=matrix: v @ a.T, f"{note} of the table"
        if self.attitude is not None:
            convention = self.attitude
            yield "reference", (_ANGLES,), lambda v: convert_angles(convention, v), f"attitude converted, since {CONVENTIONS[convention][0]}"  # fmt: skip
        for name, values in (self.bias or {}).items():
            yield name, (tuple(values),), lambda v, b=values: v - [*b.values()], f"{dict(values)} subtracted"  # fmt: skip

    def correct_fixes(self, fixes: GnssLog, reference: ReferenceLog | None, name: str) -> tuple[GnssLog, tuple[str, ...]]:  # fmt: skip
        """Correct the fixes with the reference.

        Args:
            fixes: Fixes.
            reference: Reference, None for a log without one.
            name: Name of the table of fixes.

        Returns:
            Fixes, and notes.
        """
        position, notes = fixes.position.copy(), []
        if self.offset_m is not None:
            position -= swap_frd_rfu(np.array(self.offset_m, float))
            notes.append(
                f"{name}: {list(self.offset_m)} m North, East, Down subtracted from the fixes"
            )
        if self.lever_arm is not None and reference:
            lever = torch.from_numpy(swap_frd_rfu(np.array(self.lever_arm, float)))
            q = torch.from_numpy(interpolate(reference, fixes.time)[:, :4])
            position -= rotate(q, lever.expand(len(q), 3)).numpy()
            notes.append(
                f"{name}: fixes moved to the IMU by the lever arm {list(self.lever_arm)} m, with the attitude of the reference"
            )
        velocity = fixes.velocity.copy()
        for kind in ("outliers", "frozen"):
            if kind in (self.drop or ()) and reference:
                mask = _wrong_fixes(fixes._replace(position=position), reference, kind)
                position[mask] = velocity[mask] = np.nan
                notes.append(f"{name}: {int(mask.sum())} fixes dropped as {kind}")
        return GnssLog(fixes.time, position, velocity), tuple(notes)


def _wrong_fixes(fixes: GnssLog, reference: ReferenceLog, kind: str) -> NDArray[np.bool_]:
    """Find outliers or frozen fixes, [m]."""
    rows = np.flatnonzero(np.isfinite(fixes.position).all(1))
    time, position = fixes.time[rows], fixes.position[rows]
    true = np.stack([np.interp(time, reference.time, p) for p in reference.position.T], -1)
    if kind == "outliers":
        inside = (time >= reference.time[0]) & (time <= reference.time[-1])
        wrong = find_jumps(position - true, inside)[2]
    else:
        wrong = find_frozen(position, np.linalg.norm(np.diff(true, axis=0), axis=1))
    mask = np.zeros(len(fixes.time), bool)
    mask[rows[wrong]] = True
    return mask


# --------------------------------------------------------------------------------------------------
# Changes of a table.


def _apply(table: LogTable, columns: Sequence[str], change: Any) -> LogTable:
    """Replace columns by a function of their numbers [n, k]."""
    missing = [column for column in columns if column not in table.rows]
    axes = ". Axes of lat_deg, lon_deg are exchanged in the file" if table.has(GEODETIC_COLUMNS) else ""  # fmt: skip
    require(
        not missing,
        "scenario.corrections",
        f"name columns of {table.name}",
        ", ".join(missing),
        f"It has {', '.join(map(str, table.rows.columns))}{axes}.",
    )
    values = change(np.array([convert_column(table, column) for column in columns]).T)
    return table._replace(rows=table.rows.assign(**dict(zip(columns, np.asarray(values).T, strict=True))))  # fmt: skip


def _sort(table: LogTable, notes: list[str]) -> LogTable:
    """Sort by t, and keep the first row of each time."""
    _, keep = np.unique(convert_column(table, "t"), return_index=True)
    removed = len(table.rows) - len(keep)
    if removed or (np.diff(keep) < 0).any():
        notes.append(f"{table.name}: sorted by t, {removed} rows with a repeated time left out")
    return table._replace(rows=table.rows.iloc[keep].reset_index(drop=True))


def _even(table: LogTable, notes: list[str]) -> LogTable:
    """Replace t by lines of the row number over about a hundred rows; they do not cross long intervals."""
    time = convert_column(table, "t")
    step = np.diff(time)
    borders = np.flatnonzero(step > max(_LONG_STEP, 10.0 * float(np.median(step)))) + 1
    even = np.concatenate([_smooth_times(stretch) for stretch in np.split(time, borders)])
    notes.append(
        f"{table.name}: t replaced by evenly spaced times, at most {np.abs(even - time).max():.3g} s away"
    )
    return table._replace(rows=table.rows.assign(t=even))


def _smooth_times(time: Array) -> Array:
    """Return the values of local lines at their middles, and of those at both ends, s, [n]."""
    size = min(_EVEN_ROWS, len(time) - 1 + len(time) % 2)
    if size < 3:
        return time
    half, rows = size // 2, np.arange(size)
    middle = np.convolve(time, np.ones(size) / size, "valid")
    first, last = (
        np.polyval(np.polyfit(rows, piece - piece[0], 1), rows) + piece[0]
        for piece in (time[:size], time[-size:])
    )
    return np.concatenate([first[:half], middle, last[size - half :]])


def _shift(table: LogTable, nodes: Array, delays: Array, notes: list[str]) -> LogTable:
    """Subtract the delay of a clock from t."""
    time = convert_column(table, "t")
    size = f"{delays[0]:g} s" if len(delays) == 1 else f"{delays.min():g} to {delays.max():g} s"
    notes.append(f"{table.name}: {size} subtracted from t")
    return table._replace(rows=table.rows.assign(t=time - np.interp(time, nodes, delays)))


def _drop_samples(table: LogTable, drop: Sequence[str], notes: list[str]) -> LogTable:
    """Replace spikes by a line between their neighbours, and leave out stuck rows."""
    time, *columns = (convert_column(table, column) for column in ("t", *_FORCE, *_RATE))
    samples = np.stack(columns, -1)
    if "spikes" in drop:
        samples, bad, _ = mend_samples(time, samples)
        notes.append(
            f"{table.name}: {int(bad.sum())} rows with spikes or absurd values replaced by a line"
        )
    rows = table.rows.assign(**dict(zip((*_FORCE, *_RATE), samples.T, strict=True)))
    if "stuck" in drop:
        first, last = find_stuck(samples)
        rows = pd.concat([rows.iloc[: first + 1], rows.iloc[last + 1 :]]).reset_index(drop=True)
        notes.append(f"{table.name}: {last - first} rows with equal samples left out")
    return table._replace(rows=rows)


# --------------------------------------------------------------------------------------------------
# Checks of the settings.


def _check_names(
    key: str, names: Sequence[str] | Mapping[str, Any], allowed: Sequence[str]
) -> None:
    for name in [names] if isinstance(names, str) else names:
        require(
            name in allowed,
            f"scenario.corrections.{key}",
            f"be of {', '.join(allowed)}",
            f"{name!r}",
            "Choose one of these.",
        )


def _check_mapping(key: str, values: Any, kind: str) -> None:
    require(
        isinstance(values, Mapping),
        f"scenario.corrections.{key}",
        f"be values {kind}",
        values,
        f"Set {{NAME: {values}}}.",
    )


def _nodes_of(table: str, shift: float | Sequence[Sequence[float]]) -> tuple[Array, Array]:
    """Return times and delays of the nodes of a clock, [k]."""
    pairs = [[0.0, shift]] if isinstance(shift, int | float) else [list(pair) for pair in shift]
    require(
        pairs and all(len(pair) == 2 for pair in pairs),
        f"scenario.corrections.shift_s.{table}",
        "be a number in s, or nodes [[t, delay], ...]",
        shift,
        "Set the delay of the clock.",
    )
    nodes, delays = np.array(pairs, float).T
    require(
        np.isfinite(delays).all() and (np.diff(nodes) > 0.0).all(),
        f"scenario.corrections.shift_s.{table}",
        "have increasing times and finite delays",
        pairs,
        "Sort the nodes.",
    )
    return nodes, delays
