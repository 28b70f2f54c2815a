# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scans: empty ones, soft association, and fixes that say whose they are."""

from attrs import evolve
from helpers.diver_runs import arrivals, fix, read_only, run, scan_of, SECOND
from helpers.estimates import same
import numpy as np
import pytest

from sonar_imm.estimation.association import TrackStatus
from sonar_imm.measurements import Fixes, NOBODY
from sonar_imm.trackers.diver import clutter, pairing, pruning
from sonar_imm.trackers.diver import tracker as tracker_module
from sonar_imm.trackers.diver.innovations import FixConsistency, MEMORY
from sonar_imm.trackers.diver.known import Known
from sonar_imm.trackers.diver.scan import position_groups, Scan
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS, scenario, simulate

ASSOCIATIONS = ('gnn', 'jipda')


def scan(second, *places, ids=None, std=0.5):
    return scan_of(second, places, std, target_id=ids)


SEEDS = [0, *(pytest.param(k, marks=pytest.mark.statistics) for k in (1, 2, 3))]


def ids_of(estimate):
    return estimate.extras['track_id'].tolist()


def test_a_scan_is_the_same_as_its_fixes_one_by_one():
    scene = simulate(scenario('several', {'duration': 30.0}), seed=2)
    single = [item.measurement for item in scene.measurements]
    scans = []
    for stamp in sorted({item.stamp_ns for item in single}):
        own = sorted((item for item in single if item.stamp_ns == stamp), key=lambda i: i.key())
        position, covariance = zip(*((item.position, item.covariance) for item in own))
        scans.append(
            Fixes(stamp_ns=stamp, position=position, covariance=covariance, frame_id='map')
        )
    first, other = (run(DiverTracker(DiverConfig()), items) for items in (single, scans))
    assert len(first) == len(other) == len(scans)
    assert all(same(*pair) for pair in zip(first, other))


@pytest.mark.parametrize('association', ASSOCIATIONS)
def test_an_empty_scan_is_a_missed_detection(association):
    tracker = DiverTracker(DiverConfig(association=association))
    for second in range(1, 8):
        tracker.process(scan(second, (0.1 * second, 0.0)))
    (estimate,) = tracker.process(scan(8))
    assert estimate.extras['track_state'].tolist() == [TrackStatus.COASTING]
    for second in range(9, 20):
        (estimate,) = tracker.process(scan(second))
    assert len(estimate) == 0 and len(tracker._stream.state.life) == 0


def test_no_scan_is_no_evidence():
    """A gap ends nothing; as many empty scans do."""
    tracker = DiverTracker(DiverConfig(association='jipda'))
    for second in range(1, 8):
        tracker.process(scan(second, (0.1 * second, 0.0)))
    (estimate,) = tracker.process(scan(18, (1.8, 0.0)))
    assert estimate.extras['track_state'].tolist() == [TrackStatus.CONFIRMED]
    assert ids_of(estimate) == [1]


def test_existence_is_published_and_not_a_number_where_hits_are_counted():
    jipda, gnn = (DiverTracker(DiverConfig(association=name)) for name in ('jipda', 'gnn'))
    for second in range(1, 6):
        for tracker in (jipda, gnn):
            (estimate,) = tracker.process(scan(second, (0.0, 0.0)))
            known = estimate.extras['existence']
            assert len(known) == 1 and (np.isfinite(known).all() == (tracker is jipda))
            assert tracker is gnn or 0.5 < known[0] <= 1.0


def test_a_false_fix_in_clutter_is_not_published():
    tracker = DiverTracker(DiverConfig(association='jipda', clutter_density=4e-4))
    (estimate,) = tracker.process(scan(1, (0.0, 0.0)))
    assert len(estimate) == 0
    (row,) = tracker._stream.state['existence']
    assert row == pytest.approx(2e-6 / (2e-6 + 4e-4))


@pytest.mark.parametrize('most', [1, 2])
def test_a_fix_is_of_no_new_diver_where_there_may_be_none(most):
    """The share of one track in one fix, by Bayes: of a second diver only where there may be."""
    densities = {'clutter_density': 1e-5, 'birth_density': 1e-4}
    config = DiverConfig(max_tracks=most, covariance_scales=(1.0, 3.0, 10.0), **densities)
    tracker = DiverTracker(config)
    run(tracker, [scan(second, (0.5 * second, 0.0)) for second in range(1, 11)])
    now = Scan.from_items([scan(11, (7.5, 1.9))], tracker.config)
    known, (group,) = tracker._predict(tracker._stream.state, now, 11 * SECOND), now.fixes
    known = clutter.estimate_densities(known, group)
    assert group.elapsed == 1.0
    pairing.association_stage(tracker.models, 'jipda')(known, group)
    p, r = config.detection_probability, known['existence'][0]
    seen = r * p * np.exp(group.pairs.track_log[0, 0]) / (1e-5 + (most - 1) * 1e-4)
    assert 0.01 < group.association.beta[0, 0] < 0.99
    assert group.association.beta[0, 0] == pytest.approx(seen / (seen + 1.0 - r * p), rel=1e-9)


