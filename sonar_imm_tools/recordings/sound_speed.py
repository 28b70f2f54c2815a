# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Profiles of sound speed: CARIS SVP, Kongsberg ASVP, Sea-Bird CNV, and CSV.

A cast goes down and up again, stays at depths and has spikes. The part down to the deepest sample
is taken, sorted by depth; samples of one depth are averaged, and rows without numbers or flagged
are left out. Where more than `MOST_POINTS` remain, those are kept that the linear profile needs.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
import re

import numpy as np

from sonar_imm.acoustics.rays import FASTEST, Profile, SLOWEST
from sonar_imm.estimation.arrays import FloatArray

from .columns import plain
from .sources import BagError, start_of

MOST_POINTS = 200
MOST_ROWS = 1_000_000
FLAGS = (-9.99e-29, -99.0, -999.0, -9999.0)
"""Values of samples that do not exist."""
DEPTH_NAMES = ('depth', 'tiefe', 'profondeur', 'profundidad', 'dybde', 'depsm', 'depfm')
SPEED_NAMES = (
    'sound_speed', 'sound_velocity', 'soundvelocity', 'soundspeed', 'schall', 'celerite',
    'velocidad', 'lydhastighet', 'svcm', 'svdm', 'svwm', 'sv', 'ssp', 'speed', 'velocity', 'c',
)  # fmt: skip
_NUMBERS = re.compile(r'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?')


def read_profile(path: Path) -> Profile:
    """Read a profile of sound speed.

    :returns: speeds in m/s at increasing depths in m.
    :raises BagError: the file is no profile, or none of its rows can be used.
    """
    start = start_of(path)
    try:
        with path.open(encoding='utf-8', errors='replace') as file:
            lines = [line.rstrip('\r\n') for line in islice(file, MOST_ROWS)]
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from None
    if start.startswith(b'[SVP_VERSION'):  # the first section of a CARIS file
        begins = [k for k, line in enumerate(lines) if line.lower().startswith('section')]
        begin, stop = [*begins, len(lines)][:2] if begins else (1, len(lines))
        pairs = _pairs(lines[begin + 1 : stop], 0, 1)
    elif start.lstrip().startswith(b'('):
        pairs = _pairs(lines[1:], 0, 1)
    elif b'*END*' in start or start.startswith(b'* Sea-Bird'):  # CNV, which names its columns
        names = [line.partition('=')[2].strip() for line in lines if line.startswith('# name ')]
        end = next((k for k, line in enumerate(lines) if line.startswith('*END*')), len(lines))
        pairs = _pairs(lines[end + 1 :], *_columns(path, names))
    else:
        pairs = _table(path, lines)
    return _cleaned(path, np.array(list(pairs), np.float64).reshape(-1, 2))


def _pairs(lines: list[str], depth: int, speed: int) -> Iterator[tuple[float, float]]:
    """Yield depth and speed of each row that has numbers in both columns."""
    for line in lines:
        cells = line.replace(';', ' ').replace(',', ' ').split()
        if len(cells) > max(depth, speed):
            try:
                yield float(cells[depth]), float(cells[speed])
            except ValueError:
                continue


def _table(path: Path, lines: list[str]) -> Iterator[tuple[float, float]]:
    """Return the rows of a table with a header, or of two columns without one."""
    filled = [line for line in lines if line.strip() and not line.startswith('#')]
    first = filled[0] if filled else ''
    separator = next((each for each in (';', '\t', ',') if each in first), None)
    names = [cell.strip().strip('"') for cell in first.split(separator)]
    if names and all(_NUMBERS.fullmatch(name) for name in names):
        if len(names) != 2:
            raise BagError(
                f'{path} has {len(names)} columns without names; a profile of sound speed has '
                'the columns depth and sound_speed'
            )
        return _pairs(filled, 0, 1)
    rows, columns = filled[1:], _columns(path, names)
    if separator == ';' and any(',' in line for line in rows):
        rows = [line.replace(',', '.') for line in rows]
    cells = ([cell.strip() or 'nan' for cell in line.split(separator)] for line in rows)
    return _pairs([' '.join(row) for row in cells], *columns)


def _columns(path: Path, names: list[str]) -> tuple[int, int]:
    """Return the columns of depth and sound speed. Raises `BagError`."""

    def find(wanted: tuple[str, ...]) -> int | None:
        for word in wanted:
            for k, name in enumerate(map(plain, names)):
                if name == word or name.startswith(f'{word}_') or len(word) > 3 and word in name:
                    return k
        return None

    depth, speed = find(DEPTH_NAMES), find(SPEED_NAMES)
    if depth is None or speed is None:
        missing = 'depth' if depth is None else 'sound speed'
        own = ', '.join(name[:20] for name in names[:12])
        raise BagError(
            f'{path} is no profile of sound speed: it has no column of {missing}; it has {own}'
        )
    return depth, speed


def _cleaned(path: Path, pairs: FloatArray) -> Profile:
    """Return the profile of a cast (n, 2) of depths and speeds. Raises `BagError`."""
    flagged = np.isclose(pairs[:, :1], FLAGS, rtol=1e-6, atol=0.0).any(axis=1)
    good = np.isfinite(pairs).all(axis=1) & ~flagged
    good &= (pairs[:, 1] >= SLOWEST) & (pairs[:, 1] <= FASTEST)
    if not good.any():
        raise BagError(
            f'{path} holds no profile of sound speed: no row has a depth, m, and a speed between '
            f'{SLOWEST:g} and {FASTEST:g} m/s'
        )
    cast = pairs[good]
    cast = cast * ([-1.0, 1.0] if (cast[:, 0] <= 0.0).all() and cast[:, 0].any() else 1.0)
    cast = cast[: int(cast[:, 0].argmax()) + 1]
    depth, place = np.unique(cast[:, 0].round(3), return_inverse=True)
    speed = np.bincount(place.ravel(), cast[:, 1]) / np.bincount(place.ravel())
    kept = _needed(depth, speed)
    return Profile(depth[kept], speed[kept])


def _needed(depth: FloatArray, speed: FloatArray) -> list[int]:
    """Return the at most `MOST_POINTS` points whose linear profile differs least, those first that
    are furthest from it (Douglas and Peucker 1973)."""
    kept = [0, len(depth) - 1] if len(depth) > 1 else [0]
    while len(kept) < min(MOST_POINTS, len(depth)):
        away = np.abs(speed - np.interp(depth, depth[kept], speed[kept]))
        furthest = int(away.argmax())
        if away[furthest] < 1e-9:
            break
        kept = sorted([*kept, furthest])
    return kept


def mean_speed(profile: Profile) -> float:
    """Return the harmonic mean of the speed over the depths of a profile, m/s: that of a vertical
    path."""
    if len(profile.depth) == 1:
        return float(profile.speed[0])
    above, below = profile.speed[:-1], profile.speed[1:]
    step, more = np.diff(profile.depth), below - above
    same = np.abs(more) < 1e-6
    with np.errstate(invalid='ignore', divide='ignore'):
        time = np.where(same, step / above, step * np.log(below / above) / more)
    return float(step.sum() / time.sum())
