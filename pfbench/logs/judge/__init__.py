"""Judge: trajectories of other programs against a reference. `pfbench.judge` is its door."""
