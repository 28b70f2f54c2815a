# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Reflectors as they are reported: depth, amplitude and identity.

**Identity.** The filter knows sets; who is who from record to record is decided here, after it. A
reflector found near one of the record before takes over its id, the nearest pair first; one that
was missed is waited for `track_memory` records, and ids are never used again. Where no records
came, none was missed: how far a reflector may have walked grows with the time, nothing else.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import math
from typing import NamedTuple

from attrs import evolve, Factory, frozen
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ...acoustics.envelopes import from_normal
from ...acoustics.fathometer import sediment_thickness
from ...acoustics.pulse import gram, Pulse
from ...acoustics.spectra import window_overlap
from ...estimates import Estimate
from ...estimation.arrays import FloatArray
from ...estimation.association import new_ids
from ...estimation.set_members import Members
from ...estimation.set_model import Walks
from .config import FathometerConfig
from .response import Lattice, Response
from .slopes import (
    begun,
    Common,
    common_slope,
    learned,
    REACH,
    Slope,
    slopes_followed,
    STILL,
    walks_to,
    ways,
)

IdArray = NDArray[np.uint32]
BOTTOM_REACH = 12.0
"""How many `depth_std` the floor may jump and keep its id."""
SHOWN, STRENGTH_SPREAD = 20, 0.15
"""Records that the strength of a reflector is a mean of, and how far it may be off besides."""


class Identified(NamedTuple):
    """A reflector that has an id: where it was last seen, in how many records since it was not,
    and for how many more there was time; its slope; the mean of its strength, its amplitude in
    units of the noise, and of how many records that is."""

    track_id: int
    depth: float
    missed: int
    absent: int = 0
    slope: Slope = STILL
    strength: float = 0.0
    shown: int = 0

    @property
    def walked(self) -> int:
        """How many records' walks lie between where it was seen and the next record."""
        return 1 + self.missed + self.absent

    @property
    def place(self) -> float:
        """Where it probably was in the last record."""
        slope = self.slope.mean if self.slope.dipping > 0.5 else 0.0
        return self.depth + (self.walked - 1) * slope


