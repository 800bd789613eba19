"""Claims of the papers: records, measurements, verdicts and their page.

The public names of this folder are imported on first use.
"""

from pfbench.core.lazy_import import lazy_attributes

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "claim_records": ("read_claims",),
    },
)

__all__ = __dir__()
