"""Readers of trajectories, one per file format, and the checks that all share."""
