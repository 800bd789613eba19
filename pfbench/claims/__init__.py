"""Claims of the papers: records, measurements, verdicts and their page.

The public names of this folder are imported on first use.
"""

from pfbench.core.lazy_import import lazy_attributes

__getattr__, __dir__, __all__ = lazy_attributes(__name__, __file__)
