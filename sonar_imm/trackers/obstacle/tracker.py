# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacles ahead of a vehicle, from a forward-looking sonar and navigation.

The sonar gives range and azimuth of echoes; the vehicle's own motion, known from navigation, says
how an echo of a fixed obstacle must move, and that depends on how far above or below the sonar it
lies. The tracker follows each obstacle in sonar coordinates and learns its vertical offset on the
way (`filters`). Navigation and pings arrive in any order (`pings`). A ping goes through

    predict -> recall -> associate -> note navigation -> update -> share navigation ->
    complete scan -> judge -> remember -> end -> begin -> watch

A ping of a sonar that turns takes time: each obstacle is predicted to the instant at which the
beam meets it, and predicted on to the end of the ping after its update.

An echo that may belong to no track becomes a seed (`births`); `associate` makes tracks of those
that the ping may show again, and weighs all joint events of tracks and echoes (`events`).

Each stage is a pure function of what is `Known` and of the ping. The tuple of stages is built once
from the parameters; a feature that is off has none. So a late message is put in its place by
taking the steps after it again (`intake.stream`).

Source: docs/obstacle.md, after 'forward-looking sonar obstacle tracking' (Daurade).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from operator import attrgetter, itemgetter

from attrs import evolve
import numpy as np

from ...estimates import Estimate, places
from ...estimation.arrays import FloatArray, replace_rows, take
from ...intake import KnownFrames
from ...intake.stream import ReplayStream, StreamRules
from ...measurements import (
    Altitude,
    Detections,
    Ground,
    Measurement,
    nanoseconds,
    Navigation,
)
from .avoidance import closest_approach
from .births import add_seeds, start_banks, with_clutter_density
from .bodies import with_common_errors
from .config import ObstacleConfig
from .events import associate, claims, compare, learnt, updated
from .existence import older_nearby
from .filters import behaviour_columns, build_filter, Mixture, moving_alike
from .memory import Memory
from .mixtures import moment_match
from .navigation_errors import (
    apply_messages,
    marginals,
    messages,
    NavigationErrors,
    SURE,
    under_two_assumptions,
)
from .pings import joined, Mount, Ping
from .state import begun, Known, ObstacleState, recall, remember, RULES

__all__ = ['ObstacleConfig', 'ObstacleState', 'ObstacleTracker']

Stage = Callable[[Known, Ping], Known]