def test_a_diver_is_confirmed_by_existence_and_evidence():
    tracker = DiverTracker(DiverConfig(association='jipda'))
    states = []
    for second in range(1, 5):
        (estimate,) = tracker.process(scan(second, (0.5 * second, 0.0)))
        states.append(estimate.extras['track_state'].tolist())
    assert states == [[0], [0], [1], [1]]


def confirmed_ids(estimate):
    return estimate.extras['track_id'][estimate.extras['track_state'] > 0].tolist()


def test_a_second_track_on_one_diver_is_not_confirmed():
    tracker = DiverTracker(DiverConfig(association='jipda'))
    confirmed = []
    for second in range(1, 40):
        # Two fixes of one diver, as of two sensors that share a stamp.
        (estimate,) = tracker.process(scan(second, (0.3 * second, 0.0), (0.3 * second, 0.05)))
        confirmed.append(confirmed_ids(estimate))
    assert confirmed[2:] == [[1]] * 37


def test_two_confirmed_tracks_on_one_diver_become_the_older_one():
    tracker = DiverTracker(DiverConfig(association='jipda'))
    confirmed = []
    for second in range(1, 60):
        apart = max(0.0, 6.0 - 0.4 * second)
        (estimate,) = tracker.process(scan(second, (0.0, 0.0), (apart, 0.0)))
        confirmed.append(confirmed_ids(estimate))
    assert confirmed[5] == [1, 2] and confirmed[14] == [1, 2]
    assert confirmed[-1] == [1]


@pytest.mark.statistics
def test_crossing_in_clutter_is_better_softly():
    from benchmarks.diver_accuracy import identities

    known = {'detection_probability': 0.7, 'clutter_density': 10.0 / 160.0**2}
    gnn, jipda = (
        identities('crossing', 2, association=name, model_set='heading_speed', **known)
        for name in ASSOCIATIONS
    )
    assert jipda['GOSPA, rms'] <= 3.4 < 4.0 < gnn['GOSPA, rms']
    assert jipda['false tracks/h'] == 0.0
    assert jipda['NEES'] < 2.6


def test_a_smoother_takes_scans_and_hides_what_does_not_exist():
    scene = simulate(scenario('crossing', {'duration': 12.0}), seed=1)
    config = DiverConfig(association='jipda', **scenario('crossing').instruments())
    tracker = SmoothingDiverTracker(config)
    forward = run(tracker, [item.measurement for item in scene.measurements])
    smooth = tracker.smoothed()
    assert [ids_of(item) for item in smooth] == [ids_of(item) for item in forward]


def test_named_fixes_make_a_track_each_though_they_cross_and_come_in_turn():
    tracker = DiverTracker(DiverConfig())
    for second in range(1, 60):
        name = second % 4
        place = (0.1 * second * (-1) ** name, 0.2 * name)
        (estimate,) = tracker.process(scan(second, place, ids=[name]))
    assert sorted(estimate.extras['target_id'].tolist()) == [0, 1, 2, 3]
    assert (estimate.extras['track_state'] > 0).all()
    assert tracker._stream.state.life.next_id == 5  # none was lost and found again


@pytest.mark.parametrize('association', ASSOCIATIONS)
def test_a_named_track_goes_on_while_another_name_is_heard(association):
    tracker = DiverTracker(DiverConfig(association=association))
    for second in range(1, 6):
        tracker.process(scan(second, (0.0, 0.0), ids=[9]))
    (estimate,) = tracker.process(scan(24, (50.0, 0.0), ids=[5]))
    assert (estimate.extras['target_id'] == 9).sum() == 1


def test_a_scan_with_names_and_without():
    tracker = DiverTracker(DiverConfig())
    for second in range(1, 10):
        places = ((0.1 * second, 0.0), (20.0, 20.0), (0.1 * second, 0.1))
        (estimate,) = tracker.process(scan(second, *places, ids=[3, -1, 3]))
    assert sorted(estimate.extras['target_id'].tolist()) == [-1, 3]
    assert len(estimate) == 2


