# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Offline runs: the last word on each stamp, refusals, order, smoothing."""

import json
from multiprocessing import synchronize
import os
import socket
import subprocess
import sys
import time

from helpers.clusters import dying as work
from helpers.dive_scenes import estimate_at, SECOND, START_NS, write_dive
from helpers.estimates import same
from helpers.source import ROOT
import numpy as np
import pytest

from msg_adapters.arrivals import write_arrivals
from msg_adapters.detections import write_detections
from msg_adapters.fixes import write_fix
from msg_adapters.navigation import write_navigation
from sonar_imm.measurements import Arrivals, Detections, Fix, Navigation, NOBODY
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline import jobs
from sonar_imm_tools.offline.initial import read_initial
from sonar_imm_tools.offline.inspection import inspect
from sonar_imm_tools.offline.jobs import cluster, processes, workers
from sonar_imm_tools.offline.tracking import InputOptions, OfflineRun, Revisions
from sonar_imm_tools.recordings.convert import convert_relative
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.writer import BagWriter, ros_message

DIVER = SYSTEMS['diver']
CONFIG = DIVER.config_type()()


def made(seconds, x=0.0):
    return [estimate_at(START_NS + round(seconds * SECOND), [[x, 0.0, 0.0, 0.0]], [1])]


def seconds_and_px(estimates):
    return [((each.stamp_ns - START_NS) / SECOND, each.state[0, 0]) for each in estimates]


def run_of(path, config=CONFIG, **options):
    """A run of a diver whose input is read, and its estimates."""
    with BagReader(path) as bag:
        run = OfflineRun(bag, DIVER, config, InputOptions(**options))
        return run, list(run.estimates())


def test_the_last_word_on_a_stamp_wins_and_what_can_no_longer_change_is_let_go():
    revisions = Revisions(10 * SECOND)
    final = revisions.add(made(1, 1.0)) + revisions.add(made(3, 1.0))
    final += revisions.add(made(2, 5.0) + made(3, 2.0))
    assert final == []
    assert seconds_and_px(revisions.finish()) == [(1, 1.0), (2, 5.0), (3, 2.0)]
    revisions = Revisions(2 * SECOND)
    final = [seconds_and_px(revisions.add(made(k))) for k in range(1000)]
    assert final[:5] == [[], [], [], [(0, 0.0)], [(1, 0.0)]] and len(revisions.finish()) == 3
    revisions = Revisions(2 * SECOND)
    final = [item for k in (100, 101, 5, 6) for item in revisions.add(made(k))]
    found = seconds_and_px([*final, *revisions.finish()])
    assert found == [(k, 0.0) for k in (100, 101, 5, 6)]


def test_order_by_stamp_the_expected_frame_and_names_of_topics(tmp_path):
    dive = write_dive(tmp_path / 'dive', shuffle=True, count=40)
    assert 'late' not in run_of(dive, order='stamp')[0].outcomes()
    run, estimates = run_of(dive, frame_id='odom')
    assert estimates == [] and run.refused['frame'].count == 40
    assert 'refused: 40 (frame: ' in run.failure()
    other = write_dive(tmp_path / 'other', topic='/usbl/pose', count=30)
    with pytest.raises(BagError, match='no topic for the diver tracker'):
        run_of(other)
    assert len(run_of(other, topics={'/usbl/pose': 'fix'})[1]) == 30


def test_refused_messages_are_counted_with_their_reason_and_repairs_told(tmp_path, monkeypatch):
    with BagReader(write_dive(tmp_path / 'dive', spoilt=(3, 4))) as bag:
        run = OfflineRun(bag, DIVER, CONFIG)
        advanced = []
        assert len(list(run.estimates(advanced.append))) == 118
    assert run.refused['nan'].count == 2 and run.refused['nan'].example.startswith('/fix: ')
    assert run.outcomes() == {'used': 118, 'refused': 2} and not run.failure()
    assert sum(advanced) == run.total == run.messages == 120
    monkeypatch.setattr(run.tracker, 'health', lambda: {'covariance_repairs': 3})
    assert run.outcomes() == {'covariance_repairs': 3, 'used': 118, 'refused': 2}


