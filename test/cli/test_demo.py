# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What `demo` plays, says and writes: recordings and nodes are played by small stand-ins."""

from pathlib import Path

import pytest

pytest.importorskip('rclpy')

from sonar_imm_tools.cli import check as check_module  # noqa: E402
from sonar_imm_tools.cli import checking, main  # noqa: E402
from sonar_imm_tools.evaluation.judging import Check, Judgement  # noqa: E402
from sonar_imm_tools.evaluation.numbers import error, Metric  # noqa: E402

SHOWN = (error('size', 'size', card='Size error, RMS', front=True), Metric(covers=('in', 0.95)))


@pytest.fixture
def played(monkeypatch):
    """What is played, by name: whether to the node; `played.bad` names those that fail."""

    class Played(dict):
        bad = ()

    seen = Played()

    def play(bag, system, folder, *, live, **options):
        seen[bag.name] = live
        checks = (Check('equal', 'x', 'x', bag.name not in seen.bad),) if live else ()
        latency = {'p50': 1.0, 'p99': 2.0} if live else {}
        metrics = {'size': {'rmse_m': 0.25, 'median_m': 0.2, 'p95_m': 0.5}, 'in': 0.96, 'n': 3}
        judgement = Judgement(
            run={'system': system, 'bag': str(bag), 'topics': {'/fix': 'fix'}},
            metrics=metrics,
            words='It went well.',
            shown=SHOWN,
            seen='{n} whales',
            sections=lambda: (),
            accuracy=lambda limit: None,
        )
        done = checking.CheckedRecording(system, bag, folder, checks, latency, judgement)
        return type('Done', (), {'judged': lambda self: done})()

    def at_once(plays, order, jobs):
        done = {i: plays[i]().judged() for i in order}
        return [done[i] for i in sorted(done)]

    monkeypatch.setattr(checking, 'play_recording', play)
    monkeypatch.setattr(check_module, '_shared_out', at_once)
    return seen


def smallest(system):
    sizes = {
        bag: sum(file.stat().st_size for file in bag.rglob('*'))
        for bag in checking.shipped_bags(system, Path())
    }
    return min(sizes, key=sizes.__getitem__).name


def test_the_smallest_of_each_system_is_played_to_its_node_first(played, tmp_path, capsys):
    assert main(['demo', '--out', str(tmp_path)]) == 0
    systems = ('bathymetry', 'diver', 'fathometer', 'obstacle')
    live = [name for name, to_the_node in played.items() if to_the_node]
    assert live == [smallest(system) for system in systems] == list(played)[:4]
    assert len(played) == sum(len(checking.shipped_bags(system, Path())) for system in systems)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(' ')[0] for line in lines] == [*systems, 'report:']
    assert lines[1] == (
        f'diver ({smallest("diver")}): 3 whales; Size error, RMS 0.25 m; '
        'node and offline equal on 1 recording, errors within limits on 2'
    )
    report = Path(lines[-1].removeprefix('report: '))
    assert report.parent == tmp_path and report.is_file()
    pages = list((tmp_path / 'report_runs').glob('*.html'))
    assert len(pages) == len(played)


def test_one_system_and_all_of_its_recordings(played, tmp_path, capsys):
    assert main(['demo', '--out', str(tmp_path), '--system', 'diver', '--all']) == 0
    assert set(played) == {bag.name for bag in checking.shipped_bags('diver', Path())}
    assert all(played.values())
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_a_node_that_differs_is_named_and_fails(played, tmp_path, capsys):
    played.bad = (smallest('diver'),)
    assert main(['demo', '--out', str(tmp_path), '--system', 'diver']) == 1
    out = capsys.readouterr().out
    assert f'FAILED: {smallest("diver")}' in out and 'FAIL  equal' in out
    assert 'FAILED: equal' in (tmp_path / 'report.html').read_text()
