"""Choices of this project in the configurations of a claim's studies, where a paper states no value.

The configurations mark them with `[ours]` in a comment.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from pfbench.claims.schema import Claim

_MARK = "[ours]"
_GROUPS = ("scenario", "noise", "model")


def list_choices(claim: Claim, conf: Path, experiments: Path) -> list[str]:
    """List the choices of this project in the studies of a claim.

    Args:
        claim: Claim.
        conf: Folder of configurations.
        experiments: Folder of experiments.

    Returns:
        Choices of the experiments, then of scenarios, regimes, models and filters; none twice.
    """
    files: dict[Path, None] = {}
    tests = [test for tests in claim.tests.values() for test in tests]
    for study in claim.studies:
        files[experiments / f"{study}.yaml"] = None
    for test in tests:
        for _, cell, label in test.sides:
            for group, name in zip(_GROUPS, cell.split("/"), strict=True):
                files |= dict.fromkeys(_inherited_files(conf / group, name))
            filters = _inherited_files(conf / "filter", label.partition("[")[0])
            files |= dict.fromkeys(filters)
    return list(dict.fromkeys(text for path in files for text in _marked_choices(path)))


def _inherited_files(folder: Path, name: str) -> Iterator[Path]:
    """Yield the file of a configuration and those of the same group that it extends."""
    path = folder / f"{name}.yaml"
    if not path.is_file():
        return
    yield path
    for parent in _read(path).get("defaults", ()):
        if isinstance(parent, str) and parent != "_self_":
            yield from _inherited_files(folder, parent)


def _read(path: Path) -> dict[str, Any]:
    """Read a configuration without interpolation."""
    return dict(yaml.safe_load(path.read_text(encoding="utf-8")) or {})


def _marked_choices(path: Path) -> Iterator[str]:
    """Yield the marked choices of a file: keys with values and remarks, and sentences of its head."""
    if not path.is_file():
        return
    for line in path.read_text(encoding="utf-8").splitlines():
        setting, _, remark = line.partition("#")
        if _MARK not in remark:
            continue
        remark = re.sub(r"\s+", " ", remark.partition(_MARK)[0]).strip(" .;,")
        if setting.strip():
            yield f"{setting.strip()} ({remark})" if remark else setting.strip()
        else:
            yield f"{path.stem}: {remark}"
