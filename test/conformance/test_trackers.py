# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""What every tracker promises, checked alike on recordings of all systems."""

import pickle

import attrs
from helpers.hostile.properties import check_numbers
from helpers.tracked import as_bytes, published, resumed, RUNS, tracked
import numpy as np
import pytest

from sonar_imm.measurements import Navigation, Rejection
from sonar_imm.measurements.checks import LAST_NS
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.offline.tracking import final_estimates

SECOND = 10**9
WITH_HISTORY = [name for name in RUNS if name.startswith(('diver', 'obstacle'))]


@pytest.fixture(params=RUNS)
def run(request):
    return tracked(request.param)


@attrs.frozen
class Stranger:
    """A measurement that no tracker knows."""

    stamp_ns: int = 5 * SECOND
    frame_id: str = 'map'


def test_there_is_a_recording_of_every_system():
    assert {name.split('_')[0] for name in RUNS} == set(SYSTEMS)
    for name in RUNS:
        assert sum(map(len, tracked(name).whole)) > 5, 'too few estimates to compare'


def test_the_same_input_gives_the_same_bytes_and_process_is_pure(run):
    """No input is changed, no published estimate changes later, no global random state moves."""
    tracker = run.build()
    tracker.warm()
    before = pickle.dumps(run.input)
    np.random.seed(1)  # the state of the process, which nobody may touch
    state = np.random.get_state()[1].tobytes()
    given = [tracker.process(measurement) for measurement in run.input[:60]]
    made = [[as_bytes(estimate) for estimate in estimates] for estimates in given]
    rest = [published(tracker, measurement) for measurement in run.input[60:]]
    assert made + rest == run.whole and tracker.counts == run.counts
    assert [[as_bytes(estimate) for estimate in estimates] for estimates in given] == made
    assert pickle.dumps(run.input) == before
    assert np.random.get_state()[1].tobytes() == state


def test_reset_equals_a_fresh_tracker(run):
    tracker = run.until(40)
    tracker.reset()
    assert not +tracker.counts
    assert [published(tracker, m) for m in run.input] == run.whole
    assert tracker.counts == run.counts


@pytest.mark.parametrize('name', WITH_HISTORY)
def test_shuffled_input_gives_the_bytes_of_sorted_input(name):
    """What is late by less than the window gets its place in time."""
    run = tracked(name)
    measurements = sorted(run.input, key=lambda m: m.stamp_ns)
    rng = np.random.default_rng(3)
    arrival = [
        m.stamp_ns + rng.uniform(0.0, 0.3 * run.config.history * SECOND) for m in measurements
    ]
    shuffled = [measurements[k] for k in np.argsort(arrival, kind='stable')]
    assert shuffled != measurements
    made = []
    for order in (measurements, shuffled):
        tracker = run.build()
        estimates = [estimate for m in order for estimate in tracker.process(m)]
        made.append([as_bytes(estimate) for estimate in final_estimates(estimates, run.config)])
        assert not tracker.counts['too_late']
    assert made[0] == made[1] and tracker.counts['late'] > 3


def test_strangers_the_same_parameters_and_what_is_too_late_change_nothing(run):
    """The bathymetry tracker has nothing too late: each ping stands alone."""
    tracker, late_at = run.until(50), len(run.input) * 3 // 4
    for stranger in (Stranger(), 'a word', None):
        assert tracker.process(stranger) == []
    assert tracker.counts['unknown_type'] == 3
    assert all(isinstance(count, int) and count >= 0 for count in tracker.counts.values())
    health = tracker.health()
    assert health and all(isinstance(float(value), float) for value in health.values())
    tracker.reconfigure(run.config)
    assert [published(tracker, m) for m in run.input[50:late_at]] == run.whole[50:late_at]
    if run.system.name != 'bathymetry':
        stamp_ns = run.input[0].stamp_ns - 60 * SECOND
        late = attrs.evolve(run.input[late_at - 1], stamp_ns=stamp_ns)
        assert tracker.process(late) == [] and tracker.counts['too_late'] == 1
    assert [published(tracker, m) for m in run.input[late_at:]] == run.whole[late_at:]


def test_a_clock_that_was_set_back_by_a_day_is_followed(run):
    """A bag that starts over: after a few measurements the tracker believes the new clock."""
    tracker = run.build()
    back = [attrs.evolve(m, stamp_ns=m.stamp_ns - 86400 * SECOND) for m in run.input]
    first, made = ([e for m in part for e in tracker.process(m)] for part in (run.input, back))
    stamps = {m.stamp_ns for m in back}
    assert len(made) > 0.5 * len(first) > 0
    assert made[-1].stamp_ns in stamps
    # Nothing says that who is seen now was seen before: no identity is used again.
    last = [{*e.extras.get('track_id', ())} - {0} for e in (first[-1], made[-1])]
    assert not last[0] & last[1]


def test_the_measurements_of_other_systems_are_strangers():
    kinds = {
        name.split('_')[0]: next(m for m in tracked(name).input if not isinstance(m, Navigation))
        for name in RUNS
    }
    for name, system in SYSTEMS.items():
        tracker = system.build(system.config_type()())
        for other, measurement in kinds.items():
            if other != name:
                assert tracker.process(measurement) == []
        assert tracker.counts['unknown_type'] >= 2


