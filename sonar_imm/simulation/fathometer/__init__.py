"""Scenes of a drifting vertical array above a layered floor."""

from .simulator import scenario, SCENARIOS, simulate

__all__ = ['scenario', 'SCENARIOS', 'simulate']
