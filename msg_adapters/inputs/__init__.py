# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which topics each tracker subscribes to: one module per system, with its `TOPICS`.

The nodes subscribe by them, topics of recordings are chosen by them, and scenes are written by
them, so that live, recorded and simulated data are read and written by the same functions.
"""

from __future__ import annotations

from importlib import import_module

from .topic import DOUBTS, InputTopic, needed

__all__ = ['DOUBTS', 'FEEDERS', 'InputTopic', 'inputs_of', 'made_inputs', 'needed']

FEEDERS = {'obstacle': 'fls_detector'}
"""Systems whose node has another one before it, by name: it makes one of their inputs."""


def inputs_of(system: str) -> tuple[InputTopic, ...]:
    """The inputs of `system`, or of a node before one. Raises ModuleNotFoundError when there is no
    such system."""
    for fed, name in FEEDERS.items():
        if system == name:
            return made_inputs(fed)
    topics: tuple[InputTopic, ...] = import_module(f'{__name__}.{system}').TOPICS
    return topics


def made_inputs(system: str) -> tuple[InputTopic, ...]:
    """The inputs of the node before that of `system`; nothing where there is none."""
    if system not in FEEDERS:
        return ()
    images: tuple[InputTopic, ...] = import_module(f'{__name__}.{system}').IMAGES
    return images
