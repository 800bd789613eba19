"""Polymerised resampling: partition, allocation and placement."""
