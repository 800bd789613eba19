"""Command `pfbench judge`: compare trajectories of other programs with a reference."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from pfbench.cli.command import Command
from pfbench.cli.messages import require_choice, suggest_similar
from pfbench.core.parameter_checks import require

if TYPE_CHECKING:
    from pfbench.logs.judge.judge_options import SourceOptions

_RENAMED = {"from": "start", "to": "end"}  # words of the command line that Python reserves
_OTHER_PAGES = ("claims", "datasheets")  # folders of reports
_LONGEST_NAME = 100
_NAME = re.compile(r"[A-Za-z][\w+-]*")
_PAIR = re.compile(
    r'\s*(?P<name>\w+)\s*:\s*(?:"(?P<quoted>(?:[^"]|"")+)"|(?P<plain>[^,"\s](?:[^,]*[^,\s])?))\s*(?:,|$)'
)


def judge_trajectories(words: Sequence[str]) -> None:
    """Compare programs and write the report."""
    values = split_values(words, "judge")
    options, sources, programs = _sort_words(values)
    from pfbench.logs.judge.judgement import judge_programs
    from pfbench.logs.judge.page import describe_material, describe_notes, write_judgement
    from pfbench.logs.judge.pair_sentences import describe_judgement

    reference, study = programs.pop("reference"), str(values.get("study", "judge"))
    must, remedy = (
        f"be letters, digits, _, -, + or ., at most {_LONGEST_NAME}",
        "Change study=NAME.",
    )
    require(
        re.fullmatch(r"[\w+.-]*\w[\w+.-]*", study) and len(study) <= _LONGEST_NAME,
        "study",
        must,
        study[:150],
        remedy,
    )
    require(
        study not in _OTHER_PAGES,
        "study",
        f"not be {' or '.join(_OTHER_PAGES)}",
        study,
        f"These folders hold other pages. {remedy}",
    )
    judgement = judge_programs(reference, programs, options, sources)
    page = write_judgement(judgement, values.get("reports_dir", "reports"), study, options)
    print(describe_material(judgement))
    for sentence in (*describe_notes(judgement, options), *describe_judgement(judgement)):
        print(f"- {sentence}")
    print(f"report: {page.resolve()}")


def split_values(
    words: Sequence[str], command: str, keys: Sequence[str] | None = None
) -> dict[str, str]:
    """Return the values by key; a key occurs once, and is one of some keys."""
    values: dict[str, str] = {}
    for word in words:
        key, _, value = word.partition("=")
        require(
            value and key not in values,
            "words",
            "be key=value, each key once",
            word,
            f"See pfbench {command} --help.",
        )
        if keys is not None:
            require_choice("key", key, keys, f"See pfbench {command} --help.")
        values[key] = value
    return values


def _sort_words(
    values: Mapping[str, str],
) -> tuple[Any, dict[str, SourceOptions], dict[str, str]]:
    """Return options, options of sources, and patterns of the reference and the programs."""
    from pfbench.logs.judge.judge_options import JudgeOptions, SourceOptions, name_program

    types = {field.name: field.default for field in fields(JudgeOptions)}
    keys = {new: old for old, new in _RENAMED.items()}
    option_keys = [keys.get(name, name) for name in types]
    options: dict[str, Any] = {}
    sources: dict[str, dict[str, Any]] = {}
    programs: dict[str, str] = {}
    for key, value in values.items():
        name, dot, option = key.partition(".")
        if key in option_keys:
            field = _RENAMED.get(key, key)
            options[field] = convert_numbers(key, value, types[field])
        elif dot:
            sources.setdefault(name, {})[option] = convert_source(key, option, value)
        elif key not in ("study", "reports_dir"):
            programs[key] = value
    _check_programs(programs, sources, [*option_keys, "study", "reports_dir"])
    of_programs = {}
    for name, values_of_program in sources.items():
        with name_program(name):
            of_programs[name] = SourceOptions(**values_of_program)
    return JudgeOptions(**options), of_programs, programs


def _check_programs(
    programs: Mapping[str, str], sources: Mapping[str, Any], option_keys: Sequence[str]
) -> None:
    """Check that the reference and a program are present, and that all names are valid."""
    require(
        "reference" in programs and len(programs) > 1,
        "judge",
        "have a reference and programs",
        "no program" if "reference" in programs else "no reference",
        "Use: pfbench judge reference=truth.csv mine=a.csv theirs=b.csv",
    )
    for name, pattern in programs.items():
        is_path = "." in pattern or "/" in pattern or os.path.isfile(pattern)
        require(
            not is_path or _NAME.fullmatch(name),
            "names of programs",
            "be letters, digits, _, + and -, with a letter first",
            f"{name!r}",
            f"Rename the program: {re.sub('[^A-Za-z0-9_+-]+', '_', name).strip('_') or 'mine'}={pattern}",
        )
        require(
            is_path,
            name,
            "be a program with a file",
            f"{name}={pattern}.{suggest_similar(name, option_keys)}".removesuffix("."),
            "See pfbench judge --help.",
        )
    for name in sources:
        require(
            name in programs,
            name,
            "be a program with a file",
            "options without one",
            f"Add {name}=FILE.",
        )


def convert_numbers(key: str, value: str, default: Any) -> Any:
    """Convert the text of an option to the type of its default."""
    if isinstance(default, str):
        return value
    try:
        numbers = tuple(float(text) for text in value.strip("[]()").split(","))
    except ValueError:
        numbers = ()
    require(
        numbers
        and (len(numbers) == 1 or not isinstance(default, float))
        and not any(n != n for n in numbers),
        key,
        "be a number",
        value,
        f"Change {key}=...",
    )
    return numbers[0] if isinstance(default, float) else numbers


def convert_source(key: str, option: str, value: str) -> Any:
    """Convert the text of an option of a program."""
    if option == "shift":
        return convert_numbers(key, value, 0.0)
    if option == "columns":
        return _split_pairs(key, value, "NAME:NAME_IN_FILE", "t:time,pn:north")
    if option == "scale":
        factors = _split_pairs(key, value, "NAME:FACTOR", "t:0.001")
        return {name: convert_numbers(key, text, 0.0) for name, text in factors.items()}
    require(
        option in ("frame", "format", "sd", "time", "repeats"),
        key,
        "be an option of a program",
        option,
        "Choose from frame, format, shift, columns, scale, sd, time.",
    )
    return value


def _split_pairs(key: str, value: str, form: str, example: str) -> dict[str, str]:
    """Return what follows the colon by name; quotes enclose a text with commas, brackets are its own."""
    for first, last in ("{}", "[]"):  # of the list as a whole, since no name of pfbench starts so
        if value.startswith(first) and value.endswith(last):
            value = value[1:-1]
    pairs: dict[str, str] = {}
    start = 0
    while start < len(value):
        match = _PAIR.match(value, start)
        if not match or match["name"] in pairs:
            raise ValueError(
                f"{key} must be {form},..., each name once, got {value}. Use {example}, and quotes around "
                "a name with commas."
            )
        quoted = match["quoted"]
        pairs[match["name"]] = match["plain"] if quoted is None else quoted.replace('""', '"')
        start = match.end()
    return pairs


COMMAND = Command(
    judge_trajectories,
    """\
