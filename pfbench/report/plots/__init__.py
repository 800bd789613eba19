"""Plots of results and the figures that reports are made of."""