@frozen
class Identities:
    """The ids given so far. A value: naming the reflectors of a record makes a new one."""

    reflectors: tuple[Identified, ...] = ()
    next_id: int = 1
    bottom_id: int = 0

    def name(
        self,
        depth: FloatArray,
        is_bottom: FloatArray,
        config: FathometerConfig,
        variance: FloatArray | None = None,
        *,
        strength: FloatArray | None = None,
        floor_known: bool = False,
        jump: float = 0.0,
    ) -> tuple[Identities, IdArray]:
        """Ids (K,) for reflectors at `depth` (K,) of the next record, is_bottom (K,) the
        probability of each to be the floor, variance (K,) of the depth, m^2, strength (K,) in
        units of the noise; floor_known: is_bottom is more than which of them is the first; jump:
        of all of them from the last record, m, by which these here have been `moved`."""
        ids = nearest_ids(depth, self.reflectors, config)
        bottom_id = self.bottom_id
        if floor_known and len(depth):
            bottom_id = self._follow_bottom(depth, is_bottom, ids, config)
        new = np.flatnonzero(ids == 0)
        living = np.array([known.track_id for known in self.reflectors], np.uint32)
        ids[new], next_id = new_ids(self.next_id, len(new), living)
        slopes = self._slopes(
            ids, depth, np.zeros(len(ids)) if variance is None else variance, config, jump
        )
        shown = self._shown(ids, np.zeros(len(ids)) if strength is None else strength)
        seen = [
            Identified(int(i), float(z), 0, 0, s, *each)
            for i, z, s, each in zip(ids, depth, slopes, shown)
        ]
        missed = [
            known._replace(missed=known.missed + 1)
            for known in self.reflectors
            if known.track_id not in ids and known.missed < config.track_memory
        ]
        if floor_known and len(depth) and not bottom_id:
            bottom_id = _id_of_bottom(ids, is_bottom)
        return Identities((*seen, *missed), next_id, bottom_id), ids

    def _shown(self, ids: IdArray, strength: FloatArray) -> list[tuple[float, int]]:
        """Mean strength of those that now have `ids` (K,), and of how many records."""
        known = {each.track_id: each for each in self.reflectors}
        found = []
        for track_id, new in zip(ids.tolist(), strength.tolist()):
            before = known.get(track_id)
            mean, count = (before.strength, before.shown) if before else (0.0, 0)
            count = min(count + 1, SHOWN)
            found.append((mean + (new - mean) / count, count))
        return found

    def detectable(
        self, ids: IdArray, existence: FloatArray, config: FathometerConfig
    ) -> FloatArray:
        """PMF (order_max + 1,) of how many of the reflectors `ids` (K,) are there and stronger
        than `detectable_sigmas`, by what each has shown."""
        known = {each.track_id: each for each in self.reflectors}
        pmf = np.zeros(config.order_max + 1)
        pmf[0] = 1.0
        for track_id, there in zip(ids.tolist(), existence.tolist()):
            each = known.get(track_id)
            if each is None or not each.shown:
                continue
            off = abs(each.strength) - config.detectable_sigmas
            p = there * float(ndtr(off / math.sqrt(1.0 / each.shown + STRENGTH_SPREAD**2)))
            pmf[1:] = pmf[1:] * (1.0 - p) + pmf[:-1] * p
            pmf[0] *= 1.0 - p
        return pmf

    def _slopes(
        self,
        ids: IdArray,
        depth: FloatArray,
        variance: FloatArray,
        config: FathometerConfig,
        jump: float,
    ) -> list[Slope]:
        """What is known of the slopes of those that now have `ids` (K,) and `depth` (K,)."""
        known = {
            each.track_id: (each, common)
            for each, common in zip(self.reflectors, _commons(self.reflectors, config))
        }
        if not slopes_followed(config):
            return [STILL] * len(ids)
        fresh, found = common_slope([each.slope for each in self.reflectors]), []
        for track_id, z, noise in zip(ids.tolist(), depth.tolist(), variance.tolist()):
            if track_id not in known:
                found.append(begun(fresh, noise, config))
                continue
            before, common = known[track_id]
            change = z - before.depth
            seen = change, noise, before.walked, config, jump
            found.append(learned(before.slope, common, *seen))
        return found

    def slopes(self, ids: IdArray) -> tuple[FloatArray, ...]:
        """Of the reflectors `ids` (K,): the probability that they dip, mean and standard deviation
        of the slope as that leaves them, m per record; of those not known, nothing."""
        known = {each.track_id: each.slope for each in self.reflectors}
        found = np.array([known.get(int(i), STILL)[:3] for i in ids]).reshape(-1, 3)
        d, mean, variance = found.T
        return d, d * mean, np.sqrt(d * (variance + (1.0 - d) * np.square(mean)))

    def walks(self, lattice: Lattice, records: int, config: FathometerConfig) -> Walks:
        """How members walk to the record after the time of so many."""
        known = [
            (each.place, each.slope, common)
            for each, common in zip(self.reflectors, _commons(self.reflectors, config))
        ]
        fresh = common_slope([each.slope for each in self.reflectors])
        return walks_to(known, fresh, lattice, records, config)

    def _follow_bottom(
        self, depth: FloatArray, is_bottom: FloatArray, ids: IdArray, config: FathometerConfig
    ) -> int:
        """Give the floor the id of the one before, and say which it has now, 0 for a new
        one.

        Within the reach of a reflector it has that id before any other looks for the nearest.
        Further away, on a slope or a wall, it has it when it would get a new one, also where what
        is below it is nearer to where it was; further than `BOTTOM_REACH` it is another one."""
        row = int(np.argmax(is_bottom))
        if not is_bottom[row] > 0.5:
            return self.bottom_id
        before = next((each for each in self.reflectors if each.track_id == self.bottom_id), None)
        if before is None:
            return int(ids[row])
        steps = abs(depth[row] - before.depth) / np.sqrt(before.walked) / config.depth_std
        if steps > (BOTTOM_REACH if not ids[row] else REACH):
            return int(ids[row])
        ids[ids == before.track_id] = 0
        ids[row] = before.track_id
        return before.track_id

    def require(self) -> None:
        """Raise ValueError where the state, which may come from a file, is impossible."""
        for _, _, _, _, slope, *_ in self.reflectors:
            known = math.isfinite(slope.mean) and 0.0 <= slope.dipping <= 1.0
            if not (known and slope.variance > 0.0 and slope.noise >= 0.0):
                raise ValueError('no reflector dips like that')

    def wait(self, records: int) -> Identities:
        """The time of so many records passes, and none comes."""
        if not records:
            return self
        waited = (known._replace(absent=known.absent + records) for known in self.reflectors)
        return evolve(self, reflectors=tuple(waited))

    def offset(self, depth: FloatArray, most: float, within: float) -> float:
        """By how much those of the next record at `depth` (K,) all lie elsewhere, m, `most` at
        most: the offset that brings most of them within `within` of these here, and near to it;
        0 where that is one only."""
        ways = depth[:, None] - np.array([each.place for each in self.reflectors])
        offsets = np.append(0.0, ways[np.abs(ways) <= most])
        off = np.abs(ways[..., None] - offsets).min(axis=1, initial=np.inf) / within
        near = np.maximum(1.0 - np.square(off), 0.0)
        # Of those that are as good, the least.
        best = int(np.argmax(near.sum(axis=0) - 0.5 * np.abs(offsets) / max(most, within)))
        return float(offsets[best]) if np.count_nonzero(near[:, best]) > 1 else 0.0

    def moved(self, jump: float) -> Identities:
        """All reflectors, those that are waited for among them, jump by so many m."""
        if not jump:
            return self
        there = (known._replace(depth=known.depth + jump) for known in self.reflectors)
        return evolve(self, reflectors=tuple(there))

    def forget(self) -> Identities:
        """Ids given so far belong to no reflector any more; later ones go on counting."""
        return evolve(self, reflectors=(), bottom_id=0)


