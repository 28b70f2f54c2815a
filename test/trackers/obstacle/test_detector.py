# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The detector of images, and sonars that turn: each obstacle when the beam met it."""

from attrs import evolve
from helpers.obstacle_runs import run, SECOND
from helpers.vector_files import load_vectors
import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Detections, Navigation, Rejection, SonarImage, SonarInfo
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig, ImageDetector
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker

BEARINGS = np.radians(np.linspace(20.0, -20.0, 41))  # port first
RANGES = 2.0 + 0.25 * np.arange(120)
ECHOES = {(40, 5): 200.0, (90, 33): 120.0}
SHARP = DetectorConfig()


def image(**changes):
    rng = np.random.default_rng(5)
    amplitude = np.round(4.0 * np.sqrt(rng.exponential(size=(len(RANGES), len(BEARINGS)))))
    for place, strength in ECHOES.items():
        amplitude[place] = strength
    values = {'range': RANGES, 'bearing': BEARINGS, 'amplitude': amplitude, **changes}
    return SonarImage(stamp_ns=5, frame_id='sonar', **values)


def study_image():
    """The image of an independent study, with its targets and the answers of its detector."""
    data = load_vectors('obstacle_sea/fls_image')
    amplitude = data['00/amplitude_x40'] / 40.0
    return (
        SonarImage(stamp_ns=5, range=data['range'], bearing=data['bearing'], amplitude=amplitude),
        {name[3:]: value for name, value in data.items() if name.startswith('00/')},
    )


def test_five_targets_are_five_clusters_where_they_are():
    picture, study = study_image()
    found = detect(picture, DetectorConfig())
    assert len(found) == 5
    for kind, r, b in zip(study['target_kind'], study['target_range'], study['target_bearing']):
        nearest = np.argmin(np.hypot(found.range - r, (found.bearing - b) * r))
        if kind == 'point':
            assert found.range[nearest] == pytest.approx(r, abs=0.1)
            assert found.bearing[nearest] == pytest.approx(b, abs=np.radians(0.2))
        else:
            assert found.range[nearest] == pytest.approx(r, abs=3.0)
        if kind == 'chain':
            assert found.extent_bearing[nearest] * r > 0.7
            assert found.var_bearing[nearest] * r**2 > 0.7**2


def test_the_answers_are_those_of_an_independent_detector():
    """Where a target is one cluster of both; of the chain the study's has one glint."""
    picture, study = study_image()
    found = detect(picture, DetectorConfig())
    for r, b, db in zip(study['ref_range'], study['ref_bearing'], study['ref_snr_db']):
        i = np.argmin(np.abs(found.range - r))
        if abs(r - 60.1) > 1.0:
            assert found.range[i] == pytest.approx(r, abs=0.05)
            assert found.bearing[i] == pytest.approx(b, abs=0.003)
        level = found.intensity[i] ** 2
        beside = 10.0 * np.log10(level) - db  # of the noise around, in dB of the image
        assert -1.0 < beside < 14.0


def test_the_order_of_rows_and_beams_does_not_matter():
    expected = detect(image(), SHARP)
    assert expected.range == pytest.approx([RANGES[40], RANGES[90]], abs=0.05)
    assert expected.bearing == pytest.approx([BEARINGS[5], BEARINGS[33]], abs=0.003)
    assert expected.intensity.tolist() == [200.0, 120.0]
    assert (expected.stamp_ns, expected.frame_id) == (5, 'sonar')
    straight = image()
    rng = np.random.default_rng(0)
    for rows, beams in (
        (slice(None, None, -1), slice(None, None, -1)),
        (rng.permutation(len(RANGES)), rng.permutation(len(BEARINGS))),
    ):
        turned = evolve(
            straight,
            range=RANGES[rows],
            bearing=BEARINGS[beams],
            amplitude=straight.amplitude[rows][:, beams],
        )
        again = detect(turned, SHARP)
        np.testing.assert_array_equal(again.range, expected.range)
        np.testing.assert_array_equal(again.var_bearing, expected.var_bearing)


def test_bearings_in_either_order_begin_after_beams_without_a_place():
    """The echoes lie in the outermost beams that have one."""
    beam = np.arange(len(BEARINGS))
    bearing = np.where((beam < 5) | (beam > 33), np.nan, BEARINGS)
    rising = image(bearing=bearing)
    falling = evolve(rising, bearing=bearing[::-1], amplitude=rising.amplitude[:, ::-1])
    expected, again = detect(rising, SHARP), detect(falling, SHARP)
    assert expected.intensity.tolist() == [200.0, 120.0]
    for name in ('range', 'bearing', 'var_bearing', 'intensity'):
        np.testing.assert_array_equal(getattr(again, name), getattr(expected, name))


