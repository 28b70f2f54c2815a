"""Obstacles ahead of a vehicle, from a forward-looking sonar and navigation.

The sonar gives range and azimuth of echoes; the vehicle's own motion, known from navigation, says
how an echo of a fixed obstacle must move, and that depends on how far above or below the sonar it
lies. The tracker follows each obstacle in sonar coordinates and learns its vertical offset on the
way (`filters`). A ping goes through

    sonar pose -> predict -> gate, associate, update -> end, begin tracks

Navigation and pings arrive in any order. All that is known is one value, `Obstacles`, and a step
from stamp to stamp: a pose completes the pings that waited for it. So a late message is put in its
place by taking the steps after it again (`estimation.history`).

Source: docs/obstacle.md, after 'forward-looking sonar obstacle tracking' (Daurade).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from attrs import evolve, frozen
import numpy as np

from ...estimates import Estimate
from ...estimation import imm_kernels
from ...estimation.arrays import FloatArray
from ...estimation.association import assign, association_cost, gate_threshold, Tracks, TrackStatus
from ...estimation.history import ReplayHistory, StampGate
from ...measurements import Altitude, Detections, Measurement, nanoseconds, Navigation
from ..model_checks import track_rules
from .config import ObstacleConfig
from .filters import build_filter, Mixture, Sonar
from .navigation import Mount, NavigationBuffer

__all__ = ['ObstacleConfig', 'Obstacles', 'ObstacleTracker']

STATES = ('range', 'bearing', 'vertical_offset')
MODELS = ('above', 'below')
IN_BEAM = 0.9
"""A confirmed obstacle less probable than this to be in the beam is not missed when it gives no
echo. Where it lies in the vertical is uncertain by about the beam's height for most of the
approach: at 0.5, one in five obstacles that leave the beam above or below would be given up."""
_TINY, _WIDEST = 1e-12, 0.25
"""Variances m^2 and rad^2: below the one a sender means none; bearings above the other say
nothing."""


@frozen(eq=False, kw_only=True)
class Ping:
    """What is known after a ping of T obstacles: nis (T,), NaN without a hit."""

    stamp_ns: int
    sonar: Sonar
    life: Tracks
    known: Mixture
    nis: FloatArray


@frozen(eq=False, kw_only=True)
class Obstacles:
    """All that is known at a stamp. last: after the newest ping used, None before the first; done:
    the pings this step completed; skipped: pings so far for which navigation had a gap."""

    last: Ping | None = None
    done: tuple[Ping, ...] = ()
    navigation: NavigationBuffer = NavigationBuffer()
    altitude: Altitude | None = None
    waiting: tuple[tuple[Detections, Altitude | None], ...] = ()
    skipped: int = 0
    broken: int = 0


class ObstacleTracker:
    """The tracker of `trackers.Tracker` for obstacles: `process` takes `Detections`, `Navigation`
    and `Altitude`."""

    def __init__(self, config: ObstacleConfig):
        self.config = config
        self.filter = build_filter(config)
        self.mount = Mount(config)
        self.reset()

    def reset(self) -> None:
        self.counts: Counter[str] = Counter()
        self._frames: dict[type, str] = {}
        self._gate: StampGate[Measurement] = StampGate(
            nanoseconds(self.config.history),
            nanoseconds(self.config.max_gap),
            self.config.restart_after,
        )
        self._history = ReplayHistory[Obstacles, Measurement](
            Obstacles(), nanoseconds(self.config.history)
        )

    def reconfigure(self, config: ObstacleConfig) -> None:
        self.config.require_changeable(config)
        self.config = config
        self.filter = build_filter(config)

    def warm(self) -> None:
        # Pings in which everything happens once: births, contested hits, a pose to wait for.
        tracker = ObstacleTracker(evolve(self.config, max_navigation_gap=10.0))
        for second in (1, 2, 3, 4):
            stamp = second * 10**9
            east = Navigation(
                stamp_ns=stamp, position=[second, 0.0, -20.0], orientation=[0.0, 0.0, 0.0, 1.0]
            )
            echoes = np.array([50.0, 50.1]) - second
            tracker.process(Altitude(stamp_ns=stamp, altitude=20.0))
            tracker.process(east)
            tracker.process(Detections(stamp_ns=stamp, range=echoes, bearing=[0.0, 0.001]))

    def health(self) -> dict[str, float]:
        state = self._history.state
        status = state.last.life.status if state.last else np.empty(0)
        nis = state.last.nis[np.isfinite(state.last.nis)] if state.last else np.empty(0)
        return {
            'tracks': len(status),
            'confirmed': int((status != TrackStatus.TENTATIVE).sum()),
            'nis_mean': float(nis.mean() / 2.0) if len(nis) else float('nan'),
            'pings_waiting': len(state.waiting),
            'pings_skipped': state.skipped,
            'broken_tracks': state.broken,
        }

    def process(self, measurement: Measurement) -> list[Estimate]:
        if not isinstance(measurement, (Detections, Navigation, Altitude)):
            self.counts['unknown_type'] += 1
            return []
        frame = self._frames.setdefault(type(measurement), measurement.frame_id)
        if frame != measurement.frame_id:
            self.counts['other_frame'] += 1
            return []
        judgement = self._gate.judge(measurement.stamp_ns, measurement)
        judgement.count_in(self.counts)
        if judgement.verdict == 'restart':
            self._history = ReplayHistory(
                self._after_restart(self._history.state), nanoseconds(self.config.history)
            )
        revised: dict[int, Ping] = {}
        for item in judgement.released:
            revised.update((ping.stamp_ns, ping) for ping in self._revise(item))
        return [self._estimate(revised[stamp_ns]) for stamp_ns in sorted(revised)]

    def _revise(self, item: Measurement) -> list[Ping]:
        """Put an item in its place in time; the pings it completed or changed."""
        newest = self._history.newest_ns
        inserted = self._history.insert(item.stamp_ns, _key(item), item, self._step)
        self.counts[inserted.verdict] += 1
        if inserted.revised and newest is not None and item.stamp_ns < newest:
            self.counts['late'] += 1
        return [ping for _, state in inserted.revised for ping in state.done]

    def _after_restart(self, state: Obstacles) -> Obstacles:
        """Nothing but the identities that are used up."""
        if state.last is None:
            return Obstacles()
        nobody = np.zeros(len(state.last.life), bool)
        return Obstacles(last=self._only(evolve(state.last, stamp_ns=0), nobody))

    # -- one step ------------------------------------------------------------------------------

    def _step(self, before: Obstacles, stamp_ns: int, items: Sequence[Measurement]) -> Obstacles:
        """The state after all measurements of one stamp. Pure."""
        buffer, altitude = before.navigation, before.altitude
        for item in items:
            if isinstance(item, Navigation):
                buffer = buffer.added(item)
            elif isinstance(item, Altitude):
                altitude = item
        pings = [item for item in items if isinstance(item, Detections)]
        waiting = [*before.waiting, *((ping, altitude) for ping in pings)]
        last, done, skipped, broken = before.last, [], before.skipped, before.broken
        while waiting:
            ready = self._readiness(buffer, waiting[0][0])
            if ready == 'wait':
                break
            ping, height = waiting.pop(0)
            if ready == 'gap':
                skipped += 1
                continue
            last, lost = self._ping(last, ping, self._sonar(buffer, ping, height))
            broken += lost
            done.append(last)
        oldest = waiting[0][0].stamp_ns if waiting else stamp_ns
        return Obstacles(
            last=last,
            done=tuple(done),
            navigation=buffer.since(oldest),
            altitude=altitude,
            waiting=tuple(waiting),
            skipped=skipped,
            broken=broken,
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
        pose = self.mount.sonar(buffer.pose(ping.stamp_ns))
        height = np.nan
        if altitude is not None:
            age = ping.stamp_ns - altitude.stamp_ns
            if age <= nanoseconds(self.config.max_altitude_age):
                height = altitude.altitude
        late_ns = self._late_ns()
        if not late_ns:
            return Sonar(pose, height)
        late = self.mount.sonar(buffer.pose(ping.stamp_ns + late_ns))
        return Sonar(pose, height, late, late_ns * 1e-9)

    def _ping(self, before: Ping | None, ping: Detections, sonar: Sonar) -> tuple[Ping, int]:
        """The state after a ping, and how many tracks broke."""
        z, R = self._detections(ping)
        if before is None:
            before = self._nobody(sonar, ping.stamp_ns)
        dt = (ping.stamp_ns - before.stamp_ns) * 1e-9 if before.stamp_ns else 0.0
        known = self.filter.advance(before.known, before.sonar, sonar, dt)
        sound = np.isfinite(known.x).all(axis=(1, 2)) & np.isfinite(known.P).all(axis=(1, 2, 3))
        now = self._only(evolve(before, stamp_ns=ping.stamp_ns, sonar=sonar, known=known), sound)
        chosen, h = self._associate(now, z, R)
        now = self._update(now, chosen, h, z, R)
        free = np.ones(len(z), bool)
        free[chosen[chosen >= 0]] = False
        return self._census(now, chosen >= 0, z[free], R[free]), int((~sound).sum())

    def _detections(self, ping: Detections) -> tuple[FloatArray, FloatArray]:
        """z (D, 2) and R (D, 2, 2) of the rows that are echoes, azimuth positive to starboard. A
        row that is as uncertain as it is far says nothing and is left out."""
        config = self.config
        side = -1.0 if config.bearing_positive == 'port' else 1.0
        z = np.column_stack([ping.range, side * ping.bearing])
        stated = np.column_stack([ping.var_range, ping.var_bearing])
        own = np.square([config.range_std, np.radians(config.bearing_std_deg)])
        own += np.square([config.range_step, np.radians(config.bearing_step_deg)]) / 12.0
        variance = np.where(np.isfinite(stated) & (stated > _TINY), stated, own)
        real = np.isfinite(z).all(axis=1) & (z[:, 0] > 2.0 * np.sqrt(variance[:, 0]))
        real &= (np.abs(z[:, 1]) < 0.5 * np.pi) & (variance[:, 1] < _WIDEST)
        return z[real], variance[real, :, None] * np.eye(2)

    def _associate(self, now: Ping, z: FloatArray, R: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """The detection of each track (T,), -1 for none, and what was expected (T, K, 2);
        confirmed tracks choose before tentative ones."""
        h, C = self.filter.expected(now.known, now.sonar)
        chosen, free = np.full(len(h), -1), np.ones(len(z), bool)
        if not len(h) or not len(z):
            return chosen, h
        H = np.tile(np.eye(2), (1, h.shape[1], 1, 1))
        threshold = gate_threshold(self.config.gate_probability, 2)
        fit = imm_kernels.gate(h, H, C, now.known.mu, z, R, threshold)
        target, detection = np.nonzero(np.isfinite(fit))
        cost = association_cost(
            fit[target, detection], self.config.detection_probability, self.config.clutter_density
        )
        tentative = now.life.status == TrackStatus.TENTATIVE
        for own in (~tentative, tentative):
            pairs = own[target] & free[detection]
            found = assign(target[pairs], detection[pairs], cost[pairs], len(chosen), len(free))
            chosen = np.where(found >= 0, found, chosen)
            free[found[found >= 0]] = False
        return chosen, h

    def _update(
        self, now: Ping, chosen: np.ndarray, h: FloatArray, z: FloatArray, R: FloatArray
    ) -> Ping:
        nis = np.full(len(chosen), np.nan)
        hit = np.flatnonzero(chosen >= 0)
        if not len(hit):
            return evolve(now, nis=nis)
        after, nis[hit] = self.filter.update(
            now.known.rows(hit), h[hit], z[chosen[hit]], R[chosen[hit]], now.sonar
        )
        known = Mixture(*(part.copy() for part in now.known))
        for part, new in zip(known, after):
            part[hit] = new
        return evolve(now, known=known, nis=nis)

    def _census(self, now: Ping, hit: np.ndarray, z: FloatArray, R: FloatArray) -> Ping:
        """End the tracks that are over or passed, begin one at each detection left."""
        rules = track_rules(self.config)
        tentative = now.life.status == TrackStatus.TENTATIVE
        in_beam, ahead = self.filter.outlook(now.known, now.sonar)
        looked = tentative | (in_beam > IN_BEAM)
        life, kept = now.life.scan(hit, now.stamp_ns, rules, looked=looked)
        now = evolve(now, life=life, known=now.known.rows(kept), nis=now.nis[kept])
        now = self._only(now, ahead[kept])
        room = max(0, self.config.max_tracks - len(now.life))
        if not self.filter.ready(now.sonar):
            room = 0
        z, R = z[:room], R[:room]
        if not len(z):
            return now
        return evolve(
            now,
            life=now.life.born(len(z), now.stamp_ns, rules),
            known=now.known.joined(self.filter.begin(z, R, now.sonar)),
            nis=np.append(now.nis, np.full(len(z), np.nan)),
        )

    def _nobody(self, sonar: Sonar, stamp_ns: int) -> Ping:
        K, n = self.filter.K, self.filter.n
        nothing = Mixture(np.empty((0, K, n)), np.empty((0, K, n, n)), np.empty((0, K)))
        life = Tracks.none(track_rules(self.config))
        return Ping(stamp_ns=stamp_ns, sonar=sonar, life=life, known=nothing, nis=np.empty(0))

    @staticmethod
    def _only(now: Ping, kept: np.ndarray) -> Ping:
        if kept.all():
            return now
        return evolve(now, life=now.life.only(kept), known=now.known.rows(kept), nis=now.nis[kept])

    def _estimate(self, ping: Ping) -> Estimate:
        view = self.filter.view(ping.known, ping.sonar)
        side = np.array([1.0, -1.0, 1.0])  # ROS counts bearings to port
        place, place_covariance = self.mount.to_navigation(view.place, view.place_covariance)
        extras = {
            'track_id': ping.life.track_id,
            'track_state': ping.life.status,
            'vertical_offset_lo': view.low,
            'vertical_offset_hi': view.high,
            'nis': ping.nis,
        }
        for i, a in enumerate('xyz'):
            for j, b in enumerate('xyz'[i:], start=i):
                extras[f'place_cov_{a}_{b}'] = place_covariance[:, i, j]
        return Estimate(
            stamp_ns=ping.stamp_ns,
            frame_id=self._frames.get(Navigation, ''),
            xyz=place.astype(np.float32),
            state_names=STATES,
            state=view.state * side,
            covariance=view.covariance * np.outer(side, side),
            model_names=MODELS,
            probabilities=np.column_stack([view.above, 1.0 - view.above]),
            extras=extras,
        )


def _key(measurement: Measurement) -> bytes:
    """The content of a measurement: it orders those of one stamp and tells duplicates."""
    if isinstance(measurement, Navigation):
        return b'navigation' + measurement.position.tobytes() + measurement.orientation.tobytes()
    if isinstance(measurement, Altitude):
        return b'altitude' + np.float64(measurement.altitude).tobytes()
    names = ('range', 'bearing', 'var_range', 'var_bearing')
    return b'detections' + b''.join(getattr(measurement, name).tobytes() for name in names)
