"""Gaussian filters: Kalman, extended, unscented, cubature and ensemble."""