def test_the_vehicle_is_no_obstacle_and_the_strongest_come_first():
    near = detect(image(), DetectorConfig(min_range=15.0))
    assert near.range == pytest.approx([RANGES[90]], abs=0.05)
    assert detect(image(), DetectorConfig(max_detections=1)).intensity.tolist() == [200.0]


@pytest.mark.parametrize('name, place', [('range', 40), ('bearing', 5)])
def test_an_echo_without_a_place_is_left_out(name, place):
    axis = (RANGES if name == 'range' else BEARINGS).copy()
    axis[place] = np.nan
    assert detect(image(**{name: axis}), SHARP).intensity.tolist() == [120.0]


def test_an_image_of_noise_alone_is_a_ping_without_echoes():
    noise = np.random.default_rng(6).exponential(size=(len(RANGES), len(BEARINGS)))
    assert len(detect(image(amplitude=np.sqrt(noise)), SHARP)) == 0


def test_powers_and_levels_are_turned_into_amplitudes():
    expected = detect(image(), SHARP)
    power = detect(image(amplitude=image().amplitude ** 2), DetectorConfig(image_scale='power'))
    np.testing.assert_allclose(power.range, expected.range, rtol=1e-12)
    with np.errstate(divide='ignore'):
        level = 20.0 * np.log10(image().amplitude) / 0.25
    found = detect(
        image(amplitude=level), DetectorConfig(image_scale='decibel', decibel_step=0.25)
    )
    np.testing.assert_allclose(found.range, expected.range, rtol=1e-9)


def test_samples_that_are_no_numbers_are_silence():
    spoilt = image().amplitude.copy()
    spoilt[10:14, :] = np.nan
    spoilt[20, 3] = np.inf
    found = detect(image(amplitude=spoilt), SHARP)
    assert found.intensity.tolist() == [200.0, 120.0]
    assert np.isfinite(found.var_range).all()


def test_an_image_that_contradicts_itself_is_refused():
    with pytest.raises(Rejection, match='axes') as caught:
        image(range=RANGES[:-1])
    assert caught.value.reason == 'bad_shape'
    with pytest.raises(Rejection) as caught:
        detect(image(bearing=10.0 * BEARINGS * np.arange(41)), SHARP)
    assert caught.value.reason == 'out_of_range'


STEP = np.radians(1.8)


def beams(angles, start_ns=10**9, step_ns=10**8, target=(0.1, 20.0), rows=100, **changes):
    """Echoes of single directions with a target at (bearing, range)."""
    rng = np.random.default_rng(3)
    r = 0.3 * (1.0 + np.arange(rows))
    for k, angle in enumerate(np.arctan2(np.sin(angles), np.cos(angles))):
        amplitude = np.sqrt(rng.exponential(size=rows)) * 3.0
        off = np.hypot((angle - target[0]) / (2.0 * STEP), (r - target[1]) / 0.5)
        amplitude += 150.0 * np.exp(-np.square(off))
        yield SonarImage(
            stamp_ns=start_ns + k * step_ns, range=r, bearing=[angle],
            amplitude=amplitude[:, None], frame_id='sonar', scanning=True, **changes,
        )  # fmt: skip


def sweeps(images, **parameters):
    detector = ImageDetector(DetectorConfig(beam_width_deg=2.0, **parameters))
    return [item for image in images if (item := detector.process(image)) is not None]


def test_directions_of_a_full_turn_are_gathered_into_what_lies_ahead():
    angles = np.arange(0.0, 3.3 * 2.0 * np.pi, STEP)
    found = sweeps(beams(angles))
    assert len(found) == 4  # half of one and three whole ones, each when the sonar looks aside
    for ping in found[1:]:
        assert len(ping) == 1
        assert ping.range[0] == pytest.approx(20.0, abs=0.2)
        assert ping.bearing[0] == pytest.approx(0.1, abs=0.03)


def test_a_sector_scanned_to_and_fro_gives_a_ping_each_way():
    once = np.arange(-0.5, 0.5, STEP)
    found = sweeps(beams(np.concatenate([once, once[-2::-1], once[1:], once[-2::-1]])))
    assert len(found) == 3
    assert [len(ping) for ping in found] == [1, 1, 1]
    assert [ping.bearing[0] for ping in found] == pytest.approx([0.1] * 3, abs=0.03)


def test_the_direction_where_a_sonar_turns_back_is_in_both_sweeps(monkeypatch):
    monkeypatch.setattr('sonar_imm.trackers.obstacle.detector.detect', lambda image, config: image)
    once = np.arange(-0.5, 0.5, STEP)
    found = sweeps(beams(np.concatenate([once, once[-2::-1], once[1:], once[-2::-1]])))
    for image, seen in zip(found, (once, once[::-1], once), strict=True):
        np.testing.assert_allclose(image.bearing, seen)


