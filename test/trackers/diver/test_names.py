# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Names of fixes and tags, sensors with numbers of their own, and tracks begun by a start."""

import itertools

from attrs import evolve
from helpers.diver_runs import arrivals, fix, scan
import numpy as np
import pytest

from sonar_imm.measurements import Fix, NOBODY, Start
from sonar_imm.trackers.diver.names import scans_to_merge
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS

SECOND = 10**9
BOTH = ('gnn', 'jipda')


def named(second, place, name):
    return evolve(fix(second, *place), target_id=name)


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


def ping(second, places, rng=None):
    """A message with a tag's arrivals for each number in `places`."""
    tx_id, rx_id, toa, rx = [], [], [], []
    for number, place in places.items():
        leg = np.linalg.norm(RECEIVERS - [*place, 0.0], axis=1) / 1500.0
        noise = 0.0 if rng is None else 1e-4 * rng.normal(size=4)
        toa += (leg - leg.min() + 0.01 + noise).tolist()
        tx_id += [number] * 4
        rx_id += range(4)
        rx += RECEIVERS.tolist()
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
    stated = {'weak.detection_probability': 0.2, 'strong.detection_probability': 0.95}
    config = DiverConfig.from_mapping({'sensors': ['weak', 'strong'], **stated})
    existence = {}
    for sensor in config.sensors:
        tracker = DiverTracker(config)
        for k in range(1, 10):
            tracker.process(scan(k, (0.1 * k, 0.0), sensor=sensor))
        (estimate,) = tracker.process(scan(10, sensor=sensor))
        existence[sensor] = estimate.extras['existence'].tolist()
    assert existence['weak'][0] > 0.9
    assert not existence['strong'] or existence['strong'][0] < existence['weak'][0]


def test_what_a_sensor_has_of_its_own_changes_as_what_all_have():
    """`fix_std` may change while a tracker runs, `coverage_file` may not."""
    config = {'sensors': ['a'], 'a.fix_std': 4.0}
    tracker = DiverTracker(DiverConfig.from_mapping(config))
    tracker.reconfigure(DiverConfig.from_mapping({**config, 'a.fix_std': 2.0}))
    assert tracker.config.of_sensor('a').fix_std == 2.0
    with pytest.raises(ValueError, match='coverage_file'):
        tracker.reconfigure(DiverConfig.from_mapping({**config, 'a.coverage_file': 'x.csv'}))


CONFIRMED, COASTING = 1, 2


def start(second, x, y=0.0, sigma=1.0):
    return Start(
        stamp_ns=round(second * SECOND),
        position=[x, y, 0.0],
        covariance=np.eye(2) * sigma**2,
        frame_id='map',
    )


def named_fix(second, x, y=0.0, name=NOBODY):
    return evolve(fix(second, x, y, 0.04 * np.eye(2)), target_id=name)


def run(measurements, **options):
    tracker = DiverTracker(DiverConfig(**options))
    newest = [tracker.process(item)[-1] for item in measurements][-1]
    return tracker, newest


@pytest.mark.parametrize(
    'options',
    [{}, {'association': 'jipda'}, {'association': 'gnn'}, {'dimensions': 3}, {'max_tracks': 1}],
)
def test_a_track_begins_confirmed_at_the_place_and_follows_the_fixes_after_it(options):
    tracker, first = run([start(1, 5.0, 7.0, sigma=2.0)], **options)
    assert first.extras['track_state'].tolist() == [CONFIRMED]
    assert first.xyz[0, :2] == pytest.approx([5.0, 7.0])
    assert first.covariance[0, :2, :2] == pytest.approx(np.eye(2) * 4.0)
    for second in range(2, 12):
        last = tracker.process(named_fix(second, 5.0 + 0.5 * second, 7.0))[-1]
    assert last.extras['track_id'].tolist() == [1]  # the start's own: no fix began another
    assert last.xyz[0, :2] == pytest.approx([10.5, 7.0], abs=0.5)


def test_without_a_start_the_same_fix_makes_a_tentative_track():
    _, first = run([named_fix(1, 5.0, 7.0)])
    assert first.extras['track_state'].tolist() == [0]


def test_the_track_that_is_there_gives_way_and_others_stay():
    walk = [named_fix(k, x) for k in range(1, 8) for x in (0.0, 50.0)]
    _, before = run(walk)
    _, after = run([*walk, start(7.5, 0.3)])
    assert before.extras['track_id'].tolist() == [1, 2]
    assert after.extras['track_id'].tolist() == [2, 3]
    assert after.xyz[:, 0] == pytest.approx([50.0, 0.3], abs=0.1)


def test_with_one_diver_the_start_is_where_it_is_however_far():
    walk = [named_fix(k, 0.0) for k in range(1, 8)]
    _, after = run([*walk, start(7.5, 300.0)], max_tracks=1)
    assert after.extras['track_id'].tolist() == [2]
    assert after.xyz[0, 0] == pytest.approx(300.0, abs=1e-9)
    _, several = run([*walk, start(7.5, 300.0)])
    assert several.extras['track_id'].tolist() == [1, 2]


def test_a_diver_that_has_a_name_keeps_its_track():
    walk = [named_fix(k, 0.0, name=4) for k in range(1, 8)]
    _, after = run([*walk, start(7.5, 0.1)])
    assert after.extras['target_id'].tolist() == [4, NOBODY]


def test_too_many_are_counted_and_said():
    tracker, last = run([start(1 + 0.1 * k, 100.0 * k) for k in range(5)], max_tracks=3)
    assert last.extras['track_id'].tolist() == [1, 2, 3]
    assert tracker.health()['not_started'] == 2
    assert tracker.warnings() == [
        '2 starts ignored: max_tracks (3) tracks are confirmed. Increase max_tracks'
    ]


def test_names_without_end_are_counted_and_said():
    """Each fix has a name of its own: a driver that numbers its fixes, not its targets."""
    tracker, last = run(
        [named_fix(1 + 0.01 * k, 100.0 * k, name=k + 1) for k in range(30)], max_tracks=3
    )
    assert len(last) == 25
    assert tracker.health()['names_without_track'] == 5
    (sentence,) = tracker.warnings()
    assert sentence.startswith('5 positions with a name of their own started no track')


def test_a_start_is_no_missed_detection():
    walk = [named_fix(k, 0.0) for k in range(1, 8)]
    _, after = run([*walk, *(start(7.5 + 0.01 * k, 500.0 + 50.0 * k) for k in range(12))])
    assert after.extras['track_state'][0] == CONFIRMED


def test_the_order_of_arrival_changes_nothing():
    items = [
        named_fix(1, 0.0),
        named_fix(2, 0.2),
        start(2, 30.0),
        start(2.5, 0.5),
        named_fix(3, 0.4),
        named_fix(3, 30.1),
    ]
    _, expected = run(items)
    for order in itertools.islice(itertools.permutations(items), 0, 720, 79):
        tracker = DiverTracker(DiverConfig())
        for item in order:
            last = tracker.process(item)[-1]
        if last.stamp_ns == 3 * SECOND:
            assert (last.state == expected.state).all()
            assert last.extras['track_id'].tolist() == expected.extras['track_id'].tolist()


def test_a_start_may_stand_in_a_smoothed_run():
    smoother = SmoothingDiverTracker(DiverConfig())
    for item in [start(1, 0.0), *(named_fix(k, 0.5 * k) for k in range(2, 9)), start(9, 60.0)]:
        smoother.process(item)
    made = list(smoother.smoothed())
    assert [len(item) for item in made] == [1] * 8 + [2]
    assert all(np.isfinite(item.state).all() for item in made)
