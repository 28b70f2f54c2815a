# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A survey line: its soundings, how the sonar looked at each, and what corrections do to them.

Everything follows from the table of soundings. s is +1 to port and -1 to starboard; D and Y are
the vertical and horizontal distance from the array; l is the horizontal unit vector to port, f =
(l_y, -l_x) the one forward. A correction is the true value less the reported one. With the
gradient g of the floor, gl = g.l and gf = g.f, the height *at a fixed place* changes with

    roll         s Y - D gl
    pitch        D gf
    heading      s Y gf
    offset       1                              (the tide, say)
    sound speed  ((Y^2/D - D) - 2 s Y gl) / c   (mean over the column; at the array it is known)
    latency      -v gf                          (of the position)

All are linear in g, so the means of `Line.basis` over a cell give its partials for any gradient.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from attrs import asdict, evolve, frozen
import numpy as np

from sonar_imm.acoustics.sounding import ErrorBudget, uncertainties
from sonar_imm.estimation.arrays import BoolArray, FloatArray, IntArray
from sonar_imm.intake.leaps import FASTEST, NEAR
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.bathymetry.config import BathymetryConfig

from ..recordings.export.points import Points

PARAMETERS = ('roll', 'pitch', 'heading', 'offset', 'sound_speed', 'latency')
"""Corrections in this order everywhere: rad, rad, rad, m, m/s, s."""
BASIS = 9
"""Columns of `Line.basis`."""
DIRECTION_SECONDS, SPEED_SECONDS = 1.0, 5.0
"""Pings this near share their direction, and their speed: a keel point moves by D times pitch."""
LEAST_NOISE = 0.01**2
SLACK = 10.0
"""Metres by which a sounding may lie farther from the middle of its ping than ranges reach."""
STATED = (
    'attitude_std_deg', 'heading_std_deg', 'heave_std', 'position_std', 'sound_speed_std',
    'sound_speed',
)  # fmt: skip
"""Parameters of a run that a survey uses."""
R = TypeVar('R', bound='Rows')


@frozen(eq=False)
class Rows:
    """A class whose arrays are columns of equal length."""

    def chosen(self: R, rows: BoolArray | IntArray) -> R:
        """Some of the rows."""
        return evolve(self, **{name: column[rows] for name, column in self._columns()})

    @classmethod
    def joined(cls, parts: Sequence[R]) -> R:
        """The rows of several, one after the other; all else is that of the first."""
        columns = zip(*([column for _, column in part._columns()] for part in parts))
        names = [name for name, _ in parts[0]._columns()]
        return evolve(parts[0], **dict(zip(names, map(np.concatenate, columns))))

    def _columns(self) -> list[tuple[str, Any]]:
        values = asdict(self, recurse=False)
        return [(name, value) for name, value in values.items() if isinstance(value, np.ndarray)]


@frozen(eq=False)
class Line(Rows):
    """Soundings (n,) sorted by stamp, x and y.

    xy (n, 2), z (n,) m; noise (n,) variance of z that is a sounding's own, m^2; geometry (n,)
    variance of z that it has in common with all others; D, Y (n,) m;
    s (n,) +1 or -1; port (n, 2), zero where unknown; speed (n,) m/s; label (n,); sound_speed m/s.
    """

    stamp_ns: IntArray
    xy: FloatArray
    z: FloatArray
    noise: FloatArray
    geometry: FloatArray
    D: FloatArray
    Y: FloatArray
    s: FloatArray
    port: FloatArray
    speed: FloatArray
    label: IntArray
    sound_speed: float

    def __len__(self) -> int:
        return len(self.z)

    def corrected(self, corrections: FloatArray) -> Line:
        """The line with `corrections` (6,) applied exactly, not to first order."""
        roll, pitch, heading, offset, speed, latency = corrections
        stretch = 1.0 + speed / self.sound_speed
        slant = stretch * np.hypot(self.D, self.Y)
        elevation = np.arctan2(self.D, self.Y) - self.s * roll
        level = np.clip(stretch * np.cos(elevation), -1.0, 1.0)
        D = slant * np.sin(elevation) / np.maximum(np.abs(np.sin(elevation)), 1e-12)
        D *= np.sqrt(1.0 - np.square(level))
        Y = slant * level
        ahead = np.column_stack([self.port[:, 1], -self.port[:, 0]])
        along = -D * pitch - self.s * Y * heading + self.speed * latency
        across = self.s * (Y - self.Y)
        xy = self.xy + across[:, None] * self.port + along[:, None] * ahead
        return evolve(self, xy=xy, z=self.z - (D - self.D) + offset, D=D, Y=Y)

    def basis(self) -> FloatArray:
        """What the partials of a sounding are made of (n, 9): s Y, (Y^2/D - D)/c, D l, s Y l, v l,
        and the bend Y^2/(2 D) of the error budget."""
        side = self.s * self.Y
        depth = np.maximum(np.abs(self.D), 0.05 * np.hypot(self.D, self.Y) + 1e-6)
        bend = np.square(self.Y) / depth
        sideways = [each[:, None] * self.port for each in (self.D, side, self.speed)]
        water = (bend - depth) / self.sound_speed
        return np.column_stack([side, water, *sideways, 0.5 * bend])


