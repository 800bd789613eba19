"""Files that are written whole and read back with a check of their content.

The public names of this folder are imported on first use.
"""

from pfbench.core.lazy_import import lazy_attributes

__getattr__, __dir__, __all__ = lazy_attributes(__name__, __file__)
