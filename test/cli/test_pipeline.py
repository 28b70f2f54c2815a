# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Simulate or convert, look, track, evaluate: the commands one after the other; what ``info``
recommends works; recordings in either convention of axes."""

import json
import os
from pathlib import Path
import shlex
import shutil

from attrs import evolve
from helpers import marine
from helpers.commands import contents
from helpers.dive_scenes import write_dive
from helpers.field_files import bag_of, FORMATS, line, measured
from helpers.source import ROOT
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from scipy.spatial.transform import Rotation

from msg_adapters.fixes import write_geodetic
from msg_adapters.inputs import inputs_of
from sonar_imm.measurements import Detections, GeodeticFix, Navigation, Trace
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.measurements import fitting_topics, measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import quoted
from sonar_imm_tools.recordings.writer import BagWriter, ros_message
from sonar_imm_tools.resources import shared_file

VECTORS = ROOT / 'test' / 'vectors' / 'fathometer' / 'mvdr_traces.npz'
DATA = Path(os.environ.get('SONAR_IMM_DATA', ROOT.parent / 'shared' / 'data')) / 'sbp_chiapas'
LINES = (
    'MET_EW-WE_SBP_L1_WE_20180313165838.seg', 'MET_EW-WE_SBP_L2_EW_20180313171011.seg',
    'MET_EW-WE_SBP_L3_WE_20180313172145.seg', 'MET_NS-SN_SBP_L9_SN_20180313161627.seg',
)  # fmt: skip


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
    out = tmp_path / 'out'
    run = call('track', dive, out)
    assert run == json.loads((out / 'run.json').read_text())
    assert run['messages'] == 60 and run['estimates'] == 58
    assert run['counts']['used'] == 58 and run['counts']['refused'] == 2
    assert run['refused']['nan']['count'] == 2
    assert run['topics'] == {'/fix': 'fix'} and run['bag'] == str(dive.resolve())
    assert run['parameters']['model_set'] == 'families'
    assert {'sonar_imm', 'numpy', 'rosbags'} <= run['versions'].keys()
    stamps = [int(row.split(',')[0]) for row in (out / 'estimate.csv').open().readlines()[1:]]
    assert stamps == sorted(stamps) and len(stamps) == 58
    # A run is not overwritten by accident.
    first = contents(out, 'run.json')
    assert main(['track', str(dive), str(out)]) == 2
    assert '--overwrite' in capsys.readouterr().err
    call('track', dive, out, '--overwrite')
    assert contents(out, 'run.json') == first and len(first) == 4


def test_evaluate_scores_and_reports_by_the_truth_of_any_bag(call, tmp_path, capsys):
    known = write_dive(tmp_path / 'dive', spoilt=(30, 31), shuffle=True)
    blind, out = write_dive(tmp_path / 'blind', truth=False), tmp_path / 'out'
    call('track', known, out)
    metrics = call('evaluate', out, '--report', tmp_path / 'page.html')
    assert metrics == json.loads((out / 'metrics.json').read_text())
    assert metrics['position']['rmse_m'] < 0.75 * metrics['raw_fix']['rmse_m']
    assert metrics['tracks']['tracks'] == 1
    assert (tmp_path / 'page.html').stat().st_size > 1_000_000
    call('track', blind, out, '--overwrite')
    assert 'position' not in call('evaluate', out, '--no-report')
    assert call('evaluate', out, '--no-report', '--truth', known)['position']['n'] > 100
    assert not (out / 'report.html').exists()
    assert main(['evaluate', str(out), '--truth', str(blind)]) == 2
    assert 'has no topic /truth/estimate' in capsys.readouterr().err


def test_parameters_come_from_file_and_command(call, dive, tmp_path):
    params = tmp_path / 'diver.yaml'
    params.write_text(
        '/**:\n  ros__parameters:\n    model_set: heading_speed\n    max_tracks: 2\n'
        '    use_sim_time: true\n    radar: {fix_std: 2.0, clutter_density: 1.0e-4}\n'
        '    input_types: [fix=geometry_msgs/msg/PointStamped]\n    stale_after: 7.0\n'
    )
    given = ('max_tracks=1', 'covariance_scales=1.0, 3', 'sensors=radar,b', 'radar.fix_std=4')
    words = [word for setting in given for word in ('--set', setting)]
    parameters = call('track', dive, tmp_path / 'out', '--params', params, *words)['parameters']
    assert parameters['model_set'] == 'heading_speed' and parameters['max_tracks'] == 1
    assert parameters['covariance_scales'] == [1.0, 3.0]
    assert (parameters['radar.fix_std'], parameters['radar.clutter_density']) == (4.0, 1e-4)
    assert 'input_types' not in parameters  # that of a node is checked, and ignored
    shipped = ('--params', shared_file('config/diver.yaml'))
    run = call('track', dive, tmp_path / 'shipped', '--smooth', *shipped)
    assert run['estimates'] == 58 and run['smoothed'] is True


def test_bad_parameter_files_and_topics_are_one_sentence_of_the_system_that_is_meant(
    dive, tmp_path, capsys
):
    params = tmp_path / 'diver.yaml'
    for text, words in (
        (b'/**:\n  ros__parameters:\n    model_sett: families', "did you mean 'model_set'?"),
        (b'model_set: vc', 'must be one of'),
        (b'\xff\xfe', 'is not a text file'),
        (b'input_types: [fix=geometry_msgs/msg/PointStampd]', 'geometry_msgs/msg/PointStamped'),
        ('detections=/nope', "has no topic '/nope'"),
    ):
        option = ['--params', str(params)] if isinstance(text, bytes) else ['--topic', text]
        params.write_bytes(text if isinstance(text, bytes) else b'')
        assert main(['track', str(dive), str(tmp_path / 'out'), *option]) == 2
        errors = capsys.readouterr().err
        assert words in errors and 'bathymetry' not in errors and not (tmp_path / 'out').exists()


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
    assert metrics['order_right'] >= 0.94 and metrics['ospa_m'] <= 0.07
    assert metrics['depth']['rmse_m'] <= 0.04 and metrics['identity_switches'] == 0


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
    read = RunFolder(tmp_path / 'out').read_estimates()
    estimates = {estimate.stamp_ns: estimate.columns() for estimate in read}
    traces = [each for each in measured(tmp_path / 'bag', 'fathometer') if isinstance(each, Trace)]
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


def test_a_run_whose_records_were_all_refused_fails_with_the_reason(tmp_path, capsys):
    out, bag = tmp_path / 'out', ROOT / 'bags' / 'fathometer_array'
    setting, reason = 'phones=9', 'wrong_hydrophones: the array has 8 hydrophones, not 9'
    assert main(['track', str(bag), str(out), '--set', setting]) == 2
    assert f'refused: 12 ({reason}' in capsys.readouterr().err
    assert not out.exists()
    # Among several it is a failed run, and its reason is in the summary.
    other = shutil.copytree(bag, tmp_path / 'other')
    assert main(['track', str(bag), str(other), str(out), '--set', setting]) == 1
    runs = json.loads((out / 'summary.json').read_text())['runs']
    assert [run['state'] for run in runs] == ['failed', 'failed']
    assert all(reason in run['failure'] for run in runs)


SHIPPED = sorted(path.name for path in (ROOT / 'bags').iterdir() if path.is_dir())


def recommended(bag, capsys):
    """The commands that ``info`` prints, the best one first."""
    capsys.readouterr()
    assert main(['info', str(bag)]) == 0
    said = 'to track it: ', 'or as something else: '
    lines = capsys.readouterr().out.splitlines()
    return [line.partition(': ')[2] for line in lines if line.startswith(said)]


def run(command, out, capsys, *more):
    """What a recommended command leaves."""
    program, *arguments = shlex.split(command.replace('OUT_DIR', shlex.quote(str(out))))
    assert program == 'sonar-imm'
    capsys.readouterr()
    assert main([*arguments, *more, '--json']) == 0
    return json.loads(capsys.readouterr().out)


def poses(bag='obstacle_movers', step=1):
    """(message, log time) of the navigation of a shipped recording."""
    with BagReader(ROOT / 'bags' / bag) as reader:
        return [(item.message, item.log_ns) for item in reader.messages(['/nav'])][:200:step]


def ship_at(stamp_ns):
    """The message of the ship's own position."""
    place = {'latitude': 54.0, 'longitude': 10.0, 'height': 0.0, 'frame_id': 'gps'}
    return write_geodetic(GeodeticFix(stamp_ns=stamp_ns, **place), ros_message)


