# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What passes between two records: records that are missing, and stamps that are not even."""

from helpers.fathometer_runs import run
import numpy as np
import pytest

from benchmarks.fathometer_gaps import BEFORE, kalman, LAYERS, scene, summary, tracked
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.tracker import LONGEST_GAP, Pace

OPTIONS = {'particles': 5000}


@pytest.mark.statistics
@pytest.mark.parametrize('gap', [10, 30])
def test_after_a_gap_it_is_as_if_there_had_been_none(gap):
    """Beside a Kalman filter for each layer, which knows the echoes apart."""
    runs, bounds = [], []
    for seed in range(8):
        traces, truth = scene(gap, 0.1, seed)
        runs.append(tracked(traces, truth, **OPTIONS))
        known = np.ones(truth.shape, int)
        bounds.append({'right': known[:, 0], 'found': kalman(traces, truth, gap), 'ids': known})
    found, bound = summary(runs), summary(bounds)
    assert found['P, 1st'] >= 0.75 and found['P, 2nd'] >= 0.875 and found['P, later'] >= 0.95
    assert found['found, 1st'] >= 0.95 and found['identities, 4th'] >= 0.95
    # 48 layers leave .03 of chance.
    assert found['inside, 1st'] >= 0.88 and found['inside, later'] >= 0.93
    assert found['error, 1st, m'] <= 1.5 * bound['error, 1st, m']


def test_a_gap_that_is_taken_for_a_record_loses_layers():
    traces, truth = scene(30, 0.1, 0)
    once = {'record_interval': 86400.0, 'slope_std': 0.0}
    right = tracked(traces, truth, **once, **OPTIONS)['right']
    assert right[BEFORE - 5 : BEFORE].all() and not right[BEFORE : BEFORE + 2].any()


@pytest.mark.parametrize('seed', range(3))
def test_the_first_record_has_no_reflector_too_many(seed):
    """Were every number equally probable before, most first records would have one."""
    tracker, found = run(scene(0, 0.1, seed)[0][:1], particles=2000)
    (estimate,) = found.values()
    assert np.argmax(estimate.probabilities[0]) + 1 == len(LAYERS)
    assert tracker.health()['effective_sample_size'] > 400.0


def test_where_half_may_have_come_and_gone_the_set_begins_anew_and_names_stay():
    """Followed over 120 missing records, one set of 2000 is left."""
    traces, _ = scene(120, 0.1, 4)
    tracker, found = run(traces[:BEFORE], particles=2000)
    before = max(found.values(), key=lambda each: each.stamp_ns).extras['track_id']
    tracker.process(traces[BEFORE])
    assert tracker.health()['effective_sample_size'] > 30.0
    (estimate,) = tracker.process(traces[BEFORE + 1])
    assert (
        len(estimate) == len(LAYERS) and len(set(before) & set(estimate.extras['track_id'])) >= 5
    )


def test_after_too_long_a_gap_all_is_new():
    traces, _ = scene(0, 0.1, 2)
    tracker, found = run(traces[:10], max_gap=1e8, **OPTIONS)
    before = max(found.values(), key=lambda each: each.stamp_ns).extras['track_id']
    late = traces[10].stamp_ns + (LONGEST_GAP + 1) * 10 * 10**9
    (estimate,) = tracker.process(
        type(traces[10])(
            stamp_ns=late,
            depth=traces[10].depth,
            amplitude=traces[10].amplitude,
            sigma=traces[10].sigma,
        )
    )
    assert not set(estimate.extras['track_id']) & set(before)
    assert len(before) == len(LAYERS) and tracker.counts['gaps'] == 1


def passed(stamps, **parameters):
    """How many records' time passes before each stamp, s."""
    pace, config, found = Pace(), FathometerConfig(**parameters), []
    for stamp in stamps:
        stamp_ns = round(stamp * 1e9)
        found.append(pace.records(stamp_ns, config))
        pace = pace.after(stamp_ns)
    return found


def test_stamps_that_are_not_even_are_no_gaps():
    rng = np.random.default_rng(0)
    stamps = 100.0 + 10.0 * np.arange(200) + rng.uniform(-2.0, 2.0, 200)
    assert passed(stamps) == [1] * 200 == passed(stamps, record_interval=10.0)
    # A burst at the beginning, then the right pace.
    assert passed([0.0, 0.001, 10.0, 20.0, 30.0, 40.0]) == [1] * 6


def test_the_interval_is_learned_from_the_first_records():
    stamps = np.delete(10.0 * np.arange(100), [4, 5, 40, 41, 42])
    steps = passed(stamps)
    assert steps[4] == 3 and steps[38] == 4 and sum(steps) == 100
    # From then on it stays: half as many records are each two records' time.
    assert passed([*range(20), *range(21, 41, 2)])[-9:] == [2] * 9
    assert passed([*range(20), *range(21, 41, 2)], record_interval=2.0) == [1] * 30


@pytest.mark.parametrize(
    'options',
    [
        {'heave': 'memory', 'array_depth_std': 0.1},
        {'polarity': 'both'},
        {'amplitude_memory': 0.9},
        {'smoothing_lag': 2},
    ],
)
def test_every_kind_of_state_crosses_a_gap(options):
    traces, truth = scene(10, 0.1, 3)
    tracker, found = run(traces, **options, **OPTIONS)
    last = max(found.values(), key=lambda each: each.stamp_ns)
    assert tracker.counts['unexplained'] == 0 and tracker.counts['gaps'] == 1
    assert len(last) == len(LAYERS)
    assert last.state[:, 0] == pytest.approx(truth[-1], abs=0.3)
