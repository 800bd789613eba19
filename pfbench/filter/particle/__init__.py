"""Particle filter and the stages that compose it."""
