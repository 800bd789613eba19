"""Strapdown navigation: Earth, attitude, trajectories, inertial sensors, mechanisation, error dynamics."""
