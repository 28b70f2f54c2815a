# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""From files to scores by the commands: the simulated drift of the vectors, and real lines."""

import json
import os
from pathlib import Path
import shutil

import attrs
import numpy as np
import pytest

from msg_adapters.array_records import write_csdm
from msg_adapters.table import encode_table
from sonar_imm.measurements import Trace
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.simulation.fathometer.simulator import scenario, simulate

ROOT = Path(__file__).resolve().parents[2]
VECTORS = ROOT / 'test' / 'vectors' / 'fathometer' / 'mvdr_traces.npz'
DATA = Path(os.environ.get('SONAR_IMM_DATA', ROOT.parent / 'shared' / 'data')) / 'sbp_chiapas'
LINES = (
    'MET_EW-WE_SBP_L1_WE_20180313165838.seg',
    'MET_EW-WE_SBP_L2_EW_20180313171011.seg',
    'MET_EW-WE_SBP_L3_WE_20180313172145.seg',
    'MET_NS-SN_SBP_L9_SN_20180313161627.seg',
)


@pytest.fixture
def call(capsys):
    def call(*arguments):
        capsys.readouterr()
        assert main([*map(str, arguments), '--json']) == 0
        return json.loads(capsys.readouterr().out)

    return call


@pytest.mark.statistics
def test_the_drift_of_the_vectors_is_tracked_as_well_as_can_be(call, tmp_path):
    call('convert', 'traces', VECTORS, tmp_path / 'bag', '--rate', '0.0111')
    run = call('track', tmp_path / 'bag', tmp_path / 'out')
    assert run['system'] == 'fathometer' and run['counts']['used'] == 300
    metrics = call('evaluate', tmp_path / 'out', '--no-report')
    assert metrics['order_right'] >= 0.94
    assert metrics['ospa_m'] <= 0.07
    assert metrics['depth']['rmse_m'] <= 0.04
    assert metrics['identity_switches'] == 0


def test_hostile_records_of_a_bag_are_named_and_counted_and_the_rest_is_tracked(call, tmp_path):
    """One dead hydrophone in every other record, and of each kind of useless record one."""
    scene = simulate(scenario('small', {'records': 6, 'fading': (), 'depth_companion': False}), 2)
    good = [item.measurement for item in scene.measurements]
    each = np.arange(6, dtype=np.float32)
    identity = np.tile(np.eye(8, dtype=np.complex64), (6, 1, 1))
    upper, dead, same = identity + np.triu(0.5 * np.ones((8, 8)), 1), identity.copy(), identity * 0
    dead[:] = np.nan
    same += 1.0
    hostile = [
        ('csdm', {'frequency': 100.0 + each, 'csdm': flat(upper)}),
        ('csdm', {'frequency': 100.0 + each, 'csdm': flat(same)}),
        ('csdm', {'frequency': 100.0 + each, 'csdm': flat(dead)}),
        ('csdm', {'frequency': 100.0 + each, 'csdm': flat(identity)[:, :30]}),
        ('csdm', {'frequency': 100.0 + each, 'csdm': flat(identity[:, :6, :6])}),
        ('trace', {'depth': each[:1], 'amplitude': each[:1]}),
    ]
    with BagWriter(tmp_path / 'bag') as bag:
        for k, record in enumerate(good):
            csdm = record.csdm.copy()
            if k % 2:
                csdm[:, 3], csdm[:, :, 3] = np.nan, np.nan
            record = attrs.evolve(record, csdm=csdm)
            bag.write('/csdm', write_csdm(record, ros_message), record.stamp_ns)
            topic, columns = hostile[k]
            stamp_ns = record.stamp_ns + 10**9
            message = encode_table(columns, stamp_ns=stamp_ns, frame_id='array', make=ros_message)
            bag.write(f'/{topic}', message, stamp_ns)
    settings = {'phones': 8, 'element_spacing': 0.36, 'frequency_max': 2000.0, 'loading': 0.0}
    words = [word for name, value in settings.items() for word in ('--set', f'{name}={value}')]
    call('track', tmp_path / 'bag', tmp_path / 'out', *words)
    run = json.loads((tmp_path / 'out' / 'run.json').read_text())
    assert {reason: entry['count'] for reason, entry in run['refused'].items()} == {
        'not_hermitian': 1,
        'nan': 1,
        'bad_field': 1,
        'too_short': 1,
    }
    counts = run['counts']
    assert counts['singular'] == 1 and counts['wrong_hydrophones'] == 1
    assert counts['dead_hydrophones_masked'] == 3 and counts['used'] == 6
    last = RunFolder(tmp_path / 'out').read_estimates()[-1]
    assert last.stamp_ns == good[-1].stamp_ns
    offset = np.abs(last.state[:, :1] - scene.truth[-1].depth)
    assert (offset.min(axis=1) < 0.2).all()


