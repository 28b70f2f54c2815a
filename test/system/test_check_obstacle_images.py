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

"""Images through both real nodes, detector and tracker, against the same offline."""

import json

import pytest

pytest.importorskip('rclpy')

from sonar_imm_tools.cli import main  # noqa: E402

pytestmark = pytest.mark.system

SCENE = [
    'simulate', 'obstacle', '--scenario', 'images', '--seed', '2', '--set', 'last_range=33',
    '--set', 'image_beams=64', '--set', 'image_bins=200', '--set', 'target=point',
    '--set', 'horizontal_fov_deg=30', '--set', 'late_fraction=0.2',
]  # fmt: skip


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp('bags') / 'images'
    assert main([*SCENE[:2], str(path), *SCENE[2:]]) == 0
    return path


def test_image_in_track_out_is_the_same_live_and_offline(bag, tmp_path, capsys):
    arguments = ['check', 'obstacle', '--bag', str(bag), '--limit', '8', '--out', str(tmp_path)]
    assert main([*arguments, '--json']) == 0
    (outcome,) = json.loads(capsys.readouterr().out)
    assert outcome['good'] and len(outcome['checks']) == 4
    offline, live = tmp_path / 'images/offline', tmp_path / 'images/live'
    assert (offline / 'estimate.csv').read_bytes() == (live / 'estimate.csv').read_bytes()
    rows = (offline / 'estimate.csv').read_text().splitlines()
    assert len(rows) > 10 and 'vertical_offset' in rows[0]
    run = json.loads((offline / 'run.json').read_text())
    assert run['topics']['/image'] == 'image' and run['detector']['image_far_range'] == 55.0


def test_detections_kept_in_a_bag_give_the_same_tracks(bag, tmp_path, capsys):
    kept, first, second = (tmp_path / name for name in ('kept', 'first', 'second'))
    assert main(['convert', 'images', str(bag), str(kept)]) == 0
    assert main(['track', str(bag), str(first)]) == 0
    assert main(['track', str(kept), str(second), '--params', str(bag / 'parameters.yaml')]) == 0
    assert (first / 'estimate.csv').read_bytes() == (second / 'estimate.csv').read_bytes()
    capsys.readouterr()
    assert main(['track', str(bag), str(tmp_path / 'none'), '--set', 'false_alarm=1e-15']) == 0
    assert main(['track', str(bag), str(tmp_path / 'bad'), '--set', 'false_alrm=1e-9']) == 2
    assert 'false_al' in capsys.readouterr().err