def _id_of_bottom(ids: IdArray, is_bottom: FloatArray) -> int:
    row = int(np.argmax(is_bottom))
    return int(ids[row]) if is_bottom[row] > 0.5 else 0


def nearest_ids(
    depth: FloatArray, earlier: Sequence[Identified], config: FathometerConfig
) -> IdArray:
    """Ids (K,) for reflectors at `depth` (K,): those of those `earlier` that are near enough,
    the most probable pairs first; 0: none.

    A reflector walks by `depth_std` a record, and by its slope: of those seen equally long ago the
    nearest to where they lead is the most probable, and one that has been missed could be anywhere
    in a wider range, so that it is less so at any one place. By distance alone, what was lost
    takes over from what is still seen.
    """
    ids = np.zeros(len(depth), np.uint32)
    taken = np.zeros(len(earlier), np.bool_)
    if not len(depth) or not earlier:
        return ids
    surprise = np.empty((len(depth), len(earlier)))
    for column, (known, common) in enumerate(zip(earlier, _commons(earlier, config))):
        to, change = ways(known.slope, common, known.walked, config), depth - known.depth
        surprise[:, column] = to.surprise(change, config, config.min_separation)
    for place in np.argsort(surprise, axis=None, kind='stable'):
        row, column = divmod(int(place), len(earlier))
        if not ids[row] and not taken[column] and np.isfinite(surprise[row, column]):
            ids[row], taken[column] = earlier[column].track_id, True
    return ids


def _commons(reflectors: Sequence[Identified], config: FathometerConfig) -> list[Common]:
    """What the others say of the slope of each."""
    if not slopes_followed(config):
        return [Common()] * len(reflectors)
    slopes = [each.slope for each in reflectors]
    return [common_slope([*slopes[:k], *slopes[k + 1 :]]) for k in range(len(slopes))]


