"""Figures of the papers, drawn from results of this package."""
