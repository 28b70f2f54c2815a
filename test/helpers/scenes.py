# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Small simulated scenes of every system."""

import importlib

SMALL = {
    'bathymetry': 'paper', 'diver': 'several', 'fathometer': 'drift_traces',
    'obstacle': 'approach',
}  # fmt: skip
"""A scenario of each system."""

SMALLER = {
    'bathymetry': {'pings': 2},
    'diver': {'duration': 20.0},
    'fathometer': {'records': 2, 'phones': 6, 'snapshot_seconds': 0.1, 'frequency_max': 1000.0},
    'obstacle': {'first_range': 60.0, 'last_range': 50.0},
}
"""Overrides that make any scenario small, by system."""


def smaller_scene(system, name, seed):
    """(parameters, scene) of any scenario of a system."""
    scenes = importlib.import_module(system.scenes)
    overrides = dict(SMALLER[system.name])
    given = scenes.SCENARIOS[name][1]
    if given.get('level') == 'pressure':
        overrides |= {'records': 1, 'record_seconds': 1.0, 'sample_rate': 4000.0}
    if given.get('images'):
        overrides |= {'image_beams': 64, 'image_bins': 200, 'last_range': 59.0}
    config = scenes.scenario(name, overrides)
    return config, scenes.simulate(config, seed)


def small_scene(system, seed):
    """(parameters, scene) of a system."""
    return smaller_scene(system, SMALL[system.name], seed)
