"""Scenes of an AUV that meets obstacles."""

from .simulator import scenario, SCENARIOS, simulate

__all__ = ['scenario', 'SCENARIOS', 'simulate']
