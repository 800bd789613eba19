"""Files that are written whole and read back with a check of their content.

The public names of this folder are imported on first use.
"""

from pfbench.core.lazy_import import lazy_attributes

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "atomic_write": ("write_atomically",),
        "digest": (
            "DIGEST",
            "has_valid_digest",
            "hash_content",
        ),
        "markdown": (
            "markdown_bullets",
            "markdown_head",
            "markdown_paragraph",
            "markdown_row",
        ),
        "recorded_folder": ("RecordedFolder",),
    },
)

__all__ = __dir__()