@frozen(eq=False)
class Reflectors:
    """K reflectors of one record, by depth: depth (K,) m, amplitude (K,) of the response,
    covariance (K, 2, 2) of both, existence (K,), is_bottom (K,): the probability to be the floor,
    without an envelope that nothing lies above it; strength (K,): amplitude in units of the noise;
    above_bottom (K,): probability to lie above the floor, NaN without an envelope; heave and
    heave_std: stated minus true depth of the array, m, 0 where it is no state; jumped: probability
    that all have jumped since the record before, and jump, by how many m if so.

    What they share: the error of the array's depth, datum_std (m), a part of the covariance; and
    that of the speed of sound, speed_std (K,), m, the same share of the depth of each below the
    array, which is no part of it.
    """

    depth: FloatArray
    amplitude: FloatArray
    covariance: FloatArray
    existence: FloatArray
    is_bottom: FloatArray
    strength: FloatArray = Factory(lambda self: np.zeros(len(self.depth)), takes_self=True)
    above_bottom: FloatArray = Factory(
        lambda self: np.full(len(self.depth), np.nan), takes_self=True
    )
    speed_std: FloatArray = Factory(lambda self: np.zeros(len(self.depth)), takes_self=True)
    datum_std: float = 0.0
    heave: float = 0.0
    heave_std: float = 0.0
    jumped: float = 0.0
    jump: float = 0.0

    @property
    def probable_jump(self) -> float:
        """By how much all have jumped, m, 0 where it is more probable that they did not."""
        return self.jump if self.jumped > 0.5 else 0.0

    @property
    def common_std(self) -> FloatArray:
        """Standard deviation (K,) of what all of a record share, m."""
        return np.asarray(np.hypot(self.datum_std, self.speed_std))

    @property
    def relative_variance(self) -> FloatArray:
        """Variance (K,) of the depths without what all of a record share, m^2."""
        return np.asarray(np.maximum(self.covariance[:, 0, 0] - self.datum_std**2, 1e-6))


@frozen(eq=False)
class Taken:
    """A record that was taken in: what was seen, how it was named, and by how many m all jumped
    since the one before."""

    response: Response
    named: tuple[Identified, ...]
    jump: float


def earlier_ids(depth: FloatArray, taken: Iterable[Taken], config: FathometerConfig) -> IdArray:
    """Ids (K,) of reflectors at `depth` (K,) of the first of the records `taken`. One that only
    smoothing finds so early has its id from a later record."""
    ids = np.zeros(len(depth), np.uint32)
    for k, each in enumerate(taken):
        depth = depth + each.jump if k else depth
        free = [named for named in each.named if named.track_id not in ids]
        missing = np.flatnonzero(ids == 0)
        ids[missing] = nearest_ids(depth[missing], free, config)
    return ids


def reflectors_of(
    members: Members,
    response: Response,
    lattice: Lattice,
    pulse: Pulse,
    config: FathometerConfig,
    heave: tuple[float, float] | None = None,
    array_depth_found: float = 0.0,
    jump: tuple[float, float] = (0.0, 0.0),
) -> Reflectors:
    """Members of the set in cells and units of the noise, as reflectors in m and amplitudes.
    heave: its mean and standard deviation, m, where it is a state; array_depth_found: error of the
    array's depth, m, that counts where it is more than what is told; jump: probability that all
    jumped, and how far, in cells."""
    depth, lift = lattice.first + lattice.step * members.place, heave[0] if heave else 0.0
    covariance = members.covariance.copy()
    # A cell is as uncertain as it is wide; given the places, the amplitudes are uncertain too.
    covariance[:, 0, 0] += 1.0 / 12.0
    covariance[:, 1, 1] += _conditional_variance(depth, members.prior_variance, pulse)
    amplitude, slope = members.amplitude, np.interp(depth + lift, response.depth, response.sigma)
    is_bottom, above_bottom = members.foremost, np.full(len(depth), np.nan)
    if response.floor is None:
        amplitude = slope * amplitude
    else:
        # A normal number of an envelope, back in the unit of the trace.
        rms = np.interp(depth + lift, response.depth, response.rms)
        amplitude, slope = (rms * each for each in from_normal(amplitude))
        is_bottom, above_bottom = response.floor.labels(depth + lift)
    scale = np.stack([np.full(len(depth), lattice.step), slope], axis=-1)
    covariance *= scale[:, :, None] * scale[:, None, :]
    # The particles know depths as they follow from the depth stated with this record: it alone
    # fixes them to some centimetres, so that the errors of earlier records have no say.
    # Where it is a state, the places of the particles are spread by what is not known of it.
    datum_std = max(config.array_depth_std, array_depth_found)
    if heave is None:
        covariance[:, 0, 0] += datum_std**2
    return Reflectors(
        depth,
        amplitude,
        covariance,
        members.existence,
        is_bottom,
        members.amplitude,
        above_bottom,
        _speed_std(depth + lift, response, config),
        heave[1] if heave else datum_std,
        *(heave or (0.0, 0.0)),
        jump[0],
        lattice.step * jump[1],
    )


