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
from helpers.dive_bags import write_dive
from helpers.source import ROOT
import pytest

from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.tracking import OfflineRun
from sonar_imm_tools.recordings.measurements import fitting_topics, instruments
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.writer import BagWriter

STATED = ('tilt_std_deg', 'spacing_std', 'sound_speed_std')
EXACT = tuple(word for name in STATED for word in ('--set', f'{name}=0'))
"""What a simulated recording says of its array; a copy under other names says nothing."""


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
            for name in names.get(item.topic, ()):
                writer.write(name, item.message, item.log_ns)
    return out


@pytest.fixture
def two_ships(swaths, tmp_path):
    """Two sonars of two sides each, one of them with topics named by words."""
    return renamed(
        swaths,
        tmp_path / 'two_ships',
        {
            '/port/snapshot': ('/fore/port/snapshot', '/aft/sidescan_port/snapshot'),
            '/starboard/snapshot': ('/fore/starboard/snapshot', '/aft/sidescan_stbd/snapshot'),
            '/truth/port/estimate': ('/truth/fore/port/estimate',),
            '/truth/starboard/estimate': ('/truth/fore/starboard/estimate',),
        },
    )


def made_in(folder):
    return contents(folder, 'run.json', 'summary.json')


def track(*arguments):
    return main(['track', *map(str, arguments)])


def test_words_in_a_name_tell_the_side(swaths, tmp_path):
    bag = renamed(
        swaths,
        tmp_path / 'bag',
        {
            '/port/snapshot': ('/sidescan_PORT/snapshot',),
            '/starboard/snapshot': ('/sidescan_stbd/snapshot',),
        },
    )
    with BagReader(bag) as reader:
        named = {name: entry.name for name, entry in fitting_topics(reader, 'bathymetry').items()}
    assert named == {
        '/sidescan_PORT/snapshot': 'port/snapshot',
        '/sidescan_stbd/snapshot': 'starboard/snapshot',
    }
    assert track(bag, tmp_path / 'words', *EXACT) == 0 == track(swaths, tmp_path / 'own', *EXACT)
    assert made_in(tmp_path / 'words') == made_in(tmp_path / 'own')


def test_instruments_are_told_apart_and_share_what_is_nobodys(tmp_path):
    bag = renamed(
        ROOT / 'bags' / 'bathymetry_ship',
        tmp_path / 'bag',
        {
            '/nav': ('/nav', '/b/nav'),
            '/port/snapshot': ('/a/snapshot', '/b/snapshot', '/snapshot'),
        },
    )
    with BagReader(bag) as reader:
        found = instruments(reader, 'bathymetry')
    assert {name: sorted(inputs) for name, inputs in found.items()} == {
        'a': ['/a/snapshot', '/nav'],
        'b': ['/b/nav', '/b/snapshot'],
        'snapshot': ['/nav', '/snapshot'],
    }


def test_every_instrument_is_tracked_as_if_it_were_alone(swaths, two_ships, tmp_path, capsys):
    out = tmp_path / 'out'
    assert track(two_ships, out, *EXACT, '--jobs', '2') == 0
    assert '2 runs in' in capsys.readouterr().out
    assert track(swaths, tmp_path / 'alone', *EXACT) == 0
    alone = made_in(tmp_path / 'alone')
    assert made_in(out / 'fore') == made_in(out / 'aft_sidescan') == alone
    summary = json.loads((out / 'summary.json').read_text())
    assert [run['folder'] for run in summary['runs']] == ['aft_sidescan', 'fore']
    assert all(run['estimates'] == 6 and run['state'] == 'tracked' for run in summary['runs'])
    topics = json.loads((out / 'fore' / 'run.json').read_text())['topics']
    assert topics == {
        '/fore/port/snapshot': 'port/snapshot',
        '/fore/starboard/snapshot': 'starboard/snapshot',
    }
    # Downstream: all at once, one by one, and a sentence where only one will do.
    capsys.readouterr()
    assert main(['evaluate', str(out), '--json']) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert list(metrics) == ['aft_sidescan', 'fore'] and (out / 'report.html').is_file()
    assert metrics['fore'] == json.loads((out / 'fore' / 'metrics.json').read_text())
    assert main(['evaluate', str(out / 'fore'), '--no-report']) == 0
    assert main(['export', str(out), str(tmp_path / 'x.xyz')]) == 2
    assert 'holds several runs' in capsys.readouterr().err


def test_a_named_topic_is_tracked_alone(two_ships, tmp_path):
    chosen = ('--topic', 'port/snapshot=/fore/port/snapshot')
    assert track(two_ships, tmp_path / 'out', *EXACT, *chosen) == 0
    run = json.loads((tmp_path / 'out' / 'run.json').read_text())
    assert run['topics'] == {'/fore/port/snapshot': 'port/snapshot'}


