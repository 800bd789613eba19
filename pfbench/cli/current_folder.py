"""Files of the user in the folder `conf` of the current folder, which the command line and Python use without a search path."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

_CHOICE = re.compile(r"\+?(\w+)=([\w,]+)")


def list_own_files(group: str) -> list[Path]:
    """List the files of a group in `conf` of the current folder, unless that is the folder of pfbench. A link may lead out of it."""
    from pfbench.results.paper_block import conf_dir

    folder = Path("conf")
    if not folder.is_dir() or folder.resolve() == conf_dir().resolve():
        return []
    return sorted(
        p
        for p in (folder / group).glob("*.yaml")
        if p.is_file() and not p.is_symlink() and p.name.isprintable()
    )


def add_search_path(words: Sequence[str]) -> list[str]:
    """Add the folder `conf` to words that choose one of its files, unless they set a search path.

    A file with the name of a shipped one counts, too: Hydra's loader then refuses it.
    """
    if not Path("conf").is_dir() or any(
        re.match(r"[+~]*hydra\.searchpath\b|--config-dir\b|-cd\b", word) for word in words
    ):
        return list(words)
    for match in filter(None, map(_CHOICE.fullmatch, words)):
        has_knobs = match[1] == "filter" and re.search(r"_tuned\b|tuned_baselines", match[2])
        if {*match[2].split(",")} & {path.stem for path in list_own_files(match[1])} or (
            has_knobs and list_own_files("tuned")
        ):
            return [*words, "hydra.searchpath=[file://conf]"]
    return list(words)
