# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Simulate or convert, look, track, evaluate: the commands one after the other."""

import csv
import json
import os
from pathlib import Path
import shutil

from helpers.commands import contents
from helpers.dive_bags import write_dive
from helpers.source import ROOT
import numpy as np
import pytest

from sonar_imm.measurements import Trace
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader

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
    """Run a command that has to succeed and give its JSON."""

    def call(*arguments):
        capsys.readouterr()
        assert main([*map(str, arguments), '--json']) == 0
        return json.loads(capsys.readouterr().out)

    return call


@pytest.fixture(scope='module')
def dive(tmp_path_factory):
    folder = tmp_path_factory.mktemp('recorded')
    return write_dive(folder / 'dive', count=60, spoilt=(30, 31), shuffle=True)


def test_track_twice_writes_the_same_bytes_and_accounts_for_every_message(
    call, dive, tmp_path, capsys
):
    run = call('track', dive, tmp_path / 'out')
    assert run == json.loads((tmp_path / 'out' / 'run.json').read_text())
    assert run['messages'] == 60 and run['estimates'] == 58
    assert run['counts']['used'] == 58 and run['counts']['refused'] == 2
    assert run['refused']['nan']['count'] == 2
    assert run['topics'] == {'/fix': 'fix'} and run['bag'] == str(dive.resolve())
    assert run['parameters']['model_set'] == 'families'
    assert {'sonar_imm', 'numpy', 'rosbags'} <= run['versions'].keys()
    with (tmp_path / 'out' / 'estimate.csv').open(newline='') as file:
        stamps = [int(row['stamp_ns']) for row in csv.DictReader(file)]
    assert stamps == sorted(stamps) and len(stamps) == 58
    # A run is not overwritten by accident.
    first = contents(tmp_path / 'out', 'run.json')
    assert main(['track', str(dive), str(tmp_path / 'out')]) == 2
    assert '--overwrite' in capsys.readouterr().err
    call('track', dive, tmp_path / 'out', '--overwrite')
    assert contents(tmp_path / 'out', 'run.json') == first and len(first) == 4


def test_evaluate_scores_and_reports(call, tmp_path):
    dive = write_dive(tmp_path / 'dive', spoilt=(30, 31), shuffle=True)
    call('track', dive, tmp_path / 'out')
    metrics = call('evaluate', tmp_path / 'out', '--report', tmp_path / 'page.html')
    assert metrics == json.loads((tmp_path / 'out' / 'metrics.json').read_text())
    assert metrics['position']['rmse_m'] < 0.75 * metrics['raw_fix']['rmse_m']
    assert metrics['tracks']['tracks'] == 1
    assert (tmp_path / 'page.html').stat().st_size > 1_000_000


def test_evaluate_takes_truth_from_another_bag_and_says_when_that_has_none(call, tmp_path, capsys):
    blind = write_dive(tmp_path / 'blind', truth=False)
    known = write_dive(tmp_path / 'known')
    call('track', blind, tmp_path / 'out')
    assert 'position' not in call('evaluate', tmp_path / 'out', '--no-report')
    metrics = call('evaluate', tmp_path / 'out', '--no-report', '--truth', known)
    assert metrics['position']['n'] > 100
    assert not (tmp_path / 'out' / 'report.html').exists()
    assert main(['evaluate', str(tmp_path / 'out'), '--truth', str(blind)]) == 2
    assert 'has no topic /truth/estimate' in capsys.readouterr().err


def test_parameters_come_from_file_and_command(call, dive, tmp_path):
    params = tmp_path / 'diver.yaml'
    params.write_text(
        '/**:\n  ros__parameters:\n    model_set: heading_speed\n    max_tracks: 2\n'
        '    use_sim_time: true\n    radar: {fix_std: 2.0, clutter_density: 1.0e-4}\n'
    )
    given = ('max_tracks=1', 'covariance_scales=1.0, 3', 'sensors=radar,b', 'radar.fix_std=4')
    words = [word for setting in given for word in ('--set', setting)]
    run = call('track', dive, tmp_path / 'out', '--params', params, *words)
    parameters = run['parameters']
    assert parameters['model_set'] == 'heading_speed' and parameters['max_tracks'] == 1
    assert parameters['covariance_scales'] == [1.0, 3.0]
    assert (parameters['radar.fix_std'], parameters['radar.clutter_density']) == (4.0, 1e-4)


