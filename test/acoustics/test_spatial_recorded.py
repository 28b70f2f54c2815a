# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One ping of a split-beam echo sounder as an array of two staves.

What it proves: phase, geometry and the coherence gate work on samples of a real instrument. The
calibration sphere is found at its range and angle, the floor straight below. What it does not: a
swath. The beam is 7 degrees wide and looks down, two half-apertures 3.7 wavelengths apart are no
filled array, and one ping says nothing about tracking.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from sonar_imm.acoustics import coherence, loudness, spatial, variances

ROOT = Path(__file__).resolve().parents[2]
PING = Path(os.environ.get('SONAR_IMM_DATA', ROOT / '../shared/data')) / 'crimac_ek80/ping.npz'

pytestmark = pytest.mark.skipif(
    not PING.exists(),
    reason='the recording crimac_ek80 is not here: set SONAR_IMM_DATA to the folder that holds it',
)


@pytest.fixture(scope='module')
def ping():
    """Range (n,), samples of the port and starboard halves (n, 2), spacing in wavelengths."""
    with np.load(PING) as archive:
        quadrants = archive['quadrants']
        iq = np.stack([quadrants[:, [1, 2]].sum(axis=1), quadrants[:, [0, 3]].sum(axis=1)], axis=1)
        return archive['range_m'].astype(float), iq, float(archive['spacing_wavelengths'])


def strongest(ranges, iq, first, last):
    power = np.where((ranges > first) & (ranges < last), variances.mean_power(iq), 0.0)
    return int(power.argmax())


def test_the_sphere_is_where_it_was_measured(ping):
    ranges, iq, spacing = ping
    sphere = strongest(ranges, iq, 4.0, 8.0)
    assert ranges[sphere] == pytest.approx(5.79, abs=0.02)
    gamma, sine = coherence.coherence(iq[sphere : sphere + 1], spacing)
    assert gamma[0] > 0.999
    for half_width in (0, 2, 5):
        phase = spatial.phase_difference_sines(iq, spacing, half_width=half_width)[sphere]
        assert np.degrees(np.arcsin(phase)) == pytest.approx(2.2, abs=0.15)
    # Both ways of looking at the same phase agree.
    assert sine[0] == pytest.approx(
        spatial.phase_difference_sines(iq, spacing, half_width=0)[sphere], abs=1e-4
    )


def test_the_floor_lies_straight_below(ping):
    ranges, iq, spacing = ping
    floor = strongest(ranges, iq, 10.0, 13.9)
    assert 12.0 < ranges[floor] < 13.0
    phase = spatial.phase_difference_sines(iq, spacing)[floor]
    assert abs(np.degrees(np.arcsin(phase))) < 1.5


def test_power_hears_the_floor_that_coherence_takes_for_noise(ping):
    ranges, iq, spacing = ping
    silent = coherence.silent_bins(coherence.coherence(iq, spacing)[0], 2, spacing=spacing)
    power, water = variances.mean_power(iq), (ranges > 7.0) & (ranges < 10.0)
    ratio = power / power[water].mean()
    level = loudness.loud_level(2, coherence.GATE_BINS, 1e-3)
    usable = np.ones(len(ranges), bool)
    loud = loudness.loud_bins(ratio, level, bins=coherence.GATE_BINS, usable=usable)
    floor = (ratio > loudness.VERY_LOUD) & (ranges > 12.0)
    assert floor.sum() > 150 and silent[floor].mean() > 0.85  # 20 to 78 dB above the noise
    assert loud[floor].mean() > 0.98
    assert silent[water].all() and loud[water].mean() < 0.005
    # A diffuse floor: a quarter of its power differs between the halves.
    assert 0.1 < variances.decorrelation(iq, floor) < 0.35
