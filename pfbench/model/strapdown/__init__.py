"""Total-state models of inertial sensors with aiding."""