def test_each_echo_of_a_sweep_has_the_time_of_its_direction():
    once = np.arange(-0.5, 0.5, STEP)
    for target in (0.0, 0.35):
        (ping,) = sweeps(beams(np.concatenate([once, once[-2:-3:-1]]), target=(target, 20.0)))
        heard = 10**9 + 1e8 * (target - once[0]) / STEP
        assert ping.stamp_ns + 1e9 * ping.time_offset[0] == pytest.approx(heard, abs=1e8)
        assert np.sqrt(ping.var_range[0]) < 0.3


@pytest.mark.parametrize('spoil', ['silence', 'ranges', 'frame', 'back'])
def test_a_sweep_ends_where_it_does_not_go_on(spoil):
    first = list(beams(np.arange(-0.5, 0.0, STEP)))
    late = 10**10 if spoil == 'silence' else 3 * 10**9
    rows = 90 if spoil == 'ranges' else 100
    more = list(beams(np.arange(0.0, 0.5, STEP), start_ns=late, rows=rows))
    if spoil == 'frame':
        more = [evolve(item, frame_id='other') for item in more]
    if spoil == 'back':
        more = [evolve(item, stamp_ns=item.stamp_ns - 5 * 10**9 // 2) for item in more]
    detector = ImageDetector(DetectorConfig(beam_width_deg=2.0))
    answers = [detector.process(item) for item in first + more]
    assert sum(answer is not None for answer in answers) == 1
    assert answers[len(first)] is not None


def test_memory_is_bounded_whatever_comes():
    detector = ImageDetector(DetectorConfig(sweep_sector_deg=360.0))
    angles = 1e-5 * np.arange(3000)
    for beam in beams(angles, rows=20):
        detector.process(beam)
    assert len(detector._sweep) <= 1000
    for k in range(200):  # the first sonar goes on saying what it is
        for name in (f'sonar_{k}', 'sonar'):
            detector.describe(SonarInfo(stamp_ns=k, frame_id=name, gain=2.0))
    assert len(detector.infos) <= 16 and {'sonar', 'sonar_199'} <= detector.infos.keys()


SWEEP, RATE = 9.0, np.radians(60.0) / 9.0
OBSTACLES = {'above': (60.0, 6.0, -7.0), 'level': (70.0, -8.0, -10.0), 'below': (55.0, 0.0, -12.0)}
LATEST = 54.0
WIDE = {'horizontal_fov_deg': 90.0}


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


def navigation(t):
    position, angles = vehicle(t)
    q = geometry.quaternion(*angles)
    return Navigation(stamp_ns=stamp(t), position=position, orientation=q, frame_id='odom')


def stamp(t):
    return SECOND + round(t * SECOND)


def dive(scans, obstacles=OBSTACLES, noise=0.0):
    """Navigation at 10 Hz, and what `scans` makes of times, ranges and bearings of each scan."""
    rng = np.random.default_rng(8)
    out = [(stamp(k / 10), navigation(k / 10)) for k in range(1, int(LATEST * 10) + 12)]
    for start in np.arange(0.2, LATEST - SWEEP, SWEEP):
        times = np.array([met(place, start) for place in obstacles.values()])
        places = np.array([seen(place, t) for place, t in zip(obstacles.values(), times)])
        places += noise * rng.normal(size=places.shape) * [0.1, np.radians(0.2)]
        out += [(ping.stamp_ns, ping) for ping in scans(start, times, places)]
    return [item for _, item in sorted(out, key=lambda pair: pair[0])]


def as_scan(start, times, places):
    """One message of the whole scan, with times after its first ray."""
    yield Detections(
        stamp_ns=stamp(start), range=places[:, 0], bearing=places[:, 1], time_offset=times - start
    )


def as_pings(start, times, places):
    """A message for each instant."""
    for t, place in zip(times, places):
        yield Detections(stamp_ns=stamp(t), range=place[:1], bearing=place[1:])


def as_one_instant(start, times, places):
    yield Detections(stamp_ns=stamp(start), range=places[:, 0], bearing=places[:, 1])


def places_of(estimate):
    sure = estimate.extras['track_state'] > 0
    return np.column_stack([estimate.extras[name][sure] for name in ('px', 'py')])


def last(scans, obstacles=OBSTACLES, noise=0.0, **values):
    config = ObstacleConfig(confirm_hits=1, **(WIDE | values))
    return list(run(ObstacleTracker(config), dive(scans, obstacles, noise)).values())[-1]


def test_obstacles_are_where_they_are_however_long_a_scan_takes():
    found = places_of(last(as_scan, noise=1.0))
    assert len(found) == len(OBSTACLES)
    for x, y, _ in OBSTACLES.values():
        assert np.hypot(*(found - [x, y]).T).min() < 0.4
    off = places_of(last(as_one_instant, noise=1.0))
    assert max(np.hypot(*(off - place[:2]).T).min() for place in OBSTACLES.values()) > 1.0


@pytest.mark.parametrize(
    'name, timing', [('above', 'instant'), ('level', 'two_way'), ('below', 'instant')]
)
def test_a_scan_of_one_obstacle_says_what_pings_at_its_instants_say(name, timing):
    """They differ by the prediction, which is taken in two steps, and by the late poses."""
    obstacle = {name: OBSTACLES[name]}
    one, many = (last(kind, obstacle, ping_timing=timing) for kind in (as_scan, as_pings))
    assert one.stamp_ns > many.stamp_ns - SWEEP * SECOND
    assert_allclose(places_of(one), places_of(many), atol=0.02)
    height = [each.xyz[0, 2] for each in (one, many)]
    width = [np.ptp([each.extras[f'vertical_offset_{end}'][0] for end in ('lo', 'hi')])
             for each in (one, many)]  # fmt: skip
    assert height[0] == pytest.approx(height[1], abs=0.1)
    assert width[0] == pytest.approx(width[1], rel=0.05)


def test_rows_are_those_of_the_end_of_the_scan():
    estimate = last(as_scan, noise=1.0)
    t = estimate.stamp_ns / SECOND - 1.0
    for place, r, b in zip(
        places_of(estimate), *estimate.state[estimate.extras['track_state'] > 0, :2].T
    ):
        nearest = min(OBSTACLES.values(), key=lambda each: np.hypot(*(place - each[:2])))
        there = seen(nearest, t)
        assert (r, b) == (pytest.approx(there[0], abs=0.5), pytest.approx(there[1], abs=0.02))


def test_messages_of_scans_may_come_in_any_order():
    messages = dive(as_scan, noise=1.0)
    late = messages[:-40] + messages[-40:][::-1]
    final = [
        list(run(ObstacleTracker(ObstacleConfig(**WIDE)), items).values())[-1]
        for items in (messages, late)
    ]
    for name, column in final[0].columns().items():
        assert_allclose(column, final[1].columns()[name], err_msg=name)


def test_a_row_without_a_time_has_that_of_its_neighbours():
    whole, holed = (
        last(lambda *scan, lost=lost: spoilt(*scan, lost), noise=1.0) for lost in (False, True)
    )
    assert_allclose(places_of(whole), places_of(holed), atol=0.3)


def test_some_rows_of_a_scan_may_have_elevations():
    """Here those of one obstacle, whose height they show."""

    def with_elevation(start, times, places):
        (ping,) = as_scan(start, times, places)
        deepest = np.array(list(OBSTACLES)) == 'below'
        drop = OBSTACLES['below'][2] - np.array([vehicle(t)[0][2] for t in times])
        elevation = np.where(deepest, np.arcsin(drop / places[:, 0]), np.nan)
        yield evolve(ping, elevation=elevation)

    def height_std(estimate):
        sure = estimate.extras['track_state'] > 0
        x, y, _ = OBSTACLES['below']
        row = np.hypot(*(places_of(estimate) - [x, y]).T).argmin()
        return np.sqrt(estimate.covariance[sure][row, 2, 2])

    some, none = (last(kind, noise=1.0) for kind in (with_elevation, as_scan))
    assert len(places_of(some)) == len(places_of(none)) == len(OBSTACLES)
    assert height_std(some) < 0.8 * height_std(none)


def spoilt(start, times, places, lost):
    """A scan in which each echo comes twice, the second time without its time."""
    times = np.concatenate([times, np.where(lost, np.nan, times)])
    twice = np.concatenate([places, places + [20.0, 0.0]])
    yield Detections(
        stamp_ns=stamp(start), range=twice[:, 0], bearing=twice[:, 1], time_offset=times - start
    )


def warnings(scan_time, speed=0.6):
    def untimed(start, times, places):
        yield Detections(
            stamp_ns=stamp(start), range=places[:, 0], bearing=places[:, 1], untimed=scan_time
        )

    tracker = ObstacleTracker(ObstacleConfig(**WIDE))
    run(tracker, dive(untimed))
    return [sentence for sentence in tracker.warnings() if 'no times' in sentence]


def test_a_slow_scan_without_times_is_said():
    assert warnings(0.2) == []
    assert warnings(9.0) == [
        'a scan takes 9.0 s and its detections have no times: one instant is taken for all, '
        'wrong by up to 5.4 m'
    ]
