"""Sweeps: plan, progress, and studies that add runs until they are decided."""