def line_of(points: Points, budget: ErrorBudget, sound_speed: float = 1500.0) -> Line:
    """The line in a table of soundings. Own noise is the vertical uncertainty less the budget
    and less what the geometry of the array makes all soundings have in common."""
    rows = np.lexsort((points['y'], points['x'], points.stamp_ns))
    stamp_ns = points.stamp_ns[rows]
    xy = np.column_stack([points['x'], points['y']])[rows]
    s = np.where(points['side'][rows] < 0.5, 1.0, -1.0)
    slant, angle = points['range'][rows], points['beam_angle'][rows]
    D, Y = slant * np.cos(angle), slant * np.abs(np.sin(angle))
    common, _ = uncertainties(np.zeros(len(D)), D, Y, budget, sound_speed)
    geometry = np.square(points['geometry_std'][rows])
    port, speed = _directions(stamp_ns, xy, s * Y)
    return Line(
        stamp_ns=stamp_ns,
        xy=xy,
        z=points['z'][rows],
        noise=np.maximum(points['vertical_uncertainty'][rows] - common - geometry, LEAST_NOISE),
        geometry=geometry,
        D=D,
        Y=Y,
        s=s,
        port=port,
        speed=speed,
        label=points['label'][rows].astype(np.int64),
        sound_speed=sound_speed,
    )


def without_far(points: Points) -> Points:
    """Return the soundings without those that lie where the sonar cannot have seen them from.

    A sounding lies no farther from the middle of its ping than the slant ranges reach, and pings
    no farther from one another than a ship goes meanwhile. Most soundings are right.
    """
    if not len(points):
        return points
    rows = np.argsort(points.stamp_ns, kind='stable')
    stamp_ns, slant = points.stamp_ns[rows], points['range'][rows]
    xy = np.column_stack([points['x'], points['y']])[rows]
    start = np.flatnonzero(np.diff(stamp_ns, prepend=stamp_ns[0] - 1))
    ping = np.repeat(np.arange(len(start)), np.diff(start, append=len(stamp_ns)))
    count = np.bincount(ping)
    *middle, reach = (
        medians(column[np.lexsort((column, ping))], start, count) for column in (*xy.T, slant)
    )
    places = np.column_stack(middle)
    near = np.hypot(*(xy - places[ping]).T) <= slant + reach[ping] + SLACK
    near &= _reached((stamp_ns[start] - stamp_ns[0]) * 1e-9, places, count)[ping]
    if near.all():
        return points
    kept = np.sort(rows[near])
    columns = {name: column[kept] for name, column in points.columns.items()}
    return Points(points.stamp_ns[kept], columns)


def _reached(seconds: FloatArray, places: FloatArray, soundings: IntArray) -> BoolArray:
    """Return which pings (P,), in the order of their times, a ship can have gone through that went
    through the longest stretch without a leap; places (P, 2)."""

    def leaps(one: int | IntArray, other: int | IntArray) -> Any:
        apart = np.linalg.norm(places[other] - places[one], axis=-1)
        return apart > NEAR + FASTEST * np.abs(seconds[other] - seconds[one])

    pings = np.arange(len(places))
    first = np.flatnonzero(np.append(True, leaps(pings[:-1], pings[1:])))
    last = np.append(first[1:], len(places)) - 1
    best = int(np.add.reduceat(soundings, first).argmax())
    reached = np.zeros(len(first), np.bool_)
    reached[best] = True
    for ways, enter, leave in (
        (range(best + 1, len(first)), first, last),
        (range(best - 1, -1, -1), last, first),
    ):
        here = leave[best]
        for k in ways:
            if not leaps(here, enter[k]):
                reached[k], here = True, leave[k]
    return np.asarray(np.repeat(reached, last - first + 1))


