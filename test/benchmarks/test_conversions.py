# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The files of the study of conversions, written byte by byte, hold what the converters find; the
recordings of others that only the studies read; which seed of our own is typical, and what limit
follows from the runs of a scene."""

from argparse import Namespace

import numpy as np
import pytest

from benchmarks.recordings import autoferry, scans_of, truth_of
from benchmarks.speed import conversions
from benchmarks.study import DATA
from benchmarks.typical_seed import readme, scored, typical
from sonar_imm_tools.cli import main
from sonar_imm_tools.evaluation.judging import Limit
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


def record(time, measurement, sensor=2):
    place = {'ownshipPosition': [100.0, 200.0]}
    return {'sensorID': sensor, 'time': time, 'measurement': measurement, **place}


def test_detections_become_scans_east_first():
    records = [
        record(9.0, [5.0, -6.0]), record(3.0, [[1.0, 2.0, 3.0], [10.0, 20.0, 30.0]]),
        record(4.0, []), record(5.0, [0.1, 0.2, 0.3], sensor=4),
    ]  # fmt: skip
    scans = scans_of(records, 'radar', -1_500_000_000)
    assert [scan.stamp_ns for scan in scans] == [1_500_000_000, 2_500_000_000, 7_500_000_000]
    assert [scan.position.tolist() for scan in scans] == [
        [[210.0, 101.0, 0.0], [220.0, 102.0, 0.0], [230.0, 103.0, 0.0]], [],
        [[194.0, 105.0, 0.0]],
    ]  # fmt: skip
    assert not scans_of(records, 'lidar')


def test_truth_is_sorted_and_told_once():
    one = {'targetID': 1, 'position': [1.0, 2.0, 5.0], 'time': 3.0}
    groups = [[{'targetID': 2, 'position': [7.0, 8.0, 0.0], 'time': 3.5}, one], [one]]
    due = np.array([[3.0, 1.0, 2.0, 1.0], [3.5, 2.0, 8.0, 7.0]])
    assert truth_of(groups) == pytest.approx(due)


@pytest.mark.skipif(
    not DATA.is_dir(), reason='no real recordings here; SONAR_IMM_DATA names their folder'
)
def test_the_real_scenario_lies_around_its_truth():
    scans, truth = autoferry('radar')
    assert len(truth) == 1152 + 575
    filled = sum(len(scan) > 0 for scan in scans)
    assert filled == 68 and len(scans) > filled  # some scans saw nothing
    assert sum(map(len, scans)) > 2 * filled  # clutter besides the boats
    for number in (1, 2):
        path = truth[truth[:, 1] == number]
        near = [
            np.hypot(*(place[:2] - [np.interp(stamp, path[:, 0], path[:, c]) for c in (2, 3)]))
            for scan in scans
            for stamp, place in ((scan.stamp_ns * 1e-9, place) for place in scan.position)
        ]
        assert np.sum(np.array(near) < 15.0) > 0.6 * filled


def runs_of(values):
    return {seed: {'rmse': value} for seed, value in enumerate(values, start=1)}


def test_the_seed_is_that_of_the_median_and_nine_in_ten_are_within_the_limit():
    error = np.random.default_rng(0).permutation(np.arange(1.0, 32.0))
    found = typical(runs_of(error), ['rmse'])
    assert error[found.seed - 1] == 16.0 and found.spread['rmse']['of the seed'] == 16.0
    assert found.limit == 28.0 and (error <= found.limit).sum() == 28


def test_a_run_without_the_error_is_worse_than_any_and_most_must_have_it():
    runs = runs_of([1.0, 2.0, 3.0]) | {9: {}}
    assert typical(runs, ['rmse']).seed == 2
    with pytest.raises(ValueError, match='most runs have no nees; there are: rmse'):
        typical(runs, ['nees'])


def test_the_text_names_the_command_the_seeds_and_the_limit():
    given = Namespace(
        system='diver', scene='table1', runs=5, seed=1, set=['speed=2'],
        metric=['position.rmse_m'], compress=[], keep=None, write='somewhere/diver_table1',
    )  # fmt: skip
    runs = {k: {'position.rmse_m': v} for k, v in enumerate([5.0, 1.0, 3.0, 2.0, 4.0], start=1)}
    found = typical(runs, given.metric)
    text = readme(given, found, Limit(1.0, 'm', 'position RMSE', 'position.rmse_m'), 0)
    assert 'simulate diver bags/diver_table1 --scenario table1 --seed 3 --set speed=2' in text
    assert 'Number 3 of seeds 1 to 5' in text and 'allows 4.6 m' in text
    assert 'somewhere' not in text
    kept = typical(runs, given.metric, 5)
    assert (kept.seed, kept.rank, kept.limit) == (5, 4, found.limit)


def test_a_seed_is_simulated_tracked_and_scored_with_what_its_scene_has(capsys):
    scene = ('--scenario', 'approach', '--seed', '7')
    short = ('--set', 'first_range=30', '--set', 'last_range=20')
    found = scored('obstacle', [*scene, *short])
    assert found['gospa.mean_m'] > 0.0 and found['tracks.true_obstacles'] == 1.0
    assert scored('obstacle', [*scene, '--set', 'nothing=1']) == {}
    assert 'nothing' in capsys.readouterr().err
