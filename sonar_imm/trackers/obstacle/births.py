# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Track initiation: seeds.

An echo that may belong to no track becomes a seed, which is only a place and an existence,

    q = u lambda_b / (lambda_b + lambda) q0,    lambda_b = birth_rate dt / A,

u the probability that it is no track's. Its bank of components is made when a later echo could be
of the same obstacle: when q P_D L / lambda exceeds `LEAST_RATIO`, with L the density of that echo
around the place of the seed seen level,

    along   2 R_r + .05^2 + e^2
    across  2 R_b d^2 + (.004 d)^2 + (.03 dt)^2 + e^2,

e^2 = 0 where the obstacle is fixed, 2 sway_std^2 (1 - exp(-dt / sway_time)) where it sways and
(max_speed dt / 2)^2 where it moves. lambda counts what the tracks expect there as well: an echo
of a track makes no bank. Pings without an echo near a seed lower its q; after `LIFETIME` it is
dropped. So clutter costs little.

Source: docs/obstacle.md, section Tracks.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray, IndexArray, take
from ...measurements import nanoseconds
from .bodies import Bodies
from .clutter import Clutter, sector_area
from .config import ObstacleConfig
from .existence import detection, Existence, PRIOR
from .filters import DepthSlices, Mixture, Sonar
from .navigation_errors import NavigationErrors
from .pings import default_variance, Echoes, Met, Ping

LIFETIME = 2.5
"""Seconds without an echo, after which a seed is dropped."""
LEAST_RATIO = 0.003
"""Least q P_D L / lambda of an echo for which a seed gets its bank."""
BEHAVIOURS = 0.65, 0.17, 0.18
"""Prior of a new obstacle: fixed, swaying, moving."""
LEAST_ALONG, LEAST_ACROSS, TURNS = 0.05, 0.004, 0.03
"""m, rad, m/s: errors that a place seen level leaves out."""
FIRST_INTERVAL, LONGEST_INTERVAL = 0.5, 60.0
"""Seconds of births that count for the first ping, and at most for any ping."""
EARLY_PINGS = 20
"""Pings in which the clutter density of seeds is updated."""
MAX_SEEDS = 3000
STRIP = 64
"""Seeds that are compared with echoes at once."""


class Seeds(NamedTuple):
    """Seeds of one ping."""

    stamp_ns: int
    sonar: Sonar
    echoes: Echoes
    classes: Annotated[FloatArray, 'SC']
    """q (S, C)."""
    density: Annotated[FloatArray, 'S']
    """(S,) of false echoes, as q has it."""
    place: Annotated[FloatArray, 'S2']
    """(S, 2) seen level, NED m."""
    along: Annotated[FloatArray, 'S2']
    """(S, 2) unit vectors to it."""

    def rows(self, which: BoolArray) -> Seeds:
        """Return some of the seeds."""
        return self._replace(
            echoes=self.echoes.rows(which),
            classes=self.classes[which],
            density=self.density[which],
            place=self.place[which],
            along=self.along[which],
        )


SeedBatches = tuple[Seeds, ...]
"""Seeds of the last pings, the oldest first."""
Bank = tuple[Mixture, Bodies, Existence, Met | None, int]
"""See `build_bank`."""


def level_places(z: FloatArray, sonar: Sonar) -> tuple[FloatArray, FloatArray]:
    """Return the places (S, 2) of echoes z (S, 2) seen level, NED m, and the unit vectors to
    them."""
    pose = sonar.pose
    m = np.column_stack([np.cos(z[:, 1]), np.sin(z[:, 1]), np.zeros(len(z))])
    along = (m @ pose.R.T)[:, :2]
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    return pose.position[:2] + z[:, :1] * along, along


