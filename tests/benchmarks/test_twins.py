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
