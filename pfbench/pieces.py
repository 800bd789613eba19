"""What a study of several parts has finished, in one file: the same command, given again, goes on from there."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


class Pieces:
    """Finished parts of a study by name, each a value that JSON can hold, written as soon as it is there.

    Args:
        path: of the file. One of another call, or that ends in the middle, is begun anew.
        asked: what the call asks for, as far as parts hang on it.
    """

    def __init__(self, path: Path, asked: Mapping[str, Any]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path, self.told = path, {"asked": json.loads(json.dumps(asked)), "done": {}}
        try:
            before = json.loads(path.read_text())
        except (FileNotFoundError, json.JSONDecodeError):
            return
        if before.get("asked") == self.told["asked"]:
            self.told = before

    def __call__(self, name: str, make: Callable[[], Any]) -> Any:
        """The part of this name: made by `make`, or by an earlier call."""
        done = self.told["done"]
        if name not in done:
            done[name] = make()
            written = self.path.with_name(f".{self.path.name}")
            written.write_text(json.dumps(self.told))
            os.replace(written, self.path)
        return done[name]