@pytest.mark.parametrize('name', SHIPPED)
def test_the_tracker_of_every_shipped_recording_is_recommended(name, capsys):
    """By this command test_processors.py tracks them all."""
    (command,) = recommended(ROOT / 'bags' / name, capsys)
    bag, system = quoted(str(ROOT / 'bags' / name)), name.split('_')[0]
    assert command == f'sonar-imm track {bag} OUT_DIR --system {system}'


def copied(name, out, rename=None, extra=()):
    """A shipped recording under other names, with further messages (topic, message, log time)."""
    with BagReader(ROOT / 'bags' / name) as reader, BagWriter(out) as writer:
        for item in reader.messages():
            if 'truth' not in item.topic:
                writer.write((rename or {}).get(item.topic, item.topic), item.message, item.log_ns)
        for topic, message, log_ns in extra:
            writer.write(topic, message, log_ns)
    return out


def test_topics_that_have_to_be_named_are_all_named(tmp_path, capsys):
    names = {'/nav': '/odom', '/detections': '/fls/points'}
    # Of two odometries nobody knows which one is meant.
    other = [('/wheels', *pose) for pose in poses()[:9]]
    bag = copied('obstacle_movers', tmp_path / 'bag', names, other)
    command = recommended(bag, capsys)[0]
    assert '--topic nav=/odom' in command and '--topic detections=/fls/points' in command
    assert run(command, tmp_path / 'out', capsys)['rows'] > 0
    bag = copied('obstacle_movers', tmp_path / 'one', {'/nav': '/odom'})
    given = run(recommended(bag, capsys)[0], tmp_path / 'out1', capsys)
    assert given['rows'] > 0 and given['system'] == 'obstacle'


