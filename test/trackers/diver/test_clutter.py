# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The density of false fixes, learnt from scans; where a sensor sees, and who leaves it."""

from attrs import evolve
from helpers.diver_runs import arrivals, scan, scan_of, SECOND
from helpers.estimates import same
from helpers.vector_files import load_vectors
import numpy as np
import pytest
from scipy.stats import norm

from sonar_imm.estimation.bank import Gaussians
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver import coverage, coverage_map
from sonar_imm.trackers.diver.clutter import (
    Clutter,
    Clutters,
    IN_DISC,
    LEAST,
    MOST,
    MOST_REMEMBERED,
    RADII,
)
from sonar_imm.trackers.diver.config import CLUTTER
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.trackers.state_file import json_parameters
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS


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
    made = [tracker.process(item)[-1] for item in items]
    ((_, found),) = tracker._stream.state.memory['clutter'].by_sensor
    return found.density, made


@pytest.mark.parametrize(
    'false, half, aspect', [(2.0, 60.0, 1.0), (12.0, 80.0, 0.4), (5.0, 400.0, 1.0)]
)
def test_the_density_is_found(false, half, aspect):
    items = scans(60, false, half, aspect=aspect)
    density, made = learnt(items, association='jipda')
    truth = max(false / (4.0 * half**2 * aspect), CLUTTER)
    assert 0.6 * truth < density < 1.6 * truth
    assert (made[-1].extras['track_state'] > 0).sum() == 2


def test_divers_are_no_clutter():
    density, made = learnt(scans(20, 0.0, 1.0), association='jipda')
    assert LEAST <= density < CLUTTER
    assert all((each.extras['track_state'] > 0).sum() == 2 for each in made[5:])


def test_what_is_stated_stays_and_gnn_learns_nothing():
    items = scans(20, 4.0, 40.0)
    config = DiverConfig(model_set='heading_speed', association='jipda', clutter_density=1e-4)
    tracker = DiverTracker(config)
    for item in items:
        tracker.process(item)
    assert tracker._stream.state.memory['clutter'].by_sensor == ()
    usual, stated = (
        DiverTracker(DiverConfig(association='gnn', clutter_density=value))
        for value in (0.0, CLUTTER)
    )
    assert all(same(usual.process(item)[-1], stated.process(item)[-1]) for item in items)


def test_each_sensor_has_clutter_of_its_own():
    known = {'association': 'jipda', 'model_set': 'heading_speed', 'directions': 4}
    known |= {'sensors': ['left', 'right'], 'right.clutter_density': 3e-5}
    tracker = DiverTracker(DiverConfig.from_mapping(known))
    for item in scans(10, 4.0, 40.0):
        for sensor, late in (('left', 0), ('right', 1), ('', 2)):
            tracker.process(evolve(item, stamp_ns=item.stamp_ns + late, sensor=sensor))
    found = dict(tracker._stream.state.memory['clutter'].by_sensor)
    assert sorted(found) == ['', 'left']


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
    assert known.density == MOST
    for _ in range(3000):
        known = known.with_scan(np.empty((0, 2)), np.empty(0))
    assert known.density == LEAST


@pytest.mark.parametrize(
    'false, half, settings, warns',
    [
        (6.0, 60.0, {}, True),
        (6.0, 60.0, {'clutter_density': 4e-4}, False),
        (6.0, 60.0, {'association': 'jipda'}, False),
        (0.1, 60.0, {}, False),
        (1.0, 900.0, {}, False),
    ],
)
def test_gnn_says_that_there_is_clutter(false, half, settings, warns):
    known = {'model_set': 'heading_speed', 'directions': 4, 'association': 'gnn'}
    tracker = DiverTracker(DiverConfig(**{**known, **settings}))
    for item in scans(40, false, half):
        tracker.process(item)
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
    known = remembered(points, np.ones(40), 95.0, 1e-9)
    for std in (1.0, 10.0, 100.0, 190.0, 500.0):
        (found,) = known.density_at(np.zeros((1, 2)), std**2 * np.eye(2)[None])
        (radius,) = RADII[RADII >= std][:1] if std <= RADII[-1] else [np.inf]
        assert found == pytest.approx(max(min(40.0 / (100.0 * np.pi * radius**2), MOST), 1e-9))


