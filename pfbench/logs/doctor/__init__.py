"""Diagnosis of an own log: which fault it has, the evidence for it, and the settings that mend it."""
