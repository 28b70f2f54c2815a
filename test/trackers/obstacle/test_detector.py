# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The detector of images, and sonars that turn: each obstacle when the beam met it."""

from attrs import evolve
from helpers.obstacle_runs import echoes, run, SECOND, track
from helpers.vector_files import load_vectors
import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Navigation, Rejection, SonarImage, SonarInfo
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig, ImageDetector
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker

BEARINGS = np.radians(np.linspace(20.0, -20.0, 41))  # port first
RANGES = 2.0 + 0.25 * np.arange(120)
ECHOES = {(40, 5): 200.0, (90, 33): 120.0}
SHARP = DetectorConfig()
STEP = np.radians(1.8)
ONCE = np.arange(-0.5, 0.5, STEP)
TO_AND_FRO = np.concatenate([ONCE, ONCE[-2::-1], ONCE[1:], ONCE[-2::-1]])


def image(**changes):
    rng = np.random.default_rng(5)
    amplitude = np.round(4.0 * np.sqrt(rng.exponential(size=(len(RANGES), len(BEARINGS)))))
    for place, strength in ECHOES.items():
        amplitude[place] = strength
    values = {'range': RANGES, 'bearing': BEARINGS, 'amplitude': amplitude, **changes}
    return SonarImage(stamp_ns=5, frame_id='sonar', **values)


def study_image():
    """The image of an independent study, with its targets and the answers of its detector; and
    ours."""
    data = load_vectors('obstacle_sea/fls_image')
    axes = {name: data[name] for name in ('range', 'bearing')}
    picture = SonarImage(stamp_ns=5, amplitude=data['00/amplitude_x40'] / 40.0, **axes)
    study = {name[3:]: value for name, value in data.items() if name.startswith('00/')}
    return study, detect(picture, SHARP)


def test_five_targets_are_five_clusters_where_they_are():
    study, found = study_image()
    assert len(found) == 5
    for kind, r, b in zip(study['target_kind'], study['target_range'], study['target_bearing']):
        i = np.argmin(np.hypot(found.range - r, (found.bearing - b) * r))
        assert found.range[i] == pytest.approx(r, abs=0.1 if kind == 'point' else 3.0)
        if kind == 'point':
            assert found.bearing[i] == pytest.approx(b, abs=np.radians(0.2))
        if kind == 'chain':
            assert found.extent_bearing[i] * r > 0.7 and found.var_bearing[i] * r**2 > 0.7**2


def test_the_answers_are_those_of_an_independent_detector():
    """Where a target is one cluster of both; of the chain the study's has one glint."""
    study, found = study_image()
    for r, b, db in zip(study['ref_range'], study['ref_bearing'], study['ref_snr_db']):
        i = np.argmin(np.abs(found.range - r))
        if abs(r - 60.1) > 1.0:
            assert found.range[i] == pytest.approx(r, abs=0.05)
            assert found.bearing[i] == pytest.approx(b, abs=0.003)
        # Of the noise around, in dB of the image.
        assert -1.0 < 20.0 * np.log10(found.intensity[i]) - db < 14.0


def test_the_order_of_rows_and_beams_does_not_matter():
    """Neither with beams that have no place, up to those of the echoes."""
    beam, rng = np.arange(len(BEARINGS)), np.random.default_rng(0)
    for bearing in (BEARINGS, np.where((beam < 5) | (beam > 33), np.nan, BEARINGS)):
        straight = image(bearing=bearing)
        expected = detect(straight, SHARP)
        assert expected.range == pytest.approx([RANGES[40], RANGES[90]], abs=0.05)
        assert expected.bearing == pytest.approx([BEARINGS[5], BEARINGS[33]], abs=0.003)
        assert expected.intensity.tolist() == [200.0, 120.0]
        assert (expected.stamp_ns, expected.frame_id) == (5, 'sonar')
        for beams in (beam[::-1], rng.permutation(beam)):
            rows = rng.permutation(len(RANGES))
            amplitude = straight.amplitude[rows][:, beams]
            again = image(range=RANGES[rows], bearing=bearing[beams], amplitude=amplitude)
            again = detect(again, SHARP)
            for name in ('range', 'bearing', 'var_bearing', 'intensity'):
                np.testing.assert_array_equal(getattr(again, name), getattr(expected, name))


def spoilt(values, place, value=np.nan):
    values = values.copy()
    values[place] = value
    return values


