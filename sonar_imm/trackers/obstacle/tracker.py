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
way (`filters`). Navigation and pings arrive in any order (`pings`). A ping goes through

    predict -> recall -> associate -> heed -> update -> tell -> carry -> judge -> remember -> end
    -> begin -> watch

A ping of a sonar that turns takes time: each obstacle is predicted to the instant at which the
beam meets it, and carried on to the end of the ping after its update.

Each stage is a pure function of what is `Known` and of the ping. The tuple of stages is built once
from the parameters; a feature that is off has none. So a late message is put in its place by
taking the steps after it again (`intake.stream`).

Source: docs/obstacle.md, after 'forward-looking sonar obstacle tracking' (Daurade).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from operator import attrgetter, itemgetter

import numpy as np
from scipy.special import expit

from ...estimates import Estimate, places
from ...estimation.arrays import FloatArray, replace_rows, take
from ...estimation.association import assign_fits
from ...intake import KnownFrames
from ...intake.stream import ReplayStream, StreamRules
from ...measurements import Altitude, Detections, Ground, Measurement, Navigation
from ..model_checks import track_rules
from .avoidance import closest_approach
from .bodies import Bodies, with_common_errors
from .config import ObstacleConfig
from .filters import behaviour_columns, build_filter, joined, Mixture, moving_alike, Sonar
from .memory import Memory
from .navigation_errors import (
    marginals,
    messages,
    NavigationErrors,
    SURE,
    told,
    under_two_assumptions,
)
from .pings import default_variance, Echoes, Match, Mount, Ping, Verdict
from .state import Known, ObstacleState, recall, remember

__all__ = ['ObstacleConfig', 'ObstacleState', 'ObstacleTracker']

Stage = Callable[[Known, Ping], Known]