@pytest.mark.parametrize(
    'text, words',
    [
        ('/**:\n  ros__parameters:\n    model_sett: families', "did you mean 'model_set'?"),
        ('model_set: vc', 'must be one of'),
        (b'\xff\xfe', 'is not a text file'),
    ],
)
def test_bad_parameter_files_are_one_sentence(dive, tmp_path, capsys, text, words):
    params = tmp_path / 'diver.yaml'
    params.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert main(['track', str(dive), str(tmp_path / 'out'), '--params', str(params)]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_the_shipped_parameter_file_is_understood(call, dive, tmp_path):
    from sonar_imm_tools.resources import shared_file

    params = ('--params', shared_file('config/diver.yaml'))
    run = call('track', dive, tmp_path / 'out', '--smooth', *params)
    assert run['estimates'] == 58 and run['smoothed'] is True


@pytest.mark.parametrize(
    'topic, words',
    [
        ('fix=/nope', "has no topic '/nope'"),
        ('nonsense=/fix', "the diver tracker has no input 'nonsense'"),
        ('detections=/nope', "has no topic '/nope'"),
    ],
)
def test_the_system_that_is_meant_is_named(dive, tmp_path, capsys, topic, words):
    assert main(['track', str(dive), str(tmp_path / 'run'), '--topic', topic]) == 2
    errors = capsys.readouterr().err
    assert words in errors and 'bathymetry' not in errors


def test_convert_tells_what_it_left_out(call, tmp_path, capsys):
    table = tmp_path / 'usbl.csv'
    table.write_text(
        'when,easting,northing,std\n1700000000,1,2,0.5\n1700000001,x,2,0.5\n1700000002,1,3,0.5\n'
    )
    arguments = ['convert', 'fixes', str(table), '--column', 'stamp=when', '--time-offset', '0.5']
    result = call(*arguments, tmp_path / 'bag')
    assert result['messages'] == {'/fix': 2} and result['bad_rows'] == 1
    assert main([*arguments, str(tmp_path / 'again')]) == 0
    assert 'line 3' in capsys.readouterr().out
    assert main([*arguments, str(tmp_path / 'again')]) == 2
    assert 'exists already' in capsys.readouterr().err
    found = call('info', tmp_path / 'bag')
    assert found['systems'] == {'diver': {'fix': ['/fix']}}


def test_the_node_parameters_of_a_file_are_checked_and_ignored(call, dive, tmp_path, capsys):
    params = tmp_path / 'diver.yaml'
    params.write_text('input_types: [fix=geometry_msgs/msg/PointStamped]\nstale_after: 7.0\n')
    run = call('track', dive, tmp_path / 'out', '--params', params)
    assert 'input_types' not in run['parameters'] and run['estimates'] == 58
    params.write_text('input_types: [fix=geometry_msgs/msg/PointStampd]\n')
    assert main(['track', str(dive), str(tmp_path / 'no'), '--params', str(params)]) == 2
    assert "did you mean 'geometry_msgs/msg/PointStamped'?" in capsys.readouterr().err


@pytest.mark.parametrize('command', ['simulate', 'track'])
def test_a_full_disk_is_named(command, dive, tmp_path, capsys):
    resource = pytest.importorskip('resource')
    out = tmp_path / 'out'
    _, most = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, most))  # Python ignores SIGXFSZ
        code = main([command, 'diver' if command == 'simulate' else str(dive), str(out)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    errors = capsys.readouterr().err
    assert code == 2 and 'Traceback' not in errors
    assert str(out) in errors and 'File too large' in errors


def test_detections_kept_in_a_bag_give_the_same_tracks(call, tmp_path, capsys):
    bag, kept, *outs = (tmp_path / name for name in ('images', 'kept', 'first', 'second'))
    words = ('last_range=33', 'image_beams=64', 'image_bins=200', 'target=point')
    settings = [word for given in words for word in ('--set', given)]
    assert main(['simulate', 'obstacle', str(bag), '--scenario', 'images', *settings]) == 0
    call('convert', 'images', bag, kept)
    run = call('track', bag, outs[0])
    call('track', kept, outs[1], '--params', bag / 'parameters.yaml')
    tables = [(out / 'estimate.csv').read_bytes() for out in outs]
    assert tables[0] == tables[1] and len(tables[0].splitlines()) > 10
    assert run['topics']['/image'] == 'image' and run['detector']['image_far_range'] == 55.0
    call('track', bag, tmp_path / 'none', '--set', 'sidelobe_db=0.0')
    assert main(['track', str(bag), str(tmp_path / 'bad'), '--set', 'sidelob_db=1.0']) == 2
    assert 'sidelob' in capsys.readouterr().err


# -- the simulated drift of the vectors, and real lines --


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
    bag = ROOT / 'bags' / 'fathometer_array'
    assert main(['track', str(bag), str(out), '--set', setting]) == 2
    assert f'refused: 12 ({reason}' in capsys.readouterr().err
    assert not out.exists()
    # Among several it is a failed run, and its reason is in the summary.
    other = shutil.copytree(bag, tmp_path / 'other')
    assert main(['track', str(bag), str(other), str(out), '--set', setting]) == 1
    runs = json.loads((out / 'summary.json').read_text())['runs']
    assert [run['state'] for run in runs] == ['failed', 'failed']
    assert all(reason in run['failure'] for run in runs)
