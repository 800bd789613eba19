"""`python -m pfbench` is `pfbench`."""

from pfbench.cli import main

main()
