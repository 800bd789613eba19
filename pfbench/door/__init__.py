"""The Python door: parts by name or by class, a run of filters, and its study. `pfbench` exports these names.

It uses the engine, the store and the keys of the command line.
"""

from pfbench.core.lazy_import import lazy_attributes

__getattr__, __dir__, __all__ = lazy_attributes(__name__, __file__)
