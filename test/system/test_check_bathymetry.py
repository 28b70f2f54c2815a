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

"""``check`` with a real bathymetry node."""

import json

import pytest

pytest.importorskip('rclpy')

from sonar_imm_tools.cli import main  # noqa: E402

pytestmark = pytest.mark.system


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp('bags') / 'floor'
    assert (
        main(
            [
                'simulate',
                'bathymetry',
                str(path),
                '--seed',
                '3',
                '--scenario',
                'shadow',
                '--set',
                'pings=3',
                '--set',
                'last_range=45',
                '--set',
                'shadows=30,33',
            ]
        )
        == 0
    )
    return path


@pytest.mark.parametrize('parameters', [{}, {'engine': 'grid', 'smoothing': 'states'}])
def test_live_lockstep_equals_offline(bag, tmp_path, capsys, parameters):
    params = tmp_path / 'my.yaml'
    params.write_text(json.dumps({'/**': {'ros__parameters': {'seed': 7, **parameters}}}))
    assert (
        main(
            [
                'check',
                'bathymetry',
                '--bag',
                str(bag),
                '--params',
                str(params),
                '--out',
                str(tmp_path),
                '--json',
            ]
        )
        == 0
    )
    (outcome,) = json.loads(capsys.readouterr().out)
    assert outcome['good'] and len(outcome['checks']) == 4
    offline, live = tmp_path / 'floor' / 'offline', tmp_path / 'floor' / 'live'
    assert (offline / 'estimate.csv').read_bytes() == (live / 'estimate.csv').read_bytes()
    assert (offline / 'estimate.csv').stat().st_size > 10_000


def test_a_limit_that_is_not_reached_exits_with_1(bag, capsys):
    assert main(['check', 'bathymetry', '--bag', str(bag), '--limit', '0.001']) == 1
    printed = capsys.readouterr().out
    assert 'FAIL  height RMSE against truth' in printed
    assert 'ok    estimates of the node against offline: equal bytes' in printed
