"""Own recorded logs: files or tables in any format that `pfbench import` reads, as `user_log` or `user_log_aligned`."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pfbench.core.parameter_checks import require
from pfbench.door.parts import Part, describe_value, format_words, plain_errors
from pfbench.files.table_file import TableFile
from pfbench.job.trust import WRITTEN
from pfbench.logs.judge.judge_options import SourceOptions, name_program
from pfbench.logs.judge.own_log import import_table, write_log

_TURNED = {"frd": {}, "flu": dict.fromkeys(("fy", "fz", "wy", "wz"), -1.0)}  # factors by body axes


def make_log(
    imu: Any,
    gnss: Any,
    reference: Any = None,
    *,
    columns: Mapping[str, str] | None = None,
    axes: str = "frd",
    time: str = "s",
    repeats: str = "refuse",
    scale: Mapping[str, Mapping[str, float]] | None = None,
    **settings: Any,
) -> Part:
    """Make a scenario of your own recorded log, and print what was assumed.

    Args:
        imu: Table of the IMU: a file in a format of `pfbench import`, or a data frame. Force [m/s^2] and angular rate [rad/s].
        gnss: Table of the fixes.
        reference: Table of the reference, which gives the truth. None for a log without one: filters start from level
            and course, and errors are distances to held-out fixes.
        columns: Your names of columns that are not understood by themselves, such as `{"my_ax": "fx"}`.
        axes: Body axes of the IMU: frd (forward, right, down) or flu (forward, left, up).
        time: Unit of the times: s, ms, us, ns, minutes or hours.
        repeats: refuse rows that repeat a time, or first to keep the first of them.
        scale: Factors by table and column, such as `{"reference": {"yaw": 0.0174533}}`.
        **settings: Other values of the scenario, such as `fix_codes="nmea"` or `filter_step_s=0.5`.

    Returns:
        The scenario, a variant of `user_log`, or of `user_log_aligned` without a reference.

    Raises:
        ValueError: If a column is missing, or the log is not valid; the message has the mapping to complete.
    """
    require(axes in _TURNED, "axes", f"be one of {', '.join(_TURNED)}", f"{axes!r}", "Set axes='frd'.")  # fmt: skip
    sources = {"imu": imu, "gnss": gnss, "reference": reference}
    tables: dict[str, TableFile] = {}
    with plain_errors(), tempfile.TemporaryDirectory() as scratch:
        for role, source in sources.items() if reference is not None else [*sources.items()][:2]:
            factors = dict((scale or {}).get(role, {}))
            for column, sign in (_TURNED[axes] if role == "imu" else {}).items():
                factors[column] = sign * factors.get(column, 1.0)
            with name_program(role):
                options = SourceOptions(names=columns or {}, scale=factors, time=time, repeats=repeats)  # fmt: skip
                tables[role] = import_table(role, _find_file(role, source, scratch), options)
        folder = _store(tables)
        words = format_words({"root": str(folder.parent), "folder": folder.name, **settings})
        kind = "user_log_aligned" if reference is None else "user_log"
        scenario = Part("scenario", kind, tuple(f"scenario.{word}" for word in words))
        _check(folder, settings, has_reference=reference is not None)
    notes = (f"{role}: {'; '.join(table.notes) or 'columns as in the format'}" for role, table in tables.items())  # fmt: skip
    print("\n".join([*notes, f"axes {axes}, times in {time}, stored in {folder}"]))
    return scenario


def _find_file(role: str, source: Any, scratch: str) -> Path:
    """Return the file of a table; a data frame is written to one."""
    if isinstance(source, str | Path):
        return Path(source)
    file = Path(scratch, f"{role}.csv")
    if not hasattr(source, "to_csv"):
        raise TypeError(
            f"{role} must be a file or a data frame, got {describe_value(source)}. Pass the path of a CSV file."
        )
    source.to_csv(file, index=False)
    return file


def _store(tables: Mapping[str, TableFile]) -> Path:
    """Write the tables into a folder named by their content."""
    texts = [f"{role} {table.rows.to_csv(index=False)}" for role, table in tables.items()]
    digest = hashlib.sha256("\n".join(texts).encode()).hexdigest()[:10]
    folder = Path(WRITTEN).absolute() / f"log_{digest}"
    if not folder.is_dir():
        write_log(folder, tables)
    return folder


def _check(folder: Path, settings: Mapping[str, Any], *, has_reference: bool) -> None:
    """Read the log as a job would, so that its errors appear at once."""
    from pfbench.scenario import LogFiles, read_log

    options = {key: settings[key] for key in ("origin", "fix_codes") if key in settings}
    files = LogFiles() if has_reference else LogFiles(reference=None)
    read_log(folder, files, has_attitude=has_reference, **options)