def test_pings_that_are_shared_out_over_processes_give_the_same_estimates(tmp_path, monkeypatch):
    bag, system, made = str(tmp_path / 'bag'), SYSTEMS['bathymetry'], []
    small = '--set pings=3 --set last_range=30 --set bin_width=0.1'.split()
    assert main(['simulate', 'bathymetry', bag, '--scenario', 'moving_two_sides', *small]) == 0
    for count in (1, 2):
        with BagReader(bag) as reader:
            options = InputOptions(jobs=count)
            offline = OfflineRun(reader, system, system.config_type()(), options)
            if count > 1:  # nothing is done here
                monkeypatch.setattr(offline, '_in_turn', None)
            made.append(list(offline.estimates()))
            assert len(made[-1]) == 6 and offline.outcomes()['used'] == 6
            assert len(offline.durations) >= 6 and min(offline.durations) > 0.0
    for alone, shared in zip(*made, strict=True):
        assert alone.source == shared.source and same(alone, shared)


# -- starts of tracks from a file


MESSAGE = f"""
header: {{stamp: {{sec: 1700000003, nanosec: 500000000}}, frame_id: map}}
pose:
  pose: {{position: {{x: 2.0, y: -3.5, z: 0.0}}, orientation: {{w: 1.0}}}}
  covariance: [4, 0.5, 0, 0, 0, 0, 0.5, 9, 0, 0, 0, 0, {', '.join(['0'] * 24)}]
"""


HERE = {'position': [0.0, 0.0], 'covariance': [4, 0, 0, 4]}


def written(tmp_path, text, name='places.yaml'):
    (tmp_path / name).write_text(text if isinstance(text, str) else json.dumps(text))
    return tmp_path / name


def test_yaml_json_and_the_message_say_the_same(tmp_path):
    place = {'position': [2.0, -3.5], 'covariance': [[4, 0.5], [0.5, 9]], 'frame_id': 'map'}
    place['time'] = 1_700_000_003.5
    texts = [MESSAGE, place, [place], {**place, 'time': '2023-11-14T22:13:23.5Z'}]
    for flat in ([4, 0.5, 0.5, 9], [4, 0.5, 0, 0.5, 9, 0, 0, 0, 1]):
        texts.append({**place, 'covariance': flat})
    found = [read_initial(written(tmp_path, text)) for text in texts]
    assert all(each == found[0] for each in found)
    start = found[0][0].start(0, {})
    assert start.stamp_ns == 1_700_000_003 * SECOND + SECOND // 2
    assert start.position.tolist() == [2.0, -3.5, 0.0] and start.target_id == NOBODY
    np.testing.assert_allclose(start.covariance[:2, :2], [[4.0, 0.5], [0.5, 9.0]])


def test_a_bad_file_gets_one_sentence(tmp_path):
    good = {'position': [1, 2], 'covariance': [1, 0, 0, 1]}
    for text, words in (
        ('', 'the file is empty'), ('[]', 'the file is empty'), ('pose: 3', 'pose needs'),
        ('3', 'a place needs position and covariance'), ('{position: [1, 2', 'not a YAML file'),
        ({'position': [1, 2]}, 'covariance is missing'),
        ({'covariance': [1, 0, 0, 1]}, 'position is missing'),
        ({**good, 'position': [1]}, 'two or three numbers'),
        ('{position: [1, .nan], covariance: [1, 0, 0, 1]}', 'not finite'),
        ({**good, 'position': [1, 'two']}, "'two' in place of a number"),
        ({**good, 'covariance': [1, 0, 0]}, '4, 9 or 36 numbers'),
        ({**good, 'covariance': [0, 0, 0, 0]}, 'covariance'),
        ({**good, 'covariance': [1, 5, 5, 1]}, 'covariance'),
        ({**good, 'time': 'noon'}, "time 'noon'"),
        ({**good, 'where': 'here'}, 'where is not one of'), ([good, 7], 'place 2:'),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match='--initial') as caught:
            read_initial(written(tmp_path, text))
        assert words in str(caught.value) and '\n' not in str(caught.value)
    with pytest.raises(ConfigError, match='No such file'):
        read_initial(tmp_path / 'nothing.yaml')


