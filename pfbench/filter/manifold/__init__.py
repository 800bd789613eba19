"""Filters in an invariant chart of the state."""
