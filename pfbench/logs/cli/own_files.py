"""Command `pfbench import`: write the tables of an own log from files of other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pfbench.cli.command import Command
from pfbench.core.parameter_checks import require
from pfbench.logs.cli.judge import convert_source

_TABLES = ("imu", "gnss", "reference")
_KEYS = ("format", "frame", "time", "repeats", "columns", "scale")


def import_log(words: Sequence[str]) -> None:
    """Import a log, and inspect it."""
    folder, files, options, others = _split_words(words)
    require(
        not folder.exists(),
        folder,
        "be a new folder",
        "one that exists",
        "Choose another name, or remove it.",
    )
    from pfbench.logs.cli.inspect import inspect_folder
    from pfbench.logs.judge.judge_options import SourceOptions, name_program
    from pfbench.logs.judge.own_log import import_table, write_log

    tables = {}
    for role, file in files.items():
        with name_program(role):
            tables[role] = import_table(role, Path(file), SourceOptions(**options.get(role, {})))
    write_log(folder, tables)
    for role, table in tables.items():
        notes = "".join(f"; {note}" for note in table.notes)
        print(f"{role}: {len(table.rows)} rows from {files[role]}{notes}")
    inspect_folder([str(folder), *others])


def _split_words(
    words: Sequence[str],
) -> tuple[Path, dict[str, str], dict[str, dict[str, Any]], list[str]]:
    """Return the folder, the files, the options of each table, and the words of the inspection."""
    files: dict[str, str] = {}
    options: dict[str, dict[str, Any]] = {}
    folders, others = [], []
    for word in words:
        key, equals, value = word.partition("=")
        role, _, name = key.partition(".")
        if not equals:
            folders.append(word)
        elif key in _TABLES:
            files[key] = value
        elif key in ("reports_dir", "fix_codes", "origin"):
            others.append(word)
        else:
            require(
                role in _TABLES and name in _KEYS,
                "words",
                "be FOLDER, imu=, gnss=, reference= and NAME.key=value",
                word,
                "See pfbench import --help.",
            )
            options.setdefault(role, {})[name] = convert_source(key, name, value)
    missing = [role for role in _TABLES[:2] if role not in files]
    require(
        len(folders) == 1 and not missing,
        "import",
        "have a new folder and the files of imu and gnss",
        f"no {', '.join(missing) or 'folder'}",
        "Use: pfbench import my_log imu=a.csv gnss=b.csv reference=c.csv",
    )
    return Path(folders[0]), files, options, others


COMMAND = Command(
    import_log,
    """\
pfbench import FOLDER imu=FILE gnss=FILE [reference=FILE] [NAME.key=value ...]

Write the tables imu, gnss and, if there is one, reference of an own log to a new folder, and inspect it.

  pfbench import my_log imu=imu.csv gnss=rover.pos reference=truth.tum reference.frame=enu
  pfbench import my_log imu=raw.csv imu.columns=t:time,fx:ax,fy:ay,fz:az,wx:gx,wy:gy,wz:gz imu.time=ms ...

Formats, found by content: tables with names; TUM, KF-GINS (result, IMU increments, fixes), NMEA, RTKLIB .pos, EuRoC,
KITTI (the folder of a drive for each of the three).

  NAME.format=table|tum|kf_gins|nmea|rtklib|euroc|kitti
  NAME.columns=t:time,...   name of pfbench:name in the file
  NAME.scale=lat_deg:1e-7,...   factors of columns
  NAME.time=s|ms|us|ns      unit of the time of a table
  NAME.repeats=first        keep the first row of each time
  NAME.frame=enu|ned        axes of a TUM file
  reports_dir=FOLDER        folder of reports (reports)

Exit codes: those of pfbench inspect""",
)
