# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Sets of reflectors are scored as they should be, and a whole run is told."""

import json

import numpy as np
import pytest

from sonar_imm.measurements import Trace
from sonar_imm_tools.cli import main
from sonar_imm_tools.evaluation.fathometer import LIMIT
from sonar_imm_tools.evaluation.fathometer.figures import (
    Image,
    MOST_DEPTHS,
    MOST_RECORDS,
    response_figure,
    response_image,
)
from sonar_imm_tools.evaluation.fathometer.scoring import (
    pair,
    Record,
    records_of,
    Reflections,
    score,
)
from sonar_imm_tools.evaluation.judging import judge
from sonar_imm_tools.offline.run_folder import read_measurements, RunFolder
from sonar_imm_tools.recordings.sources import BagError

SECOND = 10**9


def reflections(depth, strength=None, track_id=None):
    depth = np.array(depth, float)
    return Reflections(
        depth,
        np.ones(len(depth)) if strength is None else np.array(strength, float),
        np.arange(len(depth)) if track_id is None else np.array(track_id),
    )


def record(found, true, stamp=1, order=None, **extra):
    pmf = np.zeros(6)
    pmf[(len(found) if order is None else order) - 1] = 1.0
    return Record(
        stamp_ns=stamp * SECOND, preview=extra.get('preview', False), found=found,
        depth_std=np.full(len(found), 0.05), existence=np.ones(len(found)), pmf=pmf, order_min=1,
        sigma=1.0, true=true,
    )  # fmt: skip


def test_a_set_lies_no_distance_from_itself():
    z = np.array([130.0, 134.0, 138.0])
    assert pair(z, z[::-1], 2.0).ospa == 0.0
    assert pair(z[:0], z[:0], 2.0).ospa == 0.0


def test_ospa_in_closed_form():
    assert pair(np.array([10.0]), np.array([10.3]), 2.0).ospa == pytest.approx(0.3)
    assert pair(np.array([10.0]), np.array([15.0]), 2.0).ospa == pytest.approx(2.0)
    assert pair(np.array([]), np.array([15.0, 16.0]), 2.0).ospa == pytest.approx(2.0)
    paired = pair(np.array([10.0, 20.0, 30.0]), np.array([10.3, 20.0]), 2.0)
    assert paired.ospa == pytest.approx(((0.3**2 + 2.0**2) / 3.0) ** 0.5)
    assert list(paired.found) == [0, 1] and list(paired.true) == [0, 1]


def test_partners_are_near_and_as_many_as_can_be():
    paired = pair(np.array([10.0, 10.3]), np.array([9.7, 10.2]), 2.0)
    assert list(paired.found) == [0, 1] and list(paired.true) == [0, 1]
    assert not len(pair(np.array([10.0]), np.array([10.41]), 2.0).found)


def test_false_missed_amplitudes_and_switches_are_counted():
    true = reflections([130.0, 134.0], [0.4, 0.2], [7, 9])
    records = [
        record(reflections([130.1, 134.1], [4.0, 2.0], [1, 2]), true, 1),
        record(reflections([130.1, 134.1, 150.0], [4.0, 2.2, 1.0], [1, 3, 4]), true, 2),
        record(reflections([129.9], [4.0], [1]), true, 3, order=2),
        record(reflections([]), true, 4, order=5, preview=True),
    ]
    silent = record(reflections([130.0], [4.0]), reflections([130.0], [0.0]))
    assert score([silent])['amplitude'] == {'n': 0}
    assert score([*records, silent])['amplitude']['n'] == 5
    metrics = score(records)
    assert metrics['records'] == 3 and metrics['previews'] == 1
    assert metrics['order_right'] == pytest.approx(2 / 3)
    assert metrics['false_per_record'] == pytest.approx(1 / 3)
    assert metrics['missed_per_record'] == pytest.approx(1 / 3)
    assert metrics['depth']['rmse_m'] == pytest.approx(0.1)
    assert metrics['depth']['inside_2_sigma'] == pytest.approx(1.0)
    assert metrics['amplitude']['factor'] == pytest.approx(10.0)
    assert metrics['amplitude']['p95_relative_error'] == pytest.approx(0.08, abs=1e-9)
    assert metrics['identity_switches'] == 1 and metrics['ids'] == 4


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp('fathometer')
    scene = '--scenario drift_traces --seed 4 --set records=12 --set layers=3 --set fading='
    scene += ' --set appearing= --set depth_step=0.0625'
    assert main(['simulate', 'fathometer', str(folder / 'bag'), *scene.split()]) == 0
    how = '--system fathometer --set particles=4000'.split()
    assert main(['track', str(folder / 'bag'), str(folder / 'out'), *how]) == 0
    return RunFolder(folder / 'out')


