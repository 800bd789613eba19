"""Robust and adaptive updates of Gaussian filters, and filters of several hypotheses."""
