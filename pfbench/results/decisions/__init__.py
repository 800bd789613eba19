"""Decisions of a study: estimates, tests of families, words, records and sentences."""
