"""Put newer jobs into a published study: `python experiments/analyses/merge_study.py FOLDER STUDY ...`.

FOLDER/STUDY is a report of some jobs of the study on the same runs, written by `pfbench report reports_dir=FOLDER`.
A filter that was tuned anew, or that the published study lacks, is taken from it. All other filters of it are a check:
their errors must be those of the published study. The page is then decided again from all runs.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pfbench.files import RecordedFolder
from pfbench.report import (
    RUNS_FILE,
    StudyFacts,
    cell_entries,
    count_tuned,
    format_runs,
    read_stored_study,
    rebuild_page,
)

REPORTS = Path(__file__).parents[2] / "reports"
RUN = ["scenario", "regime", "seed", "run"]
TOLERANCE = 1e-5  # relative, of errors that are stored in single precision
Pack = dict[str, Any]


def find_new_filters(published: Pack, newer: Pack) -> list[str]:
    """List the filters of a newer report that a published study lacks or has with other tuned parameters.

    Args:
        published: Data of the published page.
        newer: Data of the newer page.
    """
    tuning = {look["key"]: look["tuning"] for look in published["facts"]["looks"]}
    looks = newer["facts"]["looks"]
    return [look["key"] for look in looks if tuning.get(look["key"]) != look["tuning"]]


def merge_runs(published: pd.DataFrame, newer: pd.DataFrame, labels: Sequence[str]) -> pd.DataFrame:
    """Replace the runs of some filters, and check that those of all others are the same.

    Args:
        published: Runs of the published study.
        newer: Runs of the newer report.
        labels: Filters to replace.

    Raises:
        ValueError: If the newer report has no other filter, or one whose errors differ.
    """
    other = newer[~newer["filter"].isin(labels)]
    pairs = other.merge(published, on=[*RUN, "filter"], suffixes=("", "_published"))
    errors, expected = pairs["rmse"].to_numpy(), pairs["rmse_published"].to_numpy()
    if not len(other) or len(pairs) < len(other):
        raise ValueError(
            "the newer report must have a filter of the published study on the same runs, got none for "
            f"{len(other) - len(pairs)} of {len(other)} runs. Run one, for instance ekf, in it."
        )
    if not np.allclose(errors, expected, rtol=TOLERANCE, atol=0.0, equal_nan=True):
        raise ValueError(
            f"errors of {', '.join(sorted(set(pairs['filter'])))} must be those of the published study, got "
            "others. The data have changed: run the whole study again."
        )
    is_old, is_new = (table["filter"].isin(labels) for table in (published, newer))
    lacking = len(published[is_old].merge(newer[is_new], on=[*RUN, "filter"])) - is_old.sum()
    if lacking:
        raise ValueError(
            f"the newer report must have all runs of {', '.join(labels)} that the published study has, got "
            f"{-lacking} missing. Run their jobs."
        )
    return pd.concat([published[~is_old], _keep_times(published, newer[is_new])], ignore_index=True)


def _keep_times(published: pd.DataFrame, newer: pd.DataFrame) -> pd.DataFrame:
    """Give runs the published time per step of their filter, whose operations do not depend on its parameters.

    Timings of one study are then of one time and machine. A filter that the study lacks keeps its own.
    """
    keys = [*RUN, "filter"]
    times = newer[keys].merge(published[[*keys, "ms"]], on=keys, how="left")["ms"]
    return newer.assign(ms=times.fillna(pd.Series(newer["ms"].to_numpy())).to_numpy())


def merge_packs(published: Pack, newer: Pack, labels: Sequence[str], runs: pd.DataFrame) -> Pack:
    """Merge what a page has beside its decisions: looks, curves, notes and provenance.

    Args:
        published: Data of the published page.
        newer: Data of the newer page.
        labels: Filters to replace.
        runs: Runs of the merged study.
    """
    pack = {**published, "generated": newer["generated"], "curves": {}, "cells": cell_entries(runs)}
    for key, curve in published["curves"].items():
        added = newer["curves"].get(key, {"t": curve["t"], "filters": {}})
        if added["t"] != curve["t"]:
            raise ValueError(
                f"curves of {key} must have the same times in both reports, got others."
            )
        new = {label: added["filters"][label] for label in labels if label in added["filters"]}
        pack["curves"][key] = {**curve, "filters": {**curve["filters"], **new}}
    looks = _replace(published["facts"]["looks"], newer["facts"]["looks"], "key", labels)
    pack["facts"] = {**published["facts"], "looks": sorted(looks, key=lambda look: look["key"])}
    pack["filter_notes"] = _replace(
        published["filter_notes"], newer["filter_notes"], "filter", labels
    )
    stored = dict(newer["provenance"])
    pack["provenance"] = [
        [name, _join(value, stored.get(name, ""))] for name, value in published["provenance"]
    ]
    pack["methods"] = _merge_methods(published["methods"], newer["methods"], pack, runs)
    return pack


def _replace(
    old: Sequence[Mapping[str, Any]],
    new: Sequence[Mapping[str, Any]],
    key: str,
    labels: Sequence[str],
) -> list[Mapping[str, Any]]:
    """Replace the entries of some filters."""
    return [e for e in old if e[key] not in labels] + [e for e in new if e[key] in labels]


def _join(old: str, new: str) -> str:
    """Join two lists of values, each once."""
    return ", ".join(dict.fromkeys(filter(None, [*old.split(", "), *new.split(", ")])))


def _merge_methods(old: Pack, new: Pack, pack: Pack, runs: pd.DataFrame) -> Pack:
    """Merge the facts of the methods paragraph."""
    looks = StudyFacts.from_pack(pack).looks
    conditions = runs.groupby(["scenario", "regime"])["filter"].nunique()
    software = {
        name: list(dict.fromkeys([*old["software"].get(name, ()), *values]))
        for name, values in new["software"].items()
    }
    return {
        **old,
        "filters": len(looks),
        "particles": {**old["particles"], **new["particles"]},
        "software": software,
        "tuned": count_tuned(looks),
        "is_complete": bool((conditions == len(looks)).all()),
    }


def merge_study(study: str, folder: Path, reports: Path = REPORTS) -> list[str]:
    """Merge a newer report into a published study and write its page again.

    Args:
        study: Name of the study.
        folder: Folder of newer reports.
        reports: Folder of published reports.

    Returns:
        Filters that were replaced or added.
    """
    (published, old), (newer, new) = (
        read_stored_study(place / study) for place in (reports, folder)
    )
    labels = find_new_filters(published, newer)
    runs = merge_runs(old, new, labels)
    with RecordedFolder(reports / study, is_complete=False) as target:
        target.write(RUNS_FILE, format_runs(runs, merge_packs(published, newer, labels, runs)))
    rebuild_page(reports / study)
    return labels


if __name__ == "__main__":
    for name in sys.argv[2:]:
        print(f"{name}: {', '.join(merge_study(name, Path(sys.argv[1])))}")
