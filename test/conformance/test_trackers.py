# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What every tracker and every simulator promises."""

import importlib
import pickle

import attrs
from helpers.hostile.runs import check_numbers
from helpers.scenes import small_scene, smaller_scene
from helpers.tracked import as_bytes, BAGS, published, resumed, RUNS, tracked
import numpy as np
import pytest

from benchmarks.false_warnings import runs
from sonar_imm.measurements import Navigation, Rejection
from sonar_imm.measurements.checks import LAST_NS
from sonar_imm.parameters import ConfigError
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


def test_the_same_input_gives_the_same_bytes_and_process_is_pure(run):
    tracker = run.build()
    tracker.warm()
    before = pickle.dumps(run.input)
    np.random.seed(1)  # the state of the process, which nobody may touch
    state = np.random.get_state()[1].tobytes()
    given = [tracker.process(measurement) for measurement in run.input[:60]]
    made = list(map(as_bytes, given))
    assert made + published(tracker, run.input[60:]) == run.whole and tracker.counts == run.counts
    assert list(map(as_bytes, given)) == made
    assert pickle.dumps(run.input) == before
    assert np.random.get_state()[1].tobytes() == state


def test_there_is_a_recording_of_every_system_and_those_of_others_are_strangers():
    assert all(sum(map(len, tracked(name).whole)) > 5 for name in RUNS), 'too few to compare'
    kinds = {
        name.split('_')[0]: next(m for m in tracked(name).input if not isinstance(m, Navigation))
        for name in RUNS
    }
    assert kinds.keys() == SYSTEMS.keys()
    for name, system in SYSTEMS.items():
        tracker = system.build(system.config_type()())
        assert not any(tracker.process(kinds[other]) for other in kinds if other != name)
        assert tracker.counts['unknown_type'] >= 2


def test_reset_equals_a_fresh_tracker(run):
    tracker = run.until(40)
    tracker.reset()
    assert not +tracker.counts
    assert published(tracker, run.input) == run.whole
    assert tracker.counts == run.counts


@pytest.mark.parametrize('name', WITH_HISTORY)
def test_shuffled_input_gives_the_bytes_of_sorted_input(name):
    """What is late by less than the window gets its place in time."""
    run, rng, made = tracked(name), np.random.default_rng(3), []
    measurements = sorted(run.input, key=lambda m: m.stamp_ns)
    window = 0.3 * run.config.history * SECOND
    arrival = [m.stamp_ns + rng.uniform(0.0, window) for m in measurements]
    shuffled = [measurements[k] for k in np.argsort(arrival, kind='stable')]
    assert shuffled != measurements
    for order in (measurements, shuffled):
        tracker = run.build()
        estimates = [estimate for m in order for estimate in tracker.process(m)]
        made.append(as_bytes(final_estimates(estimates, run.config)))
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
    assert published(tracker, run.input[50:late_at]) == run.whole[50:late_at]
    if run.system.name != 'bathymetry':
        stamp_ns = run.input[0].stamp_ns - 60 * SECOND
        late = attrs.evolve(run.input[late_at - 1], stamp_ns=stamp_ns)
        assert tracker.process(late) == [] and tracker.counts['too_late'] == 1
    assert published(tracker, run.input[late_at:]) == run.whole[late_at:]


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


def test_numbers_that_are_not_finite_harm_nobody(run):
    tried = 0
    for bad in (np.nan, np.inf):
        tracker, rng = run.until(30), np.random.default_rng(1)
        for measurement in run.input[30:45]:
            for field in attrs.fields(type(measurement)):
                value = getattr(measurement, field.name)
                if isinstance(value, np.ndarray) and value.size and value.dtype.kind in 'fc':
                    value = np.array(value)
                    value.flat[rng.integers(value.size)] = bad
                elif isinstance(value, float):
                    value = bad
                else:
                    continue
                tried += 1
                try:
                    wrong = attrs.evolve(measurement, **{field.name: value})
                except (Rejection, ValueError):
                    continue
                for estimate in tracker.process(wrong):
                    there = estimate.existing if hasattr(estimate, 'existing') else slice(None)
                    assert not np.isinf(estimate.state[there]).any(), field.name
            tracker.process(measurement)
    assert tried > 20


LAST = LAST_NS - 1