def test_the_ships_own_position_is_no_diver(tmp_path, capsys):
    """A recording of obstacles with a NavSatFix on a topic ``fix`` fits two trackers."""
    fixes = [('/gps/fix', ship_at(log_ns), log_ns) for _, log_ns in poses('obstacle_tethers', 10)]
    bag = copied('obstacle_tethers', tmp_path / 'bag', extra=fixes)
    commands = recommended(bag, capsys)
    assert [command.split()[-1] for command in commands] == ['obstacle', 'diver']
    assert main(['track', str(bag), str(tmp_path / 'out')]) == 0
    assert json.loads((tmp_path / 'out' / 'run.json').read_text())['system'] == 'obstacle'


def test_a_pose_is_the_diver_rather_than_a_receivers_position(tmp_path, capsys):
    """Neither is named: of both, the one that may be the ship's own is not tracked."""
    dive, bag = write_dive(tmp_path / 'dive', topic='/usbl/pose', truth=False), tmp_path / 'bag'
    with BagReader(dive) as reader, BagWriter(bag) as writer:
        for item in reader.messages():
            writer.write(item.topic, item.message, item.log_ns)
            writer.write('/gps/fix', ship_at(item.log_ns), item.log_ns)
    assert main(['track', str(bag), str(tmp_path / 'out')]) == 0
    printed = capsys.readouterr().out
    assert 'diver <- /usbl/pose as fix (120 messages)' in printed
    own = "ignored: /gps/fix (120 messages): the ship's own position? --topic fix=/gps/fix"
    assert own in printed
    (command,) = recommended(bag, capsys)
    assert run(command, tmp_path / 'again', capsys)['topics'] == {'/usbl/pose': 'fix'}
    own = run(command, tmp_path / 'own', capsys, '--topic', 'fix=/gps/fix')
    assert own['topics'] == {'/gps/fix': 'fix'}


