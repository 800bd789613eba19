"""Command line of pfbench: one module per command, imported on use."""

from pfbench.cli.main import main

__all__ = ["main"]
