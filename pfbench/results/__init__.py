"""Stored results, metrics and statistics of studies. Needs neither torch nor hydra."""
