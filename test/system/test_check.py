# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Real nodes beside the command: live in lock-step and offline are the same.

The command starts and ends the node itself: that is what is tried, where late input, two nodes in
a row, positions on Earth or a start come in. Else `nodes/test_every_node.py` drives each node in
the process of the test.
"""

import csv
import json
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time

from attrs import evolve
from helpers.dive_bags import write_dive
from helpers.source import ROOT
import numpy as np
import pytest

pytest.importorskip('rclpy')

from msg_adapters.inputs import inputs_of  # noqa: E402
from msg_adapters.transforms import write_transforms  # noqa: E402
from sonar_imm.acoustics import geometry  # noqa: E402
from sonar_imm.acoustics.geometry import Pose  # noqa: E402
from sonar_imm.measurements import Start, StaticTransforms  # noqa: E402
from sonar_imm_tools.cli import main  # noqa: E402
from sonar_imm_tools.cli.checking import play_recording  # noqa: E402
from sonar_imm_tools.recordings.messages import ros_message  # noqa: E402
from sonar_imm_tools.recordings.truth import write_scene  # noqa: E402
from sonar_imm_tools.recordings.writer import BagWriter  # noqa: E402
from sonar_imm_tools.simulation.diver import simulator as diver  # noqa: E402
from sonar_imm_tools.simulation.obstacle import simulator as obstacle  # noqa: E402

pytestmark = pytest.mark.system

SCENES = {
    'bathymetry': ('bathymetry', 'shadow', 'pings=3', 'last_range=45', 'shadows=30,33'),
    'diver': ('diver', 'irregular', 'duration=40'),
    'geodetic': ('diver', 'geodetic', 'duration=20'),
    # Inputs that interleave and come late.
    'late': ('obstacle', 'late', 'last_range=45', 'clutter=2'),
    'images': (
        *('obstacle', 'images', 'last_range=33', 'image_beams=64', 'image_bins=200'),
        *('target=point', 'horizontal_fov_deg=30', 'late_fraction=0.2'),
    ),
}
LIMITS = {'late': '8', 'images': '8', 'geodetic': '3'}


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """What gives the bag of one of the `SCENES`."""
    folder = tmp_path_factory.mktemp('bags')

    def bag(name):
        path, (system, scenario, *settings) = folder / name, SCENES[name]
        given = [word for setting in settings for word in ('--set', setting)]
        if not path.exists():
            seed = '2' if name == 'images' else '0' if name == 'late' else '3'
            words = ['simulate', system, str(path), '--seed', seed, '--scenario', scenario]
            assert main([*words, *given]) == 0
        return path

    return bag


def checked(capsys, system, bag, out, *more, checks=4):
    """The run offline of a check that was good: same bytes live, within the limit."""
    capsys.readouterr()
    wanted = ['--bag', str(bag), '--out', str(out), '--json', *more]
    assert main(['check', system, *wanted]) == 0
    (outcome,) = json.loads(capsys.readouterr().out)
    assert outcome['good'] and len(outcome['checks']) == checks
    assert outcome['latency_ms']['p50'] > 0.0
    offline, live = out / bag.name / 'offline', out / bag.name / 'live'
    assert (offline / 'estimate.csv').read_bytes() == (live / 'estimate.csv').read_bytes()
    assert (offline / 'estimate.csv').stat().st_size > 1_000
    return offline


def run_of(folder):
    return json.loads((folder / 'run.json').read_text())


@pytest.mark.parametrize('name', [name for name in SCENES if name != 'diver'])
def test_live_lockstep_equals_offline(bags, tmp_path, capsys, name):
    limit = ['--limit', LIMITS[name]] if name in LIMITS else []
    offline = checked(capsys, SCENES[name][0], bags(name), tmp_path, *limit)
    header = (offline / 'estimate.csv').read_text().splitlines()[0]
    assert ('latitude' in header) == (name == 'geodetic')
    if name == 'images':  # through both nodes
        run = run_of(offline)
        assert run['topics']['/image'] == 'image' and run['detector']['image_far_range'] == 55.0


def test_refused_and_late_messages_are_the_same_live_and_offline(tmp_path, capsys):
    bag = write_dive(tmp_path / 'dive', spoilt=(30, 31), shuffle=True)
    counts = run_of(checked(capsys, 'diver', bag, tmp_path / 'out'))['counts']
    assert counts['refused'] == 2 and counts['late'] > 10


def test_the_shipped_recordings_of_the_fathometer_pass(tmp_path, capsys):
    assert main(['check', 'fathometer', '--json', '--out', str(tmp_path)]) == 0
    outcomes = json.loads(capsys.readouterr().out)
    names = [outcome['bag'].rpartition('_')[2] for outcome in outcomes]
    assert names == ['array', 'drift', 'pressure']
    for outcome in outcomes:
        assert outcome['good'] and len(outcome['checks']) == 4
        assert outcome['checks'][1]['result'] == 'equal bytes'


def test_a_start_that_was_recorded_counts_live_and_offline(tmp_path, capsys):
    scene = diver.simulate(diver.scenario('irregular', {'duration': 30.0}), 3)
    given = []
    for k, item in enumerate(scene.measurements):
        if k in (4, 9):
            place = item.measurement.position + ([0.2, 0.1, 0.0] if k == 4 else [400.0, 0.0, 0.0])
            stamp, frame = item.measurement.stamp_ns, item.measurement.frame_id
            start = Start(stamp_ns=stamp, position=place, covariance=np.eye(2), frame_id=frame)
            given.append(evolve(item, measurement=start))
        given.append(item)
    bag = tmp_path / 'told'
    write_scene(evolve(scene, measurements=tuple(given)), bag, provenance={})
    offline = checked(capsys, 'diver', bag, tmp_path / 'out', '--limit', '1000')
    run = run_of(offline)
    assert run['topics']['/initial'] == 'initial' and run['counts']['used'] == len(given)
    with (offline / 'estimate.csv').open() as lines:
        ids = {row['track_id']: float(row['px']) for row in csv.DictReader(lines)}
    assert len(ids) >= 2 and max(ids.values()) > 300.0  # the second start, 400 m away


def test_check_replaces_no_file_of_the_user(tmp_path):
    """A real node has `state_file`, and saves its state there when it ends."""
    victim = tmp_path / 'precious'
    victim.write_text('shopping list')
    shutil.copytree(ROOT / 'bags' / 'diver_table1', tmp_path / 'bag')
    (tmp_path / 'bag' / 'parameters.yaml').write_text(
        f'/**:\n  ros__parameters:\n    state_file: {victim}\n    model_set: heading_speed\n'
    )
    played = play_recording(tmp_path / 'bag', 'diver', tmp_path / 'runs', quiet=True)
    assert all(check.good for check in played.checks)
    assert victim.read_text() == 'shopping list'
    assert [path.name for path in tmp_path.glob('precious*')] == ['precious']


# -- frames from /tf_static --------------------------------------------------------------------

LEVER, RPY = (1.5, -0.3, 0.4), (2.0, -5.0, 8.0)


def write_bag(path):
    """Encounters with the place of the sonar on /tf_static, as a TransformStamped: tf2 with its
    TFMessage may not be installed."""
    pose = Pose(np.array(LEVER), geometry.rotation(*np.radians(RPY)))
    printed = StaticTransforms(poses={'sonar': ('base_link', pose)})
    message = write_transforms(printed, ros_message)
    entries = {item.measurement: item for item in inputs_of('obstacle')}
    received = obstacle.simulate(obstacle.scenario('approach', {}), 1).measurements[:300]
    with BagWriter(path, compressed=False, custom_data={}) as bag:
        first_ns = received[0].received_ns - 1
        bag.write('/tf_static', message.transforms[0], first_ns)
        for each in received:
            entry = entries[type(each.measurement)]
            written = entry.write(each.measurement, ros_message)
            bag.write(f'/{entry.name}', written, each.received_ns)


def test_a_mounting_counts_live_and_offline(tmp_path, capsys):
    bag, params = tmp_path / 'bag', tmp_path / 'frames.yaml'
    write_bag(bag)
    params.write_text(
        'obstacle:\n  ros__parameters:\n    vehicle_frame: base_link\n    sonar_frame: sonar\n'
    )
    more = ['--params', str(params), '--limit', '1000']
    run = run_of(checked(capsys, 'obstacle', bag, tmp_path / 'out', *more, checks=3))  # no truth
    assert run['mounting']['sonar_lever'] == list(LEVER) and not run['refused']


# -- what ends ----------------------------------------------------------------------------------


def children(pid):
    return [int(item) for item in Path(f'/proc/{pid}/task/{pid}/children').read_text().split()]


@pytest.mark.parametrize('how', [signal.SIGTERM, signal.SIGHUP])
def test_a_check_that_is_ended_takes_its_node_along(bags, how):
    words = ['-m', 'sonar_imm_tools.cli', 'check', 'diver', '--bag', str(bags('diver'))]
    check = subprocess.Popen(
        [sys.executable, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    limit = time.monotonic() + 300.0
    while not (nodes := children(check.pid)):
        assert check.poll() is None and time.monotonic() < limit
        time.sleep(0.01)
    check.send_signal(how)
    _, printed = check.communicate(timeout=300.0)
    assert check.returncode == 128 + how and 'Traceback' not in printed
    assert not any(Path(f'/proc/{node}').exists() for node in nodes)
