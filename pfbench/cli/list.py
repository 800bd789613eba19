"""Command `pfbench list`: the files of each configuration group."""

from __future__ import annotations

from collections.abc import Sequence

from pfbench.cli.compose import read_description
from pfbench.cli.messages import suggest_similar
from pfbench.config.composition import list_groups

HELP = """\
pfbench list [GROUP]

List the configuration groups with their files, or the files of a group with their descriptions.

  pfbench list
  pfbench list filter"""


def list_options(words: Sequence[str]) -> None:
    """Print the configuration groups, or the files of one group.

    Args:
        words: Name of a group, or nothing.

    Raises:
        ValueError: If the group does not exist.
    """
    groups = list_groups()
    if not words:
        for group, files in groups.items():
            print(f"{group:12} {', '.join(sorted(path.stem for path in files))}")
        print("\nNext: pfbench list GROUP")
        return
    if len(words) > 1 or words[0] not in groups:
        similar = suggest_similar(words[0], list(groups))
        raise ValueError(
            f"group must be one of {', '.join(groups)}, got {' '.join(words) or 'an empty word'}.{similar}"
        )
    for path in sorted(groups[words[0]]):
        print(f"{path.stem:24} {read_description(path)}")
