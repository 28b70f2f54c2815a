# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Names: of fixes, of tags' pings, of divers that are also seen without one."""

from attrs import evolve
from helpers.diver_runs import arrivals, fix, scan_of
import numpy as np
import pytest

from sonar_imm.measurements import Fix, NOBODY
from sonar_imm.trackers.diver.names import scans_to_merge
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

SECOND = 10**9
BOTH = ('gnn', 'jipda')
RX = np.array([[0.0, 0.0, 0.0], [70.0, 10.0, 0.0], [-60.0, 45.0, 0.0], [10.0, 85.0, 0.0]])


def named(second, place, name):
    return evolve(fix(second, *place), target_id=name)


def scan(second, *places, **values):
    return scan_of(second, places, **values)


def test_scans_needed_before_two_tracks_are_one_follow_from_p_d():
    for p_detection in (0.5, 0.7, 0.9):
        scans = scans_to_merge(p_detection)
        apart = (1.0 - p_detection**2) ** np.array([scans, scans - 1])
        assert apart[0] <= 1e-3 < apart[1]


@pytest.mark.parametrize('association', BOTH)
def test_a_diver_heard_by_name_and_seen_without_is_one_track(association):
    """The sonar sees the diver first; its track goes on, with the name."""
    tracker = DiverTracker(DiverConfig(association=association, clutter_density=1e-4))
    rng = np.random.default_rng(3)
    first = None
    for second in range(1, 60):
        place = np.array([0.5 * second, 0.0])
        estimates = tracker.process(scan(second, place + 0.5 * rng.normal(size=2)))
        if second == 19:
            (first,) = estimates[-1].extras['track_id'].tolist()
        if second >= 20 and second % 4 == 0:
            tracker.process(named(second + 0.4, place + 0.2, 5))
    (estimate,) = estimates
    assert estimate.extras['target_id'].tolist() == [5]
    assert estimate.extras['track_id'].tolist() == [first]
    assert estimate.covariance[0, 0, 0] < 0.25  # the scans count, not the transponder alone


@pytest.mark.parametrize('association', BOTH)
def test_two_divers_that_swim_together_stay_two(association):
    tracker = DiverTracker(DiverConfig(association=association, clutter_density=1e-4))
    rng = np.random.default_rng(4)
    for second in range(1, 80):
        place = np.array([0.5 * second, 0.0])
        both = [place + 0.4 * rng.normal(size=2), place + [0.0, 3.0] + 0.4 * rng.normal(size=2)]
        seen = [item for item in both if rng.uniform() < 0.9]
        (estimate,) = tracker.process(scan(second, *seen))
        if second >= 10 and second % 4 == 0:
            tracker.process(named(second + 0.4, place + 0.5 * rng.normal(size=2), 5))
    confirmed = estimate.extras['track_state'] > 0
    assert sorted(estimate.extras['target_id'][confirmed].tolist()) == [NOBODY, 5]


@pytest.mark.parametrize('association', BOTH)
def test_a_name_that_is_said_no_more_is_forgotten_and_the_track_goes_on(association):
    tracker = DiverTracker(DiverConfig(association=association, max_coast=20.0))
    for second in range(1, 60):
        if second < 10:
            tracker.process(named(second - 0.5, (0.3 * second, 0.0), 5))
        (estimate,) = tracker.process(scan(second, (0.3 * second, 0.1 * (second % 2))))
        if second == 25:
            assert 5 in estimate.extras['target_id'].tolist()
    assert estimate.extras['target_id'].tolist() == [NOBODY]
    assert estimate.extras['track_id'].tolist() == [1]


def test_names_without_a_track_are_not_kept():
    """A source that makes up names must not fill the memory."""
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    for second in range(1, 30):
        ids = [1, *range(1000 * second, 1000 * second + 50)]
        places = [(float(k), 0.0) for k in range(len(ids))]
        tracker.process(scan(second, *places, target_id=ids))
    assert len(tracker._stream.state.memory['last_named']) < 100


# -- tags ----------------------------------------------------------------------------------------


def ping(second, places, rng=None):
    """A message with a tag's arrivals for each number in `places`."""
    tx_id, rx_id, toa, rx = [], [], [], []
    for number, place in places.items():
        leg = np.linalg.norm(RX - [*place, 0.0], axis=1) / 1500.0
        noise = 0.0 if rng is None else 1e-4 * rng.normal(size=4)
        toa += (leg - leg.min() + 0.01 + noise).tolist()
        tx_id += [number] * 4
        rx_id += range(4)
        rx += RX.tolist()
    return arrivals(round(second * SECOND), rx, toa, tx_id=tx_id, rx_id=rx_id)


