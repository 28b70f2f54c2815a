# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Real nodes beside the command, which starts and ends them itself, as processes: that is what is
tried, where two are in a row or messages come late; and `echo`, which finds publishers of other
processes. That live in lock-step and offline are the same is said of each node by
`nodes/test_every_node.py`, in one process.
"""

import json
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import time

from helpers.commands import children
from helpers.dive_scenes import write_dive
from helpers.faults.rig import wait_until_ready
from helpers.source import ROOT
import pytest

from sonar_imm_tools.cli import main
from sonar_imm_tools.cli.checking import play_recording
from sonar_imm_tools.replay.harness import NodeProcess, reserved_domain_id

pytestmark = pytest.mark.system


def checked(capsys, system, bag, out, *more):
    """The run offline of a check that was good: same bytes live, within the limit."""
    capsys.readouterr()
    wanted = ['--bag', str(bag), '--out', str(out), '--json', *more]
    assert main(['check', system, *wanted]) == 0
    (outcome,) = json.loads(capsys.readouterr().out)
    assert outcome['good'] and len(outcome['checks']) == 4
    assert outcome['latency_ms']['p50'] > 0.0
    offline, live = out / bag.name / 'offline', out / bag.name / 'live'
    assert (offline / 'estimate.csv').read_bytes() == (live / 'estimate.csv').read_bytes()
    assert (offline / 'estimate.csv').stat().st_size > 1_000
    return offline


def run_of(folder):
    return json.loads((folder / 'run.json').read_text())


def test_images_go_through_two_nodes_live_as_offline(tmp_path, capsys):
    small = 'last_range=33 image_beams=64 image_bins=200 target=point horizontal_fov_deg=30'
    settings = [f'--set={each}' for each in (*small.split(), 'late_fraction=0.2')]
    words = 'simulate', 'obstacle', str(tmp_path / 'bag'), '--seed', '2', '--scenario', 'images'
    assert main([*words, *settings]) == 0
    run = run_of(checked(capsys, 'obstacle', tmp_path / 'bag', tmp_path / 'out', '--limit', '8'))
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


@pytest.mark.parametrize('how', [signal.SIGTERM, signal.SIGHUP])
def test_a_check_that_is_ended_takes_its_node_along(how):
    bag = str(ROOT / 'bags' / 'diver_table1')
    words = ['-m', 'sonar_imm_tools.cli', 'check', 'diver', '--bag', bag]
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


def command(domain, *arguments):
    """A started command in the ROS domain `domain`."""
    return subprocess.Popen(
        [sys.executable, '-m', 'sonar_imm_tools.cli', *map(str, arguments)], cwd=ROOT,
        env=dict(os.environ, ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST'),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


@pytest.fixture
def playing(tmp_path, monkeypatch):
    """The domain of a diver node that gets fixes again and again."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    bag = write_dive(tmp_path / 'dive')
    with reserved_domain_id() as domain, NodeProcess('diver', domain_id=domain) as node:
        wait_until_ready([node])
        player = command(domain, 'play', bag, '--rate', '20', '--loop')
        try:
            yield domain
        finally:
            player.terminate()
            player.communicate()
        assert node.process.poll() is None


def test_estimates_are_found_and_shown(playing):
    echoes = [
        command(playing, 'echo', '--timeout', '300', *words.split())
        for words in ('--once', 'diver/estimate --json --count 3', '/truth/estimate --once')
    ]
    (text, error), (tables, _), (truth, _) = (echo.communicate(timeout=600) for echo in echoes)
    assert [echo.returncode for echo in echoes] == [0, 0, 0]
    lines, tables = text.splitlines(), [json.loads(line) for line in tables.splitlines()]
    assert 'listening to /diver/estimate' in error and lines[0].startswith('/diver/estimate  20')
    assert 'frame map  1 row' in lines[0] and lines[1].split()[2:4] == ['px', 'py']
    assert '±' in lines[2] and re.search(r'(heading_\d{3}|hover|lively_\w+|quiet) +\d+%', lines[2])
    assert [table['topic'] for table in tables] == ['/diver/estimate'] * 3
    assert len({table['stamp_ns'] for table in tables}) == 3 and tables[0]['types']['px'] == 'f8'
    assert truth.startswith('/truth/estimate')