pfbench judge reference=FILE NAME=FILE NAME=FILE ... [key=value ...]

Compare trajectories of any programs with a reference and with each other, and write a report.

  pfbench judge reference=truth.csv mine=a.csv theirs=b.tum theirs.frame=enu
  pfbench judge reference=truth/{sequence}.csv 'mine=mine/{sequence}_{run}.csv' 'theirs=theirs/{sequence}.nav'

Formats, found by content: CSV and .parquet with the columns t, pn, pe, pd (or lat_deg, lon_deg, h_m), optional
vn, ve, vd, roll, pitch, yaw, sd_pn, ..., cov_nn, ...; TUM; NMEA; KF-GINS; RTKLIB .pos; .npz of pfbench.

  study=NAME             name of the report (judge)        reports_dir=FOLDER   folder of reports (reports)
  from=S to=S every=S    scored time and distance of epochs
  tolerance=S            largest difference of common epochs (0.01)
  holes=skip             leave out long gaps of the reference; largest_gap=S sets their length
  coverage=SHARE         least share of the time that a run covers (0.9)
  limit=M                position error above which a run diverges
  align=offset|yaw       remove a motion from positions (none)
  origin=LAT,LON,H       origin of local positions, deg, deg, m
  block=S                length of the blocks of time (30 blocks)
  baseline=NAME          compare all with one program (all pairs)
  alpha=0.05 margin=0.05 level of the tests, margin of equality
  NAME.frame=enu|ned     axes of a TUM file                NAME.shift=S   time added to a clock
  NAME.columns=t:time,pn:north,...   names of columns      NAME.sd=FILE   deviations of KF-GINS
  NAME.scale=t:0.001,yaw:0.0174533   factors of columns    NAME.format=table|tum|kf_gins|nmea|rtklib|result""",
)
