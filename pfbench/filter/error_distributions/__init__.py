"""Updates of Gaussian filters for observation distributions that are not normal."""
