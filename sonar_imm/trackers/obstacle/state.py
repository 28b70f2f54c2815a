# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""All that the obstacle tracker knows, as values.

`Known` is what is known after a ping. Its obstacles are a table, `Obstacles`: each column, or
table in it, holds one row for each, in the order of `Known.life`; `estimation.arrays` takes,
appends and replaces rows of all columns alike. No array is ever written again.

What leaves the view is remembered as a landmark (`memory`), and recalled when its place comes into
view again.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

from attrs import frozen
import numpy as np

from ...acoustics import geometry
from ...acoustics.geometry import Pose
from ...estimation.arrays import append, BoolArray, FloatArray, take
from ...estimation.association import TENTATIVE, TrackRules, Tracks
from ...estimation.consistency import NisMemory
from .beam import MissEvidence
from .births import SeedBatches
from .bodies import Bodies, with_common_errors
from .clutter import Clutter
from .config import ObstacleConfig
from .existence import Existence, PRIOR, SUREST
from .filters import DepthSlices, Mixture, Sonar
from .memory import in_view, kept, Landmark, LEAST_WEIGHT, Memory
from .navigation_errors import NavigationErrors
from .pings import Inbox, joined, Mount, Ping
from .scales import Scales

RULES = TrackRules(confirm_hits=2, confirm_window=2, delete_misses=1, max_coast_ns=0)
"""Tracks begin tentative; `existence` says how they live."""


class Obstacles(NamedTuple):
    """T obstacles in view."""

    mixture: Mixture
    """Over depth and behaviour."""
    nis: Annotated[FloatArray, 'T']
    """(T,) of the newest echo; NaN without one in the newest ping."""
    bodies: Bodies
    """How far their echoes wander."""
    misses: MissEvidence
    """Pings that did not show them, and what that says of their height."""
    existence: Existence
    """How sure it is that they are there."""
    last: Annotated[FloatArray, 'T2']
    """(T, 2) innovation in range and bearing, in standard deviations; NaN as `nis`."""


class Known(NamedTuple):
    """What is known after a ping."""

    stamp_ns: int
    """0 before the first one."""
    sonar: Sonar
    life: Tracks
    """Of the obstacles in view."""
    obstacles: Obstacles
    memory: Memory = ()
    """Obstacles that are not in view any more."""
    repairs: int = 0
    """Number of covariances repaired so far."""
    broken: int = 0
    """Number of tracks ended so far because their numbers were not finite."""
    alike: bool = False
    """Whether most obstacles move alike (`filters.moving_alike`)."""
    pings_alike: int = 0
    """Number of pings so far in which they did."""
    innovations: NisMemory = NisMemory()
    """Of confirmed obstacles."""
    seeds: SeedBatches = ()
    """Echoes that may become tracks."""
    clutter: Clutter = Clutter.none()
    scales: Scales = Scales.none()
    """Of the variances of the echoes."""
    untimed: tuple[float, float] = (0.0, 0.0)
    """Of the ping without times that is the most wrong for it: s that it took, m of the error."""
    navigation: NavigationErrors = NavigationErrors(np.zeros(5), np.zeros((5, 5)))

    @classmethod
    def nothing(cls, filter_: DepthSlices) -> Known:
        """Return what is known before the first ping."""
        K, n = filter_.K, filter_.n
        mixture = Mixture(np.empty((0, K, n)), np.empty((0, K, n, n)), np.empty((0, K)))
        sonar = Sonar(Pose(np.zeros(3), np.eye(3)))
        existence = Existence.of(np.empty((0, len(PRIOR))), K)
        none = begun(mixture, Bodies.unknown(0), existence)
        errors = NavigationErrors.of(filter_.config)
        return cls(0, sonar, Tracks.none(RULES), none, navigation=errors)

    @property
    def confirmed(self) -> BoolArray:
        """(T,) Which tracks are confirmed, coasting ones included."""
        return self.life.status != TENTATIVE

    def with_columns(self, **columns: Any) -> Known:
        """Return the same with other columns of the obstacles."""
        return self._replace(obstacles=self.obstacles._replace(**columns))

    def only(self, kept: BoolArray) -> Known:
        """Return the same with the obstacles where `kept` (T,) is True."""
        if kept.all():
            return self
        return self._replace(life=self.life.only(kept), obstacles=take(self.obstacles, kept))

    def joined(self, life: Tracks, new: Obstacles) -> Known:
        """Return the same with more obstacles, which `life` has already."""
        return self._replace(life=life, obstacles=append(self.obstacles, new))


