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

"""``check`` with positions from a vessel, a topic for each tag, and on Earth."""

import csv
import json

from attrs import evolve
import numpy as np
import pytest

pytest.importorskip('rclpy')

from sonar_imm.measurements import Start  # noqa: E402
from sonar_imm_tools.cli import main  # noqa: E402
from sonar_imm_tools.recordings.scenes import write_scene  # noqa: E402
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate  # noqa: E402

pytestmark = pytest.mark.system


@pytest.mark.parametrize('scene', ['usbl', 'geodetic'])
def test_live_equals_offline(scene, tmp_path, capsys):
    bag = tmp_path / scene
    given = ['--scenario', scene, '--seed', '3', '--set', 'duration=20']
    assert main(['simulate', 'diver', str(bag), *given]) == 0
    capsys.readouterr()
    out = tmp_path / 'out'
    wanted = ['--bag', str(bag), '--limit', '3', '--out', str(out), '--json']
    assert main(['check', 'diver', *wanted]) == 0
    (outcome,) = json.loads(capsys.readouterr().out)
    assert outcome['good'] and len(outcome['checks']) == 4
    header = (out / scene / 'offline' / 'estimate.csv').read_text().splitlines()[0]
    assert ('latitude' in header) == (scene == 'geodetic')


def test_a_start_that_was_recorded_counts_live_and_offline(tmp_path, capsys):
    scene = simulate(scenario('irregular', {'duration': 30.0}), 3)
    given = []
    for k, item in enumerate(scene.measurements):
        if k in (4, 9):
            place = item.measurement.position + ([0.2, 0.1, 0.0] if k == 4 else [400.0, 0.0, 0.0])
            stamp, frame = item.measurement.stamp_ns, item.measurement.frame_id
            start = Start(stamp_ns=stamp, position=place, covariance=np.eye(2), frame_id=frame)
            given.append(evolve(item, measurement=start))
        given.append(item)
    bag, out = tmp_path / 'told', tmp_path / 'out'
    write_scene(evolve(scene, measurements=tuple(given)), bag, provenance={})
    wanted = ['--bag', str(bag), '--limit', '1000', '--out', str(out), '--json']
    assert main(['check', 'diver', *wanted]) == 0
    (outcome,) = json.loads(capsys.readouterr().out)
    assert outcome['good']
    run = json.loads((out / 'told' / 'offline' / 'run.json').read_text())
    assert run['topics']['/initial'] == 'initial' and run['counts']['used'] == len(given)
    with (out / 'told' / 'offline' / 'estimate.csv').open() as lines:
        ids = {row['track_id']: float(row['px']) for row in csv.DictReader(lines)}
    assert len(ids) >= 2 and max(ids.values()) > 300.0  # the second start, 400 m away
