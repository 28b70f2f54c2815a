# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Sides of a line of instruments: images of rows, and what two receivers leave open."""

from pathlib import Path

from attrs import evolve
from helpers.diver_runs import arrivals, fix, SECOND
import numpy as np
import pytest

from sonar_imm.estimation.bank import Gaussians
from sonar_imm.trackers.diver import sides
from sonar_imm.trackers.diver.instruments import Instruments
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

VECTORS = Path(__file__).parents[2] / 'vectors/diver_in_the_field'
RECEIVERS = np.array([[-40.0, 0.0, 0.0], [40.0, 0.0, 0.0], [10.0, 70.0, 0.0]])
TURNED = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
"""By an angle between two headings of the models."""


def ranges(second, position, rng, count, std=0.5):
    """Two-way ranges of transponders that the first `count` receivers ask."""
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
    with np.load(VECTORS / 'mirror.npz') as found:
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
    estimates = followed(tracker, [ranges(k + 1, p, rng, 2) for k, p in enumerate(path)])
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
        return evolve(ranges(second, place, rng, 2), bearing=np.array([bearing, np.nan]))

    deciding = {
        'receiver': lambda second, place: ranges(second, place, rng, 3),
        'bearing': with_bearing,
        'fix': lambda second, place: fix(second, *place),
    }
    for name, last in deciding.items():
        tracker = DiverTracker(DiverConfig(max_tracks=1))
        *_, before = followed(tracker, [ranges(k + 1, path[k], rng, 2) for k in range(10)])
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
        estimate = tracker.process(ranges(k + 1, place, rng, 3 if k < 10 else 2))[-1]
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