LOUD = image().amplitude
NOISE = np.random.default_rng(6).exponential(size=LOUD.shape)


@pytest.mark.parametrize(
    'changes, values, left',
    [
        ({}, {'min_range': 15.0}, [120.0]),
        ({}, {'max_detections': 1}, [200.0]),
        ({'range': spoilt(RANGES, 40)}, {}, [120.0]),
        ({'bearing': spoilt(BEARINGS, 5)}, {}, [120.0]),
        ({'amplitude': np.sqrt(NOISE)}, {}, []),
        ({'amplitude': spoilt(spoilt(LOUD, np.s_[10:14]), (20, 3), np.inf)}, {}, [200.0, 120.0]),
    ],
    ids=['the vehicle', 'strongest first', 'no range', 'no bearing', 'noise alone', 'no numbers'],
)
def test_what_is_no_obstacle_is_left_out(changes, values, left):
    found = detect(image(**changes), DetectorConfig(**values))
    assert found.intensity.tolist() == left and np.isfinite(found.var_range).all()


def test_powers_and_levels_are_turned_into_amplitudes():
    expected = detect(image(), SHARP).range
    with np.errstate(divide='ignore'):
        levels = 20.0 * np.log10(LOUD) / 0.25
    for scale, amplitude in (('power', LOUD**2), ('decibel', levels)):
        config = DetectorConfig(image_scale=scale, decibel_step=0.25)
        assert_allclose(detect(image(amplitude=amplitude), config).range, expected, rtol=1e-9)


def test_an_image_that_contradicts_itself_is_refused():
    with pytest.raises(Rejection, match='axes') as caught:
        image(range=RANGES[:-1])
    assert caught.value.reason == 'bad_shape'
    with pytest.raises(Rejection) as caught:
        detect(image(bearing=10.0 * BEARINGS * np.arange(41)), SHARP)
    assert caught.value.reason == 'out_of_range'


def beams(angles, start_ns=10**9, step_ns=10**8, target=(0.1, 20.0), rows=100, frame_id='sonar'):
    """Echoes of single directions with a target at (bearing, range)."""
    rng = np.random.default_rng(3)
    r = 0.3 * (1.0 + np.arange(rows))
    for k, angle in enumerate(np.arctan2(np.sin(angles), np.cos(angles))):
        amplitude = np.sqrt(rng.exponential(size=rows)) * 3.0
        off = np.hypot((angle - target[0]) / (2.0 * STEP), (r - target[1]) / 0.5)
        amplitude += 150.0 * np.exp(-np.square(off))
        yield SonarImage(
            stamp_ns=start_ns + k * step_ns, range=r, bearing=[angle],
            amplitude=amplitude[:, None], frame_id=frame_id, scanning=True,
        )  # fmt: skip


def sweeps(images):
    detector = ImageDetector(DetectorConfig(beam_width_deg=2.0))
    return [item for image in images if (item := detector.process(image)) is not None]


def test_directions_of_a_full_turn_are_gathered_into_what_lies_ahead():
    found = sweeps(beams(np.arange(0.0, 3.3 * 2.0 * np.pi, STEP)))
    assert len(found) == 4  # half of one and three whole ones, each when the sonar looks aside
    for ping in found[1:]:
        assert ping.range == pytest.approx([20.0], abs=0.2)
        assert ping.bearing == pytest.approx([0.1], abs=0.03)


def test_the_direction_where_a_sonar_turns_back_is_in_both_sweeps(monkeypatch):
    """A sector that is scanned to and fro gives a ping each way."""
    found = sweeps(beams(TO_AND_FRO))
    assert [len(ping) for ping in found] == [1, 1, 1]
    assert [ping.bearing[0] for ping in found] == pytest.approx([0.1] * 3, abs=0.03)
    monkeypatch.setattr('sonar_imm.trackers.obstacle.detector.detect', lambda image, config: image)
    for image, seen in zip(sweeps(beams(TO_AND_FRO)), (ONCE, ONCE[::-1], ONCE), strict=True):
        assert_allclose(image.bearing, seen)


@pytest.mark.parametrize('bearing', [0.0, 0.35])
def test_each_echo_of_a_sweep_has_the_time_of_its_direction(bearing):
    (ping,) = sweeps(beams([*ONCE, ONCE[-2]], target=(bearing, 20.0)))
    heard = 10**9 + 1e8 * (bearing - ONCE[0]) / STEP
    assert ping.stamp_ns + 1e9 * ping.time_offset[0] == pytest.approx(heard, abs=1e8)
    assert np.sqrt(ping.var_range[0]) < 0.3


