"""Studies that add runs until every planned pair is decided."""
