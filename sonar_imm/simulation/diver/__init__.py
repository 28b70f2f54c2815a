"""Scenes of swimming divers."""

from .simulator import scenario, SCENARIOS, simulate

__all__ = ['scenario', 'SCENARIOS', 'simulate']
