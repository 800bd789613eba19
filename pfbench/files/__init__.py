"""Files that are written whole and read back with a check of their content."""
