"""What a comparison can show: against other formulas, by simulation, and by how often it is wrong."""

import numpy as np
import pytest
from scipy import stats

from pfbench.stats import rank_tests


@pytest.mark.parametrize("n", [5, 9, 13, 14, 50, 51, 100])
@pytest.mark.parametrize("digits", [0, 1, 9])  # with many ties and zeros, with some, with none
def test_the_signed_rank_test_is_scipys(n, digits):
    d = np.round(np.random.default_rng(n).normal(0.3, 1, n), digits)
    for side in ("two-sided", "greater"):
        expected = stats.wilcoxon(d, alternative=side, zero_method="zsplit")
        assert rank_tests.wilcoxon_signed_rank(d, side) == pytest.approx(
            (expected.statistic, expected.pvalue), rel=1e-11
        )
