# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Obstacles ahead of a vehicle, from a forward-looking sonar and navigation.

The sonar gives range and azimuth of echoes; the vehicle's own motion, known from navigation, says
how an echo of a fixed obstacle must move, and that depends on how far above or below the sonar it
lies. The tracker follows each obstacle in sonar coordinates and learns its vertical offset on the
way (`filters`). A ping goes through

    sonar pose -> predict -> associate -> update -> prune -> spawn

Navigation and pings arrive in any order. All that is known is one value, `ObstacleState`, and a
step from stamp to stamp: a pose completes the pings that waited for it. So a late message is put
in its place by taking the steps after it again (`intake.stream`).

Source: docs/obstacle.md, after 'forward-looking sonar obstacle tracking' (Daurade).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from ...acoustics import geometry
from ...estimates import Estimate, places
from ...estimation import imm
from ...estimation.arrays import FloatArray
from ...estimation.association import assign_fits, gate_threshold, TENTATIVE, Tracks
from ...intake import KnownFrames
from ...intake.stream import ReplayStream, StreamRules
from ...measurements import Altitude, Detections, Ground, Measurement, nanoseconds, Navigation
from ..model_checks import track_rules
from ..navigation import MOST_WAITING, NavigationBuffer
from .avoidance import closest_approach, course
from .behaviours import behaviour_columns, build_filter, moving_alike
from .bodies import Bodies, considered
from .config import ObstacleConfig
from .elevation import Elevations, fits, outliers, updated
from .filters import Hints, Mixture, Sonar
from .ground import GroundMap
from .looks import Looks
from .memory import Existence, in_view, kept, Landmark, LEAST_WEIGHT, Memory, odds
from .navigation import Mount
from .state import ObstacleState, PingState

__all__ = ['ObstacleConfig', 'ObstacleState', 'ObstacleTracker']

STATES = ('range', 'bearing', 'vertical_offset')
MODELS = ('above', 'below')
IN_BEAM = 0.9
"""A confirmed obstacle less probable than this to be in the beam is not missed when it gives no
echo. Where it lies in the vertical is uncertain by about the beam's height for most of the
approach: at 0.5, one in five obstacles that leave the beam above or below would be given up."""
SMALLEST, WIDEST = 1e-12, 0.25
"""Variances m^2 and rad^2: below the one a sender means none; bearings above the other say
nothing."""
_SIDE = np.array([1.0, -1.0, 1.0])
"""ROS counts bearings to port."""
_SIDES = np.outer(_SIDE, _SIDE)
_PLACE_COVARIANCES = tuple(
    (f'place_cov_{a}_{b}', i, j)
    for i, a in enumerate('xyz')
    for j, b in enumerate('xyz'[i:], start=i)
)


