"""Scenarios from recorded logs."""
