"""Entry point of `python -m pfbench`."""

from pfbench.cli import main

main()
