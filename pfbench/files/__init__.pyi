"""Public names of `pfbench.files` and the modules that define them."""

from pfbench.files.atomic_write import (
    DIGEST as DIGEST,
    has_valid_digest as has_valid_digest,
    hash_content as hash_content,
    write_atomically as write_atomically,
)
from pfbench.files.escapes import (
    markdown_bullets as markdown_bullets,
    markdown_head as markdown_head,
    markdown_paragraph as markdown_paragraph,
    markdown_row as markdown_row,
)
from pfbench.files.recorded_folder import (
    PUBLISHED_FILES as PUBLISHED_FILES,
    RecordedFolder as RecordedFolder,
    find_published_file as find_published_file,
    write_manifest as write_manifest,
)
from pfbench.files.source_digest import hash_folder as hash_folder
