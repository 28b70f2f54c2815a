# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Descriptions of parameters: each is understood where it stands alone."""

import importlib
import re

import pytest

from sonar_imm.node_config import DetectorNodeConfig, node_config_type
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.obstacle.detector import DetectorConfig

DANGLING = re.compile(
    r'^(\w+: )?(its|their|it|they|them|that|this|these|those|such|of|by|for|from|with|at|on|in|to'
    r'|and|or|but|the (same|others?|former|latter))\b(?! (arrays|envelopes):)'
    r'|\bso (often|long|many|much|far)$'
    r'|\b(such images|those echoes|that error|each of them|(three|probabilities|noises) above)\b'
)
"""What refers to something that stands before: the parameter above, or its name."""


def dangles(description: str) -> bool:
    """Whether a description cannot be understood where it stands alone."""
    return len(description.split()) < 3 or bool(DANGLING.search(description))


@pytest.mark.parametrize(
    'fragment',
    [
        'its standard deviation, m or rad; 0: 1 m',
        'gaussian: its standard deviation',
        'of the random numbers',
        'that much higher, beside what the roughness of the sea floor asks for',
        'the same of the cells around that belong to the echo',
        'farthest range of such images; 0: unknown',
        'for snapshots that have times, and no sound speed of their own',
        'what is done with the three above: consider, estimate, or mixed',
        'time over which that error is correlated',
        'power of those echoes against the floor',
        'fix_std of each of them; empty: as fix_std',
        'speed of sound: an estimate that is not committed, so often',
        'rms roll',
    ],
)
def test_a_fragment_is_seen(fragment):
    assert dangles(fragment)


def every_config():
    yield DetectorConfig
    yield DetectorNodeConfig
    for system in SYSTEMS.values():
        yield system.config_type()
        yield node_config_type(system)
        scenes = importlib.import_module(system.scenes)
        yield type(scenes.scenario(next(iter(scenes.SCENARIOS))))


@pytest.mark.parametrize('config', list(every_config()), ids=lambda config: config.__name__)
def test_every_description_stands_alone(config):
    """``ros2 param describe`` shows a parameter without its neighbours."""
    specs = config.specs()
    assert [spec for spec in specs if dangles(spec.description)] == []
    texts = [spec.description for spec in specs]
    assert len(set(texts)) == len(texts), 'two parameters with one description'