@pytest.mark.parametrize(
    'start_ns, changes',
    [(10**10, {}), (3 * 10**9, {'rows': 90}), (3 * 10**9, {'frame_id': 'x'}), (10**9 // 2, {})],
    ids=['silence', 'ranges', 'frame', 'back'],
)
def test_a_sweep_ends_where_it_does_not_go_on(start_ns, changes):
    first = list(beams(np.arange(-0.5, 0.0, STEP)))
    more = beams(np.arange(0.0, 0.5, STEP), start_ns=start_ns, **changes)
    detector = ImageDetector(DetectorConfig(beam_width_deg=2.0))
    answers = [detector.process(item) is not None for item in [*first, *more]]
    assert answers[len(first)] and sum(answers) == 1


def test_memory_is_bounded_whatever_comes():
    detector = ImageDetector(DetectorConfig(sweep_sector_deg=360.0))
    for beam in beams(1e-5 * np.arange(3000), rows=20):
        detector.process(beam)
    assert len(detector._sweep) <= 1000
    for k in range(200):  # the first sonar goes on saying what it is
        for name in (f'sonar_{k}', 'sonar'):
            detector.describe(SonarInfo(stamp_ns=k, frame_id=name, gain=2.0))
    assert len(detector.infos) <= 16 and {'sonar', 'sonar_199'} <= detector.infos.keys()


SWEEP, LATEST, RATE, WIDE = 9.0, 54.0, np.radians(60.0) / 9.0, {'horizontal_fov_deg': 90.0}
OBSTACLES = {'above': (60.0, 6.0, -7.0), 'level': (70.0, -8.0, -10.0), 'below': (55.0, 0.0, -12.0)}


def vehicle(t):
    """Pose at t of a vehicle that swims, dives and rolls, ENU and FLU."""
    position = np.array([0.6 * t, 0.3 * np.sin(0.2 * t), -10.0 + 0.5 * np.sin(0.15 * t)])
    angles = 0.03 * np.sin(1.1 * t), 0.01 * np.sin(0.7 * t), 0.08 * np.sin(0.1 * t)
    return position, angles


def seen(place, t):
    """Range and bearing, positive to port, of a place at t."""
    position, angles = vehicle(t)
    m = geometry.rotation(*angles).T @ (np.array(place) - position)
    return np.linalg.norm(m), np.arctan2(m[1], m[0])


def met(place, start):
    """When a beam that turns from port to starboard within the scan meets a place."""
    t = start
    for _ in range(20):
        t = start + (np.radians(30.0) - seen(place, t)[1]) / RATE
    return t


def stamp(t):
    return SECOND + round(t * SECOND)


def dive(scans, obstacles=OBSTACLES, noise=0.0):
    """Navigation at 10 Hz, and what `scans` makes of times, ranges and bearings of each scan."""
    rng, out = np.random.default_rng(8), []
    for t in np.arange(1, int(LATEST * 10) + 12) / 10:
        position, angles = vehicle(t)
        turned = {'orientation': geometry.quaternion(*angles), 'frame_id': 'odom'}
        out.append(Navigation(stamp_ns=stamp(t), position=position, **turned))
    for start in np.arange(0.2, LATEST - SWEEP, SWEEP):
        times = np.array([met(place, start) for place in obstacles.values()])
        places = np.array([seen(place, t) for place, t in zip(obstacles.values(), times)])
        places += noise * rng.normal(size=places.shape) * [0.1, np.radians(0.2)]
        out += scans(start, times, places)
    return sorted(out, key=lambda item: item.stamp_ns)


def as_scan(start, times, places):
    """One message of the whole scan, with times after its first ray."""
    return [echoes(stamp(start), places, time_offset=times - start)]


def as_pings(start, times, places):
    """A message for each instant."""
    return [echoes(stamp(t), place) for t, place in zip(times, places)]


def as_one_instant(start, times, places):
    return [echoes(stamp(start), places)]


def places_of(estimate):
    sure = estimate.extras['track_state'] > 0
    return np.column_stack([estimate.extras[name][sure] for name in ('px', 'py')])


def last(scans, obstacles=OBSTACLES, noise=1.0, **values):
    return track(dive(scans, obstacles, noise), confirm_hits=1, **WIDE, **values)[-1]


def test_obstacles_are_where_they_are_however_long_a_scan_takes():
    found, off = (
        [np.hypot(*(places_of(last(scans)) - place[:2]).T).min() for place in OBSTACLES.values()]
        for scans in (as_scan, as_one_instant)
    )
    assert len(places_of(last(as_scan))) == len(OBSTACLES)
    assert max(found) < 0.4 and max(off) > 1.0


@pytest.mark.parametrize(
    'name, timing', [('above', 'instant'), ('level', 'two_way'), ('below', 'instant')]
)
def test_a_scan_of_one_obstacle_says_what_pings_at_its_instants_say(name, timing):
    """They differ by the prediction, which is taken in two steps, and by the late poses."""
    obstacle = {name: OBSTACLES[name]}
    one, many = (last(kind, obstacle, 0.0, ping_timing=timing) for kind in (as_scan, as_pings))
    assert one.stamp_ns > many.stamp_ns - SWEEP * SECOND
    assert_allclose(places_of(one), places_of(many), atol=0.02)
    assert one.xyz[0, 2] == pytest.approx(many.xyz[0, 2], abs=0.1)
    ends = [[each.extras[f'vertical_offset_{end}'][0] for end in ('lo', 'hi')]
            for each in (one, many)]  # fmt: skip
    assert np.ptp(ends[0]) == pytest.approx(np.ptp(ends[1]), rel=0.05)


def test_rows_are_those_of_the_end_of_the_scan():
    estimate = last(as_scan)
    t, sure = estimate.stamp_ns / SECOND - 1.0, estimate.extras['track_state'] > 0
    for place, (r, b) in zip(places_of(estimate), estimate.state[sure, :2]):
        nearest = min(OBSTACLES.values(), key=lambda each: np.hypot(*(place - each[:2])))
        there = seen(nearest, t)
        assert (r, b) == (pytest.approx(there[0], abs=0.5), pytest.approx(there[1], abs=0.02))


def test_messages_of_scans_may_come_in_any_order():
    messages = dive(as_scan, noise=1.0)
    late = messages[:-40] + messages[-40:][::-1]
    ours, theirs = (track(items, **WIDE)[-1].columns() for items in (messages, late))
    for name, column in ours.items():
        assert_allclose(column, theirs[name], err_msg=name)


def test_a_row_without_a_time_has_that_of_its_neighbours():
    """Each echo comes twice, the second time without its time."""

    def doubled(lost):
        def scans(start, times, places):
            times = np.concatenate([times, np.where(lost, np.nan, times)])
            return as_scan(start, times, np.concatenate([places, places + [20.0, 0.0]]))

        return scans

    whole, holed = (last(doubled(lost)) for lost in (False, True))
    assert_allclose(places_of(whole), places_of(holed), atol=0.3)


def test_some_rows_of_a_scan_may_have_elevations():
    """Here those of one obstacle, whose height they show."""

    def with_elevation(start, times, places):
        (ping,) = as_scan(start, times, places)
        drop = OBSTACLES['below'][2] - np.array([vehicle(t)[0][2] for t in times])
        deepest = np.array(list(OBSTACLES)) == 'below'
        angle = np.where(deepest, np.arcsin(drop / places[:, 0]), np.nan)
        return [evolve(ping, elevation=angle)]

    std = []
    for scans in (with_elevation, as_scan):
        estimate = last(scans)
        found, sure = places_of(estimate), estimate.extras['track_state'] > 0
        assert len(found) == len(OBSTACLES)
        row = np.hypot(*(found - OBSTACLES['below'][:2]).T).argmin()
        std.append(np.sqrt(estimate.covariance[sure][row, 2, 2]))
    assert std[0] < 0.8 * std[1]


@pytest.mark.parametrize('scan_time', [0.2, 9.0])
def test_a_slow_scan_without_times_is_said(scan_time):
    def untimed(start, times, places):
        return [echoes(stamp(start), places, untimed=scan_time)]

    tracker = ObstacleTracker(ObstacleConfig(**WIDE))
    run(tracker, dive(untimed))
    said = [
        'a scan takes 9.0 s and its detections have no times: one instant is taken for all, '
        'wrong by up to 5.4 m'
    ]
    found = [sentence for sentence in tracker.warnings() if 'no times' in sentence]
    assert found == (said if scan_time > 1.0 else [])
