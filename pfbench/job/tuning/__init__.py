"""Tuning of the baselines of a study of robustness, on seeds that no study scores."""
