"""Own logs and recorded worlds: reading, diagnosis, answers, and the judge of other programs' trajectories."""
