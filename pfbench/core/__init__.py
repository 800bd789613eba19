"""Parts that every other folder may use."""