STATES = ('range', 'bearing', 'vertical_offset')
MODELS = ('above', 'below')
IN_BEAM = 0.9
"""A confirmed obstacle less probable than this to be in the beam is not missed when it gives no
echo. Where it lies in the vertical is uncertain by about the beam's height for most of the
approach: at 0.5, one in five obstacles that leave the beam above or below would be given up."""
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
        self.rules = track_rules(config)
        evidence, remembers = config.misses == 'evidence', config.max_landmarks > 0
        several = bool(config.navigation_errors()[0].any())
        self._published = attrgetter('misses.shown' if evidence else 'mixture')
        self.stages = wanted(
            self._predict,
            self._predict_misses if evidence else None,
            self._recall,
            self._associate,
            self._heed if several else None,
            self._update,
            self._tell if several else None,
            self._carry,
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
            initial=ObstacleState(known=Known.nothing(self.filter, self.rules)),
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
            'navigation_good': float(good.mean()) if len(good) else float('nan'),
            **known.navigation.health(),
        }

    def warnings(self) -> list[str]:
        """What the sonar states and cannot be true, in a sentence for the user."""
        advice = 'check range_std, bearing_std_deg and the variances of the detections'
        known = self._stream.state.known
        sentences = known.innovations.warnings('detections', advice)
        shown = int(np.count_nonzero(known.confirmed))
        sentences += known.navigation.warnings(known.sonar.course, shown)
        takes, wrong = known.untimed
        if takes:
            sentences.append(
                f'a scan takes {takes:.1f} s and its detections have no times: one instant is '
                f'taken for all, wrong by up to {wrong:.1f} m'
            )
        return sentences

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
            ping = inbox.ping(detections, altitude, self.mount, self.config)
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
        mixture = known.obstacles.mixture
        if ping.sweep is None:
            mixture, repairs = self.filter.advance(mixture, ping.before, ping.sonar, ping.dt)
        else:
            where = self.filter.whereabouts(mixture, ping.before)
            met = ping.sweep.met(*where, ping.dt)
            before = [ping.before] * len(met.ago)
            mixture, repairs = self.filter.advance_each(
                mixture, before, met.sonars, ping.dt - met.ago
            )
            ping.met = met.rows(mixture.is_finite())
        is_finite = mixture.is_finite()
        broken = len(is_finite) - int(np.count_nonzero(is_finite))
        known = known.with_columns(mixture=mixture).only(is_finite)
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
        return recall(known, ping, self.filter, self.rules, self.config)

    def _associate(self, known: Known, ping: Ping) -> Known:
        """Tell which echo each obstacle gave; confirmed tracks choose before tentative ones."""
        mixture, config = known.obstacles.mixture, self.config
        h, C = self.filter.expected(mixture, ping.sonar, ping.met and ping.met.sonars)
        if not len(h) or not len(ping.echoes):
            ping.match = Match(np.full(len(h), -1), h, np.zeros(len(h)))
            return known
        fit = ping.echoes.fits(mixture, h, C, ping.pose(), config)
        # As probable as an echo is at the range of each track.
        usual, p = config.detection_probability, self._chance(mixture)
        weighed = fit + np.log(p / (1.0 - p) * (1.0 - usual) / usual)[:, None]
        chosen = assign_fits(weighed, ~known.confirmed, usual, config.clutter_density)
        ping.match = Match(chosen, h, fit[np.arange(len(fit)), chosen])
        return known

    def _update(self, known: Known, ping: Ping) -> Known:
        """Update the obstacles that gave an echo."""
        table, hit = known.obstacles, np.flatnonzero(ping.match.hit)
        nis = np.full(len(table.nis), np.nan)
        if not len(hit):
            return known.with_columns(nis=nis)
        before, h = take(table.mixture, hit), ping.match.expected[hit]
        echoes = ping.echoes.rows(ping.match.chosen[hit])
        bodies, R = take(table.bodies, hit).with_echoes(
            echoes.extended, echoes.z, echoes.R, default_variance(self.config)
        )
        after, nis[hit], repairs = self.filter.update(before, h, echoes.z, R, ping.sonar)
        after = echoes.update_height(after, (before, h, R), self.filter, ping.pose(hit))
        return known.with_columns(
            mixture=replace_rows(table.mixture, hit, after),
            bodies=replace_rows(table.bodies, hit, bodies),
            nis=nis,
        )._replace(repairs=known.repairs + repairs)

    def _heed(self, known: Known, ping: Ping) -> Known:
        """Note what is known of the errors of the navigation before the update."""
        ping.heard = marginals(known.obstacles.mixture)
        return known

    def _tell(self, known: Known, ping: Ping) -> Known:
        """Tell all other obstacles what the update of each said of these errors."""
        mixture = known.obstacles.mixture
        chance = expit(known.obstacles.existence.now())
        trust = np.where(known.confirmed & (chance > SURE), chance, 0.0)
        L, eta = messages(ping.heard, marginals(mixture), trust)
        if not L.any():
            return known
        if len(L) > 1:
            mixture = told(mixture, L.sum(axis=0) - L, eta.sum(axis=0) - eta)
        known = known._replace(navigation=known.navigation.told(L, eta))
        return known.with_columns(mixture=mixture)

    def _carry(self, known: Known, ping: Ping) -> Known:
        """Carry the obstacles of a ping that takes time on to its end."""
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

    def _chance(self, mixture: Mixture) -> FloatArray:
        """Probability (T,) that a ping shows obstacles that the beam holds."""
        return self.config.detection_at(np.einsum('tk,tk->t', mixture.mu, mixture.x[..., 0]))

    def _judge(self, known: Known, ping: Ping) -> Known:
        """Count hits and misses, weigh existence, and tell which tracks end."""
        table, hit, config = known.obstacles, ping.match.hit, self.config
        in_beam, ahead = self.filter.beam_probability(table.mixture, ping.sonar)
        p = self._chance(table.mixture)
        looked = ~known.confirmed | (in_beam * p > IN_BEAM * config.detection_probability)
        life, stays = known.life.scan(hit, ping.stamp_ns, self.rules, looked=looked)
        ping.verdict = Verdict(life, stays, ahead)
        return known.with_columns(
            existence=table.existence.with_ping(
                hit, ping.match.fit, in_beam, p, config.clutter_density
            )
        )

    def _remember(self, known: Known, ping: Ping) -> Known:
        """Keep what passed, or was not seen for long, as landmarks."""
        stays, ahead = ping.verdict.stays, ping.verdict.ahead
        coasted = known.stamp_ns - known.life.last_hit_ns > self.rules.max_coast_ns
        over = np.where(stays, ~ahead, coasted & ~ping.match.hit)
        return remember(known, over, self.filter, self.mount, self.config)

    def _end(self, known: Known, ping: Ping) -> Known:
        """End the tracks that are over or passed."""
        life, stays, ahead = ping.verdict
        table = known.obstacles if stays.all() else take(known.obstacles, stays)
        return known._replace(obstacles=table, life=life).only(ahead[stays])

    def _begin(self, known: Known, ping: Ping) -> Known:
        """Begin a track at each echo that nobody gave, as long as there is room."""
        free = np.ones(len(ping.echoes), np.bool_)
        free[ping.match.chosen[ping.match.hit]] = False
        which = np.flatnonzero(free)[: max(0, self.config.max_tracks - len(known.life))]
        if not len(which):
            return known
        echoes = ping.echoes.rows(which)
        bodies, R = Bodies.unknown(len(which)).with_echoes(
            echoes.extended, echoes.z, echoes.R, default_variance(self.config)
        )
        mixture, repairs = self._begun(echoes, R, ping, known.navigation)
        known = known._replace(repairs=known.repairs + repairs)
        life = known.life.born(len(which), ping.stamp_ns, self.rules)
        return known.joined(life, mixture, bodies)

    def _begun(
        self, echoes: Echoes, R: FloatArray, ping: Ping, errors: NavigationErrors
    ) -> tuple[Mixture, int]:
        """Return obstacles at echoes, as they are at the end of the ping, and how many covariances
        had to be repaired."""
        if ping.sweep is None or echoes.late is None:
            return self._begun_at(echoes, R, ping, errors, ping.sonar), 0
        sonars = [ping.sweep.at(late) for late in echoes.late]
        new = [
            self._begun_at(echoes.rows(np.array([i])), R[i : i + 1], ping, errors, sonar)
            for i, sonar in enumerate(sonars)
        ]
        end = [ping.sonar] * len(new)
        return self.filter.advance_each(joined(new), sonars, end, -echoes.late)

    def _begun_at(
        self,
        echoes: Echoes,
        R: FloatArray,
        ping: Ping,
        errors: NavigationErrors,
        sonar: Sonar,
    ) -> Mixture:
        height = echoes.height_prior(sonar, ping.ground, self.config)
        mixture = self.filter.begin(echoes.z, R, sonar, height)
        mixture = errors.given_to(mixture)
        return echoes.update_height(mixture, None, self.filter, sonar.pose)

    def _watch(self, known: Known, ping: Ping) -> Known:
        """Count what users are warned of."""
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
