"""Exploratory comparisons of filters within a condition, and their input across conditions."""