def test_existence_of_a_track_that_was_counted_is_guessed_from_its_state():
    tracker = DiverTracker(DiverConfig())
    tracker.process(scan(1, (0.0, 0.0), (20.0, 0.0), (40.0, 0.0)))
    known, (group,) = tracker._stream.state, Scan.from_items([scan(2)], tracker.config).fixes
    status = [TrackStatus.TENTATIVE, TrackStatus.CONFIRMED, TrackStatus.CONFIRMED]
    known = known.replace(life=evolve(known.life, status=np.array(status, np.uint8)))
    known = known.with_columns(existence=np.array([np.nan, np.nan, 0.3]))
    pairing.association_stage(tracker.models, 'jipda')(known, group)
    r, missed = np.array([0.5, 0.9, 0.3]), 1.0 - tracker.config.detection_probability
    np.testing.assert_allclose(group.association.exists, r * missed / (r * missed + 1.0 - r))


def test_what_is_stated_is_scaled_in_scans_as_in_single_fixes():
    config = DiverConfig(fix_std=2.0, covariance_scale=3.0)
    places = (0.0, 0.0), (9.0, 0.0), (0.0, 9.0)
    stated = np.array([0.25, np.nan, 1.0])[:, None, None] * np.eye(2)
    expected = 3.0 * np.array([0.25, 4.0, 1.0])[:, None, None] * np.eye(2)
    for ids in (None, [6, 7, 8], [NOBODY] * 3):
        item = evolve(scan(1, *places, ids=ids), covariance=stated)
        (group,) = position_groups([item], config)
        assert group.R == pytest.approx(expected)


def test_a_named_diver_is_never_the_one_too_many():
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    for second in range(1, 12):
        tracker.process(scan(second, (0.1 * second, 0.0)))
    for second in range(12, 20):
        both = scan(second, (0.1 * second, 0.0), (60.0, 5.0), ids=[NOBODY, 6])
        (estimate,) = tracker.process(both)
    followed = estimate.extras['track_state'] != TrackStatus.TENTATIVE
    assert estimate.extras['target_id'][followed].tolist() == [6]


def test_tracks_whose_numbers_are_not_finite_end_and_are_counted(monkeypatch):
    tracker = DiverTracker(DiverConfig())
    for second in range(1, 6):
        tracker.process(scan(second, (0.1 * second, 0.0), (40.0, 0.0)))
    with monkeypatch.context() as patch:
        patch.setattr(Known, 'is_finite', lambda known: np.arange(len(known)) != 1)
        (estimate,) = tracker.process(scan(6, (0.6, 0.0), (40.0, 0.0)))
    assert ids_of(estimate) == [1] and tracker.health()['broken_tracks'] == 1
    (estimate,) = tracker.process(scan(7, (0.7, 0.0), (40.0, 0.0)))
    assert 2 not in ids_of(estimate) and tracker.health()['broken_tracks'] == 1


def ping(second):
    """The echoes of a diver at (20, 30, -2) at four receivers."""
    leg = np.linalg.norm(RECEIVERS - [20.0, 30.0, -2.0], axis=1)
    return arrivals(second * SECOND, RECEIVERS, (leg + leg[0]) / 1500.0, tx=RECEIVERS[0])


@pytest.mark.parametrize('association, dimensions', [('gnn', 2), ('jipda', 3)])
def test_a_scan_changes_nothing_of_the_state_before_it(association, dimensions):
    """States are values: those in the history are what a late measurement is replayed from."""
    config = DiverConfig(
        association=association, target_z=-2.0, dimensions=dimensions,
        coverage_sector=(0.0, 0.0, 0.0, 360.0, 0.0, 60.0), bearing_bias_std_deg=1.0,
        fix_bias_std=0.2,
    )  # fmt: skip
    tracker = DiverTracker(config)
    for second in range(1, 40):
        assert read_only(tracker._stream.state) > 20
        jump = 40.0 * (second > 25)
        places = (20.0 + jump, 30.0), (30.0, 5.0 + second), (4.0 * second, 2.0)
        covariance = np.tile(0.25 * np.eye(3), (3, 1, 1))
        seen = evolve(scan(second, *places, ids=[NOBODY, 7, NOBODY]), covariance=covariance)
        tracker.process(ping(second) if second % 3 == 0 else seen)
    tracker.process(scan(41))


def test_arrivals_are_judged_where_no_fix_says_the_same():
    tracker = DiverTracker(DiverConfig(target_z=-2.0))
    for second in range(1, 9):
        tracker.process(scan(second, (20.0, 30.0)))
        tracker.process(ping(second))
    assert np.isnan(tracker.health()['arrivals_mean_nis'])
    tracker.process(ping(9))
    alone = tracker.health()['arrivals_mean_nis']
    assert alone < 1.0
    tracker.process(scan(10, (20.0, 30.0)))
    tracker.process(scan(11, (20.0, 30.0)))
    tracker.process(ping(11))
    assert tracker.health()['arrivals_mean_nis'] == alone
    tracker.process(ping(12))
    assert tracker.health()['arrivals_mean_nis'] != alone


