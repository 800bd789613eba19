"""Results of the parts of a study in one file, from which a study resumes."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


class ResumableResults:
    """Finished parts of a study by name, JSON values that are written at once.

    A file of another request, or one that is cut off, is replaced.

    Args:
        path: File of the results. Its folder is created.
        request: Description of the computation on which the parts depend.

    Attributes:
        path: File of the results.
        state: Content of the file: `asked`, the request, and `done`, the parts by name.
    """

    def __init__(self, path: Path, request: Mapping[str, Any]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.state: dict[str, Any] = {"request": json.loads(json.dumps(request)), "done": {}}
        try:
            stored = json.loads(path.read_text())
        except (FileNotFoundError, json.JSONDecodeError):
            return
        if stored.get("request") == self.state["request"]:
            self.state = stored

    def __call__(self, name: str, make: Callable[[], Any]) -> Any:
        """Return one part, computed by `make` unless an earlier call has stored it.

        Args:
            name: Name of the part, unique in the study.
            make: Computes the part, a value that JSON can represent.

        Returns:
            The part.
        """
        finished = self.state["done"]
        if name not in finished:
            finished[name] = make()
            temporary = self.path.with_name(f".{self.path.name}")
            temporary.write_text(json.dumps(self.state))
            os.replace(temporary, self.path)
        return finished[name]