def _speed_std(depth: FloatArray, response: Response, config: FathometerConfig) -> FloatArray:
    """What the error of the speed of sound makes of depths (K,), m."""
    # Where the depth of the array is not known, depths count from it.
    height = depth - np.nan_to_num(response.reference_depth)
    return np.asarray(np.abs(height) * config.sound_speed_std / config.sound_speed)


def detectable_amplitude(response: Response, config: FathometerConfig) -> float:
    """`detectable_sigmas` in the unit of the amplitude."""
    if response.floor is None:
        return config.detectable_sigmas * response.noise
    return response.noise * float(from_normal(np.array([config.detectable_sigmas]))[0][0])


def bottom_columns(
    reflectors: Reflectors, response: Response, config: FathometerConfig
) -> dict[str, float]:
    """Depth of the floor and its standard deviation, m, and how deep the transmit pulse reaches;
    NaN where that is not known, as for all but envelopes."""
    if response.floor is None:
        return dict.fromkeys(('bottom_depth', 'bottom_depth_std', 'blanked'), np.nan)
    depth, std = response.floor.depth
    speed = _speed_std(np.array([depth]), response, config)[0]
    return {
        'bottom_depth': depth - reflectors.heave,
        'bottom_depth_std': float(np.sqrt(std**2 + speed**2 + reflectors.datum_std**2)),
        'blanked': response.floor.blanked,
    }


def _conditional_variance(
    depth: FloatArray, prior_variance: FloatArray, pulse: Pulse
) -> FloatArray:
    """Variance (K,) of amplitudes in units of the noise, given all places; prior_variance (K,):
    before the record."""
    precision = gram(pulse, depth) + np.diag(1.0 / prior_variance)
    return np.diag(np.linalg.pinv(precision, hermitian=True)).clip(min=0.0)


def relative_amplitude(
    reflectors: Reflectors, response: Response, config: FathometerConfig
) -> FloatArray:
    """Amplitudes (K,) freed of spreading and of the window, in m: A (2 H + L) / taper(tau / T), H
    below the array of length L, tau = 2 H / c, T the length of a snapshot. NaN when the depth of
    the array is not known, and where the window leaves nothing."""
    height = reflectors.depth - response.reference_depth + reflectors.heave
    with np.errstate(divide='ignore', invalid='ignore'):
        share = 2.0 * height / (config.sound_speed * response.snapshot_seconds)
        taper = window_overlap(config.window, share) if response.aperture else 1.0
        taper = np.where(np.asarray(taper) > 0.0, taper, np.nan)
        return np.asarray(reflectors.amplitude * (2.0 * height + response.aperture) / taper)


def sediment_depths(
    reflectors: Reflectors, config: FathometerConfig
) -> tuple[FloatArray, FloatArray]:
    """Depths (K,) with the sediment's own speed of sound below the bottom, m, and their standard
    deviations (K,), m. The bottom is the reflector that is it most probably; what lies above it
    keeps its depth."""
    if not len(reflectors.depth):
        return np.empty(0), np.empty(0)
    row = int(np.argmax(np.nan_to_num(reflectors.is_bottom)))
    bottom = reflectors.depth[row]
    time = 2.0 * np.maximum(reflectors.depth - bottom, 0.0) / config.sound_speed
    speed = config.sediment_sound_speed or config.sound_speed
    thickness = sediment_thickness(time, speed, config.sediment_sound_speed_gradient)
    speed_std = reflectors.speed_std
    if config.sediment_sound_speed:
        # Below the bottom the water's speed tells the time only, which is seen.
        speed_std = np.minimum(speed_std, speed_std[row])
    variance = reflectors.covariance[:, 0, 0] + np.square(speed_std)
    variance = variance + np.square(thickness * config.sediment_sound_speed_std / speed)
    depth = np.where(time > 0.0, bottom + thickness, reflectors.depth)
    return depth, np.sqrt(variance)


