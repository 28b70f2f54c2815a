# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which reflectors are multiples, by their depths below the surface, record by record.

**Multiples** are echoes that were reflected more than once. By depths from the surface, in which
every way is counted once: a surface multiple lies at ``z_i + z_j``, its amplitude has the sign of
``-a_i a_j``; a peg-leg, reflected down once more by a layer k above j and q, lies at ``z_j + z_q -
z_k`` with the sign of ``-a_j a_q a_k``.

How far a track is from such a place, record by record, is small for a multiple; for a primary it
begins anywhere and walks, since layers move each for themselves. Both are Gaussian with a
twentieth of outliers, without which one wrong association would decide. What pairs and triples
there are share the prior probability evenly. A multiple is marked, never deleted.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Annotated, NamedTuple

from attrs import evolve, frozen
import numpy as np
from numpy.typing import NDArray

from ...estimation.arrays import FloatArray, IntArray
from .config import FathometerConfig
from .reflectors import IdArray, Reflectors

PRIOR, OUTLIERS, RECORDS = 0.25, 0.05, 30
MOST_WAYS = 200
_NEAR = 6.0


def seen_as(reflectors: Reflectors, ids: IdArray, records: int = 1) -> Seen:
    """What `multiples` needs to know of a record, `records` after the one before."""
    sign = np.sign(reflectors.amplitude)
    datum = reflectors.datum_std**2
    return Seen(ids, reflectors.depth, reflectors.relative_variance, sign, datum, records)


class Seen(NamedTuple):
    """The reflectors of one record, by depth: track_id (K,), depth (K,) m, variance (K,) of the
    depth without the error of the array's, sign (K,), datum: variance of the array's depth,
    records: how many records' time passed since the one before."""

    track_id: Annotated[NDArray[np.uint32], 'k']
    depth: Annotated[FloatArray, 'k']
    variance: Annotated[FloatArray, 'k']
    sign: Annotated[FloatArray, 'k']
    datum: float
    records: int = 1


class Ways(NamedTuple):
    """Ways by which sound could come from where a reflector seems to be: member (H, 3) of the
    reflectors above, factor (H, 3) of their depths, datum (H,) how often the error of the array's
    depth is left, sign (H,) of the amplitude."""

    member: IntArray
    factor: FloatArray
    datum: FloatArray
    sign: FloatArray


@frozen
class Multiples:
    """The reflectors of the last records. A value: `after` makes a new one."""

    seen: tuple[Seen, ...] = ()

    def after(self, record: Seen) -> Multiples:
        return evolve(self, seen=(*self.seen, record)[-RECORDS:])

    def probabilities(self, record: Seen, config: FathometerConfig, span: float) -> FloatArray:
        """Probability (K,) that each reflector of `record` is a multiple of others; span: of the
        depths that are tracked, m."""
        K, found = len(record.depth), np.zeros(len(record.depth))
        if not K:
            return found
        past = (*self.seen, record)[-RECORDS:]
        depth, variance = _histories(past, record.track_id)
        datum = np.array([record.datum for record in past])
        time = np.cumsum([record.records for record in past])
        for target in range(1, K):
            ways = ways_above(record.sign, target)
            off = _offsets(depth[-1:], variance[-1:], datum[-1:], ways, target)
            reach = _NEAR * np.sqrt(off[1][0]) + config.depth_std
            near = np.flatnonzero(np.abs(off[0][0]) <= reach)
            if len(near) > MOST_WAYS:
                near = near[np.argsort(np.abs(off[0][0][near]), kind='stable')[:MOST_WAYS]]
            if not len(near):
                continue
            close = Ways(ways.member[near], ways.factor[near], ways.datum[near], ways.sign[near])
            logs = _log_odds(depth, variance, datum, time, close, target, config, span)
            odds = np.exp(np.minimum(logs, 300.0))
            if config.negative_share:
                odds *= _sign_odds(close.sign == record.sign[target], record.sign[target], config)
            total = PRIOR / (1.0 - PRIOR) * float(odds.sum()) / len(ways.sign)
            found[target] = total / (1.0 + total)
        return found


def ways_above(sign: FloatArray, target: int) -> Ways:
    """Pairs and triples of the reflectors above `target`; sign (K,) by ascending depth."""
    member, factor, datum = _combinations(target)
    signs = sign[member]
    product = -signs[:, 0] * signs[:, 1] * np.where(factor[:, 2] != 0.0, signs[:, 2], 1.0)
    return Ways(member, factor, datum, product)


