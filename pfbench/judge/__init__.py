"""Judge: trajectories of other programs under the metrics and decisions of a study."""
