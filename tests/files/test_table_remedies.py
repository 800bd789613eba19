"""Tables that other programs write: what the message tells makes them read, with the same numbers."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from pfbench.files.table_file import read_table_file

NAMES, ROWS = "t,a,b", ["0.0,1.5,-2.5", "0.1,1.25,-2.75", "0.2,1.0,-3.0"]
TEXT = "\n".join([NAMES, *ROWS]) + "\n"


def by_pandas(file: Path, said: str) -> None:
    """Runs the call that the message names, in the folder of the file."""
    options, target = re.search(
        r"In pandas, read_csv\('table.csv'(.*?)\)\.to_csv\('(.*?)', index=False\)", said
    ).groups()  # type: ignore[union-attr]
    table = eval(f"pd.read_csv(file{options})", {"pd": pd, "file": file})
    table.to_csv(file.parent / target, index=False)


def edit(pattern: str, new: str, count: int = 0) -> Callable[[Path, str], None]:
    def apply(file: Path, _: str) -> None:
        file.write_text(re.sub(pattern, new, file.read_text(), count=count, flags=re.MULTILINE))

    return apply


CASES: dict[str, tuple[bytes, str, Callable[[Path, str], None]]] = {
    "semicolons": (TEXT.replace(",", ";").encode(), "semicolons as separators", by_pandas),
    "decimal commas": (TEXT.replace(",", ";").replace(".", ",").encode(), "semicolons", by_pandas),
    "tabs": (TEXT.replace(",", "\t").encode(), "tabs as separators", by_pandas),
    "blanks": (TEXT.replace(",", "  ").encode(), "blanks as separators", by_pandas),
    "latin-1": (TEXT.replace("b", "\xb0", 1).encode("latin-1"), "line 1 must be text", by_pandas),
    "utf-16": (TEXT.encode("utf-16"), "line 1 must be text", by_pandas),
    "old line ends": (TEXT.replace("\n", "\r").encode(), "writes line ends", by_pandas),
    "comment": (f"# by a logger\n{TEXT}".encode(), "Remove this line", edit("^#.*\n", "")),
    "comma at the end": (
        "\n".join([NAMES, *(f"{row}," for row in ROWS), ""]).encode(),
        "Remove the comma at the end",
        edit(",$", ""),
    ),
    "name too few": (
        TEXT.replace("t,a,b", "t,a").encode(),
        "All others have 3 fields: give line 1 as many names",
        edit("^t,a$", "t,a,b"),
    ),
    "one line": (TEXT.replace("0.1,1.25", "0.1,9,1.25").encode(), "Repair or remove this line", edit("9,", "")),
    "numbers alone": (TEXT.partition("\n")[2].encode(), "Insert a line with the names", edit("^", "t,a,b\n", 1)),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_table_of_another_program_reads_after_the_remedy(tmp_path: Path, name: str) -> None:
    content, message, repair = CASES[name]
    file = tmp_path / "table.csv"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=message) as error:
        read_table_file(file)
    repair(file, str(error.value))
    rows = read_table_file(file).rows
    assert rows.to_numpy().tolist() == [[float(x) for x in row.split(",")] for row in ROWS]


def test_decimal_commas_between_commas_are_named(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text("t,a\n" + "0,1,1,5\n" * 3)
    with pytest.raises(ValueError, match="decimal commas: write them with points"):
        read_table_file(tmp_path / "table.csv")