def test_numbers_that_are_not_finite_harm_nobody(run):
    """Every array and number of a measurement in turn is NaN, or infinite: either the measurement
    refuses it, or the tracker lives with it and publishes finite numbers."""
    refused = taken = 0
    for bad in (np.nan, np.inf):
        tracker, rng = run.until(30), np.random.default_rng(1)
        for measurement in run.input[30:45]:
            for field in attrs.fields(type(measurement)):
                value = getattr(measurement, field.name)
                if isinstance(value, np.ndarray) and value.size and value.dtype.kind in 'fc':
                    hurt = np.array(value)
                    hurt.flat[rng.integers(value.size)] = bad
                elif isinstance(value, float):
                    hurt = bad
                else:
                    continue
                try:
                    wrong = attrs.evolve(measurement, **{field.name: hurt})
                except (Rejection, ValueError):
                    refused += 1
                    continue
                taken += 1
                for estimate in tracker.process(wrong):
                    there = estimate.existing if hasattr(estimate, 'existing') else slice(None)
                    assert not np.isinf(estimate.state[there]).any(), field.name
            tracker.process(measurement)
    assert refused + taken > 20


LAST = LAST_NS - 1
CLOCKS = {
    'from the first stamp there is': lambda stamps: [s - min(stamps) + 1 for s in stamps],
    'to the last stamp there is': lambda stamps: [s - max(stamps) + LAST for s in stamps],
    'standing still': lambda stamps: [stamps[0]] * len(stamps),
    'leaping far': lambda stamps: [1 + LAST // len(stamps) * k for k in range(len(stamps))],
    'at both ends by turns': lambda stamps: [
        LAST - k if k // 7 % 2 else 1 + k for k in range(len(stamps))
    ],
}


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('clock', CLOCKS)
def test_any_clock_gives_estimates_or_reasons(run, clock):
    """No sum of stamps leaves 64 bits, and no time between measurements is too short or long."""
    # What has the stamp of others is replayed with all of them.
    taken = run.input[:40] if clock == 'standing still' else run.input
    stamps = CLOCKS[clock]([m.stamp_ns for m in taken])
    tracker, rows = run.build(), 0
    for measurement, stamp_ns in zip(taken, stamps):
        for estimate in tracker.process(attrs.evolve(measurement, stamp_ns=stamp_ns)):
            check_numbers(estimate)
            assert estimate.stamp_ns in stamps
            rows += 1
    assert rows or sum(tracker.counts.values())
    if 'stamp there is' in clock:
        assert rows == sum(map(len, run.whole)) and tracker.counts == run.counts


def test_what_follows_a_restart_is_bit_for_bit_the_same(run, tmp_path):
    """After every tenth message, and once more after what was loaded was saved."""
    tracker, kept = run.build(), tmp_path / 'state'
    for cut, measurement in enumerate(run.input):
        if cut % 10 == 1:
            again = resumed(kept, tracker, run.system.name)
            first = kept.read_bytes()
            again = resumed(kept, again, run.system.name)
            assert kept.read_bytes() == first
            end = cut + 20
            assert [published(again, m) for m in run.input[cut:end]] == run.whole[cut:end]
        tracker.process(measurement)
    rest = run.input[end:]
    assert [published(again, m) for m in rest] == run.whole[end:] and again.counts == run.counts


@pytest.mark.parametrize('name', WITH_HISTORY)
def test_a_window_that_is_sent_again_changes_nothing(name, tmp_path):
    run = tracked(name)
    cut = 60
    again = resumed(tmp_path / 'state', run.until(cut), run.system.name)
    assert not any(again.process(m) for m in run.input[cut - 5 : cut])
    assert again.counts['duplicate'] == 5
    assert [published(again, m) for m in run.input[cut:]] == run.whole[cut:]


FOLLOWED = {'config', 'counts', '_counts', '_filter', '_padded', '_settled', '_keys', '_states'}
"""Attributes that are set anew when a state is put in."""


def test_every_attribute_that_changes_is_state(run):
    """Whatever a run changes in a tracker, and in what it holds, is named in a STATE, or follows
    from what is."""
    todo = [(run.build(), run.until(60))]
    for fresh, ran in todo:
        names = [field.name for field in attrs.fields(type(ran))] if attrs.has(type(ran)) else []
        for name in {*names, *getattr(ran, '__dict__', ())}:
            before, after = (getattr(tracker, name, None) for tracker in (fresh, ran))
            if name not in ran.STATE:
                assert name in FOLLOWED or _same(before, after), f'{type(ran).__name__}.{name}'
            elif hasattr(after, 'STATE') and before is not None:
                todo.append((before, after))
    assert len(todo) > 4


def _same(value, other):
    if attrs.has(type(value)):
        names = {field.name for field in attrs.fields(type(value))} - {'_cache'}
        return all(_same(getattr(value, n), getattr(other, n)) for n in names)
    if isinstance(value, dict):
        return value.keys() == other.keys() and all(_same(value[n], other[n]) for n in value)
    if isinstance(value, (list, tuple)):
        return len(value) == len(other) and all(map(_same, value, other))
    if isinstance(value, np.ndarray):
        return np.array_equal(value, other, equal_nan=value.dtype.kind == 'f')
    if hasattr(value, '__dict__') and not callable(value):
        return _same(vars(value) | {'_cache': 0}, vars(other) | {'_cache': 0})
    return callable(value) or value == other or (value != value and other != other)
