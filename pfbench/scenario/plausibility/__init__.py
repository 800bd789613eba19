"""Agreement between the tables of recorded logs."""