def test_the_same_command_again_makes_only_what_is_missing(tmp_path, capsys):
    bags = [write_dive(tmp_path / name, count=30, spoilt=range(k)) for k, name in enumerate('abc')]
    out = tmp_path / 'out'
    assert track(*bags, out) == 0
    first, times = made_in(out), {path: path.stat().st_mtime_ns for path in out.rglob('*.csv')}
    (out / 'a' / 'run.json').unlink()  # as if killed
    (out / 'c' / 'estimate.csv').unlink()
    (out / 'c' / 'run.json').unlink()
    capsys.readouterr()
    assert track(*bags, out, '--json', '--jobs', '2') == 0
    states = [run['state'] for run in json.loads(capsys.readouterr().out)['runs']]
    assert states == ['tracked', 'kept', 'tracked']
    assert made_in(out) == first
    assert (out / 'b' / 'estimate.csv').stat().st_mtime_ns == times[out / 'b' / 'estimate.csv']
    # Another parameter, another recording, another version: refused, and by --overwrite made anew.
    assert track(*bags, out, '--set', 'detection_probability=0.8') == 1
    assert 'b holds another run, which differs in parameters (detection_probability)' in (
        capsys.readouterr().err
    )
    run = json.loads((out / 'b' / 'run.json').read_text())
    run['versions']['sonar_imm'] = '0.0.1'
    (out / 'b' / 'run.json').write_text(json.dumps(run))
    assert track(*bags, out) == 1
    assert 'b holds another run, which differs in versions (sonar_imm)' in capsys.readouterr().err
    assert track(*bags, out, '--overwrite', '--set', 'detection_probability=0.8') == 0
    capsys.readouterr()
    (bags[0] / 'notes.txt').write_text('one byte more')
    assert track(*bags, out, '--set', 'detection_probability=0.8') == 1
    output = capsys.readouterr()
    assert 'a holds another run, which differs in bag_bytes, bag_sha256' in output.err
    assert '3 runs in' in output.out and '2 kept, 1 failed' in output.out


def test_the_summary_keeps_what_other_commands_made(tmp_path, capsys):
    a, b, c = (write_dive(tmp_path / name, count=30) for name in 'abc')
    assert track(a, b, tmp_path / 'out') == 0 == track(b, c, tmp_path / 'out')
    runs = json.loads((tmp_path / 'out' / 'summary.json').read_text())['runs']
    assert [(run['folder'], run['state']) for run in runs] == [
        ('a', 'tracked'),
        ('b', 'kept'),
        ('c', 'tracked'),
    ]
    assert main(['evaluate', str(tmp_path / 'out'), '--json', '--no-report']) == 0
    capsys.readouterr()
    assert track(a, tmp_path / 'single') == 0
    assert track(a, b, tmp_path / 'single') == 2
    assert 'holds a run itself' in capsys.readouterr().err
    (tmp_path / 'out' / 'summary.json').write_text('{"runs": [{"folder": 3}]}')
    assert main(['evaluate', str(tmp_path / 'out')]) == 2
    assert 'cannot be understood' in capsys.readouterr().err


def test_bags_on_a_cluster(tmp_path, capsys):
    bags = [write_dive(tmp_path / name, count=30, spoilt=range(k)) for k, name in enumerate('ab')]
    assert track(*bags, tmp_path / 'here') == 0
    with small_cluster(silence_logs='CRITICAL') as there:
        address = ('--scheduler', there.scheduler_address)
        assert track(*bags, tmp_path / 'missing', tmp_path / 'there', *address) == 1
        assert 'missing does not exist' in capsys.readouterr().err
        assert made_in(tmp_path / 'there') == made_in(tmp_path / 'here')
        capsys.readouterr()
        assert track(*bags, tmp_path / 'there', *address) == 0
        assert '2 kept' in capsys.readouterr().out
    assert track(*bags, tmp_path / 'no', '--scheduler', 'nonsense') == 2
    assert 'no dask scheduler at nonsense' in capsys.readouterr().err
    assert track(*bags, tmp_path / 'no', *address, '--jobs', '2') == 2


def test_shards_share_the_bags_out(tmp_path, capsys):
    """As a Slurm array does: each command has the same bags, in any order, and makes its share."""
    bags = [write_dive(tmp_path / name, count=30, spoilt=range(k)) for k, name in enumerate('abc')]
    out = tmp_path / 'out'
    assert track(*bags[::-1], out, '--shard', '1/2') == 0
    assert sorted(path.name for path in out.iterdir()) == ['a', 'c', 'summary-1-of-2.json']
    assert track(*bags, out, '--shard', '2/2') == 0
    assert not (out / 'summary.json').exists()
    runs = json.loads((out / 'summary-2-of-2.json').read_text())['runs']
    assert [run['folder'] for run in runs] == ['b']
    assert track(*bags, tmp_path / 'whole') == 0
    assert {name: text for name, text in made_in(out).items() if 'summary' not in name} == (
        made_in(tmp_path / 'whole')
    )
    # Downstream all shards are one; a share again makes what is missing; one may be empty.
    capsys.readouterr()
    assert main(['evaluate', str(out), '--json', '--no-report']) == 0
    assert sorted(json.loads(capsys.readouterr().out)) == list('abc')
    assert main(['export', str(out), str(tmp_path / 'x.csv')]) == 2
    assert 'several runs, which summary-1-of-2.json lists' in capsys.readouterr().err
    (out / 'c' / 'run.json').unlink()
    assert track(*bags, out, '--shard', '1/2') == 0
    assert '1 tracked, 1 kept' in capsys.readouterr().out
    assert track(bags[0], tmp_path / 'few', '--shard', '2/3') == 0
    assert '0 runs in' in capsys.readouterr().out
    assert track(bags[0], tmp_path / 'few', '--shard', '1/3') == 0
    assert (tmp_path / 'few' / 'a' / 'run.json').is_file()


