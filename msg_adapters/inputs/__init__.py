"""Which topics each tracker subscribes to: one module per system, with its `TOPICS`.

The nodes subscribe by them, topics of recordings are chosen by them, and scenes are written by
them, so that live, recorded and simulated data are read and written by the same functions.
"""

from __future__ import annotations

from importlib import import_module

from .topic import DOUBTS, InputTopic, needed

__all__ = ['DOUBTS', 'InputTopic', 'inputs_of', 'needed']


def inputs_of(system: str) -> tuple[InputTopic, ...]:
    """The inputs of `system`. Raises ModuleNotFoundError when there is no such system."""
    topics: tuple[InputTopic, ...] = import_module(f'{__name__}.{system}').TOPICS
    return topics
