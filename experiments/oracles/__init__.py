"""The oracle book: numbers that other projects printed, and the same numbers by pfbench."""
