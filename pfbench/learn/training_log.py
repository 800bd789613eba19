"""Log of a training: a CSV table, and TensorBoard if it is installed."""

from __future__ import annotations

import csv
import importlib.util
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pfbench.files.atomic_write import set_aside, write_atomically


def write_losses(path: Path, lines: list[dict[str, float]]) -> None:
    """Write the log lines of all epochs to a CSV file.

    Another kind of file under this name is renamed to `NAME.kept`.

    Args:
        path: The file.
        lines: Log line of each epoch, all with the same names.
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(lines[0]))
    writer.writeheader()
    writer.writerows(lines)
    head = ",".join(lines[0]).encode()
    if path.is_symlink() or (path.exists() and not path.read_bytes().startswith(head)):
        set_aside(path, "kept")
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))


def open_tensorboard(path: Path) -> Callable[[dict[str, float]], None]:
    """Return a function that writes log lines for TensorBoard.

    Args:
        path: Path of the checkpoint. The log folder has its name without the suffix.

    Returns:
        The function. It does nothing if TensorBoard is not installed.
    """
    if importlib.util.find_spec("tensorboard") is None:
        return lambda line: None
    from torch.utils.tensorboard import SummaryWriter

    writer: Any = SummaryWriter(str(path.with_suffix("")))

    def write(line: dict[str, float]) -> None:
        for name, value in line.items():
            writer.add_scalar(name, value, int(line["epoch"]))
        writer.flush()

    return write
