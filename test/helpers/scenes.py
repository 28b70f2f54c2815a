# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""A small simulated scene of every system."""

import importlib

SMALL = {
    'bathymetry': ('paper', {'pings': 2}),
    'diver': ('several', {'duration': 20.0}),
    'fathometer': ('drift_traces', {'records': 4}),
    'obstacle': ('approach', {'first_range': 60.0, 'last_range': 50.0}),
}
"""Scenario and overrides that make it small, by system."""


def small_scene(system, seed):
    """(parameters, scene) of a system."""
    scenes = importlib.import_module(system.scenes)
    name, overrides = SMALL[system.name]
    config = scenes.scenario(name, overrides)
    return config, scenes.simulate(config, seed)
