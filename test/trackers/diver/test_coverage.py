# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Detection probability as a function of place: who leaves the sector is not missed in it."""

from attrs import evolve
from helpers.diver_runs import scan_of, SECOND
import numpy as np
import pytest
from scipy.stats import norm

from sonar_imm.estimation.bank import Gaussians
from sonar_imm.measurements import Arrivals
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver import coverage, coverage_map
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.trackers.state_file import json_parameters

AHEAD = (0.0, 0.0, 0.0, 90.0, 0.0, 50.0)
"""A sonar at the origin that looks along x, 45 degrees to either side, 50 m far."""


def scan(second, *places, sensor=''):
    return scan_of(second, places, sensor=sensor)


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


@pytest.mark.parametrize('association', ['gnn', 'jipda'])
@pytest.mark.parametrize('model_set', ['families', 'heading_speed', 'linear'])
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
    rx = np.array([[0.0, 0.0, 0.0], [70.0, 10.0, 0.0], [-60.0, 45.0, 0.0], [10.0, 85.0, 0.0]])

    def ping(second, place=None):
        rows = slice(0, 0 if place is None else 4)
        leg = np.linalg.norm(rx - [*(place or (0.0, 0.0)), 0.0], axis=1)
        nothing = np.full(4, np.nan)[rows]
        return Arrivals(
            stamp_ns=second * SECOND, tx_id=np.zeros(4)[rows], rx_id=np.arange(4)[rows],
            tx=np.zeros((4, 3))[rows], rx=rx[rows], toa=((leg + leg[0]) / 1500.0)[rows],
            var_toa=np.full(4, 1e-8)[rows], bearing=nothing, var_bearing=nothing,
        )  # fmt: skip

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
    'values, problem',
    [
        ({'coverage_sector': (0.0, 0.0)}, 'coverage_sector needs 6 values, got 2'),
        ({'coverage_sector': (0, 0, 0, 0, 0, 9)}, 'a width of 0 is not between 0 and 360'),
        ({'coverage_sector': (0, 0, 0, 90, 9, 9)}, 'a range from 9 to 9 holds nothing'),
        (
            {'sensors': ['a', 'b'], 'b.coverage_sector': AHEAD[:5]},
            'b.coverage_sector needs 6 values, got 5',
        ),
    ],
)
def test_sectors_that_are_none_are_refused(values, problem):
    with pytest.raises(ConfigError, match=problem):
        DiverConfig.from_mapping(values)


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
