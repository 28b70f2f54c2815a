# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What arrivals leave open: sides of a line, pings with one arrival, times that are rounded."""

from attrs import evolve
from helpers.diver_runs import arrivals, fix, SECOND
from helpers.vector_files import load_vectors
import numpy as np
import pytest
from scipy.optimize import least_squares

from sonar_imm.estimation.bank import Gaussians
from sonar_imm.trackers.diver import ranges, sides
from sonar_imm.trackers.diver.arrival_stamps import ArrivalStamps, Resolution
from sonar_imm.trackers.diver.instruments import Instruments
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

RECEIVERS = np.array([[-40.0, 0.0, 0.0], [40.0, 0.0, 0.0], [10.0, 70.0, 0.0]])
TURNED = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
"""By an angle between two headings of the models."""


def transponders(second, position, rng, count, std=0.5):
    """Two-way transponders of transponders that the first `count` receivers ask."""
    rx = RECEIVERS[:count].copy()
    rx[:, :2] = rx[:, :2] @ TURNED.T
    path = 2.0 * np.linalg.norm(np.append(position, 0.0) - rx, axis=1)
    return arrivals(
        round(second * SECOND), rx, (path + 2.0 * std * rng.normal(size=count)) / 1500.0,
        tx_id=np.arange(count) + 1, tx=rx, var_toa=(2.0 * std / 1500.0) ** 2, var_bearing=0.01,
    )  # fmt: skip


def positions(steps, start=(-25.0, 30.0), velocity=(0.6, 0.2)):
    at = np.array(start) + np.arange(steps)[:, None] * np.array(velocity)
    return at @ TURNED.T


def followed(tracker, pings):
    return [tracker.process(ping)[-1] for ping in pings]


def layout_of(config, models):
    return Instruments().layout(config, models)


def rows_of(models, x, P, mu):
    return models.make_rows(x[None, None], P[None, None], mu[None, None], np.zeros((1, 1)))


def test_the_image_is_that_of_an_independent_prototype():
    config = DiverConfig(covariance_scales=(1.0,))
    models, layout = build_models(config), layout_of(config, build_models(config))
    found = load_vectors('diver_in_the_field/mirror')
    x, P, a, b = (found[name] for name in ('x', 'P', 'a', 'b'))
    line = sides.line_through(np.array([a, b]), 0.5)
    quiet = np.eye(len(models.names))[-1]
    each = np.tile(x, (len(quiet), 1)), np.tile(P, (len(quiet), 1, 1))
    rows = sides.with_images(rows_of(models, *each, quiet), 0, models, layout, line)
    image = rows.blocks[1]
    np.testing.assert_allclose(image.x[1, :, -1], found['mirrored_x'], atol=1e-12)
    np.testing.assert_allclose(image.P[1, :, :, -1], found['mirrored_P'], atol=1e-12)
    parts = rows.blocks[1].x[..., -1], rows.blocks[1].P[..., -1]
    mean, covariance = rows.combine(*parts, rows.weight)
    np.testing.assert_allclose(mean[0], found['mean'], atol=1e-12)
    np.testing.assert_allclose(covariance[0], found['cov'], atol=1e-10)
    np.testing.assert_allclose(rows.weight, 0.5)


@pytest.mark.parametrize('model_set', ['families', 'heading_speed'])
@pytest.mark.parametrize('angle', [0.0, 0.3, 2.0])
def test_the_image_of_an_image_of_a_line_along_a_heading_is_the_row_itself(model_set, angle):
    """Else it lies between two models: position, mean speed and weights of families stay."""
    config = DiverConfig(model_set=model_set, covariance_scales=(1.0,), dimensions=3)
    models = build_models(config)
    layout = layout_of(evolve(config, receiver_position_std=1.0), models)
    rng, M, n = np.random.default_rng(3), len(models.names), models.n
    x, _, _ = models.initial_states(np.array([[3.0, 7.0]]), np.eye(2)[None])
    x = x[0, 0] + 0.1 * rng.normal(size=(M, n))
    root = rng.normal(size=(M, n, n))
    P, mu = root @ np.swapaxes(root, 1, 2) + np.eye(n), rng.dirichlet(np.ones(M))
    blocks = models.to_blocks(x[None], P[None])
    table = models.make_rows(*(part[:1] for part in _full(models, config)))
    rows = evolve(table.select(np.arange(1)), blocks=blocks, mu=mu[None])
    line = sides.Line(np.array([1.0, 2.0]), np.array([np.cos(angle), np.sin(angle)]))
    image = sides.mirror_rows(rows, models, layout, line)
    again = sides.mirror_rows(image, models, layout, line)
    maps = tuple(part.outputs for part in models.parts)
    before, once, twice = (sides.row_outputs(each, maps)[0][0] for each in (rows, image, again))
    np.testing.assert_allclose(line.image(before[:2]), once[:2], atol=1e-9)
    np.testing.assert_allclose(before[:3], twice[:3], atol=1e-9)
    assert image.mu.sum() == pytest.approx(1.0) and all(
        (np.linalg.eigvalsh(np.moveaxis(block.P, -1, 1)) > 0.0).all() for block in image.blocks
    )
    if angle == 0.0:
        np.testing.assert_allclose(again.mu, rows.mu, atol=1e-12)
        for ours, theirs in zip(again.blocks, rows.blocks):
            np.testing.assert_allclose(ours.x, theirs.x, atol=1e-9)
            np.testing.assert_allclose(ours.P, theirs.P, atol=1e-9)


