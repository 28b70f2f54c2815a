# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Offline runs: the last word on each stamp, refusals, order, smoothing."""

from helpers.dive_bags import write_dive
from helpers.dive_scenes import estimate_at, SECOND, START_NS
import numpy as np
import pytest

from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.tracking import final_estimates, InputOptions, OfflineRun, Revisions
from sonar_imm_tools.recordings.convert import convert_fixes
from sonar_imm_tools.recordings.reader import BagError, BagReader

DIVER = SYSTEMS['diver']
CONFIG = DIVER.config_type()()


def made(seconds, x=0.0):
    return estimate_at(START_NS + round(seconds * SECOND), [[x, 0.0, 0.0, 0.0]], [1])


def seconds_and_px(estimates):
    return [
        ((estimate.stamp_ns - START_NS) / SECOND, estimate.state[0, 0]) for estimate in estimates
    ]


def test_the_last_word_on_a_stamp_wins_and_stamps_come_in_order():
    revisions = Revisions(10 * SECOND)
    final = revisions.add([made(1, 1.0)]) + revisions.add([made(3, 1.0)])
    final += revisions.add([made(2, 5.0), made(3, 2.0)])
    assert final == []
    assert seconds_and_px(revisions.finish()) == [(1, 1.0), (2, 5.0), (3, 2.0)]


def test_what_can_no_longer_change_is_let_go():
    revisions = Revisions(2 * SECOND)
    final = [seconds_and_px(revisions.add([made(k)])) for k in range(5)]
    assert final == [[], [], [], [(0, 0.0)], [(1, 0.0)]]


def test_memory_does_not_grow_with_the_recording():
    revisions = Revisions(2 * SECOND)
    for k in range(1000):
        revisions.add([made(k)])
    assert len(revisions.finish()) == 3


def test_a_restarted_clock_begins_anew_and_loses_nothing():
    revisions = Revisions(2 * SECOND)
    final = [item for k in (100, 101, 5, 6) for item in revisions.add([made(k)])]
    assert seconds_and_px([*final, *revisions.finish()]) == [
        (100, 0.0),
        (101, 0.0),
        (5, 0.0),
        (6, 0.0),
    ]


def test_order_by_stamp_makes_late_input_punctual(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive', shuffle=True)) as bag:
        run = OfflineRun(bag, DIVER, CONFIG, InputOptions(order='stamp'))
        list(run.estimates())
    assert 'late' not in run.outcomes()


def test_refused_messages_are_counted_with_their_reason(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive', spoilt=(3, 4))) as bag:
        run = OfflineRun(bag, DIVER, CONFIG)
        advanced = []
        assert len(list(run.estimates(advanced.append))) == 118
    assert run.refused['nan'].count == 2
    assert run.refused['nan'].example.startswith('/fix: ')
    assert run.outcomes() == {'used': 118, 'refused': 2}
    assert not run.failure()
    assert sum(advanced) == run.total == run.messages == 120


def test_repaired_covariances_are_told_with_the_counts(tmp_path, monkeypatch):
    with BagReader(write_dive(tmp_path / 'dive')) as bag:
        run = OfflineRun(bag, DIVER, CONFIG)
        list(run.estimates())
        assert 'covariance_repairs' not in run.outcomes()
        monkeypatch.setattr(run.tracker, 'health', lambda: {'covariance_repairs': 3})
        assert run.outcomes() == {'covariance_repairs': 3, 'used': 120}


def test_the_expected_frame_refuses_the_others(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive')) as bag:
        run = OfflineRun(bag, DIVER, CONFIG, InputOptions(frame_id='odom'))
        assert list(run.estimates()) == []
    assert run.refused['frame'].count == 120
    assert 'refused: 120 (frame: ' in run.failure()


def test_topics_can_be_named(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive', topic='/usbl/pose')) as bag:
        with pytest.raises(BagError, match='no topic for the diver tracker'):
            OfflineRun(bag, DIVER, CONFIG)
        run = OfflineRun(bag, DIVER, CONFIG, InputOptions(topics={'/usbl/pose': 'fix'}))
        assert len(list(run.estimates())) == 120


def test_the_smoother_is_nearer_to_the_truth(tmp_path):
    from helpers.dive_scenes import legs

    errors = {}
    for smooth in (False, True):
        with BagReader(write_dive(tmp_path / f'dive{smooth}')) as bag:
            estimates = list(
                OfflineRun(bag, DIVER, CONFIG, InputOptions(smooth=smooth)).estimates()
            )
        rows = [estimate for estimate in estimates if len(estimate)]
        times = np.array([(row.stamp_ns - START_NS) / SECOND for row in rows])
        place = np.array([row.state[0, :2] for row in rows])
        truth = legs(np.arange(120) * 1.0)[np.rint(times).astype(int), :2]
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


def tracked(folder, **options):
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
                    early = offline.warnings()
        for k, estimate in enumerate(estimates):
            rows = np.flatnonzero(estimate.extras['track_state'] > 0)
            if k >= 10 and len(rows):
                miss = estimate.state[rows[0], :2] - truth[k]
                covariance = estimate.covariance[rows[0], :2, :2]
                error.append(np.hypot(*miss))
                inside.append(miss @ np.linalg.solve(covariance, miss) <= 5.991)
            number += k >= 10
    assert len(error) > 0.98 * number
    return np.sqrt(np.mean(np.square(error))), np.mean(inside), offline.warnings(), early


@pytest.mark.parametrize('name', ['', 'Diver 1'])
def test_wild_fixes_are_not_believed_with_and_without_names(tmp_path, name):
    rmse, inside, warnings, _ = tracked(tmp_path, name=name)
    assert rmse <= 1.35 and inside > 0.9
    assert not any('as large as reported' in text for text in warnings)


@pytest.mark.statistics
@pytest.mark.parametrize('name', ['', 'Diver 1'])
def test_fixes_that_scatter_five_times_too_far_are_named_before_the_fiftieth(tmp_path, name):
    _, inside, _, early = tracked(tmp_path, name=name, std=STD / 5.0, wild=0.0)
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
    for jobs in (1, 2):
        with BagReader(bag) as reader:
            options = InputOptions(jobs=jobs)
            offline = OfflineRun(reader, system, system.config_type()(), options)
            if jobs > 1:  # nothing is done here
                monkeypatch.setattr(offline, '_in_turn', None)
            made.append(list(offline.estimates()))
            assert len(made[-1]) == 6 and offline.outcomes()['used'] == 6
            assert len(offline.durations) >= 6 and min(offline.durations) > 0.0
    for alone, shared in zip(*made, strict=True):
        assert (alone.stamp_ns, alone.source) == (shared.stamp_ns, shared.source)
        np.testing.assert_array_equal(alone.state, shared.state)
        np.testing.assert_array_equal(alone.probabilities, shared.probabilities)