def add_seeds(
    batches: SeedBatches,
    ping: Ping,
    false: FloatArray,
    density: FloatArray,
    config: ObstacleConfig,
) -> SeedBatches:
    """Return the seeds with those of a ping, without those that are too old.

    :param false: (D,) probability that each echo is no track's.
    :param density: (D,) of false echoes.
    """
    dt = min(ping.dt, LONGEST_INTERVAL) if ping.dt > 0.0 else FIRST_INTERVAL
    born = config.birth_rate * dt / sector_area(config)
    r = np.clip(false, 0.0, 1.0) * born / (born + density)
    takes = 0.0 if ping.echoes.late is None else -float(ping.echoes.late.min(initial=0.0))
    oldest = ping.stamp_ns - nanoseconds(max(LIFETIME, ping.dt) + takes)
    kept = [seeds for seeds in batches if seeds.stamp_ns >= oldest and len(seeds.classes)]
    classes, echoes = r[:, None] * PRIOR, ping.echoes
    if echoes.late is None:
        places = level_places(echoes.z, ping.sonar)
        kept.append(Seeds(ping.stamp_ns, ping.sonar, echoes, classes, density, *places))
    else:
        for i, (late, sonar) in enumerate(zip(echoes.late.tolist(), ping.places())):
            one, stamp_ns = slice(i, i + 1), ping.stamp_ns + nanoseconds(late)
            places = level_places(echoes.z[one], sonar)
            own = echoes.rows(np.array([i]))
            kept.append(Seeds(stamp_ns, sonar, own, classes[one], density[one], *places))
    while sum(len(seeds.classes) for seeds in kept) > MAX_SEEDS and len(kept) > 1:
        kept.pop(0)
    return tuple(kept)


def association_ratios(
    seeds: Seeds, ping: Ping, place: FloatArray, expected: FloatArray, config: ObstacleConfig
) -> FloatArray:
    """Return q P_D L / lambda (S,) of each seed with the echo that fits it best.

    :param place: (D, 2) of the echoes, seen level.
    :param expected: (D,) density of false echoes and of those that tracks expect.
    """
    best = np.zeros(len(seeds.classes))
    if not len(best) or not len(place):
        return best
    dt = (ping.stamp_ns - seeds.stamp_ns) * 1e-9
    d, R = seeds.echoes.z[:, 0], seeds.echoes.R
    along = 2.0 * R[:, 0, 0] + LEAST_ALONG**2
    across = 2.0 * R[:, 1, 1] * d * d + (LEAST_ACROSS * d) ** 2 + (TURNS * dt) ** 2
    swung = 2.0 * config.sway_std**2 * -np.expm1(-dt / config.sway_time)
    gone = (0.5 * config.max_speed * dt) ** 2
    reach = 16.0 * (np.maximum(along, across) + max(swung, gone))
    seen = (seeds.classes * detection(d, config)).sum(axis=1)
    for s, i in _pairs_within(seeds.place, np.sqrt(reach), place):
        off, (north, east) = place[i] - seeds.place[s], seeds.along[s].T
        ahead = off[:, 0] * north + off[:, 1] * east
        aside = off[:, 1] * north - off[:, 0] * east
        L = np.zeros(len(s))
        for share, more in zip(BEHAVIOURS, (0.0, swung, gone)):
            a, c = along[s] + more, across[s] + more
            square = ahead * ahead / a + aside * aside / c
            L += share * np.exp(-0.5 * square) / (2.0 * np.pi * np.sqrt(a * c))
        np.maximum.at(best, s, seen[s] * L * d[s] / expected[i])
    return best


def _pairs_within(
    place: FloatArray, reach: FloatArray, others: FloatArray
) -> Iterator[tuple[IndexArray, IndexArray]]:
    """Yield the pairs of places (S, 2) and others (D, 2) within the reach (S,) of the place, m.

    In parts, of which each has the places and others of one strip of northings: all pairs of a
    ping of thousands of echoes would take gigabytes.
    """
    northward, sorted_ = np.argsort(place[:, 0]), np.argsort(others[:, 0])
    north = others[sorted_, 0]
    for first in range(0, len(place), STRIP):
        rows = northward[first : first + STRIP]
        widest = reach[rows].max()
        ends = place[rows[0], 0] - widest, place[rows[-1], 0] + widest
        near = sorted_[slice(*np.searchsorted(north, ends))]
        apart = np.square(others[None, near] - place[rows, None]).sum(axis=2)
        s, i = np.nonzero(apart < np.square(reach[rows])[:, None])
        yield rows[s], near[i]


