"""Reading of CSV and Parquet tables: a damaged file gives an error with its place, never a partial table."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pfbench.files import limits

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]  # of columns
_SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars"}
_COMMENT = "#%"
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f]")


class TableFile(NamedTuple):
    """Content of a table file.

    Attributes:
        rows: Rows.
        stated: Metadata of a Parquet file.
        notes: Rows that the reader dropped.
    """

    rows: pd.DataFrame
    stated: dict[str, str]
    notes: tuple[str, ...] = ()


def read_table_file(file: Path) -> TableFile:
    """Read a CSV or Parquet file."""
    limits.check_is_file(file, limits.TABLE_BYTES)
    return _read_parquet(file) if file.suffix == ".parquet" else _read_csv(file)


def _read_csv(file: Path) -> TableFile:
    import pandas as pd  # half a second that a run without tables does not need

    lines, notes = _whole_lines(file)
    if _has_names_in_comment(lines):
        lines[0] = lines[0].lstrip(_COMMENT + " ")
    limits.check_columns(file, lines[0].count(",") + 1)
    names = [name.strip() for name in _split_fields(lines[0])]
    _check_names(file, lines, names)
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated or not all(names):
        problem = f"{', '.join(repeated)} twice" if repeated else "an empty name"
        raise ValueError(
            f"{file.name}: line 1 must have different names of columns, got {problem}. "
            "Rename or remove a column. In pandas, to_csv(index_label=NAME) names the index."
        )
    for number, line in enumerate([] if _is_regular(lines, len(names)) else lines, 1):
        fields = len(_split_fields(line)) if line.strip() else 0
        if fields != len(names) or line.count('"') % 2:
            raise ValueError(
                f"{file.name}: line {number} must have {len(names)} fields separated by commas, "
                f"got {fields} in {line[:80]!r}. {_field_remedy(lines, len(names))}"
            )
    # bytes, since a text file in memory has four of them per character
    content, count = io.BytesIO(("\n".join(lines) + "\n").encode()), len(lines)
    del lines
    try:
        rows = pd.read_csv(
            content,
            skip_blank_lines=False,
            skipinitialspace=True,
            index_col=False,
            low_memory=False,
        )
    except (ValueError, OverflowError, IndexError) as error:
        raise ValueError(
            f"{file.name} must be a table of numbers separated by commas, got an error of the "
            f"reader: {_first_line(error)}. Write the file again."
        ) from error
    if len(rows) != count - 1:
        raise ValueError(
            f"{file.name} must have one row in each line, got {len(rows)} rows in "
            f"{count - 1} lines. Remove quotes and line breaks inside of fields."
        )
    rows.columns = pd.Index(names)
    return TableFile(rows, {}, notes)


def _is_regular(lines: Sequence[str], fields: int) -> bool:
    """Return whether all lines have this many fields and none has quotes; False for one field, which can be blank."""
    return fields > 1 and all(line.count(",") == fields - 1 and '"' not in line for line in lines)


def _field_remedy(lines: Sequence[str], names: int) -> str:
    """Return what makes all lines have as many fields as there are names."""
    rows = [line for line in lines[1:] if line.strip()]
    counts = [line.count(",") + 1 for line in rows]
    if all(line.endswith(",") and n == names + 1 for line, n in zip(rows, counts, strict=True)):
        return "Remove the comma at the end of the lines, or add one to line 1."
    if counts and min(counts) == 2 * names == max(counts):
        return "The numbers have decimal commas: write them with points."
    if counts and min(counts) == max(counts) != names:
        return f"All others have {counts[0]} fields: give line 1 as many names."
    return "Repair or remove this line."


def _split_fields(line: str) -> list[str]:
    """Return the fields of a line; one in quotes can contain commas."""
    if '"' not in line or len(line) > csv.field_size_limit():
        return line.split(",")
    return next(csv.reader([line], skipinitialspace=True))


def _has_names_in_comment(lines: Sequence[str]) -> bool:
    """Return whether line 1 is a comment with a name for each field of line 2."""
    if not lines[0].lstrip().startswith(tuple(_COMMENT)) or len(lines) < 2:
        return False
    names, fields = _split_fields(lines[0]), _split_fields(lines[1])
    return len(names) == len(fields) > 1 and all(map(is_number_text, filter(str.strip, fields)))


def _check_names(file: Path, lines: Sequence[str], names: Sequence[str]) -> None:
    """Raise ValueError if line 1 is a comment, has other separators, or has numbers instead of names."""
    problem, remedy, line = "", "", lines[0]
    # a name can contain a comma between other separators
    separator = next((s for s in _SEPARATORS if line.count(s) >= max(1, line.count(","))), "")
    if line.lstrip().startswith(tuple(_COMMENT)):
        has_names = len(lines) > 1 and line.count(",") == lines[1].count(",") > 0
        problem = "a comment"
        remedy = (
            "Remove the sign of the comment before the names." if has_names else "Remove this line."
        )
    elif separator or (len(names) == 1 and len(line.split()) > 2):
        pattern = separator or r"\s+"
        problem = f"{_SEPARATORS.get(separator, 'blanks')} as separators"
        decimal = ", decimal=','" if any("," in text for text in lines[1:2]) else ""
        remedy = _convert(file, f"sep={pattern!r}{decimal}", "commas")
    elif all(map(is_number_text, names)):
        problem, remedy = "numbers alone", "Insert a line with the names."
    if problem:
        raise ValueError(
            f"{file.name}: line 1 must be names of columns separated by commas, got {problem} in "
            f"{line[:80]!r}. {remedy}"
        )


def _convert(file: Path, options: str, result: str) -> str:
    words = ", ".join(filter(None, (repr(file.name), options)))
    return f"In pandas, read_csv({words}).to_csv({file.name!r}, index=False) writes {result}."


def is_number_text(text: str) -> bool:
    """Return whether a field of a text file is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _whole_lines(file: Path) -> tuple[list[str], tuple[str, ...]]:
    """Return the complete lines, and a note if the last one is not complete."""
    content = limits.read_text(file)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        position = content[: error.start].count(b"\n") + 1
        remedy = "Repair or remove this line."
        if position == 1:  # without the names the rest is not a table
            encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "latin-1"
            remedy = _convert(file, f"encoding={encoding!r}", "UTF-8")
        raise ValueError(
            f"{file.name}: line {position} must be text in UTF-8, got the byte "
            f"{content[error.start]:#04x}. {remedy}"
        ) from None
    del content
    text = text.replace("\r\n", "\n")
    lines = text.split("\n")
    control = _CONTROL.search(text)
    if control:
        number = text.count("\n", 0, control.start()) + 1
        is_old_mac = len(lines) == 1 and "\r" in text
        remedy = _convert(file, "", "line ends") if is_old_mac else "Repair or remove this line."
        raise ValueError(
            f"{file.name}: line {number} must not contain control characters, "
            f"got {lines[number - 1][:80]!r}. {remedy}"
        )
    last = lines.pop()
    if not lines:
        raise ValueError(
            f"{file.name} must have a line of column names, got {last[:80]!r} without a line end. "
            "Write the file again."
        )
    if not last:
        return lines, ()
    return lines, (describe_cut(file, len(lines) + 1),)


