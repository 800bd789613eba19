"""Filters of the papers that this project reproduces."""
