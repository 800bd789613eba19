"""Conditions that all filters have, and the performance profile over them."""

import numpy as np
import pandas as pd

from pfbench.results.comparison import condition_blocks


def table(cells, group="position", model="m", first=0):
    """Rows as `frame` makes them, from losses {label: [runs]} of each cell."""
    parts = []
    for c, losses in enumerate(cells):
        for label, values in losses.items():
            values = np.asarray(values, dtype=float)
            rows = {
                "scenario": f"s{c // 2}",
                "noise": f"n{c % 2}",
                "model": model,
                "seed": 1,
                "group": group,
            }
            more = {
                "label": label,
                "run": np.arange(first, first + len(values)),
                "value": values,
                "lost": np.isinf(values),
            }
            parts.append(
                pd.DataFrame({**rows, **more, "component": "norm", "metric": "rmse", "unit": "m"})
            )
    return pd.concat(parts, ignore_index=True)


def test_conditions_that_lack_a_filter_or_a_common_run_are_left_out_by_name():
    cells = [{"a": np.ones(6), "b": np.full(6, 2.0), "c": np.full(6, 3.0)} for _ in range(8)]
    del cells[2]["b"]
    cells[5]["c"][:] = np.nan  # no truth
    cells[0]["visitor"] = cells[0]["a"]
    rows = table(cells)
    rows.loc[(rows.scenario == "s3") & (rows.noise == "n1") & (rows.label == "b"), "run"] += 500
    blocks = condition_blocks.ranking_blocks(rows, "position")
    assert (blocks.filters, len(blocks.cells)) == (("a", "b", "c"), 5)
    assert blocks.left_out == (
        "visitor (ran in 1 of 8 conditions)",
        "s1 / n0 / m (without b)",
        "s2 / n1 / m (without c)",
        "s3 / n1 / m (no run in common of all filters)",
    )
    np.testing.assert_allclose(blocks.values, np.log([[1.0, 2.0, 3.0]] * 5))


def test_conditions_of_one_world_that_differ_in_the_model_are_counted():
    cells = [{"a": [1.0, 2.0], "b": [2.0, 1.0], "c": [3.0, 3.0]}] * 4
    both = pd.concat([table(cells), table(cells, model="other")])
    assert condition_blocks.ranking_blocks(both, "position").shared == 4
    assert condition_blocks.ranking_blocks(table(cells), "position").shared == 0


def test_the_profile_counts_runs_within_a_factor_of_the_best():
    cells = [
        {"a": [1.0, 2.0], "b": [2.0, 1.0], "c": [np.inf, 4.0]},
        {"a": [1.0] * 4, "b": [3.0] * 4, "c": [1.5] * 4},
    ]
    found = condition_blocks.performance_profile(
        condition_blocks.ranking_blocks(table(cells), "position"),
        np.array([1.0, 1.5, 2.0, 3.0, 4.0, 1e9]),
    )
    # cells weigh the same although one has twice the runs
    assert found[0].tolist() == [0.75, 0.75, 1.0, 1.0, 1.0, 1.0]
    assert found[1].tolist() == [0.25, 0.25, 0.5, 1.0, 1.0, 1.0]
    assert found[2].tolist() == [0.0, 0.5, 0.5, 0.5, 0.75, 0.75]
