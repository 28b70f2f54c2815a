# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What `check` says of a node that does not do what the offline tracker does, and what `demo`
plays and says: nodes are played by estimates that are changed on purpose. `warm`, and what `echo`
shows."""

import json
from pathlib import Path
import re
import shutil
from types import SimpleNamespace

from attrs import evolve
from helpers.dive_scenes import single_run, write_dive
import numpy as np
import pytest

pytest.importorskip('rclpy')

from sonar_imm_tools.cli import check as check_module  # noqa: E402
from sonar_imm_tools.cli import checking, main  # noqa: E402
from sonar_imm_tools.cli.echo import json_line, readable, text_lines  # noqa: E402
from sonar_imm_tools.evaluation.judging import Check, Judgement  # noqa: E402
from sonar_imm_tools.evaluation.numbers import error, Metric  # noqa: E402
from sonar_imm_tools.offline.run_folder import RunFolder  # noqa: E402
from sonar_imm_tools.recordings.own_files import own_limit  # noqa: E402
from sonar_imm_tools.recordings.reader import BagReader  # noqa: E402
from sonar_imm_tools.replay.harness import LockstepResult  # noqa: E402
from sonar_imm_tools.replay.listening import ReceivedTable  # noqa: E402
from sonar_imm_tools.replay.lockstep import Counts  # noqa: E402


@pytest.fixture(scope='module')
def dive(tmp_path_factory):
    return write_dive(tmp_path_factory.mktemp('bags') / 'dive', count=40, spoilt=(30,))


@pytest.fixture
def check(dive, tmp_path, monkeypatch):
    """Check `dive` against a node that publishes `change` of the offline estimates."""

    def check(change=lambda estimates: estimates, **facts):
        def played(bag, system, **options):
            estimates = change(list(RunFolder(tmp_path / 'offline').read_estimates()))
            known = {'estimates': estimates, 'counts': Counts(40, 1, len(estimates)), **facts}
            usual = {'delays': (0.001,), 'exit_code': 0, 'log': '', 'problems': ()}
            return LockstepResult(**{**usual, **known})

        monkeypatch.setattr(checking, 'run_lockstep', played)
        checked = checking.play_recording(dive, 'diver', tmp_path, quiet=True).judged()
        return {check.name: check for check in checked.checks}, checked.good

    return check


def nudged(estimates):
    """The last bit of one number in one estimate."""
    state = estimates[20].state.copy()
    state[0, 1] = np.nextafter(state[0, 1], np.inf)
    return [*estimates[:20], evolve(estimates[20], state=state), *estimates[21:]]


CHANGES = {
    'the same': (list, None), 'one bit': (nudged, 1), 'silent': (lambda estimates: [], 40),
    'one missing': (lambda estimates: estimates[:-1], 1),
    # The frame stands in the bag, not in the CSV.
    'other frame': (lambda estimates: [evolve(each, frame_id='odom') for each in estimates], 0),
}  # fmt: skip


@pytest.mark.parametrize('name', CHANGES)
def test_a_node_that_does_otherwise_is_found_out(check, name):
    change, rows = CHANGES[name]
    checks, good = check(change)
    equal = checks['estimates of the node against offline']
    assert good == equal.good == (rows is None)
    assert equal.result == ('equal bytes' if rows is None else f'{rows} rows differ')


COUNTED, ENDED = 'messages taken / refused by the node', 'end of the node after Ctrl-C'


@pytest.mark.parametrize(
    'facts, name',
    [({'counts': Counts(39, 1, 39)}, COUNTED), ({'counts': Counts(40, 0, 39)}, COUNTED),
     ({'exit_code': 1}, ENDED), ({'log': 'Traceback (most recent call last):'}, ENDED)],
)  # fmt: skip
def test_a_node_that_loses_messages_or_dies_is_found_out(check, facts, name):
    checks, good = check(**facts)
    assert not good and [check.name for check in checks.values() if not check.good] == [name]


def test_a_recording_may_state_its_own_limit(check, dive):
    own = dive / 'check.yaml'
    own.write_text('limit: 0.001\n')
    try:
        checks, good = check()
    finally:
        own.unlink()
    name = 'position RMSE against truth'
    assert not good and checks[name].wanted == 'at most 0.001 m'
    assert check()[0][name].wanted == 'at most 1.25 m'


def test_what_is_installed_is_used_as_it_is_and_the_rest_is_simulated(dive, tmp_path, monkeypatch):
    """Wheels hold the small recordings only; the others leave their recipe."""
    share = tmp_path / 'share' / 'bags'
    shutil.copytree(dive, share / 'diver_a')
    for name in ('diver_b', 'fathometer_array'):
        (share / name).mkdir()
    recipe = '--scenario small --seed 1 --set records=2'
    own = share / 'fathometer_array' / 'check.yaml'
    own.write_text(f'limit: 0.5\nsimulate: {recipe}\n')
    monkeypatch.setattr(checking, 'share_folder', lambda: tmp_path / 'share')
    (made,) = checking.shipped_bags('fathometer', tmp_path / 'scratch')
    with BagReader(made) as reader:
        assert sum(1 for _ in reader.messages(['/csdm'])) == 2
    assert own_limit(made) == 0.5
    assert checking.shipped_bags('diver', tmp_path) == [share / 'diver_a']
    with pytest.raises(FileNotFoundError, match='no recordings for obstacle'):
        checking.shipped_bags('obstacle', tmp_path)


@pytest.mark.parametrize('good', [True, False])
def test_the_exit_code_is_one_when_anything_fell_short(dive, monkeypatch, capsys, good):
    latency, one = {'p50': 1.0, 'p99': 2.0}, checking.CheckedRecording
    checks = [(Check('a', '1', '1', each),) for each in (True, good)]
    checked = [one('diver', dive, dive, each, latency, None) for each in checks]
    monkeypatch.setattr(check_module, 'run_checks', lambda *_, **__: checked)
    assert main(['check', 'diver', '--json']) == int(not good)
    capsys.readouterr()
    assert main(['check', 'diver']) == int(not good)
    assert capsys.readouterr().out.count('FAIL') == int(not good)


def test_one_recording_shows_how_far_it_is_unless_it_is_told_not_to(dive, monkeypatch, tmp_path):
    asked, done = [], SimpleNamespace(judged=lambda: 'checked')
    monkeypatch.setattr(
        checking, 'play_recording', lambda *_, quiet, **__: asked.append(quiet) or done
    )
    assert check_module.run_checks(('diver',), tmp_path, bag=dive) == ['checked']
    check_module.run_checks(('diver',), tmp_path, bag=dive, quiet=True)
    assert asked == [False, True]


# -- `demo`: recordings and nodes are played by small stand-ins --


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
            run={'system': system, 'bag': str(bag), 'topics': {'/fix': 'fix'}}, metrics=metrics,
            words='It went well.', shown=SHOWN, seen='{n} whales', sections=lambda: (),
            accuracy=lambda limit: None,
        )  # fmt: skip
        done = checking.CheckedRecording(system, bag, folder, checks, latency, judgement)
        return SimpleNamespace(judged=lambda: done)

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


def test_all_recordings_of_one_system_and_a_node_that_differs(played, tmp_path, capsys):
    words = ['demo', '--out', str(tmp_path), '--system', 'diver']
    assert main([*words, '--all']) == 0
    assert set(played) == {bag.name for bag in checking.shipped_bags('diver', Path())}
    assert all(played.values()) and len(capsys.readouterr().out.splitlines()) == 2
    played.bad = (smallest('diver'),)
    assert main(words) == 1
    out = capsys.readouterr().out
    assert f'FAILED: {smallest("diver")}' in out and 'FAIL  equal' in out
    assert 'FAILED: equal' in (tmp_path / 'report.html').read_text()


# -- `warm` --


def test_a_system_is_compiled_once_and_a_tracker_of_numpy_never(capsys):
    assert main(['warm', 'fathometer']) == 0
    first = capsys.readouterr().out
    assert main(['warm', 'fathometer']) == 0
    again = 'fathometer: nothing to compile\n'
    assert first == again or re.match(r'fathometer: \d kernels compiled, \d loaded, ', first)
    assert capsys.readouterr().out == again
    assert main(['warm', 'obstacle']) == 0
    assert capsys.readouterr().out == 'obstacle: nothing to compile\n'
    assert main(['warm', '--set', 'sound_speed=1480']) == 2
    assert 'need exactly one system' in capsys.readouterr().err


def test_the_smallest_recording_of_each_system_is_first(tmp_path):
    sizes = {'a1': 30, 'a2': 10, 'b1': 20, 'a3': 50}
    for name, size in sizes.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / 'data').write_bytes(bytes(size))
    todo = [(tmp_path / name, name[0]) for name in sizes]
    order, first = check_module._small_ones_first(todo)
    assert [todo[i][0].name for i in order] == ['a2', 'b1', 'a3', 'a1'] and first == 2


ESTIMATE = single_run(count=20)[0][-1]


def table(columns, **more):
    given = {'stamp_ns': 1_700_000_000_250_000_000, 'frame_id': 'map', **more}
    return ReceivedTable(topic='/diver/estimate', columns=columns, **given)


def test_a_state_stands_with_its_deviation_and_the_models_as_the_most_probable_one():
    names, (row,) = readable(ESTIMATE.columns(), 5)
    assert names[:5] == ['track_id', 'px', 'py', 'vx', 'vy'] and names[5] == 'model'
    assert not [name for name in names if 'cov_' in name or name in 'xyz']
    value, deviation = (float(part) for part in row['px'].split(' ± '))
    assert value == pytest.approx(ESTIMATE.state[0, 0], abs=0.51 * deviation)
    assert deviation == pytest.approx(np.sqrt(ESTIMATE.covariance[0, 0, 0]), rel=0.05)
    best = int(np.argmax(ESTIMATE.probabilities[0]))
    model, share = row['model'].split()
    assert model == ESTIMATE.model_names[best]
    assert float(share[:-1]) == pytest.approx(100 * ESTIMATE.probabilities[0, best], abs=0.51)


def test_any_table_is_shown_with_its_first_rows():
    columns = {
        'range': np.arange(30, dtype='f4'), 'iq': np.zeros((30, 16), 'f4'),
        'valid': np.ones(30, 'u1'), 'level': np.full(30, np.nan), 'tiny': np.full(30, 1.5e-7),
    }  # fmt: skip
    lines = text_lines(table(columns), 3)
    assert lines[0] == '/diver/estimate  2023-11-14 22:13:20.250 UTC  frame map  30 rows'
    assert lines[1].split() == list(columns)
    assert lines[-2].split() == ['2', '16', 'values', '1', '-', '1.5e-07']
    assert lines[-1] == '... 27 more rows (--rows)' and len(lines) == 6
    # Without rows, and of a message that is no table.
    assert len(text_lines(table({'x': np.zeros(0)}), 3)) == 2
    assert len(text_lines(table({}), 3)) == 1
    assert text_lines(ReceivedTable(topic='/a', problem='it is broken'), 3) == ['/a: it is broken']
    none = json.loads(json_line(ReceivedTable(topic='/a', problem='no')))
    assert (none['problem'], none['stamp_ns'], none['columns']) == ('no', 0, {})


def test_json_has_all_columns_with_their_types():
    content = json.loads(json_line(table({**ESTIMATE.columns(), 'bad': np.array([np.nan])})))
    columns, types = content['columns'], content['types']
    assert (columns['px'], columns['bad']) == ([ESTIMATE.state[0, 0]], [None])
    assert [types[name] for name in ('px', 'x', 'track_id')] == ['f8', 'f4', 'u4']
    assert content['stamp_ns'] == 1_700_000_000_250_000_000
