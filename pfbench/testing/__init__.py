"""Statistical tests that a user runs on a new stage or filter, each in one line.

    from pfbench.testing import check_filter, check_resampling
    check_resampling(MyScheme())
    check_filter(ParticleFilter(100, EssResampler(MyScheme())))

Each check simulates, compares with an independent reference and returns a `LawCheck`. It raises an
AssertionError with the statistic, its standard error and the limit if the statement does not hold.
"""

from pfbench.core.lazy_import import lazy_attributes

__getattr__, __dir__, __all__ = lazy_attributes(__name__, __file__)