def _full(models, config):
    x, P, mu = models.initial_states(np.zeros((1, 2)), np.eye(2)[None])
    return x, P, mu, np.zeros(x.shape[:2])


def test_two_receivers_leave_the_side_open_and_say_so():
    rng, tracker = np.random.default_rng(1), DiverTracker(DiverConfig())
    path = positions(40)
    estimates = followed(tracker, [transponders(k + 1, p, rng, 2) for k, p in enumerate(path)])
    line = sides.Line(np.zeros(2), TURNED[:, 0])
    for place, estimate in list(zip(path, estimates))[5:]:
        assert len(estimate) == 1
        extras = estimate.extras
        assert extras['side_probability'][0] == pytest.approx(0.5, abs=1e-9)
        mirror = np.array([extras['mirror_x'][0], extras['mirror_y'][0]])
        other = 2.0 * estimate.state[0, :2] - mirror
        nearest = min(np.hypot(*(side - place)) for side in (mirror, other))
        assert nearest < 3.0
        np.testing.assert_allclose(line.image(mirror), other, atol=1.0)
        error = estimate.state[0, :2] - place
        assert error @ np.linalg.solve(estimate.covariance[0, :2, :2], error) < 9.0
    assert sides.NOT_TOLD in tracker.warnings()


def test_a_third_receiver_or_a_bearing_or_a_fix_decides():
    path = positions(14)
    rng = np.random.default_rng(2)

    def with_bearing(second, place):
        bearing = np.arctan2(*(place - TURNED @ RECEIVERS[0, :2])[::-1])
        return evolve(transponders(second, place, rng, 2), bearing=np.array([bearing, np.nan]))

    deciding = {
        'receiver': lambda second, place: transponders(second, place, rng, 3),
        'bearing': with_bearing,
        'fix': lambda second, place: fix(second, *place),
    }
    for name, last in deciding.items():
        tracker = DiverTracker(DiverConfig(max_tracks=1))
        *_, before = followed(tracker, [transponders(k + 1, path[k], rng, 2) for k in range(10)])
        assert np.isfinite(before.extras['side_probability'][0])
        # One arrival alone may be wild.
        after = followed(tracker, [last(k + 1, path[k]) for k in range(10, 13)])[-1]
        assert np.isnan(after.extras['side_probability'][0]), name
        assert np.isnan(after.extras['mirror_x'][0])
        assert np.hypot(*(after.state[0, :2] - path[12])) < 3.0
        assert after.extras['track_id'].tolist() == before.extras['track_id'].tolist()
        assert sides.NOT_TOLD not in tracker.warnings()


def test_who_crosses_the_line_is_in_doubt_again():
    """Decided by a third receiver, then with two: far from the line it stays known."""
    rng, tracker = np.random.default_rng(5), DiverTracker(DiverConfig(max_tracks=1))
    path = positions(60, start=(-20.0, 15.0), velocity=(0.3, -0.6))
    known = []
    for k, place in enumerate(path):
        estimate = tracker.process(transponders(k + 1, place, rng, 3 if k < 10 else 2))[-1]
        known.append(bool(np.isnan(estimate.extras['side_probability'][0])))
        if k > 5:
            error = estimate.state[0, :2] - place
            assert error @ np.linalg.solve(estimate.covariance[0, :2, :2], error) < 14.0
    assert all(known[3:18]) and not any(known[35:])
    assert estimate.extras['side_probability'][0] < 0.99


