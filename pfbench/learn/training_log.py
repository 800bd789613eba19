"""Log of a training: a CSV table, and TensorBoard if it is installed."""

from __future__ import annotations

import csv
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any


def write_losses(path: Path, lines: list[dict[str, float]]) -> None:
    """Write the log lines of all epochs to a CSV file.

    Args:
        path: The file.
        lines: Log line of each epoch, all with the same names.
    """
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)


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
