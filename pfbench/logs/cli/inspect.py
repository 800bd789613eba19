"""Command `pfbench inspect`: name the faults of an own log, and the settings that mend them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.cli.command import Command
from pfbench.core.parameter_checks import require
from pfbench.logs.cli.judge import convert_numbers, split_values

_KEYS = ("imu", "gnss", "reference", "path", "sensor", "fix_codes", "origin", "reports_dir")
_SCENARIO = (
    "files",
    "origin",
    "fix_codes",
)  # keys of the scenario that read the log in the same way
_WARNED, _REFUSED = 3, 2


def inspect_folder(words: Sequence[str]) -> None:
    """Inspect a log, print its findings and write the page."""
    folder, others = split_folder([w.removeprefix("scenario.") for w in words], "inspect")
    values = split_values(others, "inspect", _KEYS)
    require(folder.is_dir(), folder, "be a folder with imu, gnss and, if there is one, reference", "none", "Check the path.")  # fmt: skip
    from pfbench.logs.doctor.thresholds import THRESHOLDS
    from pfbench.logs.judge.log_page import describe_run, write_log_page
    from pfbench.scenario import LogFiles, inspect_log

    names: dict[str, str] = {k: values[k] for k in ("imu", "gnss", "reference") if k in values}
    options = _convert_options(values)
    diagnosis = inspect_log(folder, LogFiles(**names) if names else None, **options)
    works = diagnosis.facts.get("checks without a reference", ())
    source = {
        "scenario": "user_log_aligned" if works else "user_log",
        "name": folder.name,
        "root": folder.parent,
        "folder": folder.name,
        "words": {k: v for k, v in {"files": names, **options}.items() if v and k in _SCENARIO},
    }
    page = write_log_page(diagnosis, source, values.get("reports_dir", "reports"))
    for finding in diagnosis.findings:
        print(f"{finding.level:7} {finding.check}: {finding.text}")
    if works:
        others = [name for name in THRESHOLDS if name not in works]
        print(f"no reference. These checks work without one: {', '.join(works)}")
        print(f"These compare with a reference and were left out: {', '.join(others)}")
    counts = {level: len(diagnosis.of(level)) for level in ("refuse", "warn", "tell")}
    print(f"{folder.name}: {', '.join(f'{n} {level}' for level, n in counts.items())}")
    print(f"report: {page.resolve()}")
    if diagnosis.settings:
        print(f"Mended: {describe_run(page.parent, folder.parent)}")
    if counts["refuse"] or counts["warn"]:
        raise SystemExit(_REFUSED if counts["refuse"] else _WARNED)


def split_folder(words: Sequence[str], command: str) -> tuple[Path, list[str]]:
    """Return the one word that is a folder, and the others."""
    folders = [word for word in words if "=" not in word]
    require(len(folders) == 1, command, "have one folder", " ".join(folders) or "none", f"Use: pfbench {command} my_log")  # fmt: skip
    return Path(folders[0]).resolve(), [word for word in words if "=" in word]


def _convert_options(values: Mapping[str, str]) -> dict[str, Any]:
    """Convert numbers and lists."""
    numbers = {
        "path": ("path", 0.0, int),
        "sensor": ("imu", 0.0, int),
        "origin": ("origin", (), list),
    }
    options = {
        name: kind(convert_numbers(key, values[key], default))
        for key, (name, default, kind) in numbers.items()
        if key in values
    }
    if codes := values.get("fix_codes", ""):
        is_list = codes.startswith("[")
        options["fix_codes"] = (
            [int(c) for c in convert_numbers("fix_codes", codes, ())] if is_list else codes
        )
    return options


COMMAND = Command(
    inspect_folder,
    """\
pfbench inspect FOLDER [key=value ...]

Check an own log (docs/use_your_data.md), name its faults, and write reports/inspect_NAME/ with a picture for
each finding and scenario/suggested.yaml, settings that mend them.

  pfbench inspect my_log
  pfbench inspect my_log gnss=fixes fix_codes=nmea

  imu=NAME gnss=NAME reference=NAME   names of the tables (imu, gnss, reference); a log can have no reference
  path=N sensor=N            flight and sensor of tables with the columns path and imu
  fix_codes=NAME|[4,5]       codes of the column fix: nmea, rtklib, mavlink, ublox or a list
  origin=LAT,LON,H           origin of local positions, deg, deg, m
  reports_dir=FOLDER         folder of reports (reports)

Exit codes: 0 no warning, 3 warnings, 2 refused: a run would refuse the log""",
)