def test_what_is_a_line():
    line = sides.line_through(np.array([[0.0, 0.0], [10.0, 10.0], [20.0, 20.1]]), 0.3)
    assert line.tells_nothing and abs(line.across @ [1.0, 1.0]) < 0.01
    nearly = sides.line_through(np.array([[0.0, 0.0], [50.0, 0.8], [100.0, 0.0]]), 0.1)
    assert nearly is not None and not nearly.tells_nothing
    assert sides.line_through(np.array([[0.0, 0.0], [50.0, 20.0], [100.0, 0.0]]), 0.3) is None
    assert sides.line_through(np.array([[5.0, 5.0], [5.0, 5.0]]), 0.3) is None
    assert sides.line_through(np.array([[5.0, 5.0]]), 0.3) is None


def test_weights_of_sides_are_held_by_what_tells_nothing():
    side = np.array([0, 0, 1])
    before, after = np.log([0.3, 0.5, 0.2]), np.log([0.1, 0.1, 0.8])
    held = np.exp(sides.hold_sides(before, after, side))
    np.testing.assert_allclose(held, [0.4, 0.4, 0.2])


def test_a_block_of_one_model_keeps_its_covariance():
    """The spread of a share is added where two headings share one image."""
    config = DiverConfig(model_set='heading_speed')
    models = build_models(config)
    x, P, mu, logw = _full(models, config)
    mu = np.zeros_like(mu)
    mu[..., 0] = 1.0
    rows = models.make_rows(x, P, mu, logw)
    turned = 0.5 * np.radians(7.0)
    line = sides.Line(np.zeros(2), np.array([np.cos(turned), np.sin(turned)]))
    image = sides.mirror_rows(rows, models, layout_of(config, models), line)
    assert image.mu[0, 0] == pytest.approx(1.0 - 7.0 / 22.5)
    assert image.mu[0, 1] == pytest.approx(7.0 / 22.5)
    assert isinstance(image.blocks[0], Gaussians)


BUOYS = np.array([[-40.0, -40.0], [40.0, -40.0], [40.0, 40.0], [-40.0, 40.0]])
START, SWUM, STD = np.array([-20.0, 15.0]), np.array([0.5, -0.3]), 0.5


def single(second, place, target, rng, std=STD):
    """The two-way range of a target from one place."""
    at = np.append(place, 0.0)[None]
    path = 2.0 * np.linalg.norm(np.append(target, 0.0) - at) + 2.0 * std * rng.normal()
    return arrivals(
        round(second * SECOND), at, np.array([path / 1500.0]), tx_id=np.ones(1), rx_id=np.zeros(1),
        tx=at, var_toa=(2.0 * std / 1500.0) ** 2,
    )  # fmt: skip


def swim(place_of, steps, seed=1, swum=SWUM, **config):
    """Estimates and targets of a diver whose ranges come from ``place_of(second)``."""
    rng, tracker = np.random.default_rng(seed), DiverTracker(DiverConfig(**config))
    targets = START + np.arange(1, steps + 1)[:, None] * swum
    pings = [single(k + 1, place_of(k + 1), at, rng) for k, at in enumerate(targets)]
    return tracker, [tracker.process(ping)[-1] for ping in pings], targets


