# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The files of the study of conversions, written byte by byte, hold what the converters find."""

import numpy as np
import pytest

from benchmarks.speed import conversions
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader

CASES = {
    'CSV of fixes': ({'rows': 40}, {'/fix': 40}),
    'NMEA 0183': ({'lines': 30}, {'/fix': 10, '/heading': 10}),
    'AIS': ({'lines': 60}, {'/fixes': 60}),
    'telemetry, 60 tags': ({'rows': 420}, {'/arrivals': 60}),
    'SEG-Y, 1000 samples': ({'traces': 8}, {'/trace': 8}),
    'XTF, 2 x 2000 samples': ({'pings': 12}, {'/detections': 12, '/nav': 12}),
    'WAV, 8 channels': ({'seconds': 2}, {'/pressure': 2}),
    'npz, 2000 x 8': ({'pings': 3}, {'/snapshot': 3}),
}
NEEDED = {'NMEA 0183': 'pynmea2', 'AIS': 'pyais', 'SEG-Y, 1000 samples': 'segyio',
          'XTF, 2 x 2000 samples': 'pyxtf', 'WAV, 8 channels': 'soundfile'}  # fmt: skip


def converted(tmp_path, case):
    pytest.importorskip(NEEDED.get(case, 'numpy'))
    kind, _, make = conversions.CASES[case]
    path, _, options = make(tmp_path, **CASES[case][0])
    assert main(['convert', kind, str(path), str(tmp_path / 'bag'), *options]) == 0
    return BagReader(tmp_path / 'bag')


@pytest.mark.parametrize('case', CASES)
def test_every_record_of_a_file_is_found(tmp_path, case):
    with converted(tmp_path, case) as bag:
        assert {each.name: each.count for each in bag.topics} == CASES[case][1]


def test_the_samples_and_places_are_those_that_were_written(tmp_path):
    with converted(tmp_path, 'SEG-Y, 1000 samples') as bag:
        traces = [item.measurement for item in measurements_of(bag, 'fathometer')]
    written = np.random.default_rng(1).normal(size=(8, 1000))
    found = np.array([trace.amplitude for trace in traces])
    assert found == pytest.approx(written, abs=1e-6)
    assert traces[0].depth[:2] == pytest.approx([0.0, 0.03])
    begin = int(np.datetime64('2025-06-03', 'ns').astype(np.int64))
    assert [trace.stamp_ns - begin for trace in traces] == [k * 250_000_000 for k in range(8)]


def test_an_xtf_of_bytes_lies_where_it_says(tmp_path):
    with converted(tmp_path, 'XTF, 2 x 2000 samples') as bag:
        found = [item.measurement for item in measurements_of(bag, 'obstacle')]
    poses = [each for each in found if type(each).__name__ == 'Navigation']
    assert poses[-1].position[:2] == pytest.approx([0.0, 11e-6 * 111_314.0], abs=1e-3)
    assert poses[-1].stamp_ns - poses[0].stamp_ns == 2_200_000_000