CLOCKS = {
    'from the first stamp there is': lambda stamps: [s - min(stamps) + 1 for s in stamps],
    'to the last stamp there is': lambda stamps: [s - max(stamps) + LAST for s in stamps],
    'standing still': lambda stamps: [stamps[0]] * len(stamps),
    'leaping far': lambda stamps: [1 + LAST // len(stamps) * k for k, _ in enumerate(stamps)],
    'by turns': lambda stamps: [LAST - k if k // 7 % 2 else 1 + k for k, _ in enumerate(stamps)],
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
            assert published(again, run.input[cut:end]) == run.whole[cut:end]
        tracker.process(measurement)
    assert published(again, run.input[end:]) == run.whole[end:] and again.counts == run.counts


@pytest.mark.parametrize('name', WITH_HISTORY)
def test_a_window_that_is_sent_again_changes_nothing(name, tmp_path):
    run, cut = tracked(name), 60
    again = resumed(tmp_path / 'state', run.until(cut), run.system.name)
    assert not any(again.process(m) for m in run.input[cut - 5 : cut])
    assert again.counts['duplicate'] == 5
    assert published(again, run.input[cut:]) == run.whole[cut:]


def attributes_of(value):
    names = [each.name for each in attrs.fields(type(value))] if attrs.has(type(value)) else ()
    return {*names, *getattr(value, '__dict__', ())} - {'_cache'}


FOLLOWED = {'config', 'counts', '_counts', '_filter', '_padded', '_settled', '_keys', '_states'}
"""Attributes that are set anew when a state is put in."""


def test_every_attribute_that_changes_is_state(run):
    todo = [(run.build(), run.until(60))]
    for fresh, ran in todo:
        for name in attributes_of(ran):
            before, after = (getattr(tracker, name, None) for tracker in (fresh, ran))
            if name not in ran.STATE:
                assert name in FOLLOWED or _same(before, after), f'{type(ran).__name__}.{name}'
            elif hasattr(after, 'STATE') and before is not None:
                todo.append((before, after))
    assert len(todo) > 4


def _same(value, other):
    if isinstance(value, dict):
        return value.keys() == other.keys() and all(_same(value[n], other[n]) for n in value)
    if isinstance(value, (list, tuple)):
        return len(value) == len(other) and all(map(_same, value, other))
    if isinstance(value, np.ndarray):
        return np.array_equal(value, other, equal_nan=value.dtype.kind == 'f')
    if not callable(value) and (names := attributes_of(value)):
        return all(_same(getattr(value, n), getattr(other, n)) for n in names)
    return callable(value) or value == other or (value != value and other != other)


@pytest.mark.parametrize('name', ['obstacle_movers', 'diver_multistatic'])
@pytest.mark.parametrize('factor, warned', [(1.0, False), (2.0, True), (0.5, True)])
def test_only_variances_that_are_not_true_are_warned_of(name, factor, warned):
    ((_, raised),) = runs(BAGS / name, factor, range(1, 2))
    assert bool(raised) == warned


@pytest.fixture(params=SYSTEMS)
def system(request):
    return SYSTEMS[request.param]


@pytest.fixture
def scenes(system):
    return importlib.import_module(system.scenes)


@pytest.mark.parametrize(
    ('system', 'name'),
    [
        (system, name)
        for system in SYSTEMS
        for name in importlib.import_module(SYSTEMS[system].scenes).SCENARIOS
    ],
)
def test_a_seed_decides_on_every_byte(system, name):
    """Of every scenario, and when each measurement is received."""
    first, again, other = (
        [
            (item.received_ns, pickle.dumps(item.measurement))
            for item in smaller_scene(SYSTEMS[system], name, seed)[1].measurements
        ]
        for seed in (3, 3, 4)
    )
    assert first == again != other
    received = [time for time, _ in first]
    assert received == sorted(received)


def test_a_scene_is_in_order_has_truth_that_draws_and_tells_of_its_instruments(system):
    np.random.seed(1)  # the state of the process, which nobody may touch
    before = np.random.get_state()[1].tobytes()
    config, scene = small_scene(system, 3)
    assert np.random.get_state()[1].tobytes() == before
    times = [item.received_ns for item in scene.measurements]
    assert times == sorted(times) and len(times) > 1
    assert all(item.received_ns >= item.measurement.stamp_ns for item in scene.measurements)
    tables = [table for truth in scene.truth for table in truth.tables(scene.frame_id)]
    assert tables
    for table in tables:
        assert list(table.columns)[:3] == ['x', 'y', 'z'] and table.frame_id
        assert {len(column) for column in table.columns.values()} == {len(table.columns['x'])}
        assert all(table.columns[name].dtype == np.float32 for name in 'xyz')
    tracker = system.build(system.config_type()(**config.instruments()))
    for item in scene.measurements:
        tracker.process(item.measurement)
    assert tracker.counts['used'] > 0 and not tracker.counts['unknown_type']


def test_every_scenario_has_a_description_and_can_be_configured(scenes):
    for name, (description, _) in scenes.SCENARIOS.items():
        assert len(description.split()) > 2
        assert scenes.scenario(name, {}) == scenes.scenario(name, None)
    shares = [spec for spec in scenes.scenario(name, {}).specs() if 'probability' in spec.name]
    assert all((spec.low, spec.high) == (0.0, 1.0) for spec in shares)


def test_a_name_that_nobody_knows_is_answered_with_those_that_exist(scenes):
    known = next(iter(scenes.SCENARIOS))
    with pytest.raises(ConfigError, match=f"unknown scenario '{known}x'.*did you mean.*{known}"):
        scenes.scenario(known + 'x', {})
    with pytest.raises(ConfigError, match='no_such_parameter'):
        scenes.scenario(known, {'no_such_parameter': 1})