def test_what_is_remembered_is_bounded_and_keeps_its_weight():
    rng, known, total = np.random.default_rng(7), Clutter(), 0.0
    for _ in range(30):
        z = rng.uniform(-500.0, 500.0, (700, 2))
        known, total = known.with_scan(z, np.full(700, 0.9), 0.1), total * np.exp(-0.01) + 560.0
    assert len(known.points) == len(known.weight) == MOST_REMEMBERED
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
    assert known.points.shape[0] < 400 and known.weight.sum() > IN_DISC


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


AHEAD = (0.0, 0.0, 0.0, 90.0, 0.0, 50.0)
"""A sonar at the origin that looks along x, 45 degrees to either side, 50 m far."""


def written(tmp_path, name, header, rows):
    file = tmp_path / name
    file.write_text('\n'.join([header, *(','.join(map(str, row)) for row in rows)]) + '\n')
    return str(file)


def ids_by_scan(config, scans):
    tracker, found = DiverTracker(config), []
    for item in scans:
        (estimate,) = tracker.process(item)
        confirmed = estimate.extras['track_state'] > 0
        found.append(estimate.extras['track_id'][confirmed].tolist())
    return found


def out_and_back(away=15):
    """A diver who swims across the edge of the sector at 50 m, turns about and comes back."""
    there = np.concatenate([np.arange(35.0, 50.0, 0.75), 49.8 - np.arange(0.0, 15.0, 0.75)])
    seconds = [*range(1, 21), *range(21 + away, 41 + away)]
    seen = {second: (x, 0.3) for second, x in zip(seconds, there)}
    return [scan(k, seen[k]) if k in seen else scan(k) for k in range(1, 41 + away)]


@pytest.mark.parametrize(
    'association, model_set',
    [('gnn', 'families'), ('jipda', 'families'), ('jipda', 'heading_speed'), ('gnn', 'linear')],
)
def test_who_leaves_the_sector_keeps_his_track(association, model_set):
    plain = DiverConfig(association=association, model_set=model_set)
    for config, tracks in ((plain, 2), (evolve(plain, coverage_sector=AHEAD), 1)):
        found = ids_by_scan(config, out_and_back())
        assert len({number for ids in found for number in ids}) == tracks
    assert found[-1] and found[30] == found[15]


@pytest.mark.parametrize('association', ['gnn', 'jipda'])
def test_who_is_inside_and_not_seen_ends_as_soon_as_without_a_sector(association):
    scans = [scan(k, (20.0, 0.2 * k)) if k < 12 else scan(k) for k in range(1, 40)]
    plain = DiverConfig(association=association)
    without, stated = (
        sum(bool(ids) for ids in ids_by_scan(config, scans))
        for config in (plain, evolve(plain, coverage_sector=AHEAD))
    )
    assert without == stated < 20


def test_an_echo_sounder_that_covers_a_sector_misses_nobody_outside():
    def ping(second, place=None):
        rows = slice(0, 0 if place is None else 4)
        leg = np.linalg.norm(RECEIVERS - [*(place or (0.0, 0.0)), 0.0], axis=1)
        toa = ((leg + leg[0]) / 1500.0)[rows]
        return arrivals(second * SECOND, RECEIVERS[rows], toa, tx=np.zeros(3), frame_id='')

    pings = [ping(k, (35.0 + 0.75 * k, 5.0)) if k <= 20 else ping(k) for k in range(1, 60)]
    left = [
        len(ids_by_scan(config, pings)[-1])
        for config in (DiverConfig(), DiverConfig(coverage_sector=AHEAD))
    ]
    assert left == [0, 1]