def begun(
    mixture: Mixture, bodies: Bodies, existence: Existence, silent: bool = False
) -> Obstacles:
    """Return obstacles that begin; silent: without an echo."""
    T = len(mixture.mu)
    misses = MissEvidence.first(mixture, silent)
    unseen = np.full((T, 2), np.nan)
    return Obstacles(mixture, np.full(T, np.nan), bodies, misses, existence, unseen)


@frozen(eq=False)
class ObstacleState:
    """All that is known at a stamp. done: what was known after each ping that this step
    completed."""

    known: Known
    inbox: Inbox = Inbox()
    done: tuple[Known, ...] = ()


# -- what leaves the view, and comes back ---------------------------------------------------------


def remember(
    known: Known, over: BoolArray, filter_: DepthSlices, mount: Mount, config: ObstacleConfig
) -> Known:
    """Return the same with landmarks of the confirmed obstacles whose tracks are `over` (T,)."""
    over = over & known.confirmed
    if not np.count_nonzero(over):
        return known
    existence = known.obstacles.existence
    stays = known.obstacles.mixture.mu[:, filter_.moves].sum(axis=1) <= 0.5
    which = np.flatnonzero(over & stays & (existence.probability() > 0.5))
    if not len(which):
        return known
    mixture, bodies = take(known.obstacles.mixture, which), take(known.obstacles.bodies, which)
    mu = np.where(filter_.moves, 0.0, mixture.mu)
    mu = np.where(mu >= LEAST_WEIGHT * mu.max(axis=1, keepdims=True), mu, 0.0)
    mixture = mixture._replace(mu=mu / mu.sum(axis=1, keepdims=True))
    view = with_common_errors(
        filter_.view(mixture, known.sonar), known.sonar, bodies, config.range_scale_std
    )
    place, covariance = mount.to_enu(view.place, view.place_covariance)
    level = place[:, 2] + view.state[:, 2]
    fresh = []
    for i, row in enumerate(which.tolist()):
        weighs = np.flatnonzero(mixture.mu[i])
        fresh.append(
            Landmark(
                track_id=int(known.life.track_id[row]),
                stamp_ns=known.stamp_ns,
                seen_ns=int(known.life.last_hit_ns[row]),
                classes=existence.classes[row],
                sonar=known.sonar.pose,
                which=weighs,
                x=mixture.x[i, weighs],
                P=mixture.P[i, weighs],
                mu=mixture.mu[i, weighs],
                body=(float(bodies.number[i]), bodies.std[i]),
                place=place[i],
                covariance=covariance[i],
                low=float(level[i] - view.high[i]),
                high=float(level[i] - view.low[i]),
            )
        )
    return known._replace(memory=kept((*known.memory, *fresh), known.stamp_ns, config))


def recall(known: Known, ping: Ping, filter_: DepthSlices, config: ObstacleConfig) -> Known:
    """Return the same with tracks again of the landmarks that come into view, as long as there is
    room."""
    memory = known.memory
    if memory and memory[-1].stamp_ns > known.stamp_ns:
        memory = kept(memory, known.stamp_ns, config)
        known = known._replace(memory=memory)
    if not memory:
        return known
    back = in_view(memory, known.stamp_ns, known.sonar, config)
    back = back[: max(0, config.max_tracks - len(known.life))]
    for each in (memory[i] for i in sorted(back)):
        if each.track_id in known.life.track_id:
            continue  # numbers began anew, and this one lives
        dt, sonar, met = (known.stamp_ns - each.stamp_ns) * 1e-9, known.sonar, None
        if ping.sweep is not None:
            place = geometry.flip_world(each.place[None])
            met = ping.sweep.met(place, np.zeros((1, 3)), dt)
            sonar, dt = met.sonars[0], dt - float(met.ago[0])
        # Its place drifted as `navigation_grade` says, which holds for any time.
        exact = NavigationErrors(np.zeros(5), np.zeros((5, 5)))
        mixture, repairs = filter_.predict_unchanged(
            exact.given_to(each.mixture(filter_.K)), Sonar(each.sonar), sonar, dt
        )
        mixture = known.navigation.given_to(mixture)
        if not mixture.is_finite()[0]:
            continue
        ping.met = joined(ping.met, met)
        number, std = each.body
        chance = each.existence(known.stamp_ns, config.landmark_time)
        classes = each.classes * (min(chance, SUREST) / each.classes.sum())
        body = Bodies(np.array([number]), std[None])
        life = known.life.resumed(each.track_id, known.stamp_ns, RULES)
        existence = Existence.of(classes[None], filter_.K, float(config.confirm_hits))
        known = known.joined(life, begun(mixture, body, existence, silent=True))
        known = known._replace(repairs=known.repairs + repairs)
    gone = set(back)
    memory = tuple(each for i, each in enumerate(memory) if i not in gone)
    return known._replace(memory=memory) if gone else known
