"""Reports of studies and datasheets of scenarios."""