def test_existence_of_a_diver_who_is_not_seen_is_the_closed_recursion(tmp_path):
    """Where the probability is the same all over the track, r' = r (1 - p) / (1 - r p)."""
    corners = [(x, y, 0.4) for x in (-500.0, 500.0) for y in (-500.0, 500.0)]
    file = written(tmp_path, 'grid.csv', 'x,y,probability', corners)
    config = DiverConfig(association='jipda', coverage_file=file, survival_time=300.0)
    tracker = DiverTracker(config)
    for second in range(1, 15):
        (estimate,) = tracker.process(scan(second, (5.0, 0.1 * second)))
    r = float(estimate.extras['existence'][0])
    assert r > 0.99
    for second in range(15, 24):
        r *= np.exp(-1.0 / 300.0)
        r *= (1.0 - 0.4) / (1.0 - r * 0.4)
        (estimate,) = tracker.process(scan(second))
        assert estimate.extras['existence'][0] == pytest.approx(r, abs=1e-12)


def test_existence_at_the_edge_is_that_of_particles_told_the_true_probability():
    """40,000 particles with the motion of the tracker, weighed by 1 - p(x) with each scan."""
    config = DiverConfig(
        association='jipda', model_set='linear', acceleration_noise=(0.1,), coverage_sector=AHEAD
    )
    tracker, rng, p = DiverTracker(config), np.random.default_rng(3), 0.9
    for second in range(1, 16):
        (estimate,) = tracker.process(scan(second, (36.0 + 0.75 * second, 0.4)))
    r = float(estimate.extras['existence'][0])
    x = rng.multivariate_normal(estimate.state[0], estimate.covariance[0], 40_000)
    motion = tracker.models.motion(1.0)
    noise, differences, reference = np.linalg.cholesky(motion.Q[0] + 1e-12 * np.eye(4)), [], []
    for second in range(16, 46):
        x = x @ motion.F[0].T + rng.normal(size=x.shape) @ noise.T
        here = np.hypot(x[:, 0], x[:, 1]) <= 50.0
        here &= np.abs(np.arctan2(x[:, 1], x[:, 0])) <= np.pi / 4.0
        r *= np.exp(-1.0 / config.survival_time)
        r *= (1.0 - p * here.mean()) / (1.0 - r * p * here.mean())
        weight = 1.0 - p * here
        x = x[rng.choice(len(x), len(x), p=weight / weight.sum())]
        (estimate,) = tracker.process(scan(second))
        reference.append(r)
        differences.append(float(estimate.extras['existence'][0]) - r)
    assert 0.2 < min(reference) < 0.9  # doubtful at the edge, and then no longer asked
    assert np.abs(differences).max() < 0.05


@pytest.mark.parametrize('edge', [-1.5, -0.4, 0.3, 1.2])
def test_what_is_left_of_a_track_by_a_half_plane_is_the_truncated_normal(edge):
    config = DiverConfig(
        model_set='linear', coverage_sector=(-1e6, 0.0, 0.0, 360.0, 0.0, 1e6 + edge), max_tracks=1
    )
    tracker = DiverTracker(config)
    tracker.process(scan(1, (0.0, 0.0)))
    known = tracker._stream.state
    P = np.diag([4.0, 1.0, 1.0, 1.0])
    P[0, 2] = P[2, 0] = 1.2
    block = Gaussians(np.zeros((1, 4, 1)), P[None, ..., None])
    life = evolve(known.life, status=np.ones(1, np.uint8))
    known = known.replace(rows=known.rows.replace(blocks=(block,)), life=life)
    seen = coverage.detection_probability(
        known, tracker.models, coverage_map.configured_coverage(config)[''], 0.9
    )
    after = coverage.apply_misses(known, tracker.models, seen, np.ones(1), True)
    x, P = (part[0, ..., 0] for part in after.rows.blocks[0])
    a = edge / 2.0
    inside = norm.cdf(a)
    assert seen.tracks[0] == pytest.approx(0.9 * inside, abs=0.07)
    left = 1.0 - 0.9 * inside
    mean = 2.0 * 0.9 * norm.pdf(a) / left
    square = 4.0 * (1.0 - 0.9 * (inside - a * norm.pdf(a))) / left
    assert x[0] == pytest.approx(mean, abs=0.25)
    assert P[0, 0] == pytest.approx(square - mean**2, abs=0.7)
    assert x[2] == pytest.approx(1.2 / 4.0 * x[0], abs=1e-9)
    assert np.linalg.eigvalsh(P).min() > 0.0