def test_the_score_of_a_track_is_that_of_its_last_scans():
    tracker, scores = DiverTracker(DiverConfig(association='gnn', history=0.0)), []
    for second in range(1, 101):
        tracker.process(scan(second, (0.0, 0.0)))
        scores.append(tracker._stream.state['score'][0])
    assert scores[9] > 5.0 * scores[1] > 0.0
    assert scores[-1] == pytest.approx(scores[-2], rel=1e-3)  # it does not grow with the dive


def test_repairs_of_every_step_of_a_gap_are_counted(monkeypatch):
    tracker = DiverTracker(DiverConfig(history=0.0))
    for second in (1, 2):
        tracker.process(scan(second, (0.0, 0.0)))
    real, steps = tracker_module.predict_over, 0

    def crossed(*arguments):
        nonlocal steps
        made = real(*arguments)
        steps = len(made)
        return [step._replace(repairs=k) for k, step in enumerate(made, start=1)]

    monkeypatch.setattr(tracker_module, 'predict_over', crossed)
    tracker.process(scan(8, (0.0, 0.0)))
    assert steps > 2
    assert tracker.health()['covariance_repairs'] == steps * (steps + 1) // 2


def test_scans_near_another_track_are_counted_for_each_partner_alone():
    """1 and 2 lie apart, 3 beside 2, 4 beside 1; who each was near before, and for how long."""
    nobody = DiverTracker(DiverConfig())._stream.state
    mean = np.array([[0.0, 0.0], [50.0, 0.0], [50.1, 0.0], [0.1, 0.0]])
    now = nobody.replace(life=evolve(nobody.life, track_id=np.array([1, 2, 3, 4], np.uint32)))
    before = {'near_to': np.array([0, 1, 1, 1]), 'near_for': np.array([0, 5, 5, 5])}
    now = now.with_columns(target_id=np.full(4, NOBODY), **before)
    tentative, wide = np.zeros(4, bool), np.tile(np.eye(2), (4, 1, 1))
    near_to, near_for = pruning.count_near_scans(now, tentative, mean, wide, [])
    assert near_to.tolist() == [0, 0, 2, 1]
    assert near_for.tolist() == [0, 0, 1, 6]


def test_warnings_of_fixes_need_evidence_and_a_bias_that_is_not_stated():
    pessimistic = FixConsistency(MEMORY, 0.4 * MEMORY, MEMORY, 0.0, MEMORY)
    lasting = FixConsistency(MEMORY, 0.9 * MEMORY, MEMORY, 0.4 * MEMORY, MEMORY)
    for item in (pessimistic, lasting):
        assert 'set fix_bias_std' in item.warnings(False, 10.0)[0]
        assert item.warnings(True, 10.0) == []
        assert item._replace(number=0.9 * MEMORY).warnings(False, 10.0) == []
    optimistic = FixConsistency(MEMORY, 2.0 * MEMORY, MEMORY, 0.0, MEMORY)
    for stated in (False, True):
        assert 'Increase covariance_scale' in optimistic.warnings(stated, 10.0)[0]
    for correlation in (0.0, 0.4):  # large and correlated: a motion that no model has
        plain = FixConsistency(MEMORY, 1.1 * MEMORY, MEMORY, correlation * MEMORY, MEMORY)
        assert plain.warnings(False, 10.0) == []


def beside_each_other(seed, seen, std=0.15, detection_probability=0.95, clutter=0.0):
    """Scans of divers 0.4 m apart, as many as `seen` says each second, in a square of 50 m."""
    rng = np.random.default_rng(seed)
    for second, count in enumerate(seen, start=1):
        places = np.array([[0.5 * second, 0.4 * number] for number in range(count)])
        places = places[rng.uniform(size=count) < detection_probability]
        places = places + std * rng.normal(size=places.shape)
        false = [0.5 * second, 0.0] + rng.uniform(-25.0, 25.0, (rng.poisson(clutter), 2))
        yield scan_of(second, np.vstack([places, false]), std)


def confirmed_by_jipda(scans, **values):
    """How many divers are confirmed after each scan, and who ever was."""
    config = DiverConfig(association='jipda', **values)
    tracker, counts, ids = DiverTracker(config), [], set()
    for item in scans:
        (estimate,) = tracker.process(item)
        followed = estimate.extras['track_state'] != TrackStatus.TENTATIVE
        counts.append(int(followed.sum()))
        ids.update(estimate.extras['track_id'][followed].tolist())
    return np.array(counts), ids


