# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Several runs of one command: instruments of one recording, several recordings, several processes
with the bytes of one by one, and going on."""

from concurrent.futures.process import BrokenProcessPool
import json
from pathlib import Path

from helpers.clusters import small_cluster
from helpers.commands import contents
from helpers.dive_scenes import write_dive
from helpers.source import ROOT
import pytest

from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.tracking import OfflineRun
from sonar_imm_tools.recordings.measurements import fitting_topics, instruments
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.writer import BagWriter

EXACT = '--set tilt_std_deg=0 --set spacing_std=0 --set sound_speed_std=0'.split()
"""What a simulated recording says of its array; a copy under other names says nothing."""
SIDES = {'port': 'PORT', 'starboard': 'stbd'}
"""Sides, and words for them."""


@pytest.fixture(scope='module')
def swaths(tmp_path_factory):
    """A short recording of a sonar with two sides."""
    bag = tmp_path_factory.mktemp('swaths') / 'swaths.bag'
    scene = ('two_sides', '--set', 'pings=3', '--set', 'last_range=22')
    assert main(['simulate', 'bathymetry', str(bag), '--scenario', *scene]) == 0
    return bag


def renamed(bag, out, names):
    """The recording `bag` with other names of topics; those that are not named are left out."""
    with BagReader(bag) as reader, BagWriter(out) as writer:
        for item in reader.messages():
            for name in names.get(item.topic, '').split():
                writer.write(name, item.message, item.log_ns)
    return out


@pytest.fixture
def two_ships(swaths, tmp_path):
    """Two sonars of two sides each, one of them with topics named by words."""
    names = {f'/truth/{side}/estimate': f'/truth/fore/{side}/estimate' for side in SIDES}
    for side, word in SIDES.items():
        names[f'/{side}/snapshot'] = f'/fore/{side}/snapshot /aft/sidescan_{word}/snapshot'
    return renamed(swaths, tmp_path / 'two_ships', names)


def made_in(folder):
    return contents(folder, 'run.json', 'summary.json')


def entries(file):
    return json.loads(file.read_text())


def track(*arguments):
    return main(['track', *map(str, arguments)])


@pytest.fixture
def dives(tmp_path):
    """Recordings a, b and c."""
    return [write_dive(tmp_path / name, count=30, spoilt=range(k)) for k, name in enumerate('abc')]


def test_words_in_a_name_tell_the_side(swaths, tmp_path):
    names = {f'/{side}/snapshot': f'/sidescan_{word}/snapshot' for side, word in SIDES.items()}
    bag = renamed(swaths, tmp_path / 'bag', names)
    with BagReader(bag) as reader:
        named = {name: entry.name for name, entry in fitting_topics(reader, 'bathymetry').items()}
    assert named == {
        '/sidescan_PORT/snapshot': 'port/snapshot', '/sidescan_stbd/snapshot': 'starboard/snapshot'
    }  # fmt: skip
    assert track(bag, tmp_path / 'words', *EXACT) == 0 == track(swaths, tmp_path / 'own', *EXACT)
    assert made_in(tmp_path / 'words') == made_in(tmp_path / 'own')


def test_instruments_are_told_apart_and_share_what_is_nobodys(tmp_path):
    names = {'/nav': '/nav /b/nav', '/port/snapshot': '/a/snapshot /b/snapshot /snapshot'}
    bag = renamed(ROOT / 'bags' / 'bathymetry_ship', tmp_path / 'bag', names)
    with BagReader(bag) as reader:
        found = instruments(reader, 'bathymetry')
    assert {name: sorted(inputs) for name, inputs in found.items()} == {
        'a': ['/a/snapshot', '/nav'], 'b': ['/b/nav', '/b/snapshot'],
        'snapshot': ['/nav', '/snapshot'],
    }  # fmt: skip


def test_every_instrument_is_tracked_as_if_it_were_alone(swaths, two_ships, tmp_path, capsys):
    out = tmp_path / 'out'
    assert track(two_ships, out, *EXACT, '--jobs', '2') == 0
    assert '2 runs in' in capsys.readouterr().out
    assert track(swaths, tmp_path / 'alone', *EXACT) == 0
    alone = made_in(tmp_path / 'alone')
    assert made_in(out / 'fore') == made_in(out / 'aft_sidescan') == alone
    runs = entries(out / 'summary.json')['runs']
    assert [run['folder'] for run in runs] == ['aft_sidescan', 'fore']
    assert all(run['estimates'] == 6 and run['state'] == 'tracked' for run in runs)
    topics = {f'/fore/{side}/snapshot': f'{side}/snapshot' for side in SIDES}
    assert entries(out / 'fore' / 'run.json')['topics'] == topics
    # Downstream: all at once, one by one, and a sentence where only one will do.
    capsys.readouterr()
    assert main(['evaluate', str(out), '--json']) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert list(metrics) == ['aft_sidescan', 'fore'] and (out / 'report.html').is_file()
    assert metrics['fore'] == entries(out / 'fore' / 'metrics.json')
    assert main(['evaluate', str(out / 'fore'), '--no-report']) == 0
    assert main(['export', str(out), str(tmp_path / 'x.xyz')]) == 2
    assert 'holds several runs' in capsys.readouterr().err
    # A topic that is named is tracked alone.
    chosen = ('--topic', 'port/snapshot=/fore/port/snapshot')
    assert track(two_ships, tmp_path / 'one', *EXACT, *chosen) == 0
    topics = entries(tmp_path / 'one' / 'run.json')['topics']
    assert topics == {'/fore/port/snapshot': 'port/snapshot'}


def test_the_same_command_again_makes_only_what_is_missing(dives, tmp_path, capsys):
    out = tmp_path / 'out'
    assert track(*dives, out) == 0
    first, kept = made_in(out), (out / 'b' / 'estimate.csv').stat().st_mtime_ns
    for name in ('a/run.json', 'c/estimate.csv', 'c/run.json'):  # as if killed
        (out / name).unlink()
    capsys.readouterr()
    assert track(*dives, out, '--json', '--jobs', '2') == 0
    states = [run['state'] for run in json.loads(capsys.readouterr().out)['runs']]
    assert states == ['tracked', 'kept', 'tracked'] and made_in(out) == first
    assert (out / 'b' / 'estimate.csv').stat().st_mtime_ns == kept
    # Another parameter, another recording, another version: refused, and by --overwrite made anew.
    other = ('--set', 'detection_probability=0.8')
    assert track(*dives, out, *other) == 1
    differs = 'holds another run, which differs in'
    assert f'b {differs} parameters (detection_probability)' in capsys.readouterr().err
    run = entries(out / 'b' / 'run.json')
    run['versions']['sonar_imm'] = '0.0.1'
    (out / 'b' / 'run.json').write_text(json.dumps(run))
    assert track(*dives, out) == 1
    assert f'b {differs} versions (sonar_imm)' in capsys.readouterr().err
    assert track(*dives, out, '--overwrite', *other) == 0
    capsys.readouterr()
    (dives[0] / 'notes.txt').write_text('one byte more')
    assert track(*dives, out, *other) == 1
    output = capsys.readouterr()
    assert f'a {differs} bag_bytes, bag_sha256' in output.err
    assert '3 runs in' in output.out and '2 kept, 1 failed' in output.out


def test_the_summary_keeps_what_other_commands_made(dives, tmp_path, capsys):
    (a, b, c), out = dives, tmp_path / 'out'
    assert track(a, b, out) == 0 == track(b, c, out)
    runs = entries(out / 'summary.json')['runs']
    states = [(run['folder'], run['state']) for run in runs]
    assert states == [('a', 'tracked'), ('b', 'kept'), ('c', 'tracked')]
    assert main(['evaluate', str(out), '--json', '--no-report']) == 0
    capsys.readouterr()
    assert track(a, tmp_path / 'single') == 0 and track(a, b, tmp_path / 'single') == 2
    assert 'holds a run itself' in capsys.readouterr().err
    (out / 'summary.json').write_text('{"runs": [{"folder": 3}]}')
    assert main(['evaluate', str(out)]) == 2
    assert 'cannot be understood' in capsys.readouterr().err


def test_bags_on_a_cluster(dives, tmp_path, capsys):
    bags, out = dives[:2], tmp_path / 'there'
    assert track(*bags, tmp_path / 'here') == 0
    with small_cluster(silence_logs='CRITICAL') as there:
        address = ('--scheduler', there.scheduler_address)
        assert track(*bags, tmp_path / 'missing', out, *address) == 1
        assert 'missing does not exist' in capsys.readouterr().err
        assert made_in(out) == made_in(tmp_path / 'here')
        capsys.readouterr()
        assert track(*bags, out, *address) == 0
        assert '2 kept' in capsys.readouterr().out
    assert track(*bags, tmp_path / 'no', '--scheduler', 'nonsense') == 2
    assert 'no dask scheduler at nonsense' in capsys.readouterr().err
    assert track(*bags, tmp_path / 'no', *address, '--jobs', '2') == 2


def test_shards_share_the_bags_out(dives, tmp_path, capsys):
    """As a Slurm array does: each command has the same bags, in any order, and makes its share."""
    out, few = tmp_path / 'out', tmp_path / 'few'
    assert track(*dives[::-1], out, '--shard', '1/2') == 0
    assert sorted(path.name for path in out.iterdir()) == ['a', 'c', 'summary-1-of-2.json']
    assert track(*dives, out, '--shard', '2/2') == 0
    assert not (out / 'summary.json').exists()
    assert [run['folder'] for run in entries(out / 'summary-2-of-2.json')['runs']] == ['b']
    assert track(*dives, tmp_path / 'whole') == 0
    made = {name: text for name, text in made_in(out).items() if 'summary' not in name}
    assert made == made_in(tmp_path / 'whole')
    # Downstream all shards are one; a share again makes what is missing; one may be empty.
    capsys.readouterr()
    assert main(['evaluate', str(out), '--json', '--no-report']) == 0
    assert sorted(json.loads(capsys.readouterr().out)) == list('abc')
    assert main(['export', str(out), str(tmp_path / 'x.csv')]) == 2
    assert 'several runs, which summary-1-of-2.json lists' in capsys.readouterr().err
    (out / 'c' / 'run.json').unlink()
    for bags, where, shard, said in (
        (dives, out, '1/2', '1 tracked, 1 kept'),
        (dives[:1], few, '2/3', '0 runs in'),
        (dives[:1], few, '1/3', ''),
    ):
        assert track(*bags, where, '--shard', shard) == 0
        assert said in capsys.readouterr().out
    assert (few / 'a' / 'run.json').is_file()
    for shard in ('0/2', '3/2', '1', '1/', '-1/2', '1/2/3', 'a/b'):
        assert track('a', 'b', tmp_path / 'no', '--shard', shard) == 2
        error = capsys.readouterr().err
        assert 'not of the form I/N' in error and 'Traceback' not in error
    assert not (tmp_path / 'no').exists()


def test_a_folder_of_tables_becomes_a_folder_of_bags(tmp_path, capsys):
    def convert(*words, code=0):
        capsys.readouterr()
        assert main(['convert', 'fixes', *map(str, words)]) == code
        return capsys.readouterr()

    tables = tmp_path / 'tables'
    tables.mkdir()
    for k, name in enumerate('abc'):
        rows = [f'{10 + t},{k + t},{2 * t}' for t in range(4)]
        (tables / f'{name}.csv').write_text('stamp,x,y\n' + '\n'.join(rows) + '\n')
    for jobs in ('1', '2'):
        assert '3 bags in' in convert(tables, tmp_path / jobs, '--jobs', jobs).out
    made = made_in(tmp_path / '1')
    assert made == made_in(tmp_path / '2') and {Path(name).parts[0] for name in made} == set('abc')
    # The same as one by one; one that fails is named and stops no other.
    convert(tables / 'b.csv', tmp_path / 'b')
    alone = {f'b/{name}': content for name, content in made_in(tmp_path / 'b').items()}
    assert alone.items() <= made.items()
    (tables / 'broken.csv').write_text('what\n1\n')
    found = convert(tables, tmp_path / 'o', '--json', code=1)
    assert found.err.startswith(str(tables / 'broken.csv')) and 'Traceback' not in found.err
    failed, good = [], []
    for entry in json.loads(found.out)['bags']:
        (failed if entry['failure'] else good).append(entry)
    assert [Path(entry['source']).name for entry in failed] == ['broken.csv']
    assert [entry['rows'] for entry in good] == [4, 4, 4]
    (tables / 'a.txt').write_text('')
    (tmp_path / 'none').mkdir()
    for folder, words in ((tables, 'two recordings would be converted into'),
                          (tmp_path / 'none', 'nothing to convert')):  # fmt: skip
        assert words in convert(folder, tmp_path / 'p', code=2).err
        assert not (tmp_path / 'p').exists()


def test_pings_that_are_coupled_are_shared_out(swaths, tmp_path, capsys):
    counts, coupled = [], ('--set', 'ping_coupling=0.35', '--json')
    for jobs in ('1', '2'):
        capsys.readouterr()
        assert track(swaths, tmp_path / jobs, *coupled, '--jobs', jobs) == 0
        run = json.loads(capsys.readouterr().out)
        counts.append((run['counts'], run['estimates'], run['messages']))
    assert counts[0] == counts[1] and counts[0][1] == 6
    assert made_in(tmp_path / '1') == made_in(tmp_path / '2')


def test_bags_are_shared_out_and_one_that_fails_stops_no_other(swaths, tmp_path, capsys):
    dive, broken, found = write_dive(tmp_path / 'dive.bag', count=30), tmp_path / 'broken.bag', []
    broken.mkdir()
    for jobs in ('1', '2'):
        capsys.readouterr()
        assert track(swaths, broken, dive, tmp_path / jobs, '--jobs', jobs) == 1
        output = capsys.readouterr()
        assert output.err.startswith(f'{broken}: ')
        assert 'Traceback' not in output.err and output.err.count('broken') == 2
        found.append((made_in(tmp_path / jobs), output.out.replace(str(tmp_path / jobs), '')))
    assert found[0] == found[1]
    assert {name.split('/')[0] for name in found[0][0]} == {'swaths', 'dive'}
    capsys.readouterr()
    assert track(swaths, dive, tmp_path / 'j', '--json') == 0
    runs = json.loads(capsys.readouterr().out)['runs']
    systems = {run['bag']: run['system'] for run in runs}
    assert systems == {str(swaths): 'bathymetry', str(dive): 'diver'}
    assert track(swaths, swaths, tmp_path / 'out') == 2  # two of one name
    assert 'two bags would be tracked into' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_a_worker_that_dies_is_one_sentence(swaths, tmp_path, capsys, monkeypatch):
    def dies(self, done):
        raise BrokenProcessPool('gone')

    monkeypatch.setattr(OfflineRun, '_taken', dies)
    assert track(swaths, tmp_path / 'out', *EXACT, '--jobs', '2') == 2
    errors = capsys.readouterr().err
    assert 'Traceback' not in errors and 'lack of memory' in errors