def write_estimate(
    reflectors: Reflectors,
    ids: IdArray,
    pmf: FloatArray,
    multiple: FloatArray,
    known: Identities,
    response: Response,
    config: FathometerConfig,
    *,
    array_depth_found: float = 0.0,
    preview: bool = False,
) -> Estimate:
    """One row per reflector, multiple (K,) the probability that it is a multiple, known: with the
    reflectors of this record; without any, one row whose depth is NaN, for the PMF's sake."""
    rows = max(1, len(ids))
    state, covariance = np.full((rows, 2), np.nan), np.full((rows, 2, 2), np.nan)
    extras: dict[str, np.ndarray] = {
        'track_id': np.zeros(rows, np.uint32),
        'existence': np.zeros(rows),
        'relative_amplitude': np.full(rows, np.nan),
        'polarity': np.zeros(rows, np.int8),
        'heave': np.full(rows, reflectors.heave),
        'heave_std': np.full(rows, reflectors.heave_std),
        'depth_common_std': np.full(rows, np.nan),
        'depth_relative_std': np.full(rows, np.nan),
        'two_way_time': np.full(rows, np.nan),
        'is_bottom': np.zeros(rows),
        'above_bottom': np.full(rows, np.nan),
        'multiple_probability': np.full(rows, np.nan),
        'dipping': np.zeros(rows),
        'slope': np.zeros(rows),
        'slope_std': np.zeros(rows),
        'sediment_depth': np.full(rows, np.nan),
        'sediment_depth_std': np.full(rows, np.nan),
        'sigma': np.full(rows, response.noise),
        'preview': np.full(rows, int(preview), np.uint8),
    }
    extras |= {
        name: np.full(rows, value)
        for name, value in {
            **bottom_columns(reflectors, response, config),
            'common_jump': reflectors.jumped * reflectors.jump,
            'array_depth_found': array_depth_found,
            'detectable_amplitude': detectable_amplitude(response, config),
        }.items()
    }
    for k, p in enumerate(known.detectable(ids, reflectors.existence, config)):
        extras[f'prob_detectable_{k}'] = np.full(rows, p)
    if len(ids):
        state[:] = np.column_stack([reflectors.depth, reflectors.amplitude])
        covariance[:] = reflectors.covariance
        covariance[:, 0, 0] += np.square(reflectors.speed_std)
        extras['track_id'][:] = ids
        extras['existence'][:] = reflectors.existence
        extras['relative_amplitude'][:] = relative_amplitude(reflectors, response, config)
        extras['depth_common_std'][:] = reflectors.common_std
        extras['depth_relative_std'][:] = np.sqrt(reflectors.relative_variance)
        height = reflectors.depth - response.reference_depth
        extras['two_way_time'][:] = 2.0 * height / config.sound_speed
        extras['polarity'][:] = np.sign(reflectors.amplitude)
        extras['multiple_probability'][:] = multiple
        for name, values in zip(('dipping', 'slope', 'slope_std'), known.slopes(ids)):
            extras[name][:] = values
        extras['is_bottom'][:] = reflectors.is_bottom
        extras['above_bottom'][:] = reflectors.above_bottom
        found = sediment_depths(reflectors, config)
        extras['sediment_depth'][:], extras['sediment_depth_std'][:] = found
    zero = np.zeros(rows)
    return Estimate(
        stamp_ns=response.stamp_ns,
        frame_id=response.frame_id,
        xyz=np.column_stack([zero, zero, -state[:, 0]]).astype(np.float32),
        state_names=('depth', 'amplitude'),
        state=state,
        covariance=covariance,
        model_names=tuple(f'order_{k}' for k in range(config.order_min, config.order_max + 1)),
        probabilities=np.tile(pmf, (rows, 1)),
        extras=extras,
    )
