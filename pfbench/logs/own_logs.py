"""Own recorded logs: tables with any column names, axes and units of time as `user_log` or `user_log_aligned`."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pfbench.core.parameter_checks import require
from pfbench.door.parts import Part, describe_value, format_words, plain_errors
from pfbench.files.atomic_write import write_atomically
from pfbench.job.trust import WRITTEN
from pfbench.logs.units import SECONDS

if TYPE_CHECKING:
    import pandas as pd

# columns of the format, with the other names that are understood; letters alone, without units
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
_NEEDED = {
    "imu": ("t", "fx", "fy", "fz", "wx", "wy", "wz"),
    "gnss": ("t",),
    "reference": ("t", "vn", "ve", "vd", "roll", "pitch", "yaw"),
}
_POSITION = (("lat_deg", "lon_deg", "h_m"), ("pn", "pe", "pd"))
_UNITS = re.compile(
    r"(?<=[a-z0-9])[_ .\[(]*(m/?s\^?2|mps2|rad/?s|radps|m/?s|mps|rad|deg|s|m)[\])]*$", re.IGNORECASE
)
_SIGNS = {"frd": (1.0, 1.0, 1.0), "flu": (1.0, -1.0, -1.0)}


def make_log(
    imu: Any,
    gnss: Any,
    reference: Any = None,
    *,
    columns: Mapping[str, str] | None = None,
    axes: str = "frd",
    time: str = "s",
    **settings: Any,
) -> Part:
    """Make a scenario of your own recorded log, and print what was assumed.

    Args:
        imu: Table of the IMU: a file in CSV or Parquet, or a data frame. Force [m/s^2] and angular rate [rad/s].
        gnss: Table of the fixes.
        reference: Table of the reference, which gives the truth. None for a log without one: filters start from level
            and course, and errors are distances to held-out fixes.
        columns: Your names of columns that are not understood by themselves, such as `{"my_ax": "fx"}`.
        axes: Body axes of the IMU: frd (forward, right, down) or flu (forward, left, up).
        time: Unit of the times: s, ms, us or ns.
        **settings: Other values of the scenario, such as `fix_codes="nmea"` or `filter_step_s=0.5`.

    Returns:
        The scenario, a variant of `user_log`, or of `user_log_aligned` without a reference.

    Raises:
        ValueError: If a column is missing, or the log is not valid; the message has the mapping to complete.
    """
    for key, value, options in (("axes", axes, _SIGNS), ("time", time, SECONDS)):
        if value not in options:
            raise ValueError(
                f"{key} must be one of {', '.join(options)}, got {value!r}. Set {key}={next(iter(options))!r}."
            )
    tables, notes = {}, []
    with plain_errors():
        sources = {"imu": imu, "gnss": gnss} | (
            {} if reference is None else {"reference": reference}
        )
        for name, source in sources.items():
            tables[name], note = _convert(name, _read(name, source), columns or {}, SECONDS[time])
            notes.append(f"{name}: {note}")
        for column, sign in zip("xyz", _SIGNS[axes], strict=True):
            tables["imu"][[f"f{column}", f"w{column}"]] *= sign
        folder = _store(tables)
        words = format_words({"root": str(folder.parent), "folder": folder.name, **settings})
        kind = "user_log_aligned" if reference is None else "user_log"
        scenario = Part("scenario", kind, tuple(f"scenario.{word}" for word in words))
        _check(folder, settings, has_reference=reference is not None)
    print("\n".join([*notes, f"axes {axes}, times in {time}, stored in {folder}"]))
    return scenario


def _read(name: str, source: Any) -> pd.DataFrame:
    """Read a table of a log from a file, or copy a data frame."""
    import pandas as pd

    if isinstance(source, pd.DataFrame):
        return source.copy()
    if not isinstance(source, str | Path):
        raise TypeError(
            f"{name} must be a file or a data frame, got {describe_value(source)}. Pass the path of a CSV file."
        )
    path = Path(source)
    require(
        path.is_file(),
        name,
        "be an existing file",
        path,
        "Correct its name.",
    )
    return (
        pd.read_parquet(path)
        if path.suffix == ".parquet"
        else pd.read_csv(path, skipinitialspace=True)
    )


def _convert(
    name: str, table: pd.DataFrame, columns: Mapping[str, str], second: float
) -> tuple[pd.DataFrame, str]:
    """Rename the columns of a table to those of the format; return it with a sentence on the names."""
    mapping = {str(column): _find_name(str(column), columns) for column in table.columns}
    renamed = {column: target for column, target in mapping.items() if target}
    targets = list(renamed.values())
    if double := sorted({target for target in targets if targets.count(target) > 1}):
        several = [column for column, target in renamed.items() if target == double[0]]
        raise ValueError(
            f"{name} must have one column for {double[0]}, got {', '.join(several)}. Name the right one: columns={{{several[0]!r}: "
            f"{double[0]!r}}}, and drop the others."
        )
    missing = [target for target in _NEEDED[name] if target not in targets]
    if name != "imu" and not any(set(position) <= set(targets) for position in _POSITION):
        missing.append(" ".join(_POSITION[0]))
    if missing:
        # a name is proposed for what it says alone: by order, gyro and force change places
        free = [column for column, target in mapping.items() if not target]
        pairs = [(c, _guess(c, missing)) for c in free]
        example = ", ".join(f"{c!r}: {target!r}" for c, target in pairs if target)
        remedy = f"columns={{{example or repr('YOUR_COLUMN') + ': ' + repr(missing[0])}}}"
        raise ValueError(
            f"{name} must have the columns {', '.join(missing)}, got {', '.join(mapping)}. Name yours: {remedy}."
        )
    changed = [f"{column} is {target}" for column, target in renamed.items() if column != target]
    result = table[list(renamed)].rename(columns=renamed)
    result["t"] = result["t"] * second
    return result, ", ".join(changed) or "columns as in the format"


def _find_name(column: str, columns: Mapping[str, str]) -> str:
    """Return the name in the format of a column; empty for none."""
    if column in columns:
        return columns[column]
    if column in columns.values():  # another column takes its place
        return ""
    plain = re.sub(r"[^a-z0-9]", "", _UNITS.sub("", column.strip()).lower())
    names = (target for target, others in _NAMES.items() if column == target or plain in others)
    return next(names, "")


def _guess(column: str, missing: Sequence[str]) -> str:
    """Return the missing column whose quantity and axis a name states; empty for none."""
    match = re.fullmatch(
        r"(?P<kind>.*?(?:acc|gyr|force|rate|omega)\w*?)[^a-z0-9]*(?P<axis>[xyz012])\W*",
        column.lower(),
    )
    if not match:
        return ""
    letter = "f" if re.search("acc|force", match["kind"]) else "w"
    target = letter + dict(zip("012", "xyz", strict=True)).get(match["axis"], match["axis"])
    return target if target in missing else ""


def _store(tables: Mapping[str, pd.DataFrame]) -> Path:
    """Write the tables into a folder named by their content."""
    texts = {name: table.to_csv(index=False) for name, table in tables.items()}
    digest = hashlib.sha256("\n".join(texts.values()).encode()).hexdigest()[:10]
    folder = Path(WRITTEN).absolute() / f"log_{digest}"
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        if not (folder / f"{name}.csv").is_file():
            write_atomically(folder / f"{name}.csv", methodcaller("write", text.encode()))
    return folder


def _check(folder: Path, settings: Mapping[str, Any], *, has_reference: bool) -> None:
    """Read the log as a job would, so that its errors appear at once."""
    from pfbench.scenario import LogFiles, read_log

    options = {key: settings[key] for key in ("origin", "fix_codes") if key in settings}
    files = LogFiles() if has_reference else LogFiles(reference=None)
    read_log(folder, files, has_attitude=has_reference, **options)