@pytest.mark.parametrize('seed', SEEDS[:4])
@pytest.mark.parametrize('std', [0.1, 0.3])
def test_jipda_keeps_two_divers_that_are_seen_in_the_same_scans(seed, std):
    """Their tracks are nearer to each other than any two of one diver may be."""
    counts, ids = confirmed_by_jipda(beside_each_other(seed, [2] * 80, std), clutter_density=1e-4)
    assert (counts[10:] == 2).mean() > 0.98 and len(ids) == 2


@pytest.mark.parametrize('seed', SEEDS[:2])
def test_jipda_keeps_two_divers_that_are_seldom_both_detected(seed):
    scans = beside_each_other(seed, [2] * 150, detection_probability=0.6)
    told = {'clutter_density': 1e-4, 'birth_density': 1e-5}
    counts, _ = confirmed_by_jipda(scans, detection_probability=0.6, **told)
    both = int(np.flatnonzero(counts == 2)[0])
    assert both < 60 and (counts[both:] == 2).all()


@pytest.mark.parametrize('clutter', [0.0, 4.0])
@pytest.mark.parametrize('seed', SEEDS[:3])
def test_jipda_merges_two_tracks_of_one_diver(seed, clutter):
    """A diver who gave two echoes for a while, then one."""
    scans = beside_each_other(seed, [2] * 30 + [1] * 30, clutter=clutter)
    density = max(clutter, 0.25) / 2500.0
    counts, _ = confirmed_by_jipda(scans, clutter_density=density)
    assert counts[29] == 2 and (counts[45:] == 1).all()


def polled(seed, divers=3, seconds=60, detection_probability=0.95, std=0.3):
    """Fixes of divers 20 m apart by a sensor that looks at one after the other, once a second."""
    rng = np.random.default_rng(seed)
    for turn in range(5, 5 + seconds):
        for diver in np.flatnonzero(rng.uniform(size=divers) < detection_probability):
            when = turn + (diver + 0.5) / divers + 0.01 * rng.normal()
            across = 20.0 * diver + std * rng.normal()
            yield fix(when, 0.5 * when, across, std**2 * np.eye(2))


def missed(made, divers=3):
    """Share of divers without a confirmed track within 3 m, after 20 s; who was confirmed."""
    shares, ids = [], set()
    for estimate in [item for item in made if item.stamp_ns > 25 * SECOND]:
        followed = estimate.extras['track_state'] > 0
        ids.update(estimate.extras['track_id'][followed].tolist())
        across = estimate.state[followed, 1]
        shares.append(np.mean([not (abs(across - 20.0 * k) < 3.0).any() for k in range(divers)]))
    return float(np.mean(shares)), ids


@pytest.mark.parametrize('seed', SEEDS[:2])
def test_fixes_of_a_sensor_that_polls_are_gathered_to_scans(seed):
    """Tracks starve where each fix is a scan."""
    hits, alone = (
        missed(run(DiverTracker(DiverConfig(association=name)), polled(seed)))[0]
        for name in ('gnn', 'jipda')
    )
    made = run(DiverTracker(DiverConfig(scan_period=1.0)), polled(seed))
    gathered, ids = missed(made)
    assert min(hits, alone) > 0.3 and gathered < 0.01 and len(ids) == 3
    assert {item.stamp_ns % SECOND for item in made} == {SECOND // 2}


def test_gathered_scans_are_the_same_in_any_order_and_as_those_gathered_by_hand():
    config, items = DiverConfig(scan_period=1.0), list(polled(3, seconds=30))
    order = np.argsort(np.arange(len(items)) + np.random.default_rng(1).uniform(0, 9, len(items)))
    first = run(DiverTracker(config), items)
    other = run(DiverTracker(config), [items[k] for k in order])
    half = SECOND // 2
    middle = [evolve(item, stamp_ns=item.stamp_ns // SECOND * SECOND + half) for item in items]
    by_hand = run(DiverTracker(DiverConfig()), middle)
    for made in (other, by_hand):
        assert len(made) == len(first) and all(same(*pair) for pair in zip(first, made))


def test_fixes_with_a_name_keep_their_stamps():
    tracker = DiverTracker(DiverConfig(scan_period=1.0))
    (estimate,) = tracker.process(evolve(fix(5.2, 0.0, 0.0), target_id=4))
    assert estimate.stamp_ns == round(5.2 * SECOND)