@cache
def _combinations(count: int) -> tuple[IntArray, FloatArray, FloatArray]:
    """Members, factors and share in the datum of `Ways`, of the first `count` reflectors."""
    first, second = np.triu_indices(count)
    # k above j and q: every pair has as many triples as there are reflectors above its upper one.
    upper = np.repeat(np.arange(len(first)), first)
    above = np.concatenate([np.arange(j) for j in first]) if len(first) else np.arange(0)
    pairs = np.column_stack([first, second, np.zeros_like(first)])
    triples = np.column_stack([first[upper], second[upper], above])
    member = np.concatenate([pairs, triples]).astype(np.int64)
    factor = np.repeat([[1.0, 1.0, 0.0], [1.0, 1.0, -1.0]], [len(pairs), len(triples)], axis=0)
    datum = np.repeat([1.0, 0.0], [len(pairs), len(triples)])
    return member, factor, datum


def _offsets(
    depth: FloatArray, variance: FloatArray, datum: FloatArray, ways: Ways, target: int
) -> tuple[FloatArray, FloatArray]:
    """How far (T, H) the target is from the end of each way, and its variance (T, H) if it were
    there, NaN where one of them was not seen."""
    # A way that is gone twice has twice the error.
    twice = (ways.member[:, 0] == ways.member[:, 1])[:, None] * [[1.0, 1.0, 0.0]]
    square = np.square(ways.factor) + twice
    used = ways.factor != 0.0
    parts = np.where(used, depth[:, ways.member] * ways.factor, 0.0)
    errors = np.where(used, variance[:, ways.member] * square, 0.0)
    off = depth[:, target, None] - parts.sum(axis=2)
    return off, variance[:, target, None] + errors.sum(axis=2) + datum[:, None] * ways.datum


def _log_odds(
    depth: FloatArray,
    variance: FloatArray,
    datum: FloatArray,
    time: IntArray,
    ways: Ways,
    target: int,
    config: FathometerConfig,
    span: float,
) -> FloatArray:
    """Log likelihood ratio (H,) of a multiple to a primary; time (T,), in records."""
    off, spread = _offsets(depth, variance, datum, ways, target)
    walk = config.depth_std**2 * (1.0 + np.square(ways.factor).sum(axis=1))
    seen = np.isfinite(off)
    # The last record before, at which the target and its way were seen; -1 for none.
    record = np.arange(len(off))[:, None]
    last = np.maximum.accumulate(np.where(seen, record, -1), axis=0)
    last = np.concatenate([np.full_like(last[:1], -1), last[:-1]])
    there, way = np.maximum(last, 0), np.arange(off.shape[1])
    walked = spread + spread[there, way] + (time[:, None] - time[there]) * walk
    # Before the first a primary can be anywhere.
    primary = np.where(last >= 0, _density(off - off[there, way], walked, span), 1.0 / span)
    ratio = np.log(_density(off, spread, span)) - np.log(primary)
    # Summed up in the order of the records, whatever the number of ways.
    return np.asarray(np.cumsum(np.where(seen, ratio, 0.0), axis=0)[-1])


def _histories(past: Sequence[Seen], track_id: NDArray[np.uint32]) -> tuple[FloatArray, ...]:
    """Depth and variance (T, K) of the reflectors `track_id` (K,) in `past` records, NaN where
    they were not seen."""
    found = np.full((2, len(past), len(track_id)), np.nan)
    every = np.concatenate([record.track_id for record in past])
    row = np.repeat(np.arange(len(past)), [len(record.track_id) for record in past])
    order = np.argsort(track_id)
    place = np.minimum(np.searchsorted(track_id, every, sorter=order), len(track_id) - 1)
    column = order[place]
    use = track_id[column] == every
    for values, name in zip(found, ('depth', 'variance')):
        values[row[use], column[use]] = np.concatenate([getattr(record, name) for record in past])[
            use
        ]
    return tuple(found)


def _density(x: FloatArray, variance: FloatArray, span: float) -> FloatArray:
    normal = np.exp(-0.5 * np.square(x) / variance) / np.sqrt(2.0 * np.pi * variance)
    return np.asarray((1.0 - OUTLIERS) * normal + OUTLIERS / span)


def _sign_odds(agrees: NDArray[np.bool_], sign: float, config: FathometerConfig) -> FloatArray:
    """How much more probable the sign is for a multiple, a twentieth of whose signs are wrong."""
    share = config.negative_share
    return np.asarray(np.where(agrees, 0.95, 0.05) / (share if sign < 0.0 else 1.0 - share))