def test_a_track_begins_where_and_when_the_file_says(tmp_path, capsys):
    """With a name of `tags`; a start after the recording is counted as refused, an unknown name
    before the run."""
    dive = write_dive(tmp_path / 'dive', count=30)
    named = {**HERE, 'position': [500.0, 0.0], 'name': 'anna'}
    places = read_initial(written(tmp_path, [HERE, named, {**HERE, 'time': 1_800_000_000}]))
    run, (first, *_) = run_of(dive, DIVER.config_type()(tags=('bob', 'anna')), initial=places)
    assert first.stamp_ns == START_NS and 2 in first.extras['target_id']
    assert (first.extras['track_state'] == 1).any()
    assert run.recipe()['initial'][0]['position'] == (0.0, 0.0, 0.0)
    assert run.refused['outside'].count == 1
    with pytest.raises(BagError, match="no target is called 'anna': bob are known"):
        run_of(dive, DIVER.config_type()(tags=('bob',)), initial=places)
    path, bad = written(tmp_path, HERE), written(tmp_path, '{position: [0, 0]}', 'bad.yaml')
    assert main(['track', str(dive), str(tmp_path / 'out'), '--initial', str(path)]) == 0
    run = json.loads((tmp_path / 'out' / 'run.json').read_text(encoding='utf-8'))
    assert run['initial'][0]['covariance'] == [4.0, 0.0, 0.0, 4.0]
    assert main(['track', str(dive), str(tmp_path / 'other'), '--initial', str(bad)]) != 0
    assert 'covariance is missing' in capsys.readouterr().err


# -- processes that share work, where they cannot


@pytest.mark.parametrize('error', [FileNotFoundError(2, 'No such file'), OSError(38, 'Not there')])
def test_without_shared_memory_there_is_a_sentence_that_helps(monkeypatch, error):
    """What a semaphore costs in a container without /dev/shm."""

    def refused(*args, **options):
        raise error

    monkeypatch.setattr(synchronize.SemLock, '__init__', refused)
    with pytest.raises(OSError, match='--jobs 1'), processes(2):
        pass


def test_a_process_that_dies_costs_its_call_only_and_one_does_calls_in_turn(tmp_path):
    with workers(2) as run:
        found = {k: rest for k, *rest in run(work, [(tmp_path, k) for k in range(6)])}
        again = list(run(work, [(tmp_path, 5)]))
    assert {k: found[k] for k in (0, 1, 2, 5)} == {k: [k * k, ''] for k in (0, 1, 2, 5)}
    assert 'was ended' in found[3][1] and 'not this one' in found[4][1]
    assert again == [(0, 25, '')]
    with workers() as run:
        found = list(run(work, [(tmp_path, 1), (tmp_path, 4)]))
    assert found == [(0, 1, ''), (1, None, 'ValueError: not this one')]


def test_a_missing_scheduler_is_one_sentence(monkeypatch):
    pytest.importorskip('distributed')
    monkeypatch.setattr(jobs, 'CONNECT_SECONDS', 0.5)
    with socket.create_server(('127.0.0.1', 0)) as silent:
        address = f'127.0.0.1:{silent.getsockname()[1]}'
        with pytest.raises(ConfigError, match=f'no dask scheduler answers at {address} '):
            cluster(address).__enter__()
    with pytest.raises(ConfigError, match='no dask scheduler'):  # the port is closed now
        cluster(address).__enter__()
    with pytest.raises(ConfigError, match='no dask scheduler at nonsense: .*port'):
        cluster('nonsense').__enter__()


