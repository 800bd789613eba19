"""Reader of CSV and Parquet tables with named columns, for trajectories and for the tables of an own log."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from pfbench.core.parameter_checks import require
from pfbench.files.table_file import read_table_file
from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.judge.trajectory_table import (
    ATTITUDE_COLUMNS,
    COVARIANCE_COLUMNS,
    GEODETIC,
    LOCAL,
    POSITION_SD,
    ROLES,
    SD_GROUPS,
    TrajectoryTable,
)
from pfbench.logs.sky.plausible_limits import LIMIT_COLUMNS, QUANTITIES
from pfbench.logs.units import ALIASES

# other names of the columns of an own log, letters alone and without units
_NAMES = {
    "t": ("t", "time", "timestamp", "stamp", "sec", "seconds", "tow", "gpstime"),
    **{f"f{a}": (f"f{a}", f"a{a}", f"acc{a}", f"accel{a}", f"acceleration{a}", f"linearacceleration{a}") for a in "xyz"},
    **{f"w{a}": (f"w{a}", f"g{a}", f"gyr{a}", f"gyro{a}", f"omega{a}", f"angularvelocity{a}", f"rate{a}") for a in "xyz"},
    "lat_deg": ("latdeg", "lat", "latitude"),
    "lon_deg": ("londeg", "lon", "lng", "longitude"),
    "h_m": ("hm", "h", "height", "alt", "altitude", "ellipsoidalheight"),
    "pn": ("pn", "north", "posn", "n"), "pe": ("pe", "east", "pose", "e"), "pd": ("pd", "down", "posd"),
    "vn": ("vn", "veln", "vnorth"), "ve": ("ve", "vele", "veast"), "vd": ("vd", "veld", "vdown"),
    "fix": ("fix", "quality", "fixtype", "q"),
    "roll": ("roll",), "pitch": ("pitch",), "yaw": ("yaw", "heading"),
}  # fmt: skip
_NEEDED = {"imu": ROLES["imu"], "gnss": ("t",), "reference": ("t", *ATTITUDE_COLUMNS)}
_UNITS = re.compile(
    r"(?<=[a-z0-9])[_ .\[(]*(m/?s\^?2|mps2|rad/?s|radps|m/?s|mps|rad|deg|s|m)[\])]*$", re.IGNORECASE
)
_STATED_UNIT = re.compile(r"[\[(]\s*([^\[(\])]+?)\s*[\])]\s*$")  # at the end of a name


def read_named_table(role: str, file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read the columns of a table that have known names, or are given them by the options.

    The tables of an own log may have the names of other programs, too.
    """
    content, accepted = read_table_file(file), ROLES[role]
    rows = content.rows.rename(columns=str)
    lines = np.arange(len(rows)) + (1 if file.suffix == ".parquet" else 2)
    rows, renamed = _rename_columns(file, rows, options, accepted), tuple[str, ...]()
    if role in _NEEDED:
        rows, renamed = _understand_names(file, rows, role, options)
    columns = list(map(str, rows))
    similar = "".join(f" Similar: {name}." for name in difflib.get_close_matches("time", columns, 1, 0.5))  # fmt: skip
    require(
        "t" in rows,
        file.name,
        "have the column t (time, s)",
        ", ".join(columns),
        f"Rename it with NAME.columns=t:NAME_IN_FILE.{similar}",
    )
    lacking = [group for group in SD_GROUPS if not set(group) <= set(rows)]
    incomplete = [name for group in lacking for name in group]
    names = [name for name in accepted if name in rows and name not in incomplete]
    values = {name: _numbers(file, rows[name], name, lines) for name in names}
    unused = [str(name) for name in rows if name not in names]
    notes = (f"columns not used: {', '.join(unused)}",) if unused else ()
    if COVARIANCE_COLUMNS[0] in values and POSITION_SD[0] in values:
        notes = (*notes, "the covariance is used in place of sd_pn, sd_pe and sd_pd")
    time = values.pop("t")
    origin = _stated_origin(content.stated)
    table_notes = (*content.notes, *renamed, *notes)
    return [TrajectoryTable(file.name, time, values, lines, table_notes, origin=origin)]


def _rename_columns(
    file: Path, rows: pd.DataFrame, options: SourceOptions, accepted: Sequence[str]
) -> pd.DataFrame:
    """Return the rows with the names of pfbench."""
    for name, in_file in options.columns.items():
        remedy = "Choose from {}. Write a name with commas in quotes."
        require(in_file in rows, f"{file.name}: columns", "exist", in_file, remedy.format(", ".join(map(str, rows))))  # fmt: skip
        require(name in accepted, f"{file.name}: columns", "exist", name, remedy.format(", ".join(accepted)))  # fmt: skip
    _check_stated_units(file, options)
    used = options.columns.items()
    hidden = [name for name in options.columns if name in rows]
    rows = rows.drop(columns=[name for name in hidden if name not in options.columns.values()])
    return rows.rename(columns={in_file: name for name, in_file in used})