def medians(values: FloatArray, starts: IntArray, counts: IntArray) -> FloatArray:
    """Medians of groups whose values (n,) are sorted within each group."""
    return np.asarray(0.5 * (values[starts + (counts - 1) // 2] + values[starts + counts // 2]))


def budget_of(run: Mapping[str, Any] | None) -> tuple[ErrorBudget, float]:
    """Return the error budget and the sound speed, m/s, of a run; the defaults of what it does not
    state (`unstated`), and of all where there is no run.json (None).

    Raises `ConfigError` where it states no sound speed, or a parameter is not what it must be.
    """
    if run is None:
        return BathymetryConfig().budget(), BathymetryConfig().sound_speed
    stated = run.get('parameters')
    if not isinstance(stated, Mapping):
        raise ConfigError('it has no parameters')
    if 'sound_speed' not in stated:
        raise ConfigError('its parameters lack sound_speed; track the recording again')
    values = {name: stated[name] for name in STATED if name in stated}
    for name, value in values.items():
        plain = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not (plain and abs(value) < 1e9):
            raise ConfigError(f'its parameter {name} is not a finite number')
        values[name] = float(value)
    config = BathymetryConfig.from_mapping(values)
    return config.budget(), config.sound_speed


def unstated(run: Mapping[str, Any] | None) -> list[str]:
    """Return the parameters of `STATED` for which `budget_of` takes the defaults."""
    stated = {} if run is None else run['parameters']
    return [name for name in STATED if name not in stated]


def partials(basis: FloatArray, g: FloatArray, sound_speed: float) -> FloatArray:
    """Partials (n, 6) of heights at fixed places; basis (n, 9) and gradient g (n, 2)."""

    def along_l(k: int) -> FloatArray:
        return np.asarray(basis[:, k] * g[:, 0] + basis[:, k + 1] * g[:, 1])

    def along_f(k: int) -> FloatArray:
        return np.asarray(basis[:, k + 1] * g[:, 0] - basis[:, k] * g[:, 1])

    roll, water = basis[:, 0] - along_l(2), basis[:, 1] - 2.0 * along_l(4) / sound_speed
    offset = np.ones(len(basis))
    return np.column_stack([roll, along_f(2), along_f(4), offset, water, -along_f(6)])


def common_variance(
    basis: FloatArray, g: FloatArray, budget: ErrorBudget, sound_speed: float
) -> FloatArray:
    """Variance (n,) of a height at a fixed place by what soundings of a line have in common: the
    error budget, on a floor of gradient g (n, 2)."""
    a = partials(basis, g, sound_speed)
    depth = basis[:, 8] * 2.0 - basis[:, 1] * sound_speed
    share = budget.sound_speed / sound_speed
    flat = np.square(basis[:, 8]) + np.square(depth)
    sideways = a[:, 4] - basis[:, 1]
    return np.asarray(
        budget.attitude**2 * (np.square(a[:, 0]) + np.square(a[:, 1]))
        + np.square(budget.heading * a[:, 2])
        + budget.heave**2
        + share**2 * flat
        + np.square(budget.sound_speed * sideways)
        + budget.position**2 * np.square(g).sum(axis=1)
    )


def _directions(
    stamp_ns: IntArray, xy: FloatArray, t: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Unit vectors to port (n, 2) and speeds (n,): places regressed on t = s Y within each ping,
    summed over near pings, then the keel points t = 0 over time."""
    if not len(t):
        return np.zeros((0, 2)), np.zeros(0)
    stamps, starts, ping = np.unique(stamp_ns, return_index=True, return_inverse=True)
    n = np.diff(np.append(starts, len(t))).astype(np.float64)
    middle = xy.mean(axis=0)
    p = xy - middle

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray((np.add.reduceat(values, starts, axis=0).T / n).T)

    t_mean, p_mean = mean(t), mean(p)
    slope = mean((t - t_mean[ping])[:, None] * (p - p_mean[ping])) * n[:, None]
    seconds = (stamps - stamps[0]) * 1e-9

    def around(most: float) -> tuple[IntArray, IntArray]:
        """First and one behind the last of the pings (P,) within `most` seconds of each."""
        most += 1e-3
        first = np.searchsorted(seconds, seconds - most, 'left')
        return first, np.searchsorted(seconds, seconds + most, 'right')

    first, last = around(DIRECTION_SECONDS)
    near = _windowed(slope, first, last)
    length = np.hypot(near[:, 0], near[:, 1])
    port = near / np.where(length > 0.0, length, 1.0)[:, None]
    keel = p_mean - t_mean[:, None] * port
    # Speed needs a ping before and one after, however far they are.
    first, last = around(SPEED_SECONDS)
    ping_number = np.arange(len(stamps))
    first = np.minimum(first, np.maximum(ping_number - 1, 0))
    last = np.maximum(last, np.minimum(ping_number + 2, len(stamps)))
    width = (last - first).astype(np.float64)
    t0 = _windowed(seconds[:, None], first, last)[:, 0] / width
    k0 = _windowed(keel, first, last) / width[:, None]
    tt = _windowed(np.square(seconds)[:, None], first, last)[:, 0] / width - np.square(t0)
    tk = _windowed(seconds[:, None] * keel, first, last) / width[:, None] - t0[:, None] * k0
    known = tt > 1e-6
    velocity = tk / np.where(known, tt, 1.0)[:, None] * known[:, None]
    speed = velocity[:, 0] * port[:, 1] - velocity[:, 1] * port[:, 0]
    return port[ping], speed[ping]


def _windowed(values: FloatArray, first: IntArray, last: IntArray) -> FloatArray:
    """Sums of rows first..last-1 of values (m, k)."""
    total = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    return np.asarray(total[last] - total[first])