def test_tables_are_read_between_their_points(tmp_path):
    grid = [(x, y, 0.1 * x + 0.01 * y) for y in (0.0, 10.0, 30.0) for x in (0.0, 2.0, 5.0)]
    by_place = DiverConfig(coverage_file=written(tmp_path, 'a.csv', 'x,y,probability', grid))
    at = coverage_map.configured_coverage(by_place)[''].probability
    places = np.array([[0.0, 0.0], [3.5, 20.0], [5.0, 30.0], [5.1, 0.0], [1.0, -0.1]])
    assert at(places, 0.9) == pytest.approx([0.0, 0.55, 0.8, 0.0, 0.0])
    ranges = written(tmp_path, 'b.csv', 'range,probability', [(40, 0.5), (10, 0.9), (60, 0.0)])
    by_range = DiverConfig(coverage_file=ranges, coverage_sector=(100, 0, 180, 20, 0, 1e6))
    at = coverage_map.configured_coverage(by_range)[''].probability
    places = np.array([[98.0, 0.0], [75.0, 0.0], [50.0, 0.0], [30.0, 0.0], [125.0, 0.0]])
    assert at(places, 0.9) == pytest.approx([0.9, 0.7, 0.25, 0.0, 0.0])


def test_each_sensor_has_its_own():
    config = DiverConfig.from_mapping(
        {
            'sensors': ['left', 'right'],
            'left.coverage_sector': AHEAD,
            'right.coverage_sector': [0, 0, 180, 90, 0, 50],
        }
    )
    found = coverage_map.configured_coverage(config)
    assert sorted(found) == ['left', 'right']
    place = np.array([-20.0, 1.0])
    assert [found[name].probability(place, 0.9) for name in ('left', 'right')] == [0.0, 0.9]
    scans = [scan(k, (20.0, 0.3 * k), sensor='left') for k in range(1, 11)]
    scans += [scan(k, sensor='right') for k in range(11, 31)]
    tracks = ids_by_scan(config, scans)
    assert tracks[-1] == tracks[8] != []
    scans[10:] = [scan(k, sensor='left') for k in range(11, 31)]
    assert not ids_by_scan(config, scans)[-1]


def test_two_divers_outside_are_not_taken_for_one():
    config = DiverConfig(association='jipda', coverage_sector=AHEAD)
    scans = [scan(k, (42.0 + 0.75 * k, 0.0), (42.0 + 0.75 * k, 3.0)) for k in range(1, 11)]
    scans += [scan(k) for k in range(11, 41)]
    assert len(ids_by_scan(config, scans)[-1]) == 2


@pytest.mark.parametrize(
    'header, rows, problem',
    [
        ('x,y,p', [(0, 0, 0.5)], 'its first line has to be x,y,probability or range,probability'),
        ('range,probability', [(0, 0.5)], 'at least two values on each axis'),
        ('range,probability', [(0, 0.5), (0, 0.4), (1, 0.1)], 'each place once'),
        ('range,probability', [(0, 0.5), (1, 1.5)], 'a probability is not between 0 and 0.9999'),
        ('range,probability', [(0, 0.5), (1, 'x')], 'could not convert'),
        ('x,y,probability', [(0, 0, 0.5), (1, 0.5)], 'inhomogeneous'),
    ],
)
def test_files_that_hold_no_table_are_refused(tmp_path, header, rows, problem):
    file = written(tmp_path, 'table.csv', header, rows)
    for name, said in ((file, problem), (file + '.no', 'table.csv.no')):
        with pytest.raises(ConfigError, match=said):
            DiverTracker(DiverConfig(coverage_file=name))


def test_a_running_tracker_takes_another_sector():
    tracker = DiverTracker(DiverConfig(coverage_sector=AHEAD))
    for second in range(1, 11):
        tracker.process(scan(second, (20.0, 0.1 * second)))
    turned = DiverConfig(coverage_sector=(0.0, 0.0, 180.0, 90.0, 0.0, 50.0))
    tracker.reconfigure(turned)
    for second in range(11, 31):
        (estimate,) = tracker.process(scan(second))
    assert len(estimate.state) == 1
    assert json_parameters(turned)['coverage_sector'][2] == 180.0
