# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Numbers of side scan: ranges, phases and what is said of a file, by hand."""

import math

import numpy as np
import pytest

from sonar_imm.measurements import Rejection
from sonar_imm_tools.recordings.conversion import ConversionReport
from sonar_imm_tools.recordings.convert import side_scan
from sonar_imm_tools.recordings.convert_options import XtfOptions


def channel(samples=(1, 2, 3), **changes):
    values = {'slant_range': 75.0, 'delay': 0.0, 'name': '', 'side': 'port', 'frequency': 4.55e5}
    return {**values, 'samples': np.array(samples), **changes}


def test_a_sample_lies_in_the_middle_of_its_bin():
    assert side_scan._ranges(channel(), 1500.0).tolist() == [12.5, 37.5, 62.5]


@pytest.mark.parametrize('delay, near', [(0.01, 7.5), (9.99, 7492.5), (10.0, 0.0), (-1.0, 0.0)])
def test_the_delay_is_there_and_back(delay, near):
    ranges = side_scan._ranges(channel(delay=delay), 1500.0)
    assert ranges == pytest.approx(near + np.array([12.5, 37.5, 62.5]))


@pytest.mark.parametrize('far', [0.0, -1.0, math.nan, math.inf, 10_000.1])
def test_a_slant_range_that_no_sonar_has_is_refused(far):
    assert side_scan._ranges(channel(slant_range=10_000.0), 1500.0)[-1] == pytest.approx(8333.333)
    with pytest.raises(Rejection, match='slant range'):
        side_scan._ranges(channel(slant_range=far), 1500.0)


@pytest.mark.parametrize(
    'samples, radians_per_count, turn',
    [
        (np.array([16384], np.int16), None, 0.5 * math.pi),
        (np.array([-16384], np.int16), None, -0.5 * math.pi),
        (np.array([64], np.uint8), None, 0.5 * math.pi),
        (np.array([0.25], np.float32), None, 0.25),
        (np.array([8], np.int16), 0.125, 1.0),
    ],
)
def test_the_range_of_whole_numbers_is_one_turn(samples, radians_per_count, turn):
    assert side_scan._turns(samples, radians_per_count) == pytest.approx([turn])


def test_a_phase_is_that_of_stave_one_against_stave_zero():
    ping = {'stamp_ns': 1, 'sound_speed': 1500.0, 'nav': None}
    channels = [channel([4, 4]), channel(np.array([0, 16384], np.int16), name='Phase')]
    made = side_scan._interferometer(ping, 'port', channels, XtfOptions())
    assert made.iq == pytest.approx(np.array([[4.0, 4.0], [4.0, 4.0j]]), abs=1e-6)
    assert made.sample_rate == pytest.approx(0.5 * 1500.0 / 37.5) and made.side == 'port'
    assert side_scan._interferometer(ping, 'port', channels[:1], XtfOptions()) is None


@pytest.mark.parametrize('order, first', [('far', 3.0), ('near', 1.0)])
def test_port_may_be_told_from_far_to_near(order, first):
    ping = {'channels': [channel(), channel(side='starboard'), channel(side='', samples=[9])]}
    found = side_scan._sides(ping, order)
    assert found['port'][0]['samples'][0] == first
    assert found['starboard'][0]['samples'][0] == 1.0 and set(found) == {'port', 'starboard'}


@pytest.mark.parametrize(
    'clipped, top, full',
    [(0, 32767, 0), (1, 32767, 1), (2, 32767, 2), (2, 4095, 2), (9, 4000, 0), (50, 15, 0)],
)
def test_more_than_a_hundredth_at_full_scale_is_said(clipped, top, full, tmp_path):
    samples = np.ones(100, np.int16)
    samples[:clipped] = top
    how, report = XtfOptions(), ConversionReport(tmp_path)
    seen = side_scan._Seen(how)
    image = side_scan._image(
        {'stamp_ns': 1, 'sound_speed': 1500.0, 'nav': None}, [channel(samples)], how
    )
    seen.image(image, [channel(samples)], 1)
    seen.tell(tmp_path / 'a.xtf', report)
    assert seen.clipped == full and seen.samples == 100
    assert any('full scale' in question for question in report.questions) == (full > 1)


def test_samples_at_full_scale_are_those_of_the_frequency_that_is_used(tmp_path):
    loud, calm = np.full(100, 32767, np.int16), np.ones(100, np.int16)
    channels = [{**channel(loud), 'frequency': 4e5}, {**channel(calm), 'frequency': 9e5}]
    for frequency, clipped in ((None, 100), (4.1e5, 100), (8e5, 0)):
        seen = side_scan._Seen(XtfOptions(frequency=frequency))
        image = side_scan._image(
            {'stamp_ns': 1, 'sound_speed': 1500.0, 'nav': None}, channels, seen.how
        )
        seen.image(image, channels, 1)
        assert seen.clipped == clipped and (image.amplitude.max() == 32767) == (clipped > 0)
        report = ConversionReport(tmp_path)
        seen.tell(tmp_path / 'a.xtf', report)
        assert '--frequency HZ' in report.notes['frequencies']