STATES = ('range', 'bearing', 'vertical_offset')
MODELS = ('above', 'below')
BEYOND = 1.3
"""Share of the reach of the sonar beyond which a track ends."""
SILENT = 5.0
"""Seconds of pings without an echo, after which a track does not change what it does."""
SELDOM = 0.4
"""Share of the pings that shows an obstacle, below which users are told how long it takes."""
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

    _stream: ReplayStream[ObstacleState]

    def __init__(self, config: ObstacleConfig):
        self._apply_config(config)
        self.mount = Mount(config)
        self.reset()

    def _apply_config(self, config: ObstacleConfig) -> None:
        """Make what follows from the parameters, once and not in every ping."""
        self.config = config
        self.filter = build_filter(config)
        evidence, remembers = config.misses == 'evidence', config.max_landmarks > 0
        shared = bool(config.navigation_errors()[0][1:].any())
        self._published = attrgetter('misses.shown' if evidence else 'mixture')
        self.stages = wanted(
            self._predict,
            self._predict_misses if evidence else None,
            self._recall,
            self._associate,
            self._note_navigation if shared else None,
            self._update,
            self._share_navigation if shared else None,
            self._complete_scan,
            self._weigh_misses if evidence else None,
            self._judge,
            self._remember if remembers else None,
            self._end,
            self._begin,
            self._watch,
        )

    def reset(self) -> None:
        self._stream = ReplayStream(
            (Detections, Navigation, Altitude, Ground),
            StreamRules.of(self.config),
            step=self._step,
            initial=ObstacleState(known=Known.nothing(self.filter)),
            survivor=self._survivor,
        )
        self.counts = self._stream.counts

    def restored(self) -> None:
        """Compute the states anew, from the oldest that was put in. Raises ValueError where that
        is none of these models."""
        K, n, base = self.filter.K, self.filter.n, self._stream.base
        for known in (*base.done, base.known):
            if known.obstacles.mixture.x.shape[1:] != (K, n):
                raise ValueError('states are of another filter')
            for landmark in known.memory:
                which = landmark.which
                if landmark.x.shape[1:] != (n,) or not ((which >= 0) & (which < K)).all():
                    raise ValueError('landmarks are of another filter')
        self._stream.restored()

    @property
    def frames(self) -> KnownFrames:
        return self._stream.frames

    def reconfigure(self, config: ObstacleConfig) -> None:
        self.config.require_changeable(config)
        self._apply_config(config)

    def remount(self, config: ObstacleConfig) -> None:
        """Take another place of the sonar on the vehicle, for all pings from now on."""
        self.config, self.mount = config, Mount(config)

    def warm(self, inputs: Collection[type] | None = None) -> None:
        """Do nothing: no kernel has to be compiled."""

    def health(self) -> dict[str, float]:
        state = self._stream.state
        known, inbox = state.known, state.inbox
        nis = known.obstacles.nis[np.isfinite(known.obstacles.nis)]
        good = self._both(known)[1][known.confirmed]
        return {
            'tracks': len(known.life),
            'confirmed': int(known.confirmed.sum()),
            'nis_mean': float(nis.mean() / 2.0) if len(nis) else float('nan'),
            'nis_memory': known.innovations.mean,
            'pings_waiting': len(inbox.waiting),
            'pings_skipped': inbox.skipped,
            'navigation_missing': inbox.missing,
            'broken_tracks': known.broken,
            'moving_alike': int(known.alike),
            'pings_moving_alike': known.pings_alike,
            'covariance_repairs': known.repairs,
            'landmarks': len(known.memory),
            'seeds': sum(len(seeds.classes) for seeds in known.seeds),
            'clutter_a_ping': known.clutter.a_ping(),
            **dict(
                zip(('scale_range', 'scale_bearing'), known.scales.factor(self.config).tolist())
            ),
            'navigation_good': float(good.mean()) if len(good) else float('nan'),
            **known.navigation.health(),
        }

    def warnings(self) -> list[str]:
        """Return what users should know of the echoes, in sentences."""
        known, config = self._stream.state.known, self.config
        advice = 'check range_std, bearing_std_deg and the variances of the detections'
        late = False
        if known.scales.noticed(config)[1] > 1.0:
            good = self._both(known)[1][known.confirmed]
            late = 2 * np.count_nonzero(good < 0.5) > len(good)
        found = known.scales.warnings(config, late) + known.clutter.warnings(config)
        if known.innovations.verdict > 0 or not known.scales.are_learnt:
            found += known.innovations.warnings('detections', advice)
        seen = known.obstacles.existence.detectability(config)[known.confirmed]
        if len(seen) and np.count_nonzero(seen < SELDOM) > 0.5 * len(seen):
            share = float(np.median(seen))
            found.append(
                f'obstacles are seen in {share:.0%} of the pings: they take '
                f'{config.confirm_hits / share * known.clutter.interval:.0f} s to confirm'
            )
        shown = int(np.count_nonzero(known.confirmed))
        found += known.navigation.warnings(known.sonar.course, shown, config, late)
        takes, wrong = known.untimed
        if takes:
            found.append(
                f'a scan takes {takes:.1f} s and its detections have no times: one instant is '
                f'taken for all, wrong by up to {wrong:.1f} m'
            )
        return found

    def process(self, measurement: Measurement) -> list[Estimate]:
        # Nonsense overflows: what is not finite then is dropped and counted.
        with np.errstate(over='ignore', divide='ignore', invalid='ignore'):
            revised = self._stream.revise(measurement)
            pings = {known.stamp_ns: known for _, state in revised for known in state.done}
            return [self._estimate(pings[stamp_ns]) for stamp_ns in sorted(pings)]

    @property
    def landmarks(self) -> Memory:
        """The obstacles that are remembered and not in view."""
        return self._stream.state.known.memory

    def known(self) -> list[dict[str, float]]:
        """All obstacles at the newest ping, those in view too, see `Landmark.row`."""
        state = self._stream.state
        memory = self._survivor(state).known.memory
        return [each.row(state.known.stamp_ns, self.config) for each in memory]

    def _step(
        self, before: ObstacleState, stamp_ns: int, items: Sequence[Measurement]
    ) -> ObstacleState:
        """Return the state after all measurements of one stamp. Pure."""
        inbox, ready = before.inbox.received(items).released(self.config)
        known, done = before.known, []
        for detections, altitude in ready:
            scale = known.scales.factor(self.config)
            ping = inbox.ping(detections, altitude, self.mount, self.config, scale)
            for stage in self.stages:
                known = stage(known, ping)
            done.append(known)
        return ObstacleState(known, inbox.forgetting(stamp_ns, self.config), tuple(done))

    def _survivor(self, state: ObstacleState) -> ObstacleState:
        """What outlives a restarted clock: the identities that are used up, and the landmarks."""
        known, everybody = state.known, np.ones(len(state.known.life), np.bool_)
        if self.config.max_landmarks:
            known = remember(known, everybody, self.filter, self.mount, self.config)
        none = known.only(~everybody)
        return ObstacleState(
            Known(
                0,
                none.sonar,
                none.life,
                none.obstacles,
                none.memory,
                none.repairs,
                navigation=NavigationErrors.of(self.config),
            )
        )

    # -- the stages -------------------------------------------------------------------------------

    def _predict(self, known: Known, ping: Ping) -> Known:
        """Move the obstacles to where this ping should show them. Tracks whose numbers are not
        finite end."""
        ping.before = known.sonar
        ping.dt = (ping.stamp_ns - known.stamp_ns) * 1e-9 if known.stamp_ns else 0.0
        # What is out of sight goes on with what it does, as a landmark: else more and more of it
        # would move, and meet false echoes all around.
        silent = known.stamp_ns - known.life.last_hit_ns > nanoseconds(SILENT)
        mixture = known.obstacles.mixture
        if ping.sweep is None:
            active = np.flatnonzero(~silent)
            switched = self.filter.switch_behaviours(take(mixture, active), ping.dt)
            mixture, repairs = self.filter.predict_unchanged(
                replace_rows(mixture, active, switched), ping.before, ping.sonar, ping.dt
            )
        else:
            where = self.filter.whereabouts(mixture, ping.before)
            met = ping.sweep.met(*where, ping.dt)
            before = [ping.before] * len(met.ago)
            mixture, repairs = self.filter.advance_each(
                mixture, before, met.sonars, ping.dt - met.ago, silent
            )
            ping.met = met.rows(mixture.is_finite())
        is_finite = mixture.is_finite()
        broken = len(is_finite) - int(np.count_nonzero(is_finite))
        existence = known.obstacles.existence.later(ping.dt)
        known = known.with_columns(mixture=mixture, existence=existence).only(is_finite)
        errors = known.navigation.predicted(ping.stamp_ns, ping.dt, self.config)
        return known._replace(
            stamp_ns=ping.stamp_ns,
            sonar=ping.sonar,
            navigation=errors,
            repairs=known.repairs + repairs,
            broken=known.broken + broken,
        )

    def _predict_misses(self, known: Known, ping: Ping) -> Known:
        """Move what misses say of the obstacles as well."""
        misses = known.obstacles.misses
        return known.with_columns(
            misses=misses.predicted(self.filter, ping.before, ping.sonar, ping.dt)
        )

    def _recall(self, known: Known, ping: Ping) -> Known:
        """Begin the tracks again of landmarks that come into view."""
        return recall(known, ping, self.filter, self.config)

    def _associate(self, known: Known, ping: Ping) -> Known:
        """Weigh all joint events of the obstacles and echoes, with tracks of those seeds that the
        ping may meet."""
        filter_, config, T = self.filter, self.config, len(known.life)
        widest = known.clutter.widest(ping.echoes.z)
        compared, repairs = compare(known.obstacles, ping, filter_, ping.met, widest)
        density = known.clutter.density(ping.echoes.z, config)
        expected = density * (1.0 + claims(known.obstacles, compared, density, filter_))
        seeds = with_clutter_density(known.seeds, known.clutter, config)
        room = config.max_tracks - T
        seeds, banks = start_banks(seeds, ping, expected, known.navigation, filter_, room)
        for mixture, bodies, existence, met, repaired in banks:
            new = begun(mixture, bodies, existence)
            known = known.joined(known.life.born(len(new.nis), ping.stamp_ns, RULES), new)
            theirs, more = compare(new, ping, filter_, met, widest)
            compared = compared.joined(theirs, len(compared.ahead))
            repairs += repaired + more
            ping.met = joined(ping.met, met)
        ping.match = associate(known.obstacles, compared, density, filter_)
        return known._replace(seeds=seeds, repairs=known.repairs + repairs)

    def _update(self, known: Known, ping: Ping) -> Known:
        """Update obstacles, existence, and what is known of false echoes and of variances."""
        table, match, config = known.obstacles, ping.match, self.config
        # Tracks that may be clutter themselves must not make it look rare.
        false = 1.0 - match.beta[known.confirmed].sum(axis=0)
        after = updated(table, match)
        last, scales = learnt(known, ping, self.filter.moves, config)
        return known._replace(
            obstacles=after._replace(last=last),
            clutter=known.clutter.after(ping.echoes.z, false, ping.dt),
            scales=scales,
        )

    def _note_navigation(self, known: Known, ping: Ping) -> Known:
        """Keep the marginals of the errors of the navigation as they are before the update."""
        ping.navigation_before = marginals(known.obstacles.mixture)
        return known

    def _share_navigation(self, known: Known, ping: Ping) -> Known:
        """Send all other obstacles the information on these errors that each gained."""
        mixture = known.obstacles.mixture
        chance = known.obstacles.existence.probability()
        trust = np.where(known.confirmed & (chance > SURE), chance, 0.0)
        L, eta = messages(ping.navigation_before, marginals(mixture), trust)
        if not L.any():
            return known
        if len(L) > 1:
            mixture = apply_messages(mixture, L.sum(axis=0) - L, eta.sum(axis=0) - eta)
        known = known._replace(navigation=known.navigation.with_messages(L, eta))
        return known.with_columns(mixture=mixture)

    def _complete_scan(self, known: Known, ping: Ping) -> Known:
        """Predict the obstacles to the end of a ping that takes time."""
        if ping.met is None:
            return known
        met = ping.met
        mixture, repairs = self.filter.advance_each(
            known.obstacles.mixture, met.sonars, [ping.sonar] * len(met.ago), met.ago
        )
        return known.with_columns(mixture=mixture)._replace(repairs=known.repairs + repairs)

    def _weigh_misses(self, known: Known, ping: Ping) -> Known:
        """Take in what it says of the height that some gave no echo."""
        table = known.obstacles
        misses = table.misses.with_ping(
            ping.match.hit, table.mixture, self.filter, ping.sonar, ping.before
        )
        return known.with_columns(misses=misses)

    def _judge(self, known: Known, ping: Ping) -> Known:
        """Confirm tracks, and tell which end and which of those are remembered."""
        table, life, match = known.obstacles, known.life, ping.match
        mean, covariance = moment_match(*table.mixture, 2)
        confirmed = known.confirmed
        partner = older_nearby(
            mean, covariance, life.track_id.astype(np.int64), confirmed, match.hit
        )
        existence = table.existence.near(partner)
        status = existence.status(life.status, match.hit, self.config)
        last_hit_ns = np.where(match.hit, ping.stamp_ns, life.last_hit_ns)
        life = evolve(life, status=status, age=life.age + 1, last_hit_ns=last_hit_ns)
        coasted = ping.stamp_ns - last_hit_ns > nanoseconds(self.config.max_coast)
        passed = ~match.compared.ahead | (mean[:, 0] > BEYOND * self.config.max_range)
        ended = existence.ended(confirmed)
        ping.over = (passed | coasted) & ~ended
        ping.stays = ~(ended | passed | coasted)
        return known._replace(life=life).with_columns(existence=existence)

    def _remember(self, known: Known, ping: Ping) -> Known:
        """Keep what passed, or was not seen for long, as landmarks."""
        return remember(known, ping.over, self.filter, self.mount, self.config)

    def _end(self, known: Known, ping: Ping) -> Known:
        """End the tracks that are over or passed."""
        return known.only(ping.stays)

    def _begin(self, known: Known, ping: Ping) -> Known:
        """Add a seed for each echo."""
        match = ping.match
        false = 1.0 - match.beta.sum(axis=0)
        return known._replace(
            seeds=add_seeds(known.seeds, ping, false, match.density, self.config)
        )

    def _watch(self, known: Known, ping: Ping) -> Known:
        """Count what users are warned of, in all pings so far: `warnings` are read at the end.
        Tracks that have just ended are in `ping` only (`ping.stays`)."""
        nis = known.obstacles.nis
        sure = np.isfinite(nis) & known.confirmed
        alike = moving_alike(self.filter, known.obstacles.mixture, known.confirmed)
        return known._replace(
            alike=alike,
            pings_alike=known.pings_alike + alike,
            innovations=known.innovations.after(nis[sure], 2),
            untimed=max(known.untimed, ping.skew(), key=itemgetter(1)),
        )

    # -- what is published ------------------------------------------------------------------------

    def _both(self, known: Known) -> tuple[Mixture, FloatArray]:
        """See `under_two_assumptions`."""
        age = (known.stamp_ns - known.navigation.first_ns) * 1e-9
        mixture = self._published(known.obstacles)
        return under_two_assumptions(mixture, known.confirmed, age, self.config)

    def _estimate(self, ping: Known) -> Estimate:
        mixture, _ = self._both(ping)
        view = self.filter.view(mixture, ping.sonar)
        view = with_common_errors(
            view, ping.sonar, ping.obstacles.bodies, self.config.range_scale_std
        )
        place, place_covariance = self.mount.to_enu(view.place, view.place_covariance)
        extras: dict[str, np.ndarray] = {
            **behaviour_columns(view, self.filter.behaviours),
            **closest_approach(*view.near, mixture.mu, ping.sonar.course, self.config),
            'track_id': ping.life.track_id,
            'track_state': ping.life.status,
            'vertical_offset_lo': view.low,
            'vertical_offset_hi': view.high,
            'nis': ping.obstacles.nis,
            'existence': ping.obstacles.existence.probability(),
            'detection_probability': ping.obstacles.existence.detectability(self.config),
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


def wanted(*stages: Stage | None) -> tuple[Stage, ...]:
    """Return the stages that are there."""
    return tuple(stage for stage in stages if stage is not None)
