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

"""Pings that are far too large, and arrays and targets in one line: time and memory are bounded,
tracks go on."""

import time
import tracemalloc

from attrs import evolve
import numpy as np
import pytest

from msg_adapters.arrivals import MAX_PAIRS
from sonar_imm.acoustics.localisation import localise
from sonar_imm.measurements import Arrivals
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

SECOND = 10**9
LIMIT_SECONDS = 8.0
"""CPU time of one ping: twenty times what it takes, a tenth of what it took."""
LIMIT_BYTES = 40_000_000


def ping(rx, toa, stamp_ns=SECOND, tx=(np.nan,) * 3, var_toa=1e-9, **more):
    n = len(rx)
    columns = {'rx_id': np.arange(n), 'bearing': np.full(n, np.nan)} | more
    return Arrivals(
        stamp_ns=stamp_ns,
        tx_id=np.zeros(n),
        rx=rx,
        tx=np.tile(tx, (n, 1)),
        toa=toa,
        var_toa=np.full(n, var_toa),
        var_bearing=np.where(np.isnan(columns['bearing']), np.nan, 1e-4),
        **columns,
    )


def receivers(n, rng):
    return np.column_stack([rng.uniform(-500.0, 500.0, (n, 2)), np.zeros(n)])


def wild_tag(rng, stamp_ns):
    rx = receivers(MAX_PAIRS, rng)
    return ping(rx, rng.uniform(0.1, 1.0, len(rx)), stamp_ns)


def good_tag(rng, stamp_ns):
    rx = receivers(MAX_PAIRS, rng)
    return ping(rx, np.linalg.norm(rx - [20.0, 30.0, 0.0], axis=1) / 1500.0, stamp_ns)


def echoes_of_many(rng, stamp_ns):
    """Fifty divers, all heard by twenty receivers."""
    angle = 2.0 * np.pi * np.arange(20) / 20
    ring = 300.0 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(20)])
    divers = np.repeat(np.random.default_rng(7).uniform(-250.0, 250.0, (50, 3)), 20, axis=0)
    rx = np.tile(ring, (50, 1))
    path = np.linalg.norm(divers - rx, axis=1) + np.linalg.norm(divers, axis=1)
    toa = path / 1500.0 + rng.normal(0.0, 3e-5, 1000)
    return ping(rx, toa, stamp_ns, tx=(0.0, 0.0, 0.0), rx_id=np.arange(1000) % 20)


@pytest.mark.parametrize('make', [wild_tag, good_tag, echoes_of_many])
def test_a_ping_of_the_largest_size_takes_seconds_and_megabytes(make):
    rng = np.random.default_rng(1)
    tracker = DiverTracker(DiverConfig())
    tracker.warm()
    for second in (1, 2):
        item = make(rng, second * SECOND)
        tracemalloc.start()
        start = time.process_time()
        tracker.process(item)
        took, (_, peak) = time.process_time() - start, tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert took < LIMIT_SECONDS and peak < LIMIT_BYTES


def test_a_tag_that_very_many_receivers_hear_is_one_diver():
    rng = np.random.default_rng(2)
    tracker = DiverTracker(DiverConfig())
    for second in range(1, 5):
        (estimate,) = tracker.process(good_tag(rng, second * SECOND))
    assert len(estimate) == 1
    np.testing.assert_allclose(estimate.state[0, :2], (20.0, 30.0), atol=0.05)


def test_an_echo_that_very_many_receivers_hear_is_taken_whole():
    rng = np.random.default_rng(3)
    tracker = DiverTracker(DiverConfig())
    rx = receivers(300, rng)
    place = np.array([20.0, 30.0, 0.0])
    path = np.linalg.norm(rx - place, axis=1) + np.linalg.norm(place)
    for second in range(1, 5):
        item = ping(rx, path / 1500.0, second * SECOND, tx=(0.0, 0.0, 0.0))
        (estimate,) = tracker.process(item)
    assert len(estimate) == 1
    np.testing.assert_allclose(estimate.state[0, :2], place[:2], atol=0.05)


def in_line(rng):
    """A line array, and a target on its line or a hair beside it."""
    n = rng.integers(2, 8)
    angle = rng.uniform(0.0, 2.0 * np.pi) * rng.integers(2)
    line = np.array([np.cos(angle), np.sin(angle)])
    along = np.arange(n) * 10.0 if rng.integers(2) else rng.uniform(-100.0, 100.0, n)
    far = rng.choice([0.0, 1e4, 1e6])
    rx = np.column_stack([along[:, None] * line + far, np.zeros(n)])
    target = np.append(rng.uniform(-300.0, 300.0) * line + far, 0.0)
    target[:2] += rng.choice([0.0, 0.0, 1e-9, 1e-3])
    leg = np.linalg.norm(rx - target, axis=1)
    tag = bool(rng.integers(2))
    toa = (leg if tag else leg + leg[0]) / 1500.0
    toa += rng.choice([0.0, 1e-7, 1e-5]) * rng.normal(size=n)
    angles = np.arctan2(*(target[:2] - rx[:, :2]).T[::-1])
    return ping(
        rx,
        toa,
        tx=(np.nan,) * 3 if tag else rx[0],
        var_toa=10.0 ** rng.uniform(-18.0, -8.0),
        bearing=angles if rng.random() < 0.3 else np.full(n, np.nan),
    )


def test_a_target_on_the_line_of_a_line_array_breaks_nothing():
    rng = np.random.default_rng(0)
    tracker = DiverTracker(DiverConfig())
    for second in range(1, 151):
        item = in_line(rng)
        fix = localise(
            item.rx,
            item.toa,
            item.var_toa,
            tx=item.tx,
            bearing=item.bearing,
            var_bearing=item.var_bearing,
        )
        for found in (fix, *fix.alternatives) if hasattr(fix, 'covariance') else ():
            assert (np.linalg.eigvalsh(found.covariance) > 0.0).all()
        tracker.process(evolve(item, stamp_ns=second * SECOND))
    assert tracker.health()['broken_tracks'] == 0
