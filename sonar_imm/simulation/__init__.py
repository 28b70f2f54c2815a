"""Simulated scenes with truth, from a seed: one folder per system, `scene` is what all share."""