@pytest.mark.parametrize('together', [True, False])
def test_the_number_of_a_tag_leads_its_pings_to_their_own_track(together):
    """Two tags cross; each keeps its track and its number."""
    tracker = DiverTracker(DiverConfig())
    rng = np.random.default_rng(1)
    for k in range(1, 41):
        places = {4: (-20.0 + k, 30.0), 9: (20.0 - k, 30.5)}
        if together:
            (estimate,) = tracker.process(ping(k, places, rng))
        else:
            name = (4, 9)[k % 2]
            (estimate,) = tracker.process(ping(k, {name: places[name]}, rng))
    by_name = dict(zip(estimate.extras['target_id'].tolist(), estimate.state))
    assert sorted(by_name) == [4, 9]
    assert by_name[4][0] == pytest.approx(20.0, abs=1.5)
    assert by_name[9][0] == pytest.approx(-20.0, abs=1.5)
    assert tracker._stream.state.life.next_id == 3  # none was lost and found again


def test_a_tag_without_a_number_is_as_before():
    tracker = DiverTracker(DiverConfig())
    for k in range(1, 10):
        (estimate,) = tracker.process(ping(k, {0: (5.0 + k, 30.0)}))
    assert estimate.extras['target_id'].tolist() == [NOBODY]
    assert len(estimate) == 1


# -- sensors -------------------------------------------------------------------------------------


def test_sensors_have_numbers_of_their_own():
    stated = {
        'sensors': ['radar', 'lidar'], 'radar.fix_std': 4, 'lidar.fix_std': 0.5,
        'radar.detection_probability': 0.5, 'radar.clutter_density': 1e-3,
    }  # fmt: skip
    config = DiverConfig.from_mapping(stated)
    assert stated.items() <= config.as_dict().items()
    assert DiverConfig.from_mapping(config.as_dict()) == config
    radar = config.of_sensor('radar')
    assert (radar.fix_std, radar.detection_probability, radar.clutter_density) == (4.0, 0.5, 1e-3)
    assert config.of_sensor('lidar').detection_probability == config.detection_probability
    assert config.of_sensor('') is config
    spread = {}
    for sensor in ('radar', 'lidar', ''):
        tracker = DiverTracker(config)
        for k in range(1, 10):
            fix = Fix(stamp_ns=k * SECOND, position=(0.1 * k, 0, 0), sensor=sensor, frame_id='m')
            (estimate,) = tracker.process(fix)
        spread[sensor] = estimate.covariance[0, 0, 0]
    assert spread['lidar'] < spread[''] < spread['radar']


def test_the_detection_probability_of_a_sensor_decides_how_soon_existence_fades():
    config = DiverConfig.from_mapping(
        {
            'sensors': ['weak', 'strong'],
            'weak.detection_probability': 0.2,
            'strong.detection_probability': 0.95,
        }
    )
    existence = {}
    for sensor in config.sensors:
        tracker = DiverTracker(config)
        for k in range(1, 10):
            tracker.process(scan(k, (0.1 * k, 0.0), sensor=sensor))
        (estimate,) = tracker.process(scan(10, sensor=sensor))
        existence[sensor] = estimate.extras['existence'].tolist()
    assert existence['weak'][0] > 0.9
    assert not existence['strong'] or existence['strong'][0] < existence['weak'][0]


@pytest.mark.parametrize(
    'values, words',
    [
        ({'sensors': ['a'], 'a.fix_std': -1.0}, "'a.fix_std' must be between"),
        ({'sensors': ['a'], 'b.fix_std': 1.0}, "unknown parameter 'b.fix_std'"),
        ({'sensors': ['a'], 'a.max_tracks': 1}, "unknown parameter 'a.max_tracks'"),
        ({'sensors': 5, 'a.fix_std': 1.0}, "'sensors' must be a list"),
        ({'tags': ('a/b',)}, "'a/b' cannot be part of a topic"),
        ({'transceiver_lever': (1.0,)}, 'needs three values'),
    ],
)
def test_lists_that_do_not_fit_are_named(values, words):
    with pytest.raises(ValueError, match=words.replace('(', r'\(')):
        DiverConfig.from_mapping(values)


def test_what_a_sensor_has_of_its_own_changes_as_what_all_have():
    """`fix_std` may change while a tracker runs, `coverage_file` may not."""
    config = {'sensors': ['a'], 'a.fix_std': 4.0}
    tracker = DiverTracker(DiverConfig.from_mapping(config))
    tracker.reconfigure(DiverConfig.from_mapping({**config, 'a.fix_std': 2.0}))
    assert tracker.config.of_sensor('a').fix_std == 2.0
    with pytest.raises(ValueError, match='coverage_file'):
        tracker.reconfigure(DiverConfig.from_mapping({**config, 'a.coverage_file': 'x.csv'}))
