"""Scenes of sea floors under a side-scan array."""

from .simulator import scenario, SCENARIOS, simulate

__all__ = ['scenario', 'SCENARIOS', 'simulate']