def circled(second):
    angle = 2.0 * np.pi * second / 60.0
    return 50.0 * np.array([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize('model_set', ['families', 'heading_speed'])
def test_four_buoys_in_turn_begin_a_track_after_five_pings(model_set):
    tracker, estimates, targets = swim(lambda s: BUOYS[s % 4], 40, model_set=model_set)
    assert [len(estimate) for estimate in estimates[:5]] == [0, 0, 0, 0, 1]
    for estimate, target in list(zip(estimates, targets))[8:]:
        error = estimate.state[0, :2] - target
        assert error @ np.linalg.solve(estimate.covariance[0, :2, :2], error) < 14.0
    assert np.hypot(*error) < 2.0 and estimate.extras['track_state'].tolist() == [1]
    assert np.isnan(estimate.extras['side_probability'][0]) and not tracker.warnings()


def test_a_ship_on_a_circle_finds_a_target():
    _, estimates, targets = swim(circled, 90, swum=np.zeros(2))
    error = estimates[-1].state[0, :2] - targets[-1]
    assert np.hypot(*error) < 3.0


def test_one_place_begins_no_track_and_says_so():
    tracker, estimates, _ = swim(lambda s: np.zeros(2), 30)
    assert not any(len(estimate) for estimate in estimates)
    assert tracker.warnings() == [ranges.NO_TRACK]


def test_ranges_from_a_line_have_two_sides():
    tracker, estimates, targets = swim(
        lambda s: np.array([40.0 * ((s % 3) - 1.0) - 10.0, -30.0]), 40
    )
    estimate = estimates[-1]
    assert len(estimate) == 1 and sides.NOT_TOLD in tracker.warnings()
    extras = estimate.extras
    assert extras['side_probability'][0] == pytest.approx(0.5, abs=1e-6)
    mirror = np.array([extras['mirror_x'][0], extras['mirror_y'][0]])
    other = 2.0 * estimate.state[0, :2] - mirror
    assert min(np.hypot(*(side - targets[-1])) for side in (mirror, other)) < 2.0
    np.testing.assert_allclose(mirror * [1.0, -1.0] - [0.0, 60.0], other, atol=0.5)


def test_a_range_of_a_track_begins_no_other():
    tracker, estimates, _ = swim(lambda s: BUOYS[s % 4], 60)
    assert {tuple(e.extras['track_id']) for e in estimates[6:]} == {(1,)}


def problem(rng, place_of=lambda k: BUOYS[k % 4], acceleration=0.0, count=9):
    time = np.arange(count) - (count - 1.0)
    at = np.column_stack([np.array([place_of(k) for k in range(count)]), np.zeros(count)])
    target = START + time[:, None] * SWUM
    path = 2.0 * np.hypot(*(target - at[:, :2]).T) + 2.0 * STD * rng.normal(size=count)
    variance = np.full(count, 4.0 * STD**2)
    return ranges.Problem(time, at, at, path, variance, 0.0, 0.7, acceleration)


def test_the_fit_is_that_of_another_solver():
    given = problem(np.random.default_rng(4))
    fit = ranges.fit_ranges(given, None)

    def residuals(x):
        place = x[:2] + given.time[:, None] * x[2:]
        expected = 2.0 * np.hypot(*(place - given.tx[:, :2]).T)
        prior = x[2:] / given.velocity_std
        return np.append((given.path - expected) / np.sqrt(given.variance), prior)

    found = least_squares(residuals, np.append(START, SWUM), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(fit.x[0], found.x, atol=1e-3)
    np.testing.assert_allclose(fit.P[0], np.linalg.inv(found.jac.T @ found.jac), rtol=1e-2)
    assert fit.weight.tolist() == [1.0]


def test_accelerations_are_in_the_covariance_of_the_fit():
    """The error of the last position, of targets that turn as assumed."""
    rng, squared = np.random.default_rng(7), []
    for _ in range(120):
        given = problem(rng, acceleration=0.05, count=12)
        # An integrated random walk backwards from the last range.
        steps = 100
        fine = rng.normal(size=(11 * steps, 2)) * np.sqrt(0.05 / steps)
        velocity = np.cumsum(fine, axis=0)
        way = np.vstack([np.zeros(2), np.cumsum(velocity, axis=0) / steps])[::steps][::-1]
        place = START + given.time[:, None] * SWUM + way
        noise = 2.0 * STD * rng.normal(size=12)
        path = 2.0 * np.hypot(*(place - given.tx[:, :2]).T) + noise
        fit = ranges.fit_ranges(given._replace(path=path), None)
        if fit is not None:
            error = fit.x[0, :2] - START
            squared.append(error @ np.linalg.solve(fit.P[0, :2, :2], error))
    assert len(squared) > 100
    assert np.mean(squared) == pytest.approx(2.0, abs=0.55)


def test_ranges_that_fit_no_target_begin_no_track():
    given = problem(np.random.default_rng(4))
    wild = given._replace(path=given.path + 30.0 * np.random.default_rng(5).normal(size=9))
    assert ranges.fit_ranges(wild, None) is None


SQUARE = np.array([[0.0, 0.0, -2.0], [240.0, 0.0, -2.0], [240.0, 240.0, -2.0], [0.0, 240.0, -2]])


def heard(step, count=60, seed=1, period=3.7, active=False):
    """Pings of a tag, or echoes of a transmitter, whose times are multiples of `step` s (0: not),
    and where the target is. The times of messages are on whole seconds."""
    rng = np.random.default_rng(seed)
    n = len(SQUARE)
    for k in range(count):
        emitted = 100.0 + period * k + rng.uniform(0.0, 1.0)
        place = np.array([90.0 + 0.4 * period * k, 100.0 + 20.0 * np.sin(k / 15), 0.0])
        path = np.linalg.norm(SQUARE - place, axis=1)
        path += active * np.linalg.norm(SQUARE[0] - place)
        delay = path / 1500.0 + 1e-4 * rng.normal(size=n)
        start = round(emitted * (1 if active else 1e9)) * (SECOND if active else 1)
        at = np.round(delay * 1e9).astype(np.int64) + (0 if active else start)
        if step:
            at = np.round(at / (step * 1e9)).astype(np.int64) * round(step * 1e9)
        stamp = start if active else int(at.min())
        toa = (at - (0 if active else stamp)) / 1e9
        known = {'tx_id': np.full(n, 1), 'rx_id': np.arange(1, n + 1)}
        known |= {'tx': SQUARE[0]} if active else {}
        yield place[:2], arrivals(stamp, SQUARE, toa, **known)


def tracked(step, **how):
    """Errors (n,), normalised ones, and warnings of a run."""
    tracker, errors, squared = DiverTracker(DiverConfig(max_tracks=1)), [], []
    for k, (place, ping) in enumerate(heard(step, **how)):
        (estimate,) = tracker.process(ping)
        if k >= 30 and len(estimate):
            error = estimate.state[0, :2] - place
            errors.append(np.hypot(*error))
            squared.append(error @ np.linalg.solve(estimate.covariance[0, :2, :2], error))
    return np.array(errors), np.array(squared), tracker


def test_the_resolution_is_that_of_an_independent_program():
    v = load_vectors('diver_in_the_field/quantum')
    found = [Resolution().after(stamps).seconds for stamps in v['stamps_ns']]
    np.testing.assert_allclose(found, v['seconds'], rtol=1e-12)
    assert Resolution().after(v['few']).seconds == v['few_seconds'] == 0.0


def test_the_resolution_is_that_of_all_times_in_whatever_parts_they_come():
    stamps = load_vectors('diver_in_the_field/quantum')['stamps_ns'][1]
    known = Resolution()
    for part in np.array_split(stamps, 9):
        known = known.after(part)
    assert known == Resolution().after(np.sort(stamps))._replace(values=known.values)
    assert known.seconds == 0.1 and known.after(np.array([12_345_678_912])).seconds == 0.0
    # Seconds since 1970 as a float are not exact; one delay again and again shows nothing.
    rough = np.array([round((1.7e9 + 0.1 * k) % 1e6 * 1e9) + 119 for k in range(30)])
    assert Resolution().after(rough).seconds == pytest.approx(0.1)
    still = Resolution()
    for _ in range(30):
        still = still.after(np.array([80_000_000]))
    assert still.seconds == 0.0


@pytest.mark.parametrize('active', [False, True])
def test_stamps_of_messages_on_whole_seconds_are_no_resolution(active):
    known = ArrivalStamps()
    for _, ping in heard(0.0, active=active):
        whole = evolve(ping, stamp_ns=ping.stamp_ns // SECOND * SECOND)
        known = known.after(whole)
    assert known.resolution == 0.0 and 339.0 < known.span < 340.0


@pytest.mark.parametrize('step, active', [(1e-3, True), (1e-2, False)])
def test_rounding_is_counted_in(step, active):
    _, squared, tracker = tracked(step, active=active)
    assert len(squared) > 25 and squared.mean() < 3.0 and (squared < 5.99).mean() > 0.85
    (sentence,) = [text for text in tracker.warnings() if 'multiples' in text]
    assert f'multiples of {step:g} s: a resolution of {1500 * step:.3g} m' in sentence
    assert f'toa_std raised to {step / 12**0.5:.2g} s' in sentence


def test_no_position_is_had_of_whole_seconds():
    _, _, tracker = tracked(1.0)
    (sentence,) = [text for text in tracker.warnings() if 'multiples' in text]
    assert 'no position can be had of them' in sentence and '1.5e+03 m' in sentence
    assert not (tracker._stream.state.life.status > 0).any()


def test_what_is_stated_is_used_and_exact_times_say_nothing():
    errors, squared, tracker = tracked(0.0)
    assert np.median(errors) < 0.5 and squared.mean() < 3.0
    assert not any('multiples' in text for text in tracker.warnings())
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    for _, ping in heard(1e-3):
        stated = np.float32(1e-6 / 12.0)  # as those who know of the rounding state it
        tracker.process(evolve(ping, var_toa=np.full(len(SQUARE), stated, np.float64)))
    assert not any('multiples' in text for text in tracker.warnings())
