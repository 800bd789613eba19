"""Data, charts, random streams, distributions and numerical checks of all other folders."""
