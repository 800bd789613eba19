"""Files of tunings to one table: `python experiments/analyses/tuned_table.py` after `pfbench tune ... folder=conf` in the checkout.

Each file conf/tuned/NAME.yaml becomes an entry of conf/tuned/families/worlds.yaml, which a run finds as it finds the file, and its
candidates become rows of tuned_candidates.parquet. To add a filter to an entry, `python experiments/analyses/tuned_table.py NAME` makes it a
file again, to which `pfbench tune` adds.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

TUNED = Path(__file__).parents[2] / "conf" / "tuned"
TABLE = TUNED / "families" / "worlds.yaml"
CANDIDATES = Path(__file__).with_name("tuned_candidates.parquet")
KEY = ["file", "filter"]
SCORES = ("log_ratio", "nees_ratio")
_REFERS = ("auto", "nominal")  # files that only refer to those of worlds
_OBJECTIVE = (
    "mean over regimes of log(median RMSE / median RMSE of the EKF), smallest; within 1 % the candidate whose "
    "NEES divided by its dimension is closest to 1"
)
_HEAD = f"""\
# Worlds in which pfbench has tuned filters: knobs that `pfbench tune` chose, what they were chosen by, and whether Kalman filters fit.
# Objective, unless an entry states another: {_OBJECTIVE}.
# The rule of `fit` is `FIT_RULE` of pfbench/job/tuned_files.py, and its ratios have both ends of their interval. All candidates are in experiments/analyses/tuned_candidates.parquet.
# `not_tuned_hours`: computing time that the tuning of a method would take, estimated from the times per step of the study all_seven.
"""


def read_candidates(name: str, method: str) -> pd.DataFrame:
    """Read the candidates of a filter in a tuning; the last row is the filter of tier A, without parameters."""
    rows = pd.read_parquet(CANDIDATES, filters=[("file", "==", name), ("filter", "==", method)])
    knob = {"value": rows["knob"].iloc[0]}
    return rows.drop(columns=[*KEY, "knob"]).dropna(axis=1, how="all").rename(columns=knob)


def split_file(name: str, content: Mapping[str, Any]) -> tuple[str, list[pd.DataFrame]]:
    """Return the entry of a file, and the candidates of each of its filters."""
    stated = {
        key: {k: v for k, v in node.items() if k not in ("candidates", "rule")}
        if isinstance(node, Mapping)
        else node
        for key, node in content.items()
    }
    frames = []
    for method, node in content.items():
        if isinstance(node, Mapping) and "candidates" in node:
            frame = pd.read_csv(StringIO(node["candidates"]), sep=" ", na_values="-")
            knob = frame.columns[1]
            frame = frame.rename(columns={knob: "value"}).assign(knob=knob)
            frames.append(frame.assign(file=name, filter=method))
    world = re.fullmatch(r"\w+ \((.*)\)", content["data"])
    assert world is not None
    lines = [f"{name}:  # {world[1][0].upper()}{world[1][1:]}."]
    lines += [f"  {key}: {_format(node)}" for key, node in stated.items()]
    return "\n".join(lines) + "\n", frames


def _format(value: Any) -> str:
    """Format a value on one line."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6)
    return text.removesuffix("...\n").strip()


def add_files() -> None:
    """Move the files of tunings into the table."""
    entries = re.split(r"^(?=\w)", TABLE.read_text(), flags=re.M)[1:] if TABLE.is_file() else []
    table = {entry.partition(":")[0]: entry for entry in entries}
    rows = [pd.read_parquet(CANDIDATES)] if CANDIDATES.is_file() else []
    for path in sorted(TUNED.glob("*.yaml")):
        if path.stem in _REFERS:
            continue
        content = yaml.safe_load(path.read_text())
        if content.get("objective") == _OBJECTIVE:
            del content["objective"]
        table[path.stem], frames = split_file(path.stem, content)
        new = {frame["filter"].iloc[0] for frame in frames}
        rows = [f[(f["file"] != path.stem) | ~f["filter"].isin(new)] for f in rows] + frames
        path.unlink()
    all_rows = pd.concat(rows, ignore_index=True).sort_values(KEY, kind="stable")
    columns = [*KEY, "r_factor", "knob", "value", *SCORES]
    errors = sorted(name for name in all_rows if name.startswith("error_"))
    all_rows[[*columns, *errors]].to_parquet(CANDIDATES, index=False, compression="zstd")
    TABLE.parent.mkdir(exist_ok=True)
    TABLE.write_text(_HEAD + "".join(entry for _, entry in sorted(table.items())))


def take_entry(name: str) -> None:
    """Make an entry of the table a file, without the candidates, which stay in their table."""
    table = yaml.safe_load(TABLE.read_text())
    lines = [f"{key}: {json.dumps(node)}" for key, node in table.pop(name).items()]
    (TUNED / f"{name}.yaml").write_text("\n".join(lines) + "\n")
    entries = re.split(r"^(?=\w)", TABLE.read_text(), flags=re.M)[1:]
    TABLE.write_text(_HEAD + "".join(e for e in entries if e.partition(":")[0] != name))


if __name__ == "__main__":
    for entry in sys.argv[1:]:
        take_entry(entry)
    if not sys.argv[1:]:
        add_files()