def test_the_example_of_slurm_hands_in_its_jobs_and_cancels_them(tmp_path):
    """By commands that stand in for those of Slurm, and keep what they are given."""
    pytest.importorskip('dask_jobqueue')
    (tmp_path / 'sbatch').write_text(f'#!/bin/sh\ncp $1 {tmp_path}/$$.job\necho job $$\n')
    (tmp_path / 'scancel').write_text(f'#!/bin/sh\ntouch {tmp_path}/$1.gone\n')
    for name in ('sbatch', 'scancel'):
        (tmp_path / name).chmod(0o755)
    example = subprocess.Popen(
        [sys.executable, ROOT / 'examples' / 'howto' / 'slurm_cluster.py'], text=True,
        env={**os.environ, 'PATH': f'{tmp_path}:{os.environ["PATH"]}'}, cwd=tmp_path,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    end = time.monotonic() + 60.0
    while len(list(tmp_path.glob('*.job'))) < 4 and time.monotonic() < end:
        time.sleep(0.1)
    address = example.communicate('\n', timeout=60)[0].splitlines()[0]
    jobs = {path.stem: path.read_text() for path in tmp_path.glob('*.job')}
    assert len(jobs) == 4 and {path.stem for path in tmp_path.glob('*.gone')} == set(jobs)
    for text in jobs.values():
        assert '#SBATCH --cpus-per-task=16' in text and '. /data/venv/bin/activate' in text
        assert f'{address} ' in text and '--nworkers 16 ' in text


# -- what is said of a recording


def said_of(path):
    with BagReader(path) as bag:
        result = inspect(bag)
    return result, {topic['name']: topic for topic in result['topics']}


def write_stamps(path, seconds, frames=('map',)):
    with BagWriter(path) as bag:
        for k, second in enumerate(seconds):
            fix = Fix(stamp_ns=START_NS, position=[0, 0, 0], frame_id=frames[k % len(frames)])
            message = write_fix(fix, ros_message)
            stamp = 0 if second is None else START_NS + round(second * SECOND)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
            bag.write('/fix', message, START_NS + k * SECOND)
    return path


def test_a_good_recording_has_no_problems_and_refused_messages_are_told(tmp_path):
    result, topics = said_of(write_dive(tmp_path / 'dive'))
    fix, truth = topics['/fix'], topics['/truth/estimate']
    assert result['systems'] == {'diver': {'fix': ['/fix']}}
    assert (fix['suits'], truth['suits']) == (['diver fix'], [])
    assert fix['rate_hz'] == pytest.approx(1.0) and result['duration_s'] == pytest.approx(119.5)
    assert fix['problems'] == truth['problems'] == []
    # A topic of another name still suits.
    dive = write_dive(tmp_path / 'other', topic='/usbl/pose', truth=False, spoilt=(1, 2, 3))
    result, topics = said_of(dive)
    assert result['systems'] == {'diver': {'fix': ['/usbl/pose']}}
    (problem,) = topics['/usbl/pose']['problems']
    assert problem.startswith('3 messages refused as fix (nan): ')


def test_odd_stamps_and_several_frames_are_told(tmp_path):
    for k, (seconds, words) in enumerate((
        ([0, 1, 2, 1.5, 3], '1 stamps older than the one before, by up to 0.5 s'),
        ([0, 1, 2, 3, 40, 41], '1 gaps in the stamps, the longest 37 s against 1 s'),
        ([None, None, 1], '2 messages without a usable stamp'),
    )):  # fmt: skip
        bag = write_stamps(tmp_path / f'{k}', seconds, frames=('map', 'odom'))
        problems = said_of(bag)[1]['/fix']['problems']
        assert any(words in problem for problem in problems)
        assert "several frames: 'map', 'odom'" in problems


def test_several_fixes_of_one_stamp_are_a_scan_and_two_pings_a_problem(tmp_path, capsys):
    _, topics = said_of(write_stamps(tmp_path / 'bag', [0, 1, 1, 1, 2, 2, 3]))
    assert topics['/fix']['problems'] == []
    assert topics['/fix']['scans'] == {'count': 4, 'most': 3}
    assert main(['info', str(tmp_path / 'bag')]) == 0
    assert '7 messages, 1 Hz, 4 scans, up to 3 per scan, frame map' in capsys.readouterr().out
    unknown = dict.fromkeys(('var_toa', 'bearing', 'var_bearing'), np.full(3, np.nan))
    ping = Arrivals(
        stamp_ns=START_NS, frame_id='map', tx_id=[0, 0, 0], rx_id=[1, 2, 3], tx=np.zeros((3, 3)),
        rx=np.diag([40.0, 50.0, 60.0]), toa=[0.05, 0.06, 0.07], **unknown,
    )  # fmt: skip
    with BagWriter(tmp_path / 'pings') as bag:
        for k in range(2):
            bag.write('/arrivals', write_arrivals(ping, ros_message), START_NS + k)
    _, topics = said_of(tmp_path / 'pings')
    assert topics['/arrivals']['problems'] == ['1 stamps equal to the one before']
    assert topics['/arrivals']['scans'] is None


def test_frames_of_relative_fixes_are_names_and_ned_needs_a_parameter(tmp_path, capsys):
    rows = ''.join(f'{k},1,2,90,10,2,{name}\n' for k in range(3) for name in ('amy', 'rov'))
    head = 'stamp,vessel_x,vessel_y,heading,forward,starboard,id\n'
    convert_relative(written(tmp_path, head + rows, 'usbl.csv'), tmp_path / 'bag')
    relative = said_of(tmp_path / 'bag')[1]['/relative']
    assert (relative['frames'], relative['problems']) == (['amy', 'rov'], [])
    pose = {'orientation': [0, 0, 0, 1], 'frame_id': 'odom_ned'}
    with BagWriter(tmp_path / 'ned') as bag:
        for k in range(3):
            stamp = START_NS + k * SECOND
            ping = Detections(stamp_ns=stamp, frame_id='sonar', range=[20.0], bearing=[0.1])
            bag.write('/detections', write_detections(ping, ros_message), stamp)
            nav = Navigation(stamp_ns=stamp, position=[k, 0, 5], **pose)
            bag.write('/odometry', write_navigation(nav, ros_message), stamp)
    assert main(['info', str(tmp_path / 'ned')]) == 0
    assert '--system obstacle --set world_frame_convention=ned' in capsys.readouterr().out


def test_what_no_tracker_knows_suits_nothing_and_a_companion_does_not_count_alone(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag, BagWriter(tmp_path / 'none'):
        bag.write('/note', ros_message('std_msgs/msg/String', data='hello'), START_NS)
    result, topics = said_of(tmp_path / 'bag')
    assert result['systems'] == {} and topics['/note']['problems'] == []
    result, _ = said_of(tmp_path / 'none')
    assert result['messages'] == 0 and result['duration_s'] == 0.0
    alone, topics = said_of(write_dive(tmp_path / 'alone', topic='/array_depth', truth=False))
    assert 'fathometer array_depth' in topics['/array_depth']['suits']
    assert 'fathometer' not in alone['systems']


def fixes_by_hint(tmp_path, seed, divers, *, speed=0.5, together=False, clutter=0.0):
    """What is said of fixes of divers 20 m apart, polled within 2 s, or of all at one stamp."""
    rng = np.random.default_rng(seed)
    with BagWriter(tmp_path / 'bag') as bag:
        for turn in range(60):
            phases = np.zeros(divers) if together else (np.arange(divers) + 0.5) / divers
            for diver, phase in enumerate(phases):
                if rng.uniform() > 0.9:
                    continue
                when = 2.0 * (turn + phase) + (0.0 if together else 0.02 * rng.normal())
                place = [speed * when, 20.0 * diver, 0.0] + 0.3 * rng.normal(size=3)
                if rng.uniform() < clutter:
                    place = rng.uniform(-100.0, 100.0, 3)
                stamp = START_NS + round(when * SECOND)
                fix = Fix(stamp_ns=stamp, position=place, frame_id='map')
                bag.write('/fix', write_fix(fix, ros_message), stamp)
    _, topics = said_of(tmp_path / 'bag')
    return [text for text in topics['/fix']['problems'] if 'scan_period' in text]


@pytest.mark.parametrize('divers, clutter', [(2, 0.15), (3, 0.0), (7, 0.15)])
def test_fixes_that_are_stamped_one_by_one_are_hinted_at(tmp_path, divers, clutter):
    (hint,) = fixes_by_hint(tmp_path, divers, divers, clutter=clutter)
    assert 1.9 < float(hint.partition('scan_period=')[2].split()[0]) < 2.1


@pytest.mark.parametrize('seed, speed', [(0, 0.0), (1, 0.5)])
@pytest.mark.parametrize('divers, together', [(1, False), (3, True)])
def test_one_diver_and_whole_scans_need_no_hint(tmp_path, seed, speed, divers, together):
    assert fixes_by_hint(tmp_path, seed, divers, speed=speed, together=together) == []
