"""Smoothing: distributions of states given all measurements."""
