# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Frames from /tf_static: from a recording offline, and live in lock-step with the same result."""

import csv
import json

import numpy as np
import pytest

pytest.importorskip('rclpy')

from msg_adapters.inputs import inputs_of  # noqa: E402
from msg_adapters.transforms import write_transforms  # noqa: E402
from sonar_imm.acoustics import geometry  # noqa: E402
from sonar_imm.acoustics.geometry import Pose  # noqa: E402
from sonar_imm.measurements import StaticTransforms  # noqa: E402
from sonar_imm_tools.cli import main  # noqa: E402
from sonar_imm_tools.recordings.messages import ros_message  # noqa: E402
from sonar_imm_tools.recordings.writer import BagWriter  # noqa: E402
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate  # noqa: E402

pytestmark = pytest.mark.system
LEVER, RPY = (1.5, -0.3, 0.4), (2.0, -5.0, 8.0)


def write_bag(path, alone):
    """Encounters with the place of the sonar on /tf_static: in a TFMessage, or, where tf2 is not
    installed, `alone` as a TransformStamped."""
    pose = Pose(np.array(LEVER), geometry.rotation(*np.radians(RPY)))
    printed = StaticTransforms(poses={'sonar': ('base_link', pose)})
    message = write_transforms(printed, ros_message)
    entries = {item.measurement: item for item in inputs_of('obstacle')}
    received = simulate(scenario('approach', {}), 1).measurements[:300]
    with BagWriter(path, compressed=False, custom_data={}) as bag:
        first_ns = received[0].received_ns - 1
        bag.write('/tf_static', message.transforms[0] if alone else message, first_ns)
        for each in received:
            entry = entries[type(each.measurement)]
            bag.write(
                f'/{entry.name}', entry.write(each.measurement, ros_message), each.received_ns
            )


def numbers(path):
    with path.open() as lines:
        return [
            [float(row[name]) for name in ('range', 'bearing', 'vertical_offset', 'x', 'y', 'z')]
            for row in csv.DictReader(lines)
        ]


@pytest.mark.parametrize('alone', [False, True])
def test_a_recorded_mounting_is_that_of_the_parameters(alone, tmp_path, capsys):
    bag = tmp_path / 'bag'
    write_bag(bag, alone)
    frames = ['--set', 'vehicle_frame=base_link', '--set', 'sonar_frame=sonar']
    lever, rpy = (json.dumps(list(item)) for item in (LEVER, RPY))
    by_hand = ['--set', f'sonar_lever={lever}', '--set', f'sonar_mount_rpy_deg={rpy}']
    deaf = ['--set', 'use_tf_static=false']
    for name, given in (('told', frames), ('by_hand', by_hand), ('plain', deaf)):
        assert main(['track', str(bag), str(tmp_path / name), '--system', 'obstacle', *given]) == 0
    tables = [numbers(tmp_path / name / 'estimate.csv') for name in ('told', 'by_hand', 'plain')]
    assert tables[0] == pytest.approx(np.array(tables[1]), rel=1e-6, abs=1e-6)
    assert np.shape(tables[2]) != np.shape(tables[0]) or not np.allclose(tables[2], tables[0])
    run = json.loads((tmp_path / 'told' / 'run.json').read_text())
    assert run['topics']['/tf_static'] == 'tf_static'
    assert run['mounting']['sonar_lever'] == list(LEVER)
    plain = json.loads((tmp_path / 'plain' / 'run.json').read_text())
    assert '/tf_static' not in plain['topics'] and 'mounting' not in plain


def test_live_equals_offline(tmp_path, capsys):
    bag, out, params = tmp_path / 'bag', tmp_path / 'out', tmp_path / 'frames.yaml'
    write_bag(bag, alone=True)
    params.write_text(
        'obstacle:\n  ros__parameters:\n    vehicle_frame: base_link\n    sonar_frame: sonar\n'
    )
    wanted = ['--bag', str(bag), '--params', str(params), '--out', str(out)]
    assert main(['check', 'obstacle', *wanted, '--limit', '1000', '--json']) == 0
    (outcome,) = json.loads(capsys.readouterr().out)
    assert outcome['good']
    run = json.loads((out / 'bag' / 'offline' / 'run.json').read_text())
    assert run['mounting']['sonar_lever'] == list(LEVER) and not run['refused']
