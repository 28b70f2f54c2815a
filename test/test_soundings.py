# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

from attrs import evolve
import numpy as np

from sonar_imm.estimates import Estimate
from sonar_imm.soundings import COLUMNS, soundings_of


def estimate(**changed):
    T = 6
    extras = {
        'range': np.linspace(20.0, 30.0, T), 'valid': np.array([1, 1, 0, 1, 1, 1], np.uint8),
        'label': np.array([0, 1, 1, 0, 0, 1], np.uint8), 'label_probability': np.full(T, 0.9),
        'vertical_uncertainty': np.full(T, 0.02), 'horizontal_uncertainty': np.full(T, 0.1),
        'intensity': np.full(T, -3.0), 'beam_angle': np.linspace(0.5, 1.2, T),
        'side': np.ones(T, np.uint8), **changed,
    }  # fmt: skip
    return Estimate(
        stamp_ns=7, frame_id='map', xyz=np.arange(3 * T, dtype=np.float32).reshape(T, 3),
        state_names=('height',), state=np.zeros((T, 1)), covariance=np.ones((T, 1, 1)),
        extras=extras,
    )  # fmt: skip


def test_one_row_for_each_bin_with_an_echo_in_the_types_of_the_contract():
    soundings = soundings_of(estimate())
    assert list(soundings.columns) == list(COLUMNS) and len(soundings) == 5
    assert all(soundings.columns[name].dtype == kind for name, kind in COLUMNS.items())
    assert soundings.columns['x'].tolist() == [0.0, 3.0, 9.0, 12.0, 15.0]
    assert (soundings.stamp_ns, soundings.frame_id) == (7, 'map')
    columns = soundings.columns  # without layover there is one surface
    assert (columns['surface'] == 1).all() and (columns['existence'] == 0.0).all()
    # Rows that are not known throughout are left out.
    vertical = np.array([0.1, np.nan, 0.1, np.inf, 1e300, 0.1])
    soundings = soundings_of(estimate(vertical_uncertainty=vertical))
    assert soundings.columns['x'].tolist() == [0.0, 15.0]
    assert all(np.isfinite(column).all() for column in soundings.columns.values())


def test_a_second_surface_follows_the_first_one_of_its_bin():
    names = 'px py pz beam_angle height vertical_uncertainty horizontal_uncertainty'.split()
    upper = {f'{name}_2': np.full(6, np.nan) for name in names}
    for k in (1, 2):  # bin 2 is no sounding at all
        for value, column in enumerate(upper.values()):
            column[k] = 10.0 * k + value
    existence = np.array([0.0, 0.9, 0.9, 0.1, 0.0, 0.0], np.float32)
    made = estimate(existence_2=existence, **upper)
    columns = soundings_of(made).columns
    assert columns['surface'].tolist() == [1, 1, 2, 1, 1, 1]
    np.testing.assert_array_equal(columns['existence'], existence[[0, 1, 1, 3, 4, 5]])
    np.testing.assert_array_equal(columns['range'], made.extras['range'][[0, 1, 1, 3, 4, 5]])
    assert columns['x'].tolist() == [0.0, 3.0, 10.0, 9.0, 12.0, 15.0]
    assert (columns['px'][2], columns['py'][2], columns['pz'][2]) == (10.0, 11.0, 12.0)
    assert columns['beam_angle'][2] == 13.0 and columns['vertical_uncertainty'][2] == 15.0
    plain = estimate()  # without navigation there are no soundings
    extras = {k: v for k, v in plain.extras.items() if 'uncertainty' not in k}
    assert soundings_of(evolve(plain, extras=extras)) is None
