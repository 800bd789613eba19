"""Proposals that a Gaussian filter guides."""