def test_a_laser_scan_with_odometry_is_tracked_as_info_says(tmp_path, capsys):
    """Without its options the refusal speaks of the tracker that ``info`` recommends."""
    ranges = np.full(101, 30.0, np.float32)
    ranges[50] = 12.0
    seen = {
        'angle_min': -0.5, 'angle_max': 0.5, 'angle_increment': 0.01, 'time_increment': 0.0,
        'scan_time': 0.1, 'range_min': 0.1, 'range_max': 25.0, 'ranges': ranges,
        'intensities': np.ones(101, np.float32),
    }  # fmt: skip
    bag = tmp_path / 'bag'
    with BagWriter(bag) as writer:
        for nav, log_ns in poses()[:100]:
            scan = ros_message('sensor_msgs/msg/LaserScan', header=nav.header, **seen)
            writer.write('/odom', nav, log_ns)
            writer.write('/scan', scan, log_ns)
    (command,) = recommended(bag, capsys)
    assert '--topic nav=/odom --topic detections=/scan' in command
    assert run(command, tmp_path / 'out', capsys)['rows'] > 0
    assert main(['track', str(bag), str(tmp_path / 'no')]) == 2
    refusal = capsys.readouterr().err
    for words in ('no topic for the obstacle tracker', '/odom as nav', '/scan as detections'):
        assert words in refusal


def test_what_only_the_user_knows_of_an_image_is_asked_in_the_command(tmp_path, capsys):
    """A picture of ranges by beams states neither; with both told, the command works."""
    shade = np.random.default_rng(1).rayleigh(12, (20, 100, 60))
    shade[:, 40:43, 30:32] += 200.0
    kind = {'height': 100, 'width': 60, 'encoding': 'mono8', 'is_bigendian': 0, 'step': 60}
    with BagWriter(tmp_path / 'bag') as writer:
        for nav, log_ns in poses()[:100]:
            writer.write('/odom', nav, log_ns)
        for (nav, log_ns), pixels in zip(poses()[:100:5], np.minimum(shade, 255).astype('u1')):
            given = {'header': nav.header, 'data': pixels.ravel(), **kind}
            writer.write('/sonar/image', ros_message('sensor_msgs/msg/Image', **given), log_ns)
    (command,) = recommended(tmp_path / 'bag', capsys)
    told = command.replace('=METRES', '=40').replace('=DEGREES', '=90')
    assert told != command and run(told, tmp_path / 'out', capsys)['rows'] > 0