def flat(csdm):
    """Matrices (F, N, N) as a column of a table."""
    return csdm.astype(np.complex64).reshape(len(csdm), -1).view(np.float32)


@pytest.mark.statistics
@pytest.mark.parametrize('line', LINES)
def test_the_water_bottom_of_a_real_line_is_followed(call, tmp_path, line):
    """With what the converter tells the tracker. 4 to 6 s a line: its records are the test."""
    pytest.importorskip('segyio')
    if not (DATA / line).exists():
        pytest.skip('no real recordings here; SONAR_IMM_DATA names their folder')
    cut = ('--sample-spacing', 0.376, '--first-sample', 12, '--samples', 74, '--stack', 4)
    call('convert', 'segy', DATA / line, tmp_path / 'bag', *cut)
    call('track', tmp_path / 'bag', tmp_path / 'out', '--set', 'particles=3000')
    estimates = {
        estimate.stamp_ns: estimate.columns()
        for estimate in RunFolder(tmp_path / 'out').read_estimates()
    }
    with BagReader(tmp_path / 'bag') as bag:
        read = [received.measurement for received in measurements_of(bag, 'fathometer')]
    traces = [item for item in read if isinstance(item, Trace)]
    hits, ids = [], set()
    for trace in traces:
        # Three samples in a row above an eighth of full scale; the greatest of the next four.
        loud = trace.amplitude > 3840.0
        first = int(np.argmax(loud[:-2] & loud[1:-1] & loud[2:]))
        floor = trace.depth[first + int(np.argmax(trace.amplitude[first : first + 4]))]
        row = estimates[trace.stamp_ns]
        away = np.abs(row['depth'] - floor)
        hits.append(away.min() < 1.0)
        if hits[-1]:
            ids.add(int(row['track_id'][np.argmin(away)]))
    assert np.mean(hits) >= 0.94 and len(ids) <= 0.012 * len(traces)


@pytest.mark.parametrize(
    ('setting', 'reason'),
    [
        ('min_separation=20.0', 'too_crowded: 12 members'),
        ('phones=9', 'wrong_hydrophones: the array has 8 hydrophones, not 9'),
    ],
)
def test_a_run_whose_records_were_all_refused_fails_with_the_reason(
    tmp_path, capsys, setting, reason
):
    out = tmp_path / 'out'
    bag = Path(__file__).resolve().parents[2] / 'bags' / 'fathometer_array'
    assert main(['track', str(bag), str(out), '--set', setting]) == 2
    assert f'refused: 12 ({reason}' in capsys.readouterr().err
    assert not out.exists()
    # Among several it is a failed run, and its reason is in the summary.
    other = shutil.copytree(bag, tmp_path / 'other')
    assert main(['track', str(bag), str(other), str(out), '--set', setting]) == 1
    runs = json.loads((out / 'summary.json').read_text())['runs']
    assert [run['state'] for run in runs] == ['failed', 'failed']
    assert all(reason in run['failure'] for run in runs)
