"""Command `pfbench new`: a script of your own part that runs at once."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

from pfbench.cli.messages import suggest_similar
from pfbench.cli.new_scripts import SCRIPTS

HELP = """\
pfbench new filter|proposal|model|scenario|log NAME

Write NAME.py into the current folder: a class of your own and a study of it beside filters of pfbench. It runs
without a change. Change the class.

  pfbench new filter careful
  python careful.py"""


def write_script(words: Sequence[str]) -> None:
    """Write the script of a part."""
    if len(words) != 2:
        raise ValueError(
            f"new must have a kind and a name, got {' '.join(words) or 'none'}. Use: pfbench new filter NAME"
        )
    kind, name = words
    if kind not in SCRIPTS:
        similar = suggest_similar(kind, list(SCRIPTS))
        raise ValueError(f"kind must be one of {', '.join(SCRIPTS)}, got {kind}.{similar}")
    if not (name.isidentifier() and name.islower()):
        raise ValueError(
            f"name must be of lower-case letters, digits and underscores, got {name}. Use my_{kind}."
        )
    path = Path(f"{name}.py")
    if path.exists():
        raise ValueError(f"{path} must not exist, got a file. Choose another name.")
    if importlib.util.find_spec(name) is not None or kind == name:
        raise ValueError(
            f"name must not be that of an installed package or of its kind, got {name}. Use my_{name}."
        )
    title = "".join(word.capitalize() for word in name.split("_"))
    path.write_text(SCRIPTS[kind].replace("TITLE", title).replace("NAME", name), encoding="utf-8")
    print(f"script: {path.resolve()}\nNext: python {path}")