def test_a_type_that_nobody_hears_names_what_would_do(tmp_path, capsys):
    types, kind = get_typestore(Stores.ROS2_JAZZY), 'usbl_msgs/msg/Target'
    types.register(get_types_from_msg('std_msgs/Header header\nfloat64 range', kind))

    def messages(each, stamp):
        header = marine.header(sec=stamp // 10**9)
        yield '/usbl/target', types.types[kind](header=header, range=40.0)

    bag_of(tmp_path / 'dive', line(5), messages, types)
    assert main(['track', str(tmp_path / 'dive'), str(tmp_path / 'run')]) == 2
    sentence = capsys.readouterr().err
    assert kind in sentence and 'PoseWithCovarianceStamped' in sentence
    assert 'diver' in sentence and 'bathymetry' not in sentence
    assert main(['info', str(tmp_path / 'dive')]) == 1
    assert 'fix takes geometry_msgs/msg/PoseWithCovarianceStamped' in capsys.readouterr().out


KINDS = ('usbl.csv', 'dive.gpx', 'gps.log', 'line.seg', 'frames')


@pytest.mark.parametrize('command, name', [('track', 'usbl.csv'), *(('info', k) for k in KINDS)])
def test_a_file_of_another_kind_is_named_with_the_command_that_converts_it(
    command, name, tmp_path, capsys
):
    (each,) = (each for each in FORMATS if each.name == name)
    each.make(tmp_path / name, line(30))
    out = [str(tmp_path / 'out')] * (command == 'track')
    assert main([command, str(tmp_path / name), *out]) == 2
    suggested = capsys.readouterr().err.split('sonar-imm convert ')[1].split(' makes one')[0]
    words = suggested.replace('OUT_BAG', str(tmp_path / 'bag')).split()
    assert main(['convert', *words, *each.options]) == 0


def test_a_file_of_no_known_kind_and_images_of_an_interferometer_say_what_they_need(
    tmp_path, capsys
):
    (tmp_path / 'a.csv').write_text('Wann;Wo\n1;2\n')
    assert main(['info', str(tmp_path / 'a.csv')]) == 2
    assert '--column stamp=HEADER --column x=HEADER' in capsys.readouterr().err
    (each,) = (each for each in FORMATS if each.name == 'swath.bag')
    each.make(tmp_path / 'swath.bag', line(3))
    assert main(['info', str(tmp_path / 'swath.bag')]) == 1
    assert 'sonar-imm convert interferometer' in capsys.readouterr().out


# -- a publisher in NED and FRD, and one in ENU and FLU, get the same answer: in ENU --

TETHERS = ROOT / 'bags' / 'obstacle_tethers'
TO_NED, TO_FRD = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])


def other_way(measurement):
    """As a vehicle in NED and FRD and a sonar that counts to starboard would state it."""
    if isinstance(measurement, Detections):
        return evolve(measurement, bearing=-measurement.bearing)
    if isinstance(measurement, Navigation):
        R = TO_NED @ Rotation.from_quat(measurement.orientation).as_matrix() @ TO_FRD
        return evolve(
            measurement, frame_id=measurement.frame_id + '_ned', pose_covariance=None,
            position=TO_NED @ measurement.position, twist_covariance=None,
            orientation=Rotation.from_matrix(R).as_quat(),
        )  # fmt: skip
    return measurement


def test_both_conventions_give_the_same_places_and_a_frame_that_nobody_told_of_is_refused(
    tmp_path, capsys
):
    write = {entry.measurement: (entry.name, entry.write) for entry in inputs_of('obstacle')}
    with BagReader(TETHERS) as bag, BagWriter(tmp_path / 'ned') as out:
        topics = {name: entry.name for name, entry in fitting_topics(bag, 'obstacle').items()}
        for received in measurements_of(bag, 'obstacle', topics):
            name, written = write[type(received.measurement)]
            message = written(other_way(received.measurement), ros_message)
            out.write(f'/{name}', message, received.measurement.stamp_ns)
    given = ('--set', 'world_frame_convention=ned', '--set', 'bearing_positive=starboard')
    tables = []
    for bag, run, more in ((TETHERS, 'a', ()), (tmp_path / 'ned', 'b', given)):
        assert main(['track', str(bag), str(tmp_path / run), '--order', 'stamp', *more]) == 0
        rows = (tmp_path / run / 'estimate.csv').read_text().splitlines()[1:]
        tables.append(np.genfromtxt(rows, delimiter=','))
    assert len(tables[0]) > 200
    np.testing.assert_allclose(tables[1], tables[0], rtol=1e-5, atol=1e-5)
    capsys.readouterr()
    assert main(['track', str(tmp_path / 'ned'), str(tmp_path / 'run')]) == 0
    assert 'north-east-down but east-north-up is expected' in capsys.readouterr().out
