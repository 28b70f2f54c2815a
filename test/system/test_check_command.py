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

"""``check`` and ``play`` with a real node."""

import json
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip('rclpy')

from sonar_imm_tools.cli import main  # noqa: E402

pytestmark = pytest.mark.system


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp('bags') / 'dive'
    assert (
        main(
            [
                'simulate',
                'diver',
                str(path),
                '--seed',
                '3',
                '--scenario',
                'irregular',
                '--set',
                'duration=40',
            ]
        )
        == 0
    )
    return path


def test_live_lockstep_equals_offline(bag, tmp_path, capsys):
    assert (
        main(
            ['check', 'diver', '--bag', str(bag), '--limit', '3', '--out', str(tmp_path), '--json']
        )
        == 0
    )
    (outcome,) = json.loads(capsys.readouterr().out)
    assert outcome['good'] and len(outcome['checks']) == 4
    assert outcome['latency_ms']['p50'] > 0.0
    offline, live = tmp_path / 'dive' / 'offline', tmp_path / 'dive' / 'live'
    assert (offline / 'estimate.csv').read_bytes() == (live / 'estimate.csv').read_bytes()
    assert (offline / 'estimate.csv').stat().st_size > 10_000


def test_inputs_that_interleave_and_come_late_give_equal_bytes_too(tmp_path, capsys):
    bag = tmp_path / 'approach'
    assert (
        main(
            [
                'simulate',
                'obstacle',
                str(bag),
                '--scenario',
                'late',
                '--set',
                'last_range=45',
                '--set',
                'clutter=2',
            ]
        )
        == 0
    )
    assert (
        main(
            [
                'check',
                'obstacle',
                '--bag',
                str(bag),
                '--limit',
                '8',
                '--out',
                str(tmp_path),
                '--json',
            ]
        )
        == 0
    )
    (outcome,) = json.loads(capsys.readouterr().out.partition('\n')[2])
    assert outcome['good'] and len(outcome['checks']) == 4


def test_a_limit_that_is_not_reached_exits_with_1(bag, capsys):
    assert main(['check', 'diver', '--bag', str(bag), '--limit', '0.01']) == 1
    printed = capsys.readouterr().out
    assert 'FAIL  position RMSE against truth' in printed
    assert 'ok    estimates of the node against offline: equal bytes' in printed


def test_lockstep_with_nobody_is_one_line_and_exit_code_1(bag, capsys, monkeypatch):
    from sonar_imm_tools.replay import player

    monkeypatch.setattr(player, 'MATCH_LIMIT', 0.5)
    assert main(['play', str(bag), '--lockstep', '/nobody']) == 1
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and "no answer from a node '/nobody'" in error


def children(pid):
    return [int(item) for item in Path(f'/proc/{pid}/task/{pid}/children').read_text().split()]


@pytest.mark.parametrize('how', [signal.SIGTERM, signal.SIGHUP])
def test_a_check_that_is_ended_takes_its_node_along(bag, how):
    check = subprocess.Popen(
        [sys.executable, '-m', 'sonar_imm_tools.cli', 'check', 'diver', '--bag', str(bag)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    limit = time.monotonic() + 300.0
    while not (nodes := children(check.pid)):
        assert check.poll() is None and time.monotonic() < limit
        time.sleep(0.01)
    check.send_signal(how)
    _, printed = check.communicate(timeout=300.0)
    assert check.returncode == 128 + how and 'Traceback' not in printed
    assert not any(Path(f'/proc/{node}').exists() for node in nodes)
