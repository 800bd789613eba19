"""Proposals with state reconstruction by Dynamic Matrix Control."""
