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
from helpers.dive_bags import write_dive
from helpers.dive_scenes import estimate_at, legs, SECOND, START_NS
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
from sonar_imm_tools.offline.tracking import final_estimates, InputOptions, OfflineRun, Revisions
from sonar_imm_tools.recordings.convert import convert_fixes, convert_relative
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.writer import BagWriter, ros_message

DIVER = SYSTEMS['diver']
CONFIG = DIVER.config_type()()


def made(seconds, x=0.0):
    return estimate_at(START_NS + round(seconds * SECOND), [[x, 0.0, 0.0, 0.0]], [1])


def seconds_and_px(estimates):
    return [
        ((estimate.stamp_ns - START_NS) / SECOND, estimate.state[0, 0]) for estimate in estimates
    ]


def test_the_last_word_on_a_stamp_wins_and_what_can_no_longer_change_is_let_go():
    revisions = Revisions(10 * SECOND)
    final = revisions.add([made(1, 1.0)]) + revisions.add([made(3, 1.0)])
    final += revisions.add([made(2, 5.0), made(3, 2.0)])
    assert final == []
    assert seconds_and_px(revisions.finish()) == [(1, 1.0), (2, 5.0), (3, 2.0)]
    revisions = Revisions(2 * SECOND)
    final = [seconds_and_px(revisions.add([made(k)])) for k in range(1000)]
    assert final[:5] == [[], [], [], [(0, 0.0)], [(1, 0.0)]] and len(revisions.finish()) == 3
    revisions = Revisions(2 * SECOND)
    final = [item for k in (100, 101, 5, 6) for item in revisions.add([made(k)])]
    found = seconds_and_px([*final, *revisions.finish()])
    assert found == [(k, 0.0) for k in (100, 101, 5, 6)]