def split_lines(text: str) -> list[str]:
    """Split a text at line ends of any system; the last line is the one without an end."""
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def describe_cut(file: Path, line: int) -> str:
    """Describe a last line without a line end, which a reader drops."""
    return (
        f"{file.name}: line {line} has no line end, so the file may be truncated. "
        "This line was dropped"
    )


def _read_parquet(file: Path) -> TableFile:
    try:
        import pyarrow as pa  # required only for Parquet
        from pyarrow import parquet
    except ImportError as error:
        raise ValueError(
            f"{file.name} needs pyarrow. Run pip install 'pfbench[data]', or store the log as CSV."
        ) from error
    try:
        metadata = parquet.read_metadata(file)
        check_parquet(file)
        table = parquet.read_table(file, page_checksum_verification=True, use_threads=False)
        table.validate(full=True)
        names = table.column_names
        rows = table.to_pandas(ignore_metadata=True)
        pairs = (table.schema.metadata or {}).items()
        stated = {key.decode(): value.decode() for key, value in pairs}
        damage = _disagreement(metadata, rows)
    except limits.LimitError:
        raise
    except (
        pa.lib.ArrowException,
        OSError,
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        OverflowError,
        MemoryError,
    ) as error:
        raise ValueError(
            f"{file.name} must be a Parquet file, got an error of its reader: "
            f"{_first_line(error)}. Write the file again."
        ) from error
    if damage or len(set(names)) < len(names):
        raise ValueError(
            f"{file.name} must agree with the counts and limits stored in it, "
            f"got {damage or 'a column twice'}. The file is damaged: write it again."
        )
    return TableFile(rows, stated)


def check_parquet(file: Path) -> None:
    """Check the size of a Parquet file by its own counts, before it is read."""
    from pyarrow import parquet

    limits.check_is_file(file, limits.TABLE_BYTES)
    metadata = parquet.read_metadata(file)
    limits.check_columns(file, metadata.num_columns)
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    rows = max(metadata.num_rows, sum(group.num_rows for group in groups))
    stated = sum(group.total_byte_size for group in groups)
    limits.check_inflated(file, max(8 * rows * metadata.num_columns, stated))


def _disagreement(metadata: Any, rows: pd.DataFrame) -> str:
    """Describe the first column whose values leave the stored limits of a row group, or return ''."""
    if metadata.num_rows != len(rows):
        return f"{len(rows)} rows instead of {metadata.num_rows}"
    start = 0
    for group in (metadata.row_group(i) for i in range(metadata.num_row_groups)):
        section = rows.iloc[start : start + group.num_rows]
        start += group.num_rows
        for chunk in (group.column(i) for i in range(group.num_columns)):
            statistics, name = chunk.statistics, chunk.path_in_schema
            if statistics is None or not statistics.has_min_max or name not in section:
                continue
            text = _outside(section[name].to_numpy(), statistics.min, statistics.max)
            if text:
                return f"{text} in column {name}"
    return ""


def _outside(values: Any, least: Any, largest: Any) -> str:
    if values.dtype.kind not in "iuf" or not isinstance(least, int | float) or not len(values):
        return ""
    finite = values[np.isfinite(values)]
    if finite.size and finite.min() == least and finite.max() == largest:
        return ""
    if not finite.size or np.isinf(values).any():
        return ""  # rejected or accepted by the check of missing values
    return f"values from {finite.min()} to {finite.max()} instead of {least} to {largest}"


def _first_line(error: BaseException) -> str:
    lines: Sequence[str] = str(error).splitlines()
    return f"{type(error).__name__} {lines[0][:160] if lines else ''}".strip().rstrip(".")