@pytest.mark.parametrize('shard', ['0/2', '3/2', '1', '1/', '-1/2', '1/2/3', 'a/b'])
def test_a_share_that_cannot_be(tmp_path, capsys, shard):
    assert track('a', 'b', tmp_path / 'out', '--shard', shard) == 2
    error = capsys.readouterr().err
    assert 'not of the form I/N' in error and 'Traceback' not in error
    assert not (tmp_path / 'out').exists()


def test_a_folder_of_tables_becomes_a_folder_of_bags(tmp_path, capsys):
    tables = tmp_path / 'tables'
    tables.mkdir()
    for k, name in enumerate(('a', 'b', 'c')):
        rows = [f'{10 + t},{k + t},{2 * t}' for t in range(4)]
        (tables / f'{name}.csv').write_text('stamp,x,y\n' + '\n'.join(rows) + '\n')
    made = {}
    for jobs in ('1', '2'):
        out = tmp_path / jobs
        capsys.readouterr()
        assert main(['convert', 'fixes', str(tables), str(out), '--jobs', jobs]) == 0
        assert '3 bags in' in capsys.readouterr().out
        made[jobs] = made_in(out)
    assert made['1'] == made['2'] and {Path(name).parts[0] for name in made['1']} == set('abc')
    # The same as one by one; one that fails is named and stops no other.
    assert main(['convert', 'fixes', str(tables / 'b.csv'), str(tmp_path / 'b')]) == 0
    alone = {f'b/{name}': content for name, content in made_in(tmp_path / 'b').items()}
    assert alone.items() <= made['1'].items()
    (tables / 'broken.csv').write_text('what\n1\n')
    capsys.readouterr()
    assert main(['convert', 'fixes', str(tables), str(tmp_path / 'o'), '--json']) == 1
    found = capsys.readouterr()
    assert found.err.startswith(str(tables / 'broken.csv')) and 'Traceback' not in found.err
    entries = json.loads(found.out)['bags']
    assert [Path(entry['source']).name for entry in entries if entry['failure']] == ['broken.csv']
    assert [entry['rows'] for entry in entries if not entry['failure']] == [4, 4, 4]
    (tables / 'a.txt').write_text('')
    assert main(['convert', 'fixes', str(tables), str(tmp_path / 'p')]) == 2
    assert 'two recordings would be converted into' in capsys.readouterr().err
    (tmp_path / 'none').mkdir()
    assert main(['convert', 'fixes', str(tmp_path / 'none'), str(tmp_path / 'q')]) == 2
    assert 'nothing to convert' in capsys.readouterr().err
    assert not (tmp_path / 'p').exists() and not (tmp_path / 'q').exists()


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
    dive, broken = write_dive(tmp_path / 'dive.bag', count=30), tmp_path / 'broken.bag'
    broken.mkdir()
    bags = [str(swaths), str(broken), str(dive)]
    found = []
    for jobs in ('1', '2'):
        capsys.readouterr()
        assert main(['track', *bags, str(tmp_path / jobs), '--jobs', jobs]) == 1
        output = capsys.readouterr()
        assert output.err.startswith(f'{broken}: ')
        assert 'Traceback' not in output.err and output.err.count('broken') == 2
        found.append((made_in(tmp_path / jobs), output.out.replace(str(tmp_path / jobs), '')))
    assert found[0] == found[1]
    assert {name.split('/')[0] for name in found[0][0]} == {'swaths', 'dive'}
    capsys.readouterr()
    assert main(['track', str(swaths), str(dive), str(tmp_path / 'j'), '--json']) == 0
    runs = json.loads(capsys.readouterr().out)['runs']
    assert {run['bag']: run['system'] for run in runs} == {
        str(swaths): 'bathymetry',
        str(dive): 'diver',
    }


def test_two_bags_of_one_name_are_refused(swaths, tmp_path, capsys):
    assert main(['track', str(swaths), str(swaths), str(tmp_path / 'out')]) == 2
    assert 'two bags would be tracked into' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_a_worker_that_dies_is_one_sentence(swaths, tmp_path, capsys, monkeypatch):
    def dies(self, done):
        raise BrokenProcessPool('gone')

    monkeypatch.setattr(OfflineRun, '_taken', dies)
    assert main(['track', str(swaths), str(tmp_path / 'out'), *EXACT, '--jobs', '2']) == 2
    assert 'Traceback' not in (errors := capsys.readouterr().err) and 'lack of memory' in errors
