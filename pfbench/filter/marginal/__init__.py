"""Rao-Blackwellised filter."""
