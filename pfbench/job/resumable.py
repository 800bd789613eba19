"""Results of the parts of a study in one file, from which a study resumes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pfbench.files.atomic_write import write_atomically
from pfbench.files.digest import DIGEST, has_valid_digest, hash_content


class ResumableResults:
    """Finished parts of a study by name, JSON values that are written at once.

    A file of another request, or a damaged one, is replaced.

    Args:
        path: File of the results. Its folder is created.
        request: Description of the computation on which the parts depend.

    Attributes:
        path: File of the results.
        state: Content of the file: `request` and `done`, the parts by name.
    """

    def __init__(self, path: Path, request: Mapping[str, Any]) -> None:
        self.path = path
        self.state: dict[str, Any] = {"request": json.loads(json.dumps(request)), "done": {}}
        try:
            stored = json.loads(path.read_text())
        except (FileNotFoundError, ValueError):
            return
        is_whole = isinstance(stored, dict) and has_valid_digest(stored)
        if is_whole and stored.get("request") == self.state["request"]:
            self.state = {key: stored[key] for key in ("request", "done")}

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
            # of the values as JSON returns them
            content = json.loads(json.dumps(self.state))
            text = json.dumps({**content, DIGEST: hash_content(content)})
            write_atomically(self.path, lambda file: file.write(text.encode()))
        return finished[name]
