# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The speed of sound is not known exactly, and the depths say so."""

from helpers.fathometer_runs import run
import numpy as np
import pytest

from benchmarks.fathometer_gaps import scene

ARRAY = 30.0  # m, of the scene


@pytest.fixture(scope='module')
def drawn():
    return scene(0, 0.1, 4)


def followed(drawn, **options):
    """Of the later records: depths, true ones by the speed of the scene, variances, estimates."""
    traces, truth = drawn
    _, found = run(traces, **{'particles': 3000, 'array_depth_std': 0.03, **options})
    rows = [(each, z) for each, z in zip(found.values(), truth) if len(each) == len(z)][5:]
    assert len(rows) > 15
    depth = np.array([each.state[:, 0] for each, _ in rows])
    variance = np.array([each.covariance[:, 0, 0] for each, _ in rows])
    return depth, np.array([z for _, z in rows]), variance, [each for each, _ in rows]


def inside(depth, truth, variance, faster):
    """Share of the depths within two standard deviations where the sound is so many m/s faster."""
    true = ARRAY + (truth - ARRAY) * (1500.0 + np.reshape(faster, (-1, 1, 1))) / 1500.0
    return float(np.mean(np.abs(depth - true) <= 2.0 * np.sqrt(variance)))


def test_depths_have_the_error_of_a_speed_that_is_off(drawn):
    exact = followed(drawn, sound_speed_std=0.0, array_depth_std=0.0)
    assert inside(*exact[:3], 0.0) > 0.95
    assert inside(*exact[:3], 5.0) < 0.3 and inside(*exact[:3], 10.0) < 0.05
    speeds = np.random.default_rng(0).standard_normal(400)
    for std in (2.0, 5.0, 10.0):
        stated = followed(drawn, sound_speed_std=std, array_depth_std=0.0)
        assert inside(*stated[:3], std * speeds) == pytest.approx(0.95, abs=0.025)
        # Nothing but the covariance is another one.
        assert stated[0].tobytes() == exact[0].tobytes()
    default = followed(drawn)
    assert inside(*default[:3], 5.0) == inside(*default[:3], 10.0) == 1.0


def test_what_is_common_and_what_is_relative_add_up(drawn):
    depth, truth, variance, estimates = followed(drawn, sound_speed_std=5.0)
    common = np.array([each.extras['depth_common_std'] for each in estimates])
    relative = np.array([each.extras['depth_relative_std'] for each in estimates])
    assert common**2 + relative**2 == pytest.approx(variance, rel=1e-3)
    # The rest is the depth of the array, of which a few records say less than many.
    array = common**2 - ((depth - ARRAY) / 300.0) ** 2
    assert array == pytest.approx(np.tile(array[:, :1], array.shape[1]), abs=1e-9)
    assert array.max() < 0.04**2 and array[3:] == pytest.approx(0.03**2, abs=1e-9)
    thickness = np.diff(depth) - np.diff(truth)
    spread = np.sqrt(relative[:, 1:] ** 2 + relative[:, :-1] ** 2)
    assert np.mean(np.abs(thickness) <= 2.0 * spread) > 0.9


def test_heave_is_what_is_common_in_place_of_the_depth_of_the_array(drawn):
    depth, _, variance, estimates = followed(drawn, sound_speed_std=5.0, heave='independent')
    height = depth + np.array([each.extras['heave'] for each in estimates]) - ARRAY
    stated = np.array([each.extras['heave_std'] for each in estimates])
    common = np.array([each.extras['depth_common_std'] for each in estimates])
    assert common**2 == pytest.approx(stated**2 + (height / 300.0) ** 2, rel=1e-9)


def test_the_speed_of_the_water_counts_down_to_the_bottom(drawn):
    """Where the sediment has a speed of its own; else it is water."""
    *_, water = followed(drawn, sound_speed_std=5.0)
    *_, own = followed(drawn, sound_speed_std=5.0, sediment_sound_speed=1500.0)
    *_, exact = followed(drawn, sound_speed_std=0.0)
    for each, other, none in zip(water, own, exact):
        height = each.state[:, 0] - ARRAY
        without = none.extras['sediment_depth_std'] ** 2
        assert each.extras['sediment_depth_std'] ** 2 - without == pytest.approx(
            (height / 300.0) ** 2, rel=1e-6
        )
        assert other.extras['sediment_depth_std'] ** 2 - without == pytest.approx(
            np.full(len(height), (height[0] / 300.0) ** 2), rel=1e-6
        )
