# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Arrival times that are rounded: found, counted in, or refused."""

from pathlib import Path

from attrs import evolve
from helpers.diver_runs import arrivals
import numpy as np
import pytest

from sonar_imm.trackers.diver.arrival_stamps import ArrivalStamps, Resolution
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

VECTORS = Path(__file__).parents[2] / 'vectors' / 'diver_in_the_field'
SECOND = 10**9
RECEIVERS = np.array(
    [[0.0, 0.0, -2.0], [240.0, 0.0, -2.0], [240.0, 240.0, -2.0], [0.0, 240.0, -2]]
)


def heard(step, count=60, seed=1, period=3.7, active=False):
    """Pings of a tag, or echoes of a transmitter, whose times are multiples of `step` s (0: not),
    and where the target is. The times of messages are on whole seconds."""
    rng = np.random.default_rng(seed)
    n = len(RECEIVERS)
    for k in range(count):
        emitted = 100.0 + period * k + rng.uniform(0.0, 1.0)
        place = np.array([90.0 + 0.4 * period * k, 100.0 + 20.0 * np.sin(k / 15), 0.0])
        path = np.linalg.norm(RECEIVERS - place, axis=1)
        path += active * np.linalg.norm(RECEIVERS[0] - place)
        delay = path / 1500.0 + 1e-4 * rng.normal(size=n)
        start = round(emitted * (1 if active else 1e9)) * (SECOND if active else 1)
        at = np.round(delay * 1e9).astype(np.int64) + (0 if active else start)
        if step:
            at = np.round(at / (step * 1e9)).astype(np.int64) * round(step * 1e9)
        stamp = start if active else int(at.min())
        yield (
            place[:2],
            arrivals(
                stamp,
                RECEIVERS,
                (at - (0 if active else stamp)) / 1000000000.0,
                tx_id=np.full(n, 1),
                rx_id=np.arange(1, n + 1),
                tx=np.tile(RECEIVERS[0], (n, 1)) if active else np.full((n, 3), np.nan),
            ),
        )


def tracked(step, **how):
    """Errors (n,), normalised ones, and warnings of a run."""
    tracker, errors, squared = DiverTracker(DiverConfig(max_tracks=1)), [], []
    for k, (place, ping) in enumerate(heard(step, **how)):
        (estimate,) = tracker.process(ping)
        if k >= 30 and len(estimate):
            error = estimate.state[0, :2] - place
            errors.append(np.hypot(*error))
            squared.append(error @ np.linalg.solve(estimate.covariance[0, :2, :2], error))
    return np.array(errors), np.array(squared), tracker


def test_the_resolution_is_that_of_an_independent_program():
    v = np.load(VECTORS / 'quantum.npz')
    found = [Resolution().after(stamps).seconds for stamps in v['stamps_ns']]
    np.testing.assert_allclose(found, v['seconds'], rtol=1e-12)
    assert Resolution().after(v['few']).seconds == v['few_seconds'] == 0.0


def test_the_resolution_is_that_of_all_times_in_whatever_parts_they_come():
    stamps = np.load(VECTORS / 'quantum.npz')['stamps_ns'][1]
    known = Resolution()
    for part in np.array_split(stamps, 9):
        known = known.after(part)
    assert known == Resolution().after(np.sort(stamps))._replace(values=known.values)
    assert known.seconds == 0.1 and known.after(np.array([12_345_678_912])).seconds == 0.0
    # Seconds since 1970 as a float are not exact; one delay again and again shows nothing.
    rough = np.array([round((1.7e9 + 0.1 * k) % 1e6 * 1e9) + 119 for k in range(30)])
    assert Resolution().after(rough).seconds == pytest.approx(0.1)
    still = Resolution()
    for _ in range(30):
        still = still.after(np.array([80_000_000]))
    assert still.seconds == 0.0


@pytest.mark.parametrize('active', [False, True])
def test_stamps_of_messages_on_whole_seconds_are_no_resolution(active):
    known = ArrivalStamps()
    for _, ping in heard(0.0, active=active):
        whole = evolve(ping, stamp_ns=ping.stamp_ns // SECOND * SECOND)
        known = known.after(whole)
    assert known.resolution == 0.0 and 339.0 < known.span < 340.0


@pytest.mark.parametrize('step', [1e-3, 1e-2])
@pytest.mark.parametrize('active', [False, True])
def test_rounding_is_counted_in(step, active):
    _, squared, tracker = tracked(step, active=active)
    assert len(squared) > 25 and squared.mean() < 3.0 and (squared < 5.99).mean() > 0.85
    (sentence,) = [text for text in tracker.warnings() if 'multiples' in text]
    assert f'multiples of {step:g} s: a resolution of {1500 * step:.3g} m' in sentence
    assert f'toa_std raised to {step / 12**0.5:.2g} s' in sentence


def test_no_position_is_had_of_whole_seconds():
    _, _, tracker = tracked(1.0)
    (sentence,) = [text for text in tracker.warnings() if 'multiples' in text]
    assert 'no position can be had of them' in sentence and '1.5e+03 m' in sentence
    assert not (tracker._stream.state.life.status > 0).any()


def test_what_is_stated_is_used_and_exact_times_say_nothing():
    errors, squared, tracker = tracked(0.0)
    assert np.median(errors) < 0.5 and squared.mean() < 3.0
    assert not any('multiples' in text for text in tracker.warnings())
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    for _, ping in heard(1e-3):
        stated = np.float32(1e-6 / 12.0)  # as those who know of the rounding state it
        tracker.process(evolve(ping, var_toa=np.full(len(RECEIVERS), stated, np.float64)))
    assert not any('multiples' in text for text in tracker.warnings())
