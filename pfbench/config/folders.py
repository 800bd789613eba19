"""Folders of the configuration files, of the installed package or of the checkout."""

from __future__ import annotations

from pathlib import Path

import pfbench


def conf_dir() -> Path:
    """Return the folder of configurations, of the installed package or of the checkout."""
    return _find_folder("conf", "config.yaml")


def experiments_dir() -> Path:
    """Return the folder of experiments, of the installed package or of the checkout."""
    return _find_folder("experiments", "quickstart.yaml")


def name_run_command(study: str) -> str:
    """Return the command that runs the jobs of a study: its experiment, or words to complete.

    Args:
        study: Name of the study.
    """
    if (experiments_dir() / f"{study}.yaml").is_file():
        return f"pfbench run -m +experiment={study}"
    return f"pfbench run study={study} scenario=NAME noise=NAME filter=NAME"


def _find_folder(name: str, marker: str) -> Path:
    """Return the folder inside or next to the package that contains the marker file."""
    package = Path(pfbench.__file__).resolve().parent
    for folder in (package / name, package.parent / name):
        if (folder / marker).exists():
            return folder
    raise FileNotFoundError(
        f"{name}/{marker} must be inside or next to {package}, got neither. Reinstall pfbench."
    )
