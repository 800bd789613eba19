"""Results of a study in the form that decisions read."""

from __future__ import annotations

import numpy as np
import pandas as pd


def tidy_runs(
    frame: pd.DataFrame,
    metric: str = "rmse",
    group: str = "position",
    component: str = "norm",
) -> pd.DataFrame:
    """Select one metric of the table of `load_frame` in the form of `to_study_runs`.

    Args:
        frame: Rows of `load_frame`.
        metric: Name of the metric.
        group: Group of the state; not used for metrics of a job.
        component: Component of the group; not used for metrics of a job.

    Returns:
        Table with the columns of `to_study_runs`.

    Raises:
        ValueError: if no row matches.
    """
    rows = frame[frame["metric"] == metric]
    if rows["group"].nunique() > 1:
        rows = rows[(rows["group"] == group) & (rows["component"] == component)]
    if rows.empty:
        raise ValueError(
            f"metric and group must have results, got {metric} and {group}. Choose from "
            f"{sorted(map(str, frame['metric'].unique()))} and {sorted(map(str, frame['group'].unique()))}."
        )
    return tidy_rows(rows)


def tidy_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Arrange the rows of one metric and component in the form of `to_study_runs`.

    Args:
        rows: Rows of `load_frame`, one per run of a filter in a condition.
    """
    models = rows.groupby("scenario")["model"].transform("nunique")
    regime = rows["noise"].astype(str).where(models == 1, rows["noise"] + " / " + rows["model"])
    scenario = rows["scenario"].astype(str)
    return pd.DataFrame(
        {
            "filter": rows["label"].astype(str),
            "scenario": scenario,
            "family": rows["family"].astype(str),
            "regime": regime,
            "run": [f"{s:012d} {r:09d}" for s, r in zip(rows["seed"], rows["run"], strict=True)],
            "value": rows["value"].astype(np.float64),
            "keeps_track": rows["keeps_track"].astype(bool),
        }
    )
