# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Envelopes over a floor that scatters: the scene, the first return, its identity, the
warnings."""

from attrs import evolve
import numpy as np
import pytest

from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.reflectors import Identities
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.evaluation.fathometer.records import records_of
from sonar_imm_tools.simulation.fathometer.simulator import scenario, simulate

SECOND = 10**9


@pytest.fixture(scope='module')
def scene():
    return simulate(scenario('diffuse', {'records': 60}), 5)


def stated(**overrides):
    return FathometerConfig.from_mapping(
        {**scenario('diffuse').instruments(), 'particles': 1000, **overrides}, ignore_unknown=True
    )


def track(scene, config):
    tracker = FathometerTracker(config)
    return tracker, [tracker.process(each.measurement)[0] for each in scene.measurements]


def test_the_scene_is_quiet_above_the_floor_and_scatters_below(scene):
    above, below = [], []
    for each, true in zip(scene.measurements, scene.truth):
        trace = each.measurement
        above.append(trace.amplitude[trace.depth < true.depth.min() - 2.0])
        inside = (trace.depth > true.depth.min() + 1.5) & (trace.depth < true.depth.min() + 3.5)
        below.append(trace.amplitude[inside])
    assert np.concatenate(above).max() == 0.0
    # Rayleigh of rms 0.25 at the top, falling to 1/e over 5 m, less the threshold of 0.06.
    expected = 0.886 * 0.25 * np.exp(-2.5 / 5.0) - 0.06
    assert np.concatenate(below).mean() == pytest.approx(expected, rel=0.15)


def test_the_floor_is_followed_under_one_identity(scene):
    _, estimates = track(scene, stated())
    rows = [each.columns() for each in estimates]
    first = [int(np.argmax(each['is_bottom'])) for each in rows]
    away = [each['depth'][k] - true.depth.min() for each, k, true in zip(rows, first, scene.truth)]
    assert np.mean(np.abs(away) < 1.0) >= 0.95
    assert len({int(each['track_id'][k]) for each, k in zip(rows, first)}) == 1
    right = [len(r.found) == len(t.depth) for r, t in zip(records_of(estimates), scene.truth)]
    assert np.mean(right) >= 0.9


def test_a_faint_floor_is_not_lost_to_what_scatters_below_it(scene):
    """A soft floor, a third of the loudest, 5 m above where the scatter begins."""
    faint = []
    for each, true in zip(scene.measurements[:25], scene.truth):
        trace = each.measurement
        floor = true.depth.min() - 5.0
        width = stated().pulse_width
        echo = 0.35 * trace.amplitude.max()
        echo *= np.exp(-0.5 * np.square((trace.depth - floor) / width))
        faint.append((evolve(trace, amplitude=trace.amplitude + echo), floor))
    tracker, right = FathometerTracker(stated()), []
    for trace, floor in faint:
        columns = tracker.process(trace)[0].columns()
        right.append(abs(columns['depth'][np.argmax(columns['is_bottom'])] - floor) < 0.5)
    assert np.mean(right) >= 0.9


def test_the_first_return_keeps_its_name_on_a_wall():
    config = evolve(stated(), depth_std=0.3, min_separation=1.0)

    def name(known, depth, bottom, floor_known=True):
        return known.name(np.array(depth), np.array(bottom), config, floor_known=floor_known)

    first, ids = name(Identities(), [10.0, 14.0], [1.0, 0.0])
    assert list(ids) == [1, 2]
    # It rises by 2 m, and something below it is nearer to where it was.
    after, ids = name(first, [8.0, 9.9, 14.0], [1.0, 0.0, 0.0])
    assert list(ids) == [1, 3, 2] and after.bottom_id == 1
    # Ten metres are no slope.
    _, ids = name(after, [20.0], [1.0])
    assert ids[0] not in (1, 2, 3)
    # Where the floor is not known, the nearest counts.
    _, ids = name(first, [8.0, 9.9, 14.0], [1.0, 0.0, 0.0], floor_known=False)
    assert list(ids) == [3, 1, 2]


def test_a_wrong_pulse_is_said_with_its_remedy(scene):
    tracker, _ = track(
        scene, FathometerConfig(noise_sigma=0.02, particles=300, water='off', pulse='band')
    )
    sentences = ' '.join(tracker.warnings())
    assert 'envelopes need water auto' in sentences and 'no set of reflectors' in sentences
    tracker, _ = track(scene, stated(particles=300))
    assert tracker.warnings() == []


def test_a_full_set_is_said(scene):
    tracker, _ = track(scene, stated(order_max=2, particles=300))
    sentences = ' '.join(tracker.warnings())
    assert 'against a limit of 2' in sentences and 'order_max may not fit' in sentences


def test_unexplained_records_are_said():
    tracker = FathometerTracker(
        FathometerConfig(pulse='gaussian', noise_sigma=0.1, order_min=6, order_max=6, particles=50)
    )
    depth = 0.25 * np.arange(80)
    for second in range(1, 13):
        amplitude = -np.exp(-0.5 * np.square(depth - 10.0))
        tracker.process(Trace(stamp_ns=second * SECOND, depth=depth, amplitude=amplitude))
        assert tracker.counts['unexplained'] == second
        assert tracker._before is None  # the next one begins anew
        assert bool(tracker.warnings()) == (second >= 10)  # a few records are no evidence
    assert any('no set of reflectors explains 100 %' in each for each in tracker.warnings())