class ObstacleTracker:
    """The tracker of `trackers.Tracker` for obstacles: `process` takes `Detections`,
    `Navigation`, `Altitude` and `Ground`."""

    STATE = ('_stream',)

    def __init__(self, config: ObstacleConfig):
        self._settle(config)
        self.mount = Mount(config)
        self._H = np.tile(np.eye(2), (1, self.filter.K, 1, 1))
        self.reset()

    def _settle(self, config: ObstacleConfig) -> None:
        """What follows from the parameters, once and not in every ping."""
        self.config = config
        self.filter = build_filter(config)
        self.rules = track_rules(config)
        own = np.square([config.range_std, np.radians(config.bearing_std_deg)])
        own += np.square([config.range_step, np.radians(config.bearing_step_deg)]) / 12.0
        self._own_variance = own

    def reset(self) -> None:
        self._stream = ReplayStream(
            (Detections, Navigation, Altitude, Ground),
            StreamRules.of(self.config),
            step=self._step,
            initial=ObstacleState(),
            survivor=self._survivor,
        )
        self.counts = self._stream.counts

    def restored(self) -> None:
        """Raise ValueError for states, put in, that are none of these models."""
        K, n = self.filter.K, self.filter.n
        for state in self._stream.kept:
            for ping in (*state.done, *filter(None, [state.last])):
                if ping.mixture.x.shape[1:] != (K, n):
                    raise ValueError('states are of another filter')
                for landmark in ping.memory:
                    which = landmark.which
                    if landmark.x.shape[1:] != (n,) or not ((which >= 0) & (which < K)).all():
                        raise ValueError('landmarks are of another filter')

    @property
    def frames(self) -> KnownFrames:
        return self._stream.frames

    def reconfigure(self, config: ObstacleConfig) -> None:
        self.config.require_changeable(config)
        self._settle(config)

    def remount(self, config: ObstacleConfig) -> None:
        """Take another place of the sonar on the vehicle, for all pings from now on."""
        self.config, self.mount = config, Mount(config)

    def warm(self, inputs: Collection[type] | None = None) -> None:
        """Do nothing: no kernel has to be compiled."""

    def health(self) -> dict[str, float]:
        state = self._stream.state
        status = state.last.life.status if state.last else np.empty(0)
        nis = state.last.nis[np.isfinite(state.last.nis)] if state.last else np.empty(0)
        return {
            'tracks': len(status),
            'confirmed': int((status != TENTATIVE).sum()),
            'nis_mean': float(nis.mean() / 2.0) if len(nis) else float('nan'),
            'nis_memory': state.innovations.mean,
            'pings_waiting': len(state.waiting),
            'pings_skipped': state.skipped,
            'navigation_missing': state.missing,
            'broken_tracks': state.broken,
            'moving_alike': int(state.last.alike) if state.last else 0,
            'pings_moving_alike': state.alike,
            'covariance_repairs': state.last.repairs if state.last else 0,
            'landmarks': len(state.last.memory) if state.last else 0,
        }

    def warnings(self) -> list[str]:
        """What the sonar states and cannot be true, in a sentence for the user."""
        advice = 'check range_std, bearing_std_deg and the variances of the detections'
        return self._stream.state.innovations.warnings('detections', advice)

    def process(self, measurement: Measurement) -> list[Estimate]:
        # Nonsense overflows: what is not finite then is dropped and counted.
        with np.errstate(over='ignore', divide='ignore', invalid='ignore'):
            revised = self._stream.revise(measurement)
            pings = {ping.stamp_ns: ping for _, state in revised for ping in state.done}
            return [self._estimate(pings[stamp_ns]) for stamp_ns in sorted(pings)]

    @property
    def landmarks(self) -> Memory:
        """The obstacles that are remembered and not in view."""
        last = self._stream.state.last
        return last.memory if last else ()

    def known(self) -> list[dict[str, float]]:
        """All obstacles at the newest ping, those in view too, see `Landmark.row`."""
        state = self._stream.state
        survivor = self._survivor(state).last
        if state.last is None or survivor is None:
            return []
        return [each.row(state.last.stamp_ns, self.config) for each in survivor.memory]

    # -- one step ------------------------------------------------------------------------------

    def _step(
        self, before: ObstacleState, stamp_ns: int, items: Sequence[Measurement]
    ) -> ObstacleState:
        """The state after all measurements of one stamp. Pure."""
        buffer, altitude, ground = before.navigation, before.altitude, before.ground
        for item in items:
            if isinstance(item, Navigation):
                buffer = buffer.added(item)
            elif isinstance(item, Altitude):
                altitude = item
            elif isinstance(item, Ground):
                ground = ground.added(item)
        pings = [item for item in items if isinstance(item, Detections)]
        waiting = [*before.waiting, *((ping, altitude) for ping in pings)]
        given_up = max(0, len(waiting) - MOST_WAITING)
        del waiting[:given_up]
        last, done, skipped, broken = before.last, [], before.skipped, before.broken
        alike, innovations = before.alike, before.innovations
        while waiting:
            ready = self._readiness(buffer, waiting[0][0])
            if ready == 'wait':
                break
            ping, height = waiting.pop(0)
            if ready == 'gap':
                skipped += 1
                continue
            last, lost = self._ping(last, ping, self._sonar(buffer, ping, height), ground)
            broken += lost
            alike += last.alike
            sure = np.isfinite(last.nis) & (last.life.status != TENTATIVE)
            innovations = innovations.after(last.nis[sure], 2)
            done.append(last)
        oldest = waiting[0][0].stamp_ns if waiting else stamp_ns
        return ObstacleState(
            last=last,
            done=tuple(done),
            navigation=buffer.since(oldest - nanoseconds(self.config.course_window)),
            altitude=altitude,
            ground=ground,
            waiting=tuple(waiting),
            skipped=skipped,
            missing=before.missing + given_up,
            broken=broken,
            alike=alike,
            innovations=innovations,
        )

    def _readiness(self, buffer: NavigationBuffer, ping: Detections) -> str:
        return buffer.readiness(
            ping.stamp_ns,
            ping.stamp_ns + self._late_ns(),
            nanoseconds(self.config.max_navigation_gap),
            nanoseconds(self.config.max_extrapolation),
        )

    def _late_ns(self) -> int:
        """How long after the transmission a pose is needed."""
        if self.config.ping_timing == 'instant':
            return 0
        return nanoseconds(2.0 * self.config.max_range / self.config.sound_speed)

    def _sonar(
        self, buffer: NavigationBuffer, ping: Detections, altitude: Altitude | None
    ) -> Sonar:
        vehicle = buffer.pose(ping.stamp_ns)
        pose = self.mount.sonar(vehicle)
        reference = float(pose.position[2] + vehicle.position[2])  # depth plus height
        straight = geometry.flip_world(course(buffer, ping.stamp_ns, self.config.course_window))
        oldest_ns = ping.stamp_ns - nanoseconds(self.config.max_altitude_age)
        height = np.nan
        if altitude is not None and altitude.stamp_ns >= oldest_ns:
            height = altitude.altitude
        late_ns = self._late_ns()
        if not late_ns:
            return Sonar(pose, height, reference=reference, course=straight)
        late = self.mount.sonar(buffer.pose(ping.stamp_ns + late_ns))
        return Sonar(pose, height, late, late_ns * 1e-9, reference, straight)

    def _ping(
        self, before: PingState | None, ping: Detections, sonar: Sonar, ground: GroundMap
    ) -> tuple[PingState, int]:
        """The state after a ping, and how many tracks broke."""
        z, R, extended, up, var_up = self._detections(ping)
        seen = Elevations.of(up, var_up, self.config)
        now, broken = self._predict(before or self._nobody(sonar), ping.stamp_ns, sonar)
        now = self._recall(now)
        chosen, expected, fit = self._associate(now, z, R, seen)
        now = self._update(now, chosen, expected, z, R, extended, seen)
        hit = chosen >= 0
        if self.config.misses == 'evidence' and before:
            looks = now.looks.after(hit, now.mixture, self.filter, sonar, before.sonar)
            now = now._replace(looks=looks)
        now = self._prune(now, hit, fit)
        if np.count_nonzero(hit) < len(z):
            free = np.ones(len(z), bool)
            free[chosen[hit]] = False
            seen = seen and seen.rows(free)
            now = self._spawn(now, z[free], R[free], extended[free], seen, ground)
        confirmed = now.life.status != TENTATIVE
        return now._replace(alike=moving_alike(self.filter, now.mixture, confirmed)), broken

    def _predict(self, before: PingState, stamp_ns: int, sonar: Sonar) -> tuple[PingState, int]:
        """The tracks as this ping should show them, and how many had numbers not finite."""
        dt = (stamp_ns - before.stamp_ns) * 1e-9 if before.stamp_ns else 0.0
        mixture, repairs = self.filter.advance(before.mixture, before.sonar, sonar, dt)
        now = before._replace(
            stamp_ns=stamp_ns,
            sonar=sonar,
            mixture=mixture,
            looks=before.looks.advanced(self.filter, before.sonar, sonar, dt),
            repairs=before.repairs + repairs,
        )
        is_finite = mixture.is_finite()
        broken = len(is_finite) - int(np.count_nonzero(is_finite))
        return (now.only(is_finite) if broken else now), broken

    def _detections(self, ping: Detections) -> tuple[np.ndarray, ...]:
        """z (D, 2), R (D, 2, 2), whether an extent is stated (D,), elevation and its variance
        (D,), of the rows that are echoes, azimuth positive to starboard. A row that is as
        uncertain as it is far says nothing and is left out."""
        z = np.column_stack([ping.range, -ping.bearing])  # REP-103 counts bearings to port
        variance = np.column_stack([ping.var_range, ping.var_bearing])
        stated = np.isfinite(variance) & (variance > SMALLEST)
        variance = np.where(stated, variance, self._own_variance)
        R = variance[:, :, None] * np.eye(2)
        real = np.isfinite(z[:, 0]) & (np.abs(z[:, 1]) < 0.5 * np.pi)
        real &= (z[:, 0] > 2.0 * np.sqrt(variance[:, 0])) & (variance[:, 1] < WIDEST)
        extended = np.isfinite(ping.extent_range)
        columns = z, R, extended, ping.elevation, ping.var_elevation
        if real.all():
            return columns
        return tuple(column[real] for column in columns)

    def _associate(
        self, now: PingState, z: FloatArray, R: FloatArray, seen: Elevations | None
    ) -> tuple[np.ndarray, FloatArray, FloatArray]:
        """The detection of each track (T,), -1 for none, what was expected (T, K, 2), and the log
        density (T,) of what was found; confirmed tracks choose before tentative ones."""
        h, C = self.filter.expected(now.mixture, now.sonar)
        if not len(h) or not len(z):
            return np.full(len(h), -1), h, np.zeros(len(h))
        config = self.config
        if seen:
            fit = fits(now.mixture, h, now.sonar.pose, z, R, seen, config)
        else:
            threshold = gate_threshold(config.gate_probability, 2)
            fit = imm.gate(h, self._H, C, now.mixture.mu, z, R, threshold)
        tentative = now.life.status == TENTATIVE
        usual = config.detection_probability
        weighed = fit
        if config.detection_ranges:  # as probable as it is at the range of each track
            p = self._chance(now.mixture)
            weighed = fit + np.log(p / (1.0 - p) * (1.0 - usual) / usual)[:, None]
        chosen = assign_fits(weighed, tentative, usual, config.clutter_density)
        return chosen, h, fit[np.arange(len(fit)), chosen]

    def _update(
        self,
        now: PingState,
        chosen: np.ndarray,
        h: FloatArray,
        z: FloatArray,
        R: FloatArray,
        extended: np.ndarray,
        seen: Elevations | None,
    ) -> PingState:
        nis = np.full(len(chosen), np.nan)
        hit = np.flatnonzero(chosen >= 0)
        if not len(hit):
            return now._replace(nis=nis)
        every = len(hit) == len(chosen)
        mixture, bodies = now.mixture, now.bodies
        if not every:
            mixture, bodies, h, chosen = mixture.rows(hit), bodies.rows(hit), h[hit], chosen[hit]
        z, R = z[chosen], R[chosen]
        bodies, R = bodies.seen(extended[chosen], z, R, self._own_variance)
        before = mixture
        mixture, nis[hit], repairs = self.filter.update(mixture, h, z, R, now.sonar)
        if seen:
            chance = self.config.outlier_probability
            doubt = outliers(before, h, z, R, chance, self.filter.outlier_density)
            mixture = updated(mixture, seen.rows(chosen), doubt, now.sonar.pose, self.config)
        if not every:
            mixture = now.mixture.replaced(hit, mixture)
            bodies = now.bodies.replaced(hit, bodies)
        repairs += now.repairs
        return now._replace(mixture=mixture, bodies=bodies, nis=nis, repairs=repairs)

    def _chance(self, mixture: Mixture) -> FloatArray:
        """Probability (T,) that a ping shows obstacles that the beam holds."""
        if not self.config.detection_ranges:
            return np.full(len(mixture.mu), self.config.detection_probability)
        return self.config.detection_at(np.einsum('tk,tk->t', mixture.mu, mixture.x[..., 0]))

    def _prune(self, now: PingState, hit: np.ndarray, fit: FloatArray) -> PingState:
        """End the tracks that are over or passed; `hit` (T,): those that got a detection of log
        density `fit` (T,)."""
        tentative = now.life.status == TENTATIVE
        in_beam, ahead = self.filter.outlook(now.mixture, now.sonar)
        p = self._chance(now.mixture)
        probable = in_beam * p > IN_BEAM * self.config.detection_probability
        looked = tentative | (probable if self.config.detection_ranges else in_beam > IN_BEAM)
        life, stays = now.life.scan(hit, now.stamp_ns, self.rules, looked=looked)
        now = now._replace(
            existence=now.existence.after(hit, fit, in_beam, p, self.config.clutter_density)
        )
        if self.config.max_landmarks:
            coasted = now.stamp_ns - now.life.last_hit_ns > self.rules.max_coast_ns
            now = self._remember(now, np.where(stays, ~ahead, coasted & ~hit))
        return now.rows(stays)._replace(life=life).only(ahead[stays])

    def _remember(self, now: PingState, over: np.ndarray) -> PingState:
        """With landmarks of the confirmed obstacles whose tracks are `over` (T,)."""
        over = over & (now.life.status != TENTATIVE)
        if not np.count_nonzero(over):
            return now
        log_odds = now.existence.now()
        stays = now.mixture.mu[:, self.filter.moves].sum(axis=1) <= 0.5
        which = np.flatnonzero(over & stays & (log_odds > 0.0))
        if not len(which):
            return now
        mixture, bodies = now.mixture.rows(which), now.bodies.rows(which)
        mu = np.where(self.filter.moves, 0.0, mixture.mu)
        mu = np.where(mu >= LEAST_WEIGHT * mu.max(axis=1, keepdims=True), mu, 0.0)
        mixture = mixture._replace(mu=mu / mu.sum(axis=1, keepdims=True))
        view = considered(
            self.filter.view(mixture, now.sonar), now.sonar, bodies, self.config.range_scale_std
        )
        place, covariance = self.mount.to_enu(view.place, view.place_covariance)
        level = place[:, 2] + view.state[:, 2]
        fresh = []
        for i, row in enumerate(which.tolist()):
            weighs = np.flatnonzero(mixture.mu[i])
            fresh.append(
                Landmark(
                    track_id=int(now.life.track_id[row]),
                    stamp_ns=now.stamp_ns,
                    seen_ns=int(now.life.last_hit_ns[row]),
                    log_odds=float(log_odds[row]),
                    sonar=now.sonar.pose,
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
        return now._replace(memory=kept((*now.memory, *fresh), now.stamp_ns, self.config))

    def _recall(self, now: PingState) -> PingState:
        """With tracks again of the landmarks that come into view, as long as there is room."""
        memory = now.memory
        if memory and memory[-1].stamp_ns > now.stamp_ns:
            memory = kept(memory, now.stamp_ns, self.config)
            now = now._replace(memory=memory)
        if not memory or not self.filter.ready(now.sonar):
            return now
        back = in_view(memory, now.stamp_ns, now.sonar, self.config)
        back = back[: max(0, self.config.max_tracks - len(now.life))]
        for each in (memory[i] for i in sorted(back)):
            if each.track_id in now.life.track_id:
                continue  # numbers began anew, and this one lives
            dt = (now.stamp_ns - each.stamp_ns) * 1e-9
            mixture, repairs = self.filter.carried(
                each.mixture(self.filter.K), each.sonar, now.sonar.pose, dt
            )
            if not mixture.is_finite()[0]:
                continue
            number, std = each.body
            now = self._joined(
                now,
                now.life.resumed(each.track_id, now.stamp_ns, self.rules),
                mixture,
                Bodies(np.array([number]), std[None]),
                odds(each.existence(now.stamp_ns, self.config.landmark_time)),
                silent=True,
            )._replace(repairs=now.repairs + repairs)
        gone = set(back)
        memory = tuple(each for i, each in enumerate(memory) if i not in gone)
        return now._replace(memory=memory) if gone else now

    def _survivor(self, state: ObstacleState) -> ObstacleState:
        """What outlives a restarted clock: the identities that are used up, and the landmarks."""
        if state.last is None:
            return ObstacleState()
        everybody = np.ones(len(state.last.life), bool)
        last = self._remember(state.last, everybody) if self.config.max_landmarks else state.last
        return ObstacleState(last=last._replace(stamp_ns=0).only(~everybody))

    def _spawn(
        self,
        now: PingState,
        z: FloatArray,
        R: FloatArray,
        extended: np.ndarray,
        seen: Elevations | None,
        ground: GroundMap,
    ) -> PingState:
        """Begin a track at each detection z (B, 2), R (B, 2, 2), as long as there is room."""
        ready = self.filter.ready(now.sonar)
        room = max(0, self.config.max_tracks - len(now.life)) if ready else 0
        z, R, extended = z[:room], R[:room], extended[:room]
        if not len(z):
            return now
        bodies, R = Bodies.unknown(len(z)).seen(extended, z, R, self._own_variance)
        hints = None
        if seen or ground:
            seen = seen and seen.rows(np.arange(len(z)))
            ends = seen.ends() if seen else np.full((len(z), 2), np.nan)
            hints = Hints(ends, *ground.below(z, now.sonar, self.config))
        fresh = self.filter.begin(z, R, now.sonar, hints)
        if seen:
            chance = self.config.outlier_probability
            fresh = updated(fresh, seen, chance, now.sonar.pose, self.config)
        life = now.life.born(len(z), now.stamp_ns, self.rules)
        return self._joined(now, life, fresh, bodies)

    def _joined(
        self,
        now: PingState,
        life: Tracks,
        fresh: Mixture,
        bodies: Bodies,
        log_odds: float = 0.0,
        silent: bool = False,
    ) -> PingState:
        """With more obstacles, which `life` has already; silent: they gave no echo."""
        B = len(fresh.mu)
        return now._replace(
            life=life,
            mixture=now.mixture.joined(fresh),
            nis=np.append(now.nis, np.full(B, np.nan)),
            bodies=now.bodies.joined(bodies),
            looks=now.looks.joined(Looks.first(fresh, silent)),
            existence=now.existence.joined(Existence.of(np.full(B, log_odds))),
        )

    def _nobody(self, sonar: Sonar) -> PingState:
        K, n = self.filter.K, self.filter.n
        nothing = Mixture(np.empty((0, K, n)), np.empty((0, K, n, n)), np.empty((0, K)))
        life = Tracks.none(self.rules)
        return PingState(
            stamp_ns=0,
            sonar=sonar,
            life=life,
            mixture=nothing,
            nis=np.empty(0),
            bodies=Bodies.unknown(0),
            looks=Looks.first(nothing),
            existence=Existence.of(np.empty(0)),
        )

    def _estimate(self, ping: PingState) -> Estimate:
        mixture = ping.looks.shown if self.config.misses == 'evidence' else ping.mixture
        view = self.filter.view(mixture, ping.sonar)
        view = considered(view, ping.sonar, ping.bodies, self.config.range_scale_std)
        place, place_covariance = self.mount.to_enu(view.place, view.place_covariance)
        extras: dict[str, np.ndarray] = {
            **behaviour_columns(view, self.filter.behaviours),
            **closest_approach(*view.near, mixture.mu, ping.sonar.course, self.config),
            'track_id': ping.life.track_id,
            'track_state': ping.life.status,
            'vertical_offset_lo': view.low,
            'vertical_offset_hi': view.high,
            'nis': ping.nis,
            **places(place),
            **{name: place_covariance[:, i, j] for name, i, j in _PLACE_COVARIANCES},
        }
        return Estimate(
            stamp_ns=ping.stamp_ns,
            frame_id=self._stream.frame_id,
            xyz=place,
            state_names=STATES,
            state=view.state * _SIDE,
            covariance=view.covariance * _SIDES,
            model_names=MODELS,
            probabilities=np.column_stack([view.above, 1.0 - view.above]),
            extras=extras,
        )
