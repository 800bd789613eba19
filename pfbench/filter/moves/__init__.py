"""MCMC moves of particles after resampling, and the histories that they require."""
