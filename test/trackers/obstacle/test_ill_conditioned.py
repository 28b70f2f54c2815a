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

"""Detections that claim to be perfect: obstacles keep their covariances; repairs are counted."""

from helpers.obstacle_runs import SECOND
import numpy as np
import pytest

from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker


def pings(variance, count=25):
    """A vehicle heads for one obstacle and stops for the last pings."""
    for k in range(count):
        x = float(min(k, count - 8))
        stamp = (k + 1) * SECOND
        yield Navigation(
            stamp_ns=stamp, position=[x, 0.0, -20.0], orientation=[0.0, 0.0, 0.0, 1.0]
        )
        yield Altitude(stamp_ns=stamp, altitude=12.0)
        yield Detections(
            stamp_ns=stamp,
            range=[np.hypot(60.0 - x, 2.0)],
            bearing=[0.0],
            var_range=[variance],
            var_bearing=[1e-11 * max(variance, 0.2)],
        )


@pytest.mark.parametrize('method', ['gaussian_sum', 'seafloor'])
@pytest.mark.parametrize('variance', [0.03, 2e-12])
def test_covariances_and_probabilities_stay_what_they_are(method, variance):
    tracker = ObstacleTracker(
        ObstacleConfig(method=method, scale_std=0.0 if method == 'gaussian_sum' else 0.01)
    )
    for item in pings(variance):
        for estimate in tracker.process(item):
            assert np.isfinite(estimate.state).all()
            assert (np.linalg.eigvalsh(estimate.covariance) >= 0.0).all()
            assert (estimate.probabilities >= 0.0).all()
            np.testing.assert_array_equal(estimate.probabilities.sum(axis=1), 1.0)
    health = tracker.health()
    assert health['broken_tracks'] == 0
    assert health['tracks'] == 1


def test_repairs_add_up_in_health(monkeypatch):
    """Variances that senders may state need none, so the filter is made to report some."""
    tracker = ObstacleTracker(ObstacleConfig())
    advance, update = tracker.filter.advance, tracker.filter.update
    monkeypatch.setattr(tracker.filter, 'advance', lambda *given: (advance(*given)[0], 2))
    monkeypatch.setattr(tracker.filter, 'update', lambda *given: (*update(*given)[:2], 1))
    assert tracker.health()['covariance_repairs'] == 0
    for item in pings(0.03, count=5):
        tracker.process(item)
    assert tracker.health()['covariance_repairs'] == 2 * 5 + 4  # the first ping begins the track
