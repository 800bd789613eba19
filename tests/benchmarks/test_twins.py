"""The table of printed errors of twin experiments: DAPPER's error by its definition, and the page."""

import sys

import numpy as np
from checkout import ROOT

sys.path.insert(0, str(ROOT / "experiments" / "analyses"))
import twins


def test_the_error_is_averaged_over_time_after_the_burn_in() -> None:
    """Roots of the mean square over two components are 5 and 10 after a first one of 1000."""
    error = np.array(
        [[[1000.0, 1000.0], [5.0, 5.0], [10.0, 10.0]], [[0.0, 1.0], [7.0, 1.0], [1.0, 7.0]]]
    )
    assert np.allclose(twins.dapper_rmse(error, np.array([1.0, 2.0, 3.0]), 1.0), [7.5, 5.0])


def test_a_printed_number_of_one_run_lies_in_the_range_of_the_runs() -> None:
    row = dict(printed="0.24", ours="0.22", standard_error="0.001", median="0.22", lowest="0.206", runs="20", lost="0")  # fmt: skip
    for highest, lost, hit in (("0.236", "0", "yes"), ("0.234", "0", "no"), ("0.45", "0", "loses"), ("0.236", "1", "loses")):  # fmt: skip
        assert twins.judge(row | {"highest": highest, "lost": lost})["hit"] == hit
