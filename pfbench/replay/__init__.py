"""Replay: one run of a stored job, computed again with all its traces."""
