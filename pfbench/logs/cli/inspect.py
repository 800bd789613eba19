"""Command `pfbench inspect`: name the faults of an own log, and the settings that mend them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.cli.command import Command
from pfbench.core.parameter_checks import require
from pfbench.logs.cli.judge import convert_numbers

_KEYS = ("imu", "gnss", "reference", "path", "sensor", "fix_codes", "origin", "reports_dir")
_WARNED, _REFUSED = 3, 2


def inspect_folder(words: Sequence[str]) -> None:
    """Inspect a log, print its findings and write the page."""
    folder, values = _split_folder(words)
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
        "words": _describe_words(names, options),
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


def _split_folder(words: Sequence[str]) -> tuple[Path, dict[str, str]]:
    """Return the folder and the values by key."""
    folders = [word for word in words if "=" not in word]
    values: dict[str, str] = {}
    for word in words:
        key, equals, value = word.removeprefix("scenario.").partition("=")  # as remedies name them
        if not equals:
            continue
        require(
            key in _KEYS and value and key not in values,
            "words",
            f"be FOLDER and key=value with the keys {', '.join(_KEYS)}, each once",
            word,
            "See pfbench inspect --help.",
        )
        values[key] = value
    got = " ".join(folders) or "none"
    require(len(folders) == 1, "inspect", "have one folder", got, "Use: pfbench inspect my_log")
    folder = Path(folders[0])
    require(
        folder.is_dir(),
        folder,
        "be a folder with imu, gnss and, if there is one, reference",
        "none",
        "Check the path.",
    )
    return folder.resolve(), values


def _convert_options(values: Mapping[str, str]) -> dict[str, Any]:
    """Convert numbers and lists."""
    options: dict[str, Any] = {}
    for key, name in (("path", "path"), ("sensor", "imu")):
        if key in values:
            options[name] = int(convert_numbers(key, values[key], 0.0))
    if "origin" in values:
        options["origin"] = list(convert_numbers("origin", values["origin"], ()))
    codes = values.get("fix_codes", "")
    if codes.startswith("["):
        options["fix_codes"] = [int(code) for code in convert_numbers("fix_codes", codes, ())]
    elif codes:
        options["fix_codes"] = codes
    return options


def _describe_words(names: Mapping[str, str], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of the scenario that read the log in the same way."""
    keys = {key: options[key] for key in ("origin", "fix_codes") if key in options}
    files = {"files": json.loads(json.dumps(names))} if names else {}
    return {**files, **keys}


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
