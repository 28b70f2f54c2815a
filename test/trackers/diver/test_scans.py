# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scans: empty ones, soft association, fixes that say whose they are, and the density of false
fixes."""

from attrs import evolve
from helpers.diver_runs import arrivals, fix, followed, read_only, run, scan, scan_of, SECOND
from helpers.estimates import same
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.estimation.association import TrackStatus
from sonar_imm.measurements import Fixes, NOBODY
from sonar_imm.trackers.diver import clutter, pairing, pruning
from sonar_imm.trackers.diver import tracker as tracker_module
from sonar_imm.trackers.diver.clutter import Clutter, Clutters
from sonar_imm.trackers.diver.config import CLUTTER
from sonar_imm.trackers.diver.innovations import FixConsistency, MEMORY
from sonar_imm.trackers.diver.scan import position_groups, Scan
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS, scenario, simulate

ASSOCIATIONS = ('gnn', 'jipda')
JIPDA = DiverConfig(association='jipda')
SEEDS = [0, *(pytest.param(k, marks=pytest.mark.statistics) for k in (1, 2, 3))]


def ids_of(estimate, least=TrackStatus.TENTATIVE):
    return estimate.extras['track_id'][estimate.extras['track_state'] >= least].tolist()


def confirmed(made):
    return [ids_of(estimate, TrackStatus.CONFIRMED) for estimate in made]


def swum(last, step=0.1):
    """Scans of a diver who swims east, until the second `last`."""
    return [scan(second, (step * second, 0.0)) for second in range(1, last + 1)]


def test_a_scan_is_the_same_as_its_fixes_one_by_one():
    scene = simulate(scenario('several', {'duration': 30.0}), seed=2)
    single = [item.measurement for item in scene.measurements]
    scans = []
    for stamp in sorted({item.stamp_ns for item in single}):
        own = sorted((item for item in single if item.stamp_ns == stamp), key=lambda i: i.key())
        position, covariance = zip(*((item.position, item.covariance) for item in own))
        known = {'position': position, 'covariance': covariance, 'frame_id': 'map'}
        scans.append(Fixes(stamp_ns=stamp, **known))
    first, other = (run(DiverTracker(DiverConfig()), items) for items in (single, scans))
    assert len(first) == len(other) == len(scans)
    assert all(map(same, first, other))


@pytest.mark.parametrize('association', ASSOCIATIONS)
def test_existence_is_published_and_not_a_number_where_hits_are_counted(association):
    made = run(DiverTracker(DiverConfig(association=association)), swum(5, 0.5))
    for estimate in made:
        (known,) = estimate.extras['existence']
        assert np.isnan(known) if association == 'gnn' else 0.5 < known <= 1.0
    states = [each.extras['track_state'].tolist() for each in made]
    assert association == 'gnn' or states == [[0], [0], [1], [1], [1]]


@pytest.mark.parametrize('association', ASSOCIATIONS)
def test_an_empty_scan_is_a_missed_detection_and_no_scan_no_evidence(association):
    tracker = DiverTracker(DiverConfig(association=association))
    made = followed(tracker, [*swum(7), *map(scan, range(8, 20))])
    assert made[7].extras['track_state'].tolist() == [TrackStatus.COASTING]
    assert len(made[-1]) == 0 and len(tracker._stream.state.life) == 0
    tracker.reset()
    *_, estimate = run(tracker, [*swum(7), scan(18, (1.8, 0.0))])
    assert estimate.extras['track_state'].tolist() == [TrackStatus.CONFIRMED]
    assert ids_of(estimate) == [1]


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
    run(tracker, swum(10, 0.5))
    now = Scan.from_items([scan(11, (7.5, 1.9))], tracker.config)
    known, (group,) = tracker._predict(tracker._stream.state, now, 11 * SECOND), now.fixes
    known = clutter.estimate_densities(known, group)
    assert group.elapsed == 1.0
    pairing.association_stage(tracker.models, 'jipda')(known, group)
    p, r = config.detection_probability, known['existence'][0]
    seen = r * p * np.exp(group.pairs.track_log[0, 0]) / (1e-5 + (most - 1) * 1e-4)
    assert 0.01 < group.association.beta[0, 0] < 0.99
    assert group.association.beta[0, 0] == pytest.approx(seen / (seen + 1.0 - r * p), rel=1e-9)


def test_a_second_track_on_one_diver_is_not_confirmed():
    # Two fixes of one diver, as of two sensors that share a stamp.
    scans = [scan(k, (0.3 * k, 0.0), (0.3 * k, 0.05)) for k in range(1, 40)]
    assert confirmed(run(DiverTracker(JIPDA), scans))[2:] == [[1]] * 37


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
    tracker, scans = DiverTracker(DiverConfig()), []
    for second in range(1, 60):
        name = second % 4
        scans.append(scan(second, (0.1 * second * (-1) ** name, 0.2 * name), target_id=[name]))
    estimate = run(tracker, scans)[-1]
    assert sorted(estimate.extras['target_id'].tolist()) == [0, 1, 2, 3]
    assert (estimate.extras['track_state'] > 0).all()
    assert tracker._stream.state.life.next_id == 5  # none was lost and found again


@pytest.mark.parametrize('association', ASSOCIATIONS)
def test_a_named_track_goes_on_while_another_name_is_heard(association):
    tracker = DiverTracker(DiverConfig(association=association))
    heard = [scan(second, (0.0, 0.0), target_id=[9]) for second in range(1, 6)]
    estimate = run(tracker, [*heard, scan(24, (50.0, 0.0), target_id=[5])])[-1]
    assert (estimate.extras['target_id'] == 9).sum() == 1


def test_a_scan_with_names_and_without():
    scans = []
    for second in range(1, 10):
        places = ((0.1 * second, 0.0), (20.0, 20.0), (0.1 * second, 0.1))
        scans.append(scan(second, *places, target_id=[3, -1, 3]))
    estimate = run(DiverTracker(DiverConfig()), scans)[-1]
    assert sorted(estimate.extras['target_id'].tolist()) == [-1, 3]


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
        item = evolve(scan(1, *places, target_id=ids), covariance=stated)
        (group,) = position_groups([item], config)
        assert group.R == pytest.approx(expected)


def test_a_named_diver_is_never_the_one_too_many():
    named = {'target_id': [NOBODY, 6]}
    both = [scan(second, (0.1 * second, 0.0), (60.0, 5.0), **named) for second in range(12, 20)]
    estimate = run(DiverTracker(DiverConfig(max_tracks=1)), [*swum(11), *both])[-1]
    followed = estimate.extras['track_state'] != TrackStatus.TENTATIVE
    assert estimate.extras['target_id'][followed].tolist() == [6]


@pytest.mark.filterwarnings('ignore:invalid value')
def test_tracks_whose_numbers_are_not_finite_end_and_are_counted():
    for what, at in (('x', (0, 5)), ('P', (0, 0, 3))):
        tracker = DiverTracker(DiverConfig(model_set='heading_speed'))
        *scans, broken, last = (scan(k, (0.1 * k, 0.0), (40.0, 0.0)) for k in range(1, 8))
        run(tracker, scans)
        (block,) = tracker._stream.state.rows.blocks
        getattr(block, what)[(1, *at)] = np.nan if what == 'x' else np.inf
        for item in (broken, last):
            (estimate,) = tracker.process(item)
            assert 1 in ids_of(estimate) and 2 not in ids_of(estimate)
            assert tracker.health()['broken_tracks'] == 1


def ping(second):
    leg = np.linalg.norm(RECEIVERS - [20.0, 30.0, -2.0], axis=1)
    return arrivals(second * SECOND, RECEIVERS, (leg + leg[0]) / 1500.0, tx=RECEIVERS[0])


def fixed(second):
    return scan(second, (20.0, 30.0))


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
        seen = evolve(scan(second, *places, target_id=[NOBODY, 7, NOBODY]), covariance=covariance)
        tracker.process(ping(second) if second % 3 == 0 else seen)
    tracker.process(scan(41))


def test_arrivals_are_judged_where_no_fix_says_the_same():
    tracker = DiverTracker(DiverConfig(target_z=-2.0))

    def nis(*measurements):
        run(tracker, measurements)
        return tracker.health()['arrivals_mean_nis']

    both = [make(second) for second in range(1, 9) for make in (fixed, ping)]
    assert np.isnan(nis(*both))
    alone = nis(ping(9))
    assert alone < 1.0
    assert nis(fixed(10), fixed(11), ping(11)) == alone
    assert nis(ping(12)) != alone


def test_the_score_of_a_track_is_that_of_its_last_scans():
    tracker, scores = DiverTracker(DiverConfig(association='gnn', history=0.0)), []
    for item in swum(100, 0.0):
        tracker.process(item)
        scores.append(tracker._stream.state['score'][0])
    assert scores[9] > 5.0 * scores[1] > 0.0
    assert scores[-1] == pytest.approx(scores[-2], rel=1e-3)  # it does not grow with the dive


def test_repairs_of_every_step_of_a_gap_are_counted(monkeypatch):
    tracker = DiverTracker(DiverConfig(history=0.0))
    run(tracker, swum(2, 0.0))
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
    apart = np.zeros(4, bool), mean, np.tile(np.eye(2), (4, 1, 1)), []
    near_to, near_for = pruning.count_near_scans(now, *apart)
    assert near_to.tolist() == [0, 0, 2, 1]
    assert near_for.tolist() == [0, 0, 1, 6]


def test_warnings_of_fixes_need_evidence_and_a_bias_that_is_not_stated():
    def consistency(square, cross=0.0):
        return FixConsistency(MEMORY, square * MEMORY, MEMORY, cross * MEMORY, MEMORY)

    for item in (consistency(0.4), consistency(0.9, 0.4)):  # pessimistic, lasting
        assert 'set fix_bias_std' in item.warnings(False, 10.0)[0]
        assert item.warnings(True, 10.0) == []
        assert item._replace(number=0.9 * MEMORY).warnings(False, 10.0) == []
    for stated in (False, True):
        assert 'Increase covariance_scale' in consistency(2.0).warnings(stated, 10.0)[0]
    for cross in (0.0, 0.4):  # large and correlated: a motion that no model has
        assert consistency(1.1, cross).warnings(False, 10.0) == []


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
    made = run(DiverTracker(evolve(JIPDA, **values)), scans)
    ids = confirmed(made)
    return np.array(list(map(len, ids))), set().union(*ids)


@pytest.mark.parametrize('seed', SEEDS)
def test_jipda_keeps_two_divers_that_are_seen_in_the_same_scans(seed):
    """Their tracks are nearer to each other than any two of one diver may be."""
    counts, ids = confirmed_by_jipda(beside_each_other(seed, [2] * 80, 0.3), clutter_density=1e-4)
    assert (counts[10:] == 2).mean() > 0.98 and len(ids) == 2


@pytest.mark.parametrize('seed', SEEDS[:2])
def test_jipda_keeps_two_divers_that_are_seldom_both_detected(seed):
    scans = beside_each_other(seed, [2] * 150, detection_probability=0.6)
    told = {'clutter_density': 1e-4, 'birth_density': 1e-5}
    counts, _ = confirmed_by_jipda(scans, detection_probability=0.6, **told)
    both = int(np.flatnonzero(counts == 2)[0])
    assert both < 60 and (counts[both:] == 2).all()


def polled(seed, seconds=60):
    """Fixes of divers 20 m apart by a sensor that looks at one after the other, once a second."""
    rng = np.random.default_rng(seed)
    for turn in range(5, 5 + seconds):
        for diver in np.flatnonzero(rng.uniform(size=3) < 0.95):
            when = turn + (diver + 0.5) / 3 + 0.01 * rng.normal()
            across = 20.0 * diver + 0.3 * rng.normal()
            yield fix(when, 0.5 * when, across, 0.09 * np.eye(2))


def missed(made):
    """Share of divers without a confirmed track within 3 m, after 20 s; who was confirmed."""
    shares, ids = [], set()
    for estimate in [item for item in made if item.stamp_ns > 25 * SECOND]:
        followed = estimate.extras['track_state'] > 0
        ids.update(estimate.extras['track_id'][followed].tolist())
        off = np.abs(estimate.state[followed, 1] - 20.0 * np.arange(3)[:, None])
        shares.append(np.mean(~(off < 3.0).any(axis=1)))
    return float(np.mean(shares)), ids


@pytest.mark.parametrize('seed', SEEDS[:2])
def test_fixes_of_a_sensor_that_polls_are_gathered_to_scans(seed):
    """Tracks starve where each fix is a scan."""
    each = {'association': 'gnn'}, {'association': 'jipda'}, {'scan_period': 1.0}
    *alone, made = (run(DiverTracker(DiverConfig(**how)), polled(seed)) for how in each)
    gathered, ids = missed(made)
    assert min(missed(each)[0] for each in alone) > 0.3 and gathered < 0.01 and len(ids) == 3
    assert {item.stamp_ns % SECOND for item in made} == {SECOND // 2}


def test_gathered_scans_are_the_same_in_any_order_and_as_those_gathered_by_hand():
    config, items = DiverConfig(scan_period=1.0), list(polled(3, seconds=30))
    order = np.argsort(np.arange(len(items)) + np.random.default_rng(1).uniform(0, 9, len(items)))
    first, half = run(DiverTracker(config), items), SECOND // 2
    other = run(DiverTracker(config), [items[k] for k in order])
    middle = [evolve(item, stamp_ns=item.stamp_ns // SECOND * SECOND + half) for item in items]
    by_hand = run(DiverTracker(DiverConfig()), middle)
    for made in (other, by_hand):
        assert len(made) == len(first) and all(map(same, first, made))


def test_fixes_with_a_name_keep_their_stamps():
    tracker = DiverTracker(DiverConfig(scan_period=1.0))
    (estimate,) = tracker.process(evolve(fix(5.2, 0.0, 0.0), target_id=4))
    assert estimate.stamp_ns == round(5.2 * SECOND)


@pytest.mark.parametrize('clutter', [0.0, 4.0])
@pytest.mark.parametrize('seed', SEEDS[:3])
def test_jipda_merges_two_tracks_of_one_diver_to_the_older_one(seed, clutter):
    scans = beside_each_other(seed, [2] * 30 + [1] * 30, clutter=clutter)
    config = evolve(JIPDA, clutter_density=max(clutter, 0.25) / 2500.0)
    made = confirmed(run(DiverTracker(config), scans))
    older = min(made[29])
    assert len(made[29]) == 2 and [len(ids) for ids in made[45:]] == [1] * 15
    if not clutter:
        assert made[45:] == [[older]] * 15


def scans(count, false, half, seed=11, divers=((0.0, 0.0), (0.0, 2.0)), aspect=1.0):
    """Divers who swim along x, seen with .9 to .5 m, and false fixes in a rectangle."""
    rng = np.random.default_rng(seed)
    found = []
    for second in range(1, count + 1):
        there = np.array(divers) + (0.7 * second - 0.35 * count, 0.0)
        there = there[rng.uniform(size=len(there)) < 0.9]
        wild = rng.uniform(-half, half, (rng.poisson(false), 2)) * (1.0, aspect)
        both = np.concatenate([there + rng.normal(scale=0.5, size=there.shape), wild])
        found.append(scan_of(second, both))
    return found


def learnt(items, **settings):
    tracker = DiverTracker(DiverConfig(model_set='heading_speed', **settings))
    made = followed(tracker, items)
    ((_, found),) = tracker._stream.state.memory['clutter'].by_sensor
    return found.density, [(each.extras['track_state'] > 0).sum() for each in made]


@pytest.mark.parametrize('false, half, aspect', [(2, 60, 1.0), (12, 80, 0.4), (5, 400, 1.0)])
def test_the_density_is_found(false, half, aspect):
    items = scans(60, false, half, aspect=aspect)
    density, confirmed = learnt(items, association='jipda')
    truth = max(false / (4.0 * half**2 * aspect), CLUTTER)
    assert 0.6 * truth < density < 1.6 * truth
    assert confirmed[-1] == 2


def test_divers_are_no_clutter():
    density, confirmed = learnt(scans(20, 0.0, 1.0), association='jipda')
    assert clutter.LEAST <= density < CLUTTER
    assert confirmed[5:] == [2] * 15


def test_what_is_stated_stays_and_gnn_learns_nothing():
    items = scans(20, 4.0, 40.0)
    tracker = DiverTracker(evolve(JIPDA, model_set='heading_speed', clutter_density=1e-4))
    run(tracker, items)
    assert tracker._stream.state.memory['clutter'].by_sensor == ()
    configs = [DiverConfig(association='gnn', clutter_density=value) for value in (0.0, CLUTTER)]
    assert all(map(same, *(run(DiverTracker(config), items) for config in configs)))


def test_each_sensor_has_clutter_of_its_own():
    known = {'model_set': 'heading_speed', 'directions': 4, 'association': 'jipda'}
    known |= {'sensors': ['left', 'right'], 'right.clutter_density': 3e-5}
    tracker = DiverTracker(DiverConfig.from_mapping(known))
    for item in scans(10, 4.0, 40.0):
        for late, sensor in enumerate(('left', 'right', '')):
            tracker.process(evolve(item, stamp_ns=item.stamp_ns + late, sensor=sensor))
    assert sorted(dict(tracker._stream.state.memory['clutter'].by_sensor)) == ['', 'left']


def test_the_covariance_is_that_of_the_false_fixes():
    rng, known, all_of_them = np.random.default_rng(5), Clutter(), []
    for _ in range(8):
        z = rng.uniform(-300.0, 300.0, (40, 2)) * (1.0, 0.3) @ [[0.8, 0.6], [-0.6, 0.8]]
        z += (5e5, 6e6)  # far from the origin of the frame
        known, weight = known.with_scan(z, np.full(40, 1.0)), np.exp(-1.0 / 100.0)
        all_of_them = [(w * weight, p) for w, p in all_of_them] + [(1.0, p) for p in z]
    weights = np.array([w for w, _ in all_of_them])
    C = np.cov(np.array([p for _, p in all_of_them]).T, aweights=weights, ddof=0)
    scatter = np.array([[known.xx, known.xy], [known.xy, known.yy]])
    assert scatter == pytest.approx(C * weights.sum(), rel=1e-6)
    assert known.area == pytest.approx(600.0 * 180.0, rel=0.1)


def test_densities_are_bounded():
    rng, known = np.random.default_rng(2), Clutter()
    assert known.density == pytest.approx(CLUTTER, rel=1e-4)
    for _ in range(300):
        known = known.with_scan(rng.normal(scale=0.01, size=(50, 2)), np.ones(50))
    assert known.density == clutter.MOST
    for _ in range(3000):
        known = known.with_scan(np.empty((0, 2)), np.empty(0))
    assert known.density == clutter.LEAST


@pytest.mark.parametrize('false, half, settings, warns', [
    (6.0, 60.0, {}, True), (6.0, 60.0, {'clutter_density': 4e-4}, False),
    (6.0, 60.0, {'association': 'jipda'}, False), (0.1, 60.0, {}, False), (1.0, 900.0, {}, False),
])  # fmt: skip
def test_gnn_says_that_there_is_clutter(false, half, settings, warns):
    known = {'model_set': 'heading_speed', 'directions': 4, 'association': 'gnn'}
    tracker = DiverTracker(DiverConfig(**{**known, **settings}))
    run(tracker, scans(40, false, half))
    (about,) = [text for text in tracker.warnings() if 'clutter_density' in text] or ['']
    assert bool(about) == warns
    # Its own false tracks take a part of them.
    assert not warns or 0.5 * false < float(about.split()[0]) < 1.2 * false


def remembered(points, weight, scans, whole):
    """Statistics that remember false fixes, with `whole` as the density of the sensor."""

    class Known(Clutter):
        density = whole

    return Known(scans=scans, points=points, weight=weight)


def test_the_density_at_a_fix_is_that_of_an_independent_program():
    v = load_vectors('diver_in_the_field/density')
    known = remembered(v['points'], v['weight'], float(v['scans']) - 5.0, float(v['whole']))
    found = known.density_at(v['z'], v['R'])
    assert found == pytest.approx(v['density'], rel=1e-12)
    assert len(np.unique(found)) > 5
    assert known.density_at(np.empty((0, 2)), np.empty((0, 2, 2))).shape == (0,)


def test_a_disc_is_as_wide_as_a_fix_is_uncertain():
    points = np.random.default_rng(3).normal(scale=1.0, size=(40, 2))
    known, radii = remembered(points, np.ones(40), 95.0, 1e-9), clutter.RADII
    for std in (1.0, 10.0, 100.0, 190.0, 500.0):
        (found,) = known.density_at(np.zeros((1, 2)), std**2 * np.eye(2)[None])
        (radius,) = radii[radii >= std][:1] if std <= radii[-1] else [np.inf]
        due = min(40.0 / (100.0 * np.pi * radius**2), clutter.MOST)
        assert found == pytest.approx(max(due, 1e-9))


def test_what_is_remembered_is_bounded_and_keeps_its_weight():
    rng, known, total = np.random.default_rng(7), Clutter(), 0.0
    for _ in range(30):
        z = rng.uniform(-500.0, 500.0, (700, 2))
        known, total = known.with_scan(z, np.full(700, 0.9), 0.1), total * np.exp(-0.01) + 560.0
    assert len(known.points) == len(known.weight) == clutter.MOST_REMEMBERED
    assert known.weight.sum() == pytest.approx(total, rel=1e-9)
    # Each stands for several, so a disc needs more than `IN_DISC` alone.
    assert known.weight.max() > 1.5
    places = rng.uniform(-300.0, 300.0, (200, 2))
    found = known.density_at(places, np.tile(np.eye(2), (200, 1, 1)))
    assert np.median(found) == pytest.approx(560e-6 * 30 / 35, rel=0.25)
    for _ in range(1000):
        known = known.with_scan(np.empty((0, 2)), np.empty(0))
    assert not len(known.points)


def test_false_fixes_in_a_clump_begin_no_track_for_long():
    """A pier returns two fixes a scan; a diver passes by, and another is in the open."""
    rng = np.random.default_rng(1)
    tracker, shown = DiverTracker(DiverConfig()), []
    for second in range(1, 121):
        z = rng.normal(scale=3.0, size=(rng.poisson(0.8), 2))
        divers = np.array([[0.6 * second - 36.0, 9.0], [0.6 * second - 36.0, 50.0]])
        z = np.concatenate([z, divers + rng.normal(scale=0.5, size=(2, 2))])
        (estimate,) = tracker.process(scan_of(second, z))
        firm = estimate.state[estimate.extras['track_state'] > 0, :2]
        own = [np.hypot(*(firm - diver).T).min(initial=9.0) < 2.0 for diver in divers]
        shown.append((*own, len(firm) - sum(own)))
    first, second, false = np.mean(shown[30:], axis=0)
    assert first > 0.95 and second > 0.95 and false < 0.1
    ((_, known),) = tracker._stream.state.memory['clutter'].by_sensor
    at = np.array([[0.0, 0.0], [0.0, 50.0], [40.0, -40.0]])
    density = known.density_at(at, np.tile(0.25 * np.eye(2), (3, 1, 1)))
    assert density[0] > 5.0 * density[1] == 5.0 * density[2] == 5.0 * known.density
    assert known.points.shape[0] < 400 and known.weight.sum() > clutter.IN_DISC


def test_new_targets_arrive_in_time():
    """Twice the time, twice the new targets; instruments and messages take nothing from others."""
    steady, looks = Clutters(), []
    for look in range(1, 6):
        steady, elapsed = steady.with_look('a', look * SECOND // 2)
        looks.append(elapsed)
    assert looks == [10.0, *[0.5] * 4]
    assert steady.with_look('a', 3 * SECOND)[1] == pytest.approx(0.5)
    assert steady.with_look('a', 90 * SECOND)[1] == 10.0
    assert steady.with_look('b', 90 * SECOND)[1] == 10.0
    same_stamp, elapsed = steady.with_look('a', 5 * SECOND // 2)
    assert elapsed == 0.5 and same_stamp == steady
    pairs, looks = Clutters(), []
    for look in range(1, 60):
        for late in (0, 1_000_000):
            pairs, elapsed = pairs.with_look('a', look * SECOND + late)
            looks.append(elapsed)
    assert min(looks[40:]) > 0.4 and 1.0 > looks[-2] > 0.99
    for name in range(50):
        pairs, _ = pairs.with_look(str(name), 70 * SECOND)
    assert len(pairs.looks) == 20
