"""Commands of own logs."""