def with_clutter_density(
    batches: SeedBatches, clutter: Clutter, config: ObstacleConfig
) -> SeedBatches:
    """Return the seeds with the clutter density as it is known by now: seeds of the first pings
    began when nothing was known."""
    if clutter.pings > EARLY_PINGS or config.clutter_density > 0.0:
        return batches
    found = []
    for seeds in batches:
        density = np.maximum(clutter.density(seeds.echoes.z, config), seeds.density)
        less = (seeds.density / density)[:, None]
        found.append(seeds._replace(classes=less * seeds.classes, density=density))
    return tuple(found)


def with_miss(seeds: Seeds, config: ObstacleConfig) -> Seeds:
    """Return the seeds after a ping without an echo of them."""
    q = seeds.classes
    left = q * (1.0 - detection(seeds.echoes.z[:, 0], config))
    total = 1.0 - q.sum(axis=1) + left.sum(axis=1)
    return seeds._replace(classes=left / total[:, None])


def start_banks(
    batches: SeedBatches,
    ping: Ping,
    expected: FloatArray,
    errors: NavigationErrors,
    filter_: DepthSlices,
    room: int,
) -> tuple[SeedBatches, list[Bank]]:
    """Return the seeds that are left after a ping, and the banks of those that it may show again,
    at the instant at which it does.

    :param expected: (D,) density of false echoes and of those that tracks expect.
    :param errors: of the navigation.
    :param room: most seeds that get a bank, those of the largest ratio first.
    """
    config, z = filter_.config, ping.echoes.z
    if ping.sweep is None:
        place, _ = level_places(z, ping.sonar)
    else:
        seen = [level_places(z[i : i + 1], sonar)[0] for i, sonar in enumerate(ping.places())]
        place = np.concatenate(seen)
    found = (association_ratios(seeds, ping, place, expected, config) for seeds in batches)
    worth = np.concatenate([np.empty(0), *found])
    best = np.argsort(-worth, kind='stable')[: max(room, 0)]
    grows = np.zeros(len(worth), np.bool_)
    grows[best] = worth[best] > LEAST_RATIO
    banks, left = [], []
    for seeds in batches:
        chosen, grows = grows[: len(seeds.classes)], grows[len(seeds.classes) :]
        left.append(with_miss(seeds.rows(~chosen), config))
        if chosen.any():
            banks.append(build_bank(seeds.rows(chosen), ping, errors, filter_))
    return tuple(left), banks


def build_bank(seeds: Seeds, ping: Ping, errors: NavigationErrors, filter_: DepthSlices) -> Bank:
    """Return the components of seeds, made at their instant and carried to a ping, where that met
    them, and how many covariances had to be repaired."""
    echoes, config, then = seeds.echoes, filter_.config, seeds.sonar
    bodies, R = Bodies.unknown(len(echoes)).with_echoes(
        echoes.extended, echoes.z, echoes.R, default_variance(config)
    )
    mixture = filter_.begin(echoes.z, R, then, echoes.height_prior(then, ping.ground, config))
    mixture, _ = echoes.update_height(errors.given_to(mixture), then.pose, config)
    dt, found = (ping.stamp_ns - seeds.stamp_ns) * 1e-9, None
    if ping.sweep is None:
        mixture, repairs = filter_.advance(mixture, then, ping.sonar, dt)
    else:
        found = ping.sweep.met(*filter_.whereabouts(mixture, then), dt)
        before = [then] * len(echoes)
        mixture, repairs = filter_.advance_each(mixture, before, found.sonars, dt - found.ago)
    finite = mixture.is_finite()
    if not finite.all():
        mixture, bodies, seeds = take(mixture, finite), take(bodies, finite), seeds.rows(finite)
        found = found and found.rows(finite)
    return mixture, bodies, Existence.of(seeds.classes, filter_.K), found, repairs
