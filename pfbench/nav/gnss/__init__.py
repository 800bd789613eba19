"""Satellite navigation: orbits, ephemerides, ranges and the receiver clock."""
