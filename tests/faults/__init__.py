"""Harness of faults: kills, full disks, damaged and hostile files, extreme numbers, and the table of their outcomes."""
