# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Studies in their smallest size: each row has its numbers, and the pages find them."""

from importlib import import_module
import math

import pytest

from benchmarks import study

SMALL = {
    'bathymetry_paper': ({'pings': 1, 'parts': ['methods']}, {}, 'methods>defaults>patch'),
    'bathymetry_sea': ({'pings': 2, 'only': 'nadir'}, {}, 'cases>nadir, terrain>rmse_m'),
    'bathymetry_accuracy': (
        {'object_pings': 1, 'parts': ['resolved']},
        {'SIZES': {'ledge': (2.0, 3.0)}, 'BANDS': ((17.0, 77.0),)}
        | {'SETTINGS': {'8 staves': {}}, 'BARE': {'flat': ('thermal', {'patch_std': 0.0})}},
        'resolved>ledge, 8 staves>rmse_m',
    ),
    'fathometer_sea': (
        {'runs': 1, 'particles': 200, 'drawn': 2, 'parts': ['30 missing, walk 0.1 m']},
        {},
        'gaps>30 missing, walk 0.1 m, Kalman>inside',
    ),
    'obstacle_accuracy': ({'pictures': 5, 'parts': ['images']}, {}, 'images>found>steady>21 dB'),
}
"""Options, what is made smaller besides, and a number."""


@pytest.mark.parametrize('name', SMALL)
def test_a_small_study_has_its_numbers(name, monkeypatch):
    options, changes, place = SMALL[name]
    module = import_module(f'benchmarks.{name}')
    for key, value in changes.items():
        monkeypatch.setattr(module, key, value)
    found = {}
    for part in module.main(**options):
        study.merge(found, part)
    for key in place.split('>'):
        found = next(iter(found.values())) if key == '*' else found[key]
    assert math.isfinite(found)
