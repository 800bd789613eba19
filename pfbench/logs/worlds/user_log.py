"""Log of a user: a recorded drive whose reader applies corrections and says them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from typing_extensions import override

from pfbench.logs.worlds.constrained import ConstrainedDrive
from pfbench.logs.worlds.corrections import LogCorrections
from pfbench.logs.worlds.log_reader import read_log
from pfbench.logs.worlds.log_tables import NavigationLog


@dataclass(frozen=True)
class UserLog(ConstrainedDrive):
    """Recorded drive with corrections of its tables.

    The other attributes are those of `ConstrainedDrive`.

    Attributes:
        corrections: Corrections that the reader applies before its checks.
    """

    corrections: LogCorrections = field(default_factory=LogCorrections)

    @override
    def _read_log(self, folder: Path) -> NavigationLog:
        return self.read_tables(folder)

    def read_tables(self, folder: Path, *, has_attitude: bool = True) -> NavigationLog:
        """Read and check the log in a folder as the keys of the scenario say.

        Args:
            folder: Folder of the tables.
            has_attitude: Whether the log must have a reference with an attitude.
        """
        keys = ("files", "origin", "limits", "fix_codes", "corrections")
        return read_log(folder, has_attitude=has_attitude, **{key: getattr(self, key) for key in keys})  # fmt: skip
