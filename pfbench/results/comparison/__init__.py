"""Comparisons of filters: pairs within a condition, rankings across conditions, lost runs."""