def _understand_names(
    file: Path, rows: pd.DataFrame, role: str, options: SourceOptions
) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """Rename the columns of a role that have other names; refuse a table without those that are needed.

    Returns the rows, and a note on the names.
    """
    columns = [*map(str, rows)]
    meanings = {c: _find_name(c, options.names) for c in columns if c not in ROLES[role]}
    meanings = {column: name for column, name in meanings.items() if name in ROLES[role] and name not in rows}  # fmt: skip
    targets = [*meanings.values()]
    double = next((name for name in targets if targets.count(name) > 1), "")
    several = [column for column, name in meanings.items() if name == double]
    require(
        not double, file.name, f"have one column for {double}", ", ".join(several),
        f"Name the right one: NAME.columns={double}:{''.join(several[:1])}",
    )  # fmt: skip
    present = {*columns, *targets}
    missing = [name for name in _NEEDED[role] if name not in present]
    if role != "imu" and not (present >= {*GEODETIC} or present >= {*LOCAL}):
        missing.append(" ".join(GEODETIC))
    # a name is proposed for what it says alone: by order, gyro and force change places
    guesses = {c: name for c in columns if c not in meanings and (name := _guess_name(c, missing))}
    guesses = guesses or {"YOUR_COLUMN": "".join(missing[:1])}
    require(
        not missing, file.name, f"have the columns {', '.join(missing)}", ", ".join(columns),
        f"Name yours: NAME.columns={','.join(f'{name}:{c}' for c, name in guesses.items())}, in Python columns={guesses}.",
    )  # fmt: skip
    _check_stated_units(file, replace(options, columns={name: column for column, name in meanings.items()}))  # fmt: skip
    note = ", ".join(f"{column} is {name}" for column, name in meanings.items())
    return rows.rename(columns=meanings), (note,) if note else ()


def _find_name(column: str, names: Mapping[str, str]) -> str:
    """Return the name that the format has for a column; empty for none."""
    plain = re.sub(r"[^a-z0-9]", "", _UNITS.sub("", column.strip()).lower())
    understood = next((name for name, others in _NAMES.items() if plain in others), "")
    return names.get(column, "" if understood in names.values() else understood)


def _guess_name(column: str, missing: Sequence[str]) -> str:
    """Return the missing name whose quantity and axis a column states; empty for none."""
    match = re.fullmatch(
        r"(?P<kind>.*?(?:acc|gyr|force|rate|omega)\w*?)[^a-z0-9]*(?P<axis>[xyz012])\W*",
        column.lower(),
    )
    if not match:
        return ""
    letter = "f" if re.search("acc|force", match["kind"]) else "w"
    name = letter + dict(zip("012", "xyz", strict=True)).get(match["axis"], match["axis"])
    return name if name in missing else ""


def _check_stated_units(file: Path, options: SourceOptions) -> None:
    """Refuse names that state other units, as time [ms], that no factor converts."""
    factors: dict[str, float] = {}
    for name, in_file in options.columns.items():
        match = _STATED_UNIT.search(in_file)
        stated = match[1] if match else ""
        units = QUANTITIES[LIMIT_COLUMNS[name]].units if name in LIMIT_COLUMNS else {}
        factor = units.get(ALIASES.get(stated, stated), 1.0)
        if factor != 1 and name not in options.factors:
            factors[name] = factor
    names = ", ".join(f"{name} from {options.columns[name]}" for name in factors)
    word = ",".join(f"{name}:{factor:.8g}" for name, factor in {**options.scale, **factors}.items())
    require(
        not factors,
        f"{file.name}: columns",
        "be in s, m, m/s and rad, latitude and longitude in deg",
        names,
        f"Set NAME.scale={word}.",
    )


def _stated_origin(stated: Mapping[str, str]) -> tuple[float, ...]:
    """Return the origin that a Parquet file states in deg, deg, m, or an empty tuple."""
    try:
        return tuple(float(stated[f"origin_{name}"]) for name in GEODETIC)
    except (KeyError, ValueError):
        return ()


def _numbers(file: Path, column: pd.Series, name: str, lines: np.ndarray) -> np.ndarray:
    """Convert a column to numbers; NaN where a cell is empty."""
    numbers = pd.to_numeric(column, errors="coerce").to_numpy(dtype=np.float64)
    bad = np.isnan(numbers) & column.notna().to_numpy()
    if bad.any():
        row = int(bad.argmax())
        raise ValueError(
            f"{file.name}: line {lines[row]}, column {name} must be a number, got "
            f"{str(column.iloc[row])[:40]!r}. Repair or remove this line."
        )
    return numbers