def test_a_whole_run_is_judged_and_told(run, capsys):
    judgement = judge(run)
    assert judgement.metrics['scored_records'] == 12
    assert judgement.accuracy(None).good and not judgement.accuracy(1e-6).good
    assert judgement.accuracy(None).name == f'{LIMIT.meaning} against truth'
    titles = [section.title for section in judgement.part([]).sections]
    assert titles[:4] == [
        'Depth response and reflectors',
        'How many there are',
        'Amplitudes',
        'Distance from the truth',
    ]
    assert main(['evaluate', str(run.path), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['ospa_m'] == judgement.metrics['ospa_m']


def test_the_image_is_what_the_tracker_saw(run):
    content = run.read_run()
    traces = [item for item in read_measurements(content) if isinstance(item, Trace)]
    image = response_image(content)
    assert image.value.shape == (len(traces[0]), len(traces))
    expected = traces[5].amplitude / traces[5].sigma
    assert np.allclose(image.value[:, 5], expected, rtol=1e-4, atol=1e-4)
    assert image.stamp_ns[5] == traces[5].stamp_ns


def test_a_thin_reflector_does_not_vanish_from_a_long_recording():
    """Of an image with more depths and records than are drawn, the largest of a few is."""
    value = np.zeros((2 * MOST_DEPTHS, 3 * MOST_RECORDS))
    value[301, 604] = 9.0
    depth, stamp_ns = 0.1 * np.arange(len(value)), 10**9 * np.arange(value.shape[1])
    (drawn,) = response_figure(Image(value, depth, stamp_ns), [], 0).data
    assert drawn.z.shape == (MOST_DEPTHS, MOST_RECORDS)
    [[row, column]] = np.argwhere(drawn.z)
    assert drawn.z[row, column] == 9.0
    assert drawn.y[row] == pytest.approx(30.1, abs=0.1)
    assert drawn.x[column] == pytest.approx(604.0, abs=3.0)


def test_without_truth_there_is_a_page_and_no_verdict(run):
    records = records_of(run.read_estimates())
    assert 'scored_records' not in score(records)
    blind = judge(run).metrics
    assert blind['truth_lag_s'] == 0.0


def test_other_estimates_and_other_truth_are_one_sentence(run):
    import attrs

    some = run.read_estimates()
    bare = [attrs.evolve(item, extras={}) for item in some]
    with pytest.raises(BagError, match='not estimates of reflectors'):
        records_of(bare)
    divers = [attrs.evolve(item, state_names=('px', 'py')) for item in some]
    with pytest.raises(BagError, match='truth is not that of reflectors'):
        records_of(some, divers)


def test_truth_further_away_than_the_gap_is_none(run):
    some = run.read_estimates()
    early, late = records_of(some[:1], some[1:], gap=60.0), records_of(some[:1], some[1:], gap=100)
    assert early[0].true is None and late[0].true is not None


def test_the_truth_of_a_record_is_that_of_its_lag_later(run):
    some = run.read_estimates()
    later = 1e-9 * (some[1].stamp_ns - some[0].stamp_ns)
    there = [np.sort(record.found.depth) for record in records_of(some)]
    shifted = records_of(some, some, lag=later, gap=0.1 * later)
    assert shifted[-1].true is None
    for record, depth in zip(shifted[:-1], there[1:], strict=True):
        np.testing.assert_array_equal(np.sort(record.true.depth), depth)
