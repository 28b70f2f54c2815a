# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tags that send no number: each ping is of one of them, and which one only its times say."""

from helpers.diver_runs import arrivals
import numpy as np
import pytest

from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

RECEIVERS = np.array([[-58.0, -41.0], [47.0, -62.0], [61.0, 38.0], [-39.0, 55.0]])
TAGS = np.array([[-42.0, -50.0], [40.0, 51.0], [10.0, -12.0], [-60.0, 30.0], [70.0, -20.0]])


def ping(stamp, place, rng, late=0.0):
    """A ping that all receivers hear at an unknown time, and `late` by so many metres."""
    path = np.hypot(*(RECEIVERS - place).T) + 0.3 * rng.normal(size=4)
    path += late
    rx = np.column_stack([RECEIVERS, np.zeros(4)])
    return arrivals(round(stamp * 1e9), rx, path / 1500.0 + 5.0, var_toa=(0.3 / 1500.0) ** 2)


@pytest.mark.parametrize('tags', [2, 5])
def test_each_of_several_tags_without_a_number_has_its_own_track(tags):
    """Opposite tags, too: two of four arrivals of one fit the place of the other."""
    rng, tracker = np.random.default_rng(7), DiverTracker(DiverConfig())
    for second in range(30):
        for k, start in enumerate(TAGS[:tags]):
            place = start + 0.5 * second * np.array([(-1.0) ** k, 0.3])
            (estimate,) = tracker.process(ping(100.0 + second + 0.18 * k, place, rng))
    sure = estimate.extras['track_state'] > 0
    assert sorted(estimate.extras['track_id'][sure]) == [*range(1, tags + 1)]
    places = TAGS[:tags] + 14.5 * np.array([[(-1.0) ** k, 0.3] for k in range(tags)])
    apart = np.hypot(*(estimate.state[sure, None, :2] - places).transpose(2, 0, 1))
    assert sorted(apart.argmin(axis=1)) == [*range(tags)] and apart.min(axis=1).max() < 1.0
    assert not tracker.warnings()


def test_wild_arrivals_start_no_second_track_of_a_tag():
    rng, tracker, most = np.random.default_rng(9), DiverTracker(DiverConfig()), 0
    for second in range(60):
        late = rng.uniform(5.0, 50.0) * (rng.uniform(size=4) < 0.25)
        (estimate,) = tracker.process(ping(100.0 + second, TAGS[0], rng, late))
        most = max(most, int((estimate.extras['track_state'] > 0).sum()))
    assert most == 1 and np.hypot(*(estimate.state[0, :2] - TAGS[0])) < 1.0


def test_one_late_arrival_of_four_leaves_the_ping_with_its_tag():
    rng, tracker = np.random.default_rng(8), DiverTracker(DiverConfig())
    for second in range(20):
        late = [25.0 * (second == 15), 0.0, 0.0, 0.0]
        (estimate,) = tracker.process(ping(100.0 + second, TAGS[0], rng, late))
        if second == 15:
            assert estimate.extras['track_state'].tolist() == [1]
            assert np.hypot(*(estimate.state[0, :2] - TAGS[0])) < 1.0
