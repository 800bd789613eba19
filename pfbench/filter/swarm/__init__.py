"""Particle swarm proposal and its parts."""