def test_order_by_stamp_makes_late_input_punctual(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive', shuffle=True, count=40)) as bag:
        run = OfflineRun(bag, DIVER, CONFIG, InputOptions(order='stamp'))
        list(run.estimates())
    assert 'late' not in run.outcomes()


def test_refused_messages_are_counted_with_their_reason_and_repairs_told(tmp_path, monkeypatch):
    with BagReader(write_dive(tmp_path / 'dive', spoilt=(3, 4))) as bag:
        run = OfflineRun(bag, DIVER, CONFIG)
        advanced = []
        assert len(list(run.estimates(advanced.append))) == 118
    assert run.refused['nan'].count == 2
    assert run.refused['nan'].example.startswith('/fix: ')
    assert run.outcomes() == {'used': 118, 'refused': 2}
    assert not run.failure()
    assert sum(advanced) == run.total == run.messages == 120
    monkeypatch.setattr(run.tracker, 'health', lambda: {'covariance_repairs': 3})
    assert run.outcomes() == {'covariance_repairs': 3, 'used': 118, 'refused': 2}


def test_the_expected_frame_refuses_the_others(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive')) as bag:
        run = OfflineRun(bag, DIVER, CONFIG, InputOptions(frame_id='odom'))
        assert list(run.estimates()) == []
    assert run.refused['frame'].count == 120
    assert 'refused: 120 (frame: ' in run.failure()


def test_topics_can_be_named(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive', topic='/usbl/pose', count=30)) as bag:
        with pytest.raises(BagError, match='no topic for the diver tracker'):
            OfflineRun(bag, DIVER, CONFIG)
        run = OfflineRun(bag, DIVER, CONFIG, InputOptions(topics={'/usbl/pose': 'fix'}))
        assert len(list(run.estimates())) == 30


def test_the_smoother_is_nearer_to_the_truth(tmp_path):
    errors = {}
    for smooth in (False, True):
        with BagReader(write_dive(tmp_path / f'dive{smooth}', count=60)) as bag:
            run = OfflineRun(bag, DIVER, CONFIG, InputOptions(smooth=smooth))
            estimates = list(run.estimates())
        rows = [estimate for estimate in estimates if len(estimate)]
        times = np.array([(row.stamp_ns - START_NS) / SECOND for row in rows])
        place = np.array([row.state[0, :2] for row in rows])
        truth = legs(np.arange(60) * 1.0)[np.rint(times).astype(int), :2]
        errors[smooth] = np.sqrt(np.mean(np.sum((place - truth) ** 2, axis=1)))
    assert errors[True] < 0.9 * errors[False]


def test_what_a_live_tracker_published_ends_as_the_offline_run(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive', shuffle=True)) as bag:
        run = OfflineRun(bag, DIVER, CONFIG)
        offline = list(run.estimates())
        tracker, published = DIVER.build(CONFIG), []
        for measurement in OfflineRun(bag, DIVER, CONFIG)._measurements(lambda count: None):
            published += tracker.process(measurement)
    assert len(published) > len(offline)
    live = final_estimates(published, CONFIG)
    assert [item.stamp_ns for item in live] == [item.stamp_ns for item in offline]
    assert all((a.state == b.state).all() for a, b in zip(live, offline))


# The log of a USBL as a stranger has it: a name in every row, one fix in twenty wild.


FIRST_S, EVERY_S, COUNT, STD = 1_700_000_000, 2, 150, 0.9


def swum(rng):
    """A diver in legs at .7 m/s, (COUNT, 2)."""
    heading = np.repeat(rng.uniform(-np.pi, np.pi, COUNT // 15), 15)
    steps = 0.7 * EVERY_S * np.column_stack([np.cos(heading), np.sin(heading)])
    return np.cumsum(steps, axis=0)


def log(path, truth, rng, name, std=STD, wild=0.05):
    """The CSV of a diver heard to .9 m, which states `std`; `wild` of the fixes are 40 m off."""
    seen = truth + STD * rng.normal(size=truth.shape)
    off = rng.uniform(size=len(truth)) < wild
    seen[off] += 40.0 * rng.normal(size=(int(off.sum()), 2))
    head, tail = ('Time,X,Y,Std,Target', f',{name}') if name else ('Time,X,Y,Std', '')
    rows = [
        f'{FIRST_S + EVERY_S * k},{x:.2f},{y:.2f},{std}{tail}' for k, (x, y) in enumerate(seen)
    ]
    path.write_text('\n'.join([head, *rows]) + '\n')


def errors_of(folder, **options):
    """Errors (k,) of the first confirmed track after ten fixes, whether the 95 % ellipse held the
    diver, and what the tracker warns of at the end and after 40 fixes."""
    error, inside, number = [], [], 0
    diver = SYSTEMS['diver']
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth = swum(rng)
        log(folder / f'{seed}.csv', truth, rng, **options)
        convert_fixes(folder / f'{seed}.csv', folder / f'{seed}.bag')
        with BagReader(folder / f'{seed}.bag') as bag:
            offline = OfflineRun(bag, diver, diver.config_type()())
            estimates, early = [], []
            for estimate in offline.estimates():
                estimates.append(estimate)
                if len(estimates) == 40:
                    early = offline.tracker.warnings()
        for k, estimate in enumerate(estimates):
            rows = np.flatnonzero(estimate.extras['track_state'] > 0)
            if k >= 10 and len(rows):
                miss = estimate.state[rows[0], :2] - truth[k]
                covariance = estimate.covariance[rows[0], :2, :2]
                error.append(np.hypot(*miss))
                inside.append(miss @ np.linalg.solve(covariance, miss) <= 5.991)
            number += k >= 10
    assert len(error) > 0.98 * number
    return np.sqrt(np.mean(np.square(error))), np.mean(inside), offline.tracker.warnings(), early


@pytest.mark.parametrize('name', ['', 'Diver 1'])
def test_wild_fixes_are_not_believed_with_and_without_names(tmp_path, name):
    rmse, inside, warnings, _ = errors_of(tmp_path, name=name)
    assert rmse <= 1.35 and inside > 0.9
    assert not any('as large as reported' in text for text in warnings)


@pytest.mark.statistics
@pytest.mark.parametrize('name', ['', 'Diver 1'])
def test_fixes_that_scatter_five_times_too_far_are_named_before_the_fiftieth(tmp_path, name):
    _, inside, _, early = errors_of(tmp_path, name=name, std=STD / 5.0, wild=0.0)
    # Over 20 runs .80.
    assert inside > 0.7
    assert any('as large as reported' in text for text in early)


def test_pings_that_are_shared_out_over_processes_give_the_same_estimates(tmp_path, monkeypatch):
    bag = str(tmp_path / 'bag')
    small = ('pings=3', 'last_range=30', 'bin_width=0.1')
    scene = ['simulate', 'bathymetry', bag, '--scenario', 'moving_two_sides']
    assert main([*scene, *(word for each in small for word in ('--set', each))]) == 0
    system = SYSTEMS['bathymetry']
    made = []
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
        assert (alone.stamp_ns, alone.source) == (shared.stamp_ns, shared.source)
        np.testing.assert_array_equal(alone.state, shared.state)
        np.testing.assert_array_equal(alone.probabilities, shared.probabilities)


# -- starts of tracks from a file


MESSAGE = f"""
header: {{stamp: {{sec: 1700000003, nanosec: 500000000}}, frame_id: map}}
pose:
  pose: {{position: {{x: 2.0, y: -3.5, z: 0.0}}, orientation: {{w: 1.0}}}}
  covariance: [4, 0.5, 0, 0, 0, 0, 0.5, 9, 0, 0, 0, 0, {', '.join(['0'] * 24)}]
"""


HERE = {'position': [0.0, 0.0], 'covariance': [4, 0, 0, 4]}


def written(tmp_path, text, name='places.yaml'):
    path = tmp_path / name
    path.write_text(text, encoding='utf-8')
    return path


def test_yaml_json_and_the_message_say_the_same(tmp_path):
    place = {'position': [2.0, -3.5], 'covariance': [[4, 0.5], [0.5, 9]], 'frame_id': 'map'}
    place['time'] = 1_700_000_003.5
    texts = [MESSAGE, json.dumps(place), json.dumps([place])]
    texts += [json.dumps({**place, 'time': '2023-11-14T22:13:23.5Z'})]
    for flat in ([4, 0.5, 0.5, 9], [4, 0.5, 0, 0.5, 9, 0, 0, 0, 1]):
        texts.append(json.dumps({**place, 'covariance': flat}))
    found = [read_initial(written(tmp_path, text)) for text in texts]
    assert all(each == found[0] for each in found)
    start = found[0][0].start(0, {})
    assert start.stamp_ns == 1_700_000_003 * SECOND + SECOND // 2
    assert start.position.tolist() == [2.0, -3.5, 0.0] and start.target_id == NOBODY
    np.testing.assert_allclose(start.covariance[:2, :2], [[4.0, 0.5], [0.5, 9.0]])


@pytest.mark.parametrize(
    'text, words',
    [
        ('', 'the file is empty'),
        ('[]', 'the file is empty'),
        ('3', 'a place needs position and covariance'),
        ('{position: [1, 2]}', 'covariance is missing'),
        ('{covariance: [1, 0, 0, 1]}', 'position is missing'),
        ('{position: [1], covariance: [1, 0, 0, 1]}', 'two or three numbers'),
        ('{position: [1, .nan], covariance: [1, 0, 0, 1]}', 'not finite'),
        ('{position: [1, two], covariance: [1, 0, 0, 1]}', "'two' in place of a number"),
        ('{position: [1, 2], covariance: [1, 0, 0]}', '4, 9 or 36 numbers'),
        ('{position: [1, 2], covariance: [0, 0, 0, 0]}', 'covariance'),
        ('{position: [1, 2], covariance: [1, 5, 5, 1]}', 'covariance'),
        ('{position: [1, 2], covariance: [1, 0, 0, 1], time: noon}', "time 'noon'"),
        ('{position: [1, 2], covariance: [1, 0, 0, 1], where: here}', 'where is not one of'),
        ('[{position: [1, 2], covariance: [1, 0, 0, 1]}, 7]', 'place 2:'),
        ('{position: [1, 2', 'not a YAML file'),
        ('pose: 3', 'pose needs'),
    ],
)
def test_a_bad_file_gets_one_sentence(tmp_path, text, words):
    with pytest.raises(ConfigError, match='--initial') as caught:
        read_initial(written(tmp_path, text))
    assert words in str(caught.value) and '\n' not in str(caught.value)
    with pytest.raises(ConfigError, match='No such file'):
        read_initial(tmp_path / 'nothing.yaml')


def test_a_track_begins_where_and_when_the_file_says(tmp_path):
    """With a name of `tags`; a start after the recording is counted as refused, an unknown name
    before the run."""
    places = (HERE, {**HERE, 'position': [500.0, 0.0], 'name': 'anna'})
    path = written(tmp_path, json.dumps([*places, {**HERE, 'time': 1_800_000_000}]))
    options = InputOptions(initial=read_initial(path))
    with BagReader(write_dive(tmp_path / 'dive', count=30)) as bag:
        run = OfflineRun(bag, DIVER, DIVER.config_type()(tags=('bob', 'anna')), options)
        first = list(run.estimates())[0]
        assert first.stamp_ns == START_NS and 2 in first.extras['target_id']
        assert (first.extras['track_state'] == 1).any()
        assert run.recipe()['initial'][0]['position'] == (0.0, 0.0, 0.0)
        assert run.refused['outside'].count == 1
        with pytest.raises(BagError, match="no target is called 'anna': bob are known"):
            list(OfflineRun(bag, DIVER, DIVER.config_type()(tags=('bob',)), options).estimates())


def test_the_command_takes_the_file(tmp_path, capsys):
    bag = str(write_dive(tmp_path / 'dive', count=20))
    path = written(tmp_path, '{position: [0, 0], covariance: [4, 0, 0, 4]}')
    assert main(['track', bag, str(tmp_path / 'out'), '--initial', str(path)]) == 0
    run = json.loads((tmp_path / 'out' / 'run.json').read_text(encoding='utf-8'))
    assert run['initial'][0]['covariance'] == [4.0, 0.0, 0.0, 4.0]
    bad = written(tmp_path, '{position: [0, 0]}', 'bad.yaml')
    assert main(['track', bag, str(tmp_path / 'other'), '--initial', str(bad)]) != 0
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


def test_a_process_that_dies_costs_its_call_only(tmp_path):
    with workers(2) as run:
        found = {
            k: (result, failure)
            for k, result, failure in run(work, [(tmp_path, k) for k in range(6)])
        }
        again = list(run(work, [(tmp_path, 5)]))
    assert {k: found[k] for k in (0, 1, 2, 5)} == {k: (k * k, '') for k in (0, 1, 2, 5)}
    assert 'was ended' in found[3][1] and 'not this one' in found[4][1]
    assert again == [(0, 25, '')]


def test_one_process_does_calls_in_turn(tmp_path):
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


def write_fixes(path, seconds, frames=('map',)):
    with BagWriter(path) as bag:
        for k, second in enumerate(seconds):
            fix = Fix(stamp_ns=START_NS, position=[0, 0, 0], frame_id=frames[k % len(frames)])
            message = write_fix(fix, ros_message)
            stamp = 0 if second is None else START_NS + round(second * SECOND)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
            bag.write('/fix', message, START_NS + k * SECOND)
    return path


def test_a_good_recording_has_no_problems(tmp_path):
    result, topics = said_of(write_dive(tmp_path / 'dive'))
    assert result['systems'] == {'diver': {'fix': ['/fix']}}
    assert topics['/fix']['suits'] == ['diver fix']
    assert topics['/fix']['rate_hz'] == pytest.approx(1.0)
    assert topics['/fix']['problems'] == [] and topics['/truth/estimate']['problems'] == []
    assert topics['/truth/estimate']['suits'] == []
    assert result['duration_s'] == pytest.approx(119.5)


def test_a_topic_of_another_name_still_suits_and_refused_messages_are_told(tmp_path):
    dive = write_dive(tmp_path / 'dive', topic='/usbl/pose', truth=False, spoilt=(1, 2, 3))
    result, topics = said_of(dive)
    assert result['systems'] == {'diver': {'fix': ['/usbl/pose']}}
    (problem,) = topics['/usbl/pose']['problems']
    assert problem.startswith('3 messages refused as fix (nan): ')


@pytest.mark.parametrize(
    'seconds, words',
    [
        ([0, 1, 2, 1.5, 3], '1 stamps older than the one before, by up to 0.5 s'),
        ([0, 1, 2, 3, 40, 41], '1 gaps in the stamps, the longest 37 s against 1 s'),
        ([None, None, 1], '2 messages without a usable stamp'),
    ],
)
def test_odd_stamps_and_several_frames_are_told(tmp_path, seconds, words):
    _, topics = said_of(write_fixes(tmp_path / 'bag', seconds, frames=('map', 'odom')))
    assert any(words in problem for problem in topics['/fix']['problems'])
    assert "several frames: 'map', 'odom'" in topics['/fix']['problems']


def test_several_fixes_of_one_stamp_are_a_scan(tmp_path, capsys):
    _, topics = said_of(write_fixes(tmp_path / 'bag', [0, 1, 1, 1, 2, 2, 3]))
    assert topics['/fix']['problems'] == []
    assert topics['/fix']['scans'] == {'count': 4, 'most': 3}
    assert main(['info', str(tmp_path / 'bag')]) == 0
    assert '7 messages, 1 Hz, 4 scans, up to 3 per scan, frame map' in capsys.readouterr().out


def test_two_pings_of_one_stamp_are_a_problem(tmp_path):
    ping = Arrivals(
        stamp_ns=START_NS, frame_id='map', tx_id=[0, 0, 0], rx_id=[1, 2, 3], tx=np.zeros((3, 3)),
        rx=np.diag([40.0, 50.0, 60.0]), toa=[0.05, 0.06, 0.07], var_toa=np.full(3, np.nan),
        bearing=np.full(3, np.nan), var_bearing=np.full(3, np.nan),
    )  # fmt: skip
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(2):
            bag.write('/arrivals', write_arrivals(ping, ros_message), START_NS + k)
    _, topics = said_of(tmp_path / 'bag')
    assert topics['/arrivals']['problems'] == ['1 stamps equal to the one before']
    assert topics['/arrivals']['scans'] is None


def test_frames_of_relative_fixes_are_names_of_targets(tmp_path):
    table = tmp_path / 'usbl.csv'
    rows = ''.join(f'{k},1,2,90,10,2,{name}\n' for k in range(3) for name in ('amy', 'rov'))
    table.write_text('stamp,vessel_x,vessel_y,heading,forward,starboard,id\n' + rows)
    convert_relative(table, tmp_path / 'bag')
    _, topics = said_of(tmp_path / 'bag')
    assert topics['/relative']['frames'] == ['amy', 'rov']
    assert topics['/relative']['problems'] == []


def test_navigation_in_ned_is_an_input_that_needs_a_parameter(tmp_path, capsys):
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(3):
            stamp_ns = START_NS + k * 10**9
            ping = Detections(stamp_ns=stamp_ns, frame_id='sonar', range=[20.0], bearing=[0.1])
            pose = Navigation(
                stamp_ns=stamp_ns, position=[k, 0, 5], orientation=[0, 0, 0, 1],
                frame_id='odom_ned',
            )  # fmt: skip
            bag.write('/detections', write_detections(ping, ros_message), stamp_ns)
            bag.write('/odometry', write_navigation(pose, ros_message), stamp_ns)
    assert main(['info', str(tmp_path / 'bag')]) == 0
    assert '--system obstacle --set world_frame_convention=ned' in capsys.readouterr().out


def test_what_no_tracker_knows_suits_nothing_and_an_empty_recording_is_no_trouble(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag, BagWriter(tmp_path / 'none'):
        bag.write('/note', ros_message('std_msgs/msg/String', data='hello'), START_NS)
    result, topics = said_of(tmp_path / 'bag')
    assert result['systems'] == {} and topics['/note']['problems'] == []
    result, _ = said_of(tmp_path / 'none')
    assert result['messages'] == 0 and result['duration_s'] == 0.0


def test_a_companion_counts_by_its_name_and_not_alone(tmp_path):
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
