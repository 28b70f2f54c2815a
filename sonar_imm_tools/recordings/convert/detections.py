# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Detections of acoustic tags by receivers with clocks of their own, as arrivals of pings.

Telemetry receivers store which tag they heard at which time of their own clock. Fixed tags
("sync tags") compare the clocks. Detection i of one transmission, by receiver r at the distance
d_r from the tag, satisfies

    t_i = T + d_r / c + o_r(t_i) + error,

with the unknown time T of the transmission, common to all its detections, and the offset o_r of
the clock. T is removed by taking the mean over a transmission. o_r is linear between knots, its
values there follow by least squares, and the first receiver that others share detections with has
the right time. Detections that do not go with the others (echoes) are left out step by step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from sonar_imm.estimation.arrays import BoolArray, FloatArray, IntArray

from ... import SECOND
from ..conversion import ConversionReport, converter
from ..convert_options import DetectionsOptions
from ..sources import BagError
from ..table_files import CsvTable
from ..tables import Row
from ..times import BadRow
from .arrivals import Arrival, name_columns, Places, read_places, Stations, write_pings

HOUR = 3600.0
LONGEST_SYNC = 60.0
"""Seconds between the clocks of two receivers, at most."""
ROUNDS = 5
FAR = 5.0
"""Standard deviations, by the median, at which a detection does not go with the others."""
LEAST = 1e-6
"""Seconds; no clock is compared better."""
LONGEST_PING = 1.0
"""Seconds from the first to the last detection of a ping, at most, where none is stated."""
LEAST_STAMPS = 10
"""Stamps by which their resolution is judged."""
RESOLUTIONS = (60.0, 1.0)
"""Seconds to which receivers or exports round their stamps, beside parts of a second."""
SMALL = 1e-3
"""Part of the size of an array below which the travel in one resolution does not matter."""


class Received(NamedTuple):
    """Detections: receiver (n,), an index; tag (n,), an index; stamp_ns (n,)."""

    receiver: IntArray
    tag: IntArray
    stamp_ns: IntArray


class Clocks(NamedTuple):
    """Offsets of clocks. knots (k,) s after the first detection; offset (receivers, k) s, NaN for
    a receiver that no fixed tag connects with the first; std: s, of a detection about them, NaN
    when nothing was compared; used: how many detections of fixed tags."""

    begin_ns: int
    knots: FloatArray
    offset: FloatArray
    std: float
    used: int

    def right(self, received: Received) -> tuple[IntArray, BoolArray]:
        """Stamps (n,) by one clock, and whether (n,) they could be told."""
        seconds = (received.stamp_ns - self.begin_ns) / SECOND
        late = np.zeros(len(seconds))
        for receiver in np.unique(received.receiver):
            own = received.receiver == receiver
            late[own] = np.interp(seconds[own], self.knots, self.offset[receiver])
        known = np.isfinite(late)
        shift = np.round(np.where(known, late, 0.0) * SECOND).astype(np.int64)
        return received.stamp_ns - shift, known


@converter(DetectionsOptions)
def convert_detections(path: Path, how: DetectionsOptions, report: ConversionReport) -> None:
    """Convert rows of receiver, tag and time to the topic ``/arrivals``, one message per ping."""
    places, origin = read_places(
        how.receivers, report, how.receiver_options, how.origin, 'receiver'
    )
    fixed: Places = {}
    if how.sync is not None:
        fixed = read_places(how.sync, report, how.receiver_options, origin, 'tag')[0]
    table = CsvTable(path, how.options)
    name_columns(table)
    table.require('stamp', 'receiver', 'tag')
    names = list(places)
    numbers = {name: k for k, name in enumerate(names)}

    def parse(row: Row) -> tuple[int, str, int]:
        row.require_valid()
        return numbers[_receiver(row, numbers)], _tag(row), row.stamp_ns()

    rows = [parsed for _, parsed in report.read_rows(table, parse)]
    tags = list(dict.fromkeys(tag for _, tag, _ in rows))
    number = {tag: k for k, tag in enumerate(tags)}
    found = [(receiver, number[tag], stamp) for receiver, tag, stamp in rows]
    received = Received(*np.array(found, np.int64).reshape(-1, 3).T)
    stamps, known, std = received.stamp_ns, np.ones(len(rows), bool), how.toa_std
    stations = np.array(list(places.values()))
    apart = np.linalg.norm(stations[:, None] - stations[None], axis=-1)
    size = float(apart.max(initial=0.0)) / how.sound_speed
    rounding = _rounding(table, received.stamp_ns, size, how, report)
    if len(names) > 1 and len(set(received.receiver.tolist())) == 1:
        report.questions.append(
            f'{path.name}: all detections are of {names[received.receiver[0]]}; a position needs '
            'three receivers or more'
        )
    if fixed:
        at = np.array([fixed.get(tag, (np.nan,) * 3) for tag in tags]).reshape(-1, 3)
        interval = how.clock_interval * HOUR
        clocks = compare_clocks(received, stations, at, how.sound_speed, interval)
        stamps, known = clocks.right(received)
        std = std or (None if np.isnan(clocks.std) else max(clocks.std, rounding or LEAST))
        _note(report, clocks, names)
        for k in np.flatnonzero(~known)[:1]:
            report.problems.append(
                f'{int((~known).sum())} detections have no common time, the first of receiver '
                f'{names[received.receiver[k]]}: it shares no ping of a fixed tag with the others'
            )
    std = std or rounding
    optional = (np.nan if std is None else std * std, *(np.nan,) * 6)
    pings: dict[tuple[object, str], list[Arrival]] = {}
    for tag in tags:
        if tag in fixed:
            continue
        own = np.flatnonzero((received.tag == number[tag]) & known)
        window = how.window or _window(received.receiver[own], stamps[own], size, tag, report)
        for ping, members in enumerate(gather(received.receiver[own], stamps[own], window)):
            pings[ping, tag] = [
                Arrival('', int(stamps[k]), np.nan, '', names[received.receiver[k]], optional, tag)
                for k in own[members]
            ]
    if not pings and fixed:
        report.problems.append('there is no tag beside the fixed ones')
    write_pings(table, pings, Stations(places, None, origin), report, how)


def _note(report: ConversionReport, clocks: Clocks, names: Sequence[str]) -> None:
    if not clocks.used:
        report.notes['clocks'] = 'no two receivers share a detection of a fixed tag'
        return
    spread = [
        f'{name} {1e3 * offset[0]:+.1f} to {1e3 * offset[-1]:+.1f} ms'
        for name, offset in zip(names, clocks.offset)
        if np.isfinite(offset).all()
    ]
    report.notes['clocks'] = (
        f'{", ".join(spread)} at the begin and the end; {clocks.used} detections of fixed tags '
        f'agree to {1e3 * clocks.std:.2f} ms'
    )


def _receiver(row: Row, known: Mapping[str, int]) -> str:
    """The name of the receiver: that of the row, also behind its model or with one left out."""
    text = row.text('receiver')
    named = text if text in known else f'{row.text("model")}-{text}'
    found = (
        [named]
        if named in known and (named == text or row.text('model'))
        else [name for name in known if text and name.endswith(f'-{text}')]
    )
    if len(found) != 1:
        raise BadRow(f"the position of receiver '{text}' is not known", 'unknown receiver')
    return found[0]


def _tag(row: Row) -> str:
    """The tag of a row, with its code space where that stands in a column of its own."""
    text, space = row.text('tag'), row.text('code_space')
    if not text:
        raise BadRow('the tag is empty')
    return text if not space or text.startswith(space) else f'{space}-{text}'


def _rounding(
    table: CsvTable,
    stamp_ns: IntArray,
    size: float,
    how: DetectionsOptions,
    report: ConversionReport,
) -> float | None:
    """The standard deviation of stamps that are rounded, s; None where their resolution is small
    beside `size`, the seconds of travel across the receivers. Raises `BagError` where it is as
    large."""
    stated = stamp_ns - how.options.time_offset_ns
    parts = int(np.gcd.reduce(stated - stated.min(initial=0), initial=0)) / SECOND
    whole = (each for each in RESOLUTIONS if not (stated % round(each * SECOND)).any())
    step = next(whole, min(parts, 1.0))
    if len(stamp_ns) < LEAST_STAMPS or step < SMALL * size or not size:
        return None
    std = step / 12.0**0.5
    text = (
        f'the stamps have a resolution of {step:g} s, {step * how.sound_speed:.3g} m of travel, '
        f'and the receivers are up to {size * how.sound_speed:.3g} m apart'
    )
    if how.toa_std is not None:
        if how.toa_std < std:
            report.questions.append(f'{table.path.name}: {text}: is --toa-std {std:.2g} meant?')
        return None
    if step > size:
        raise BagError(
            f'{table.path}: {text}. If another column holds the part of a second: --column '
            f'fraction=HEADER. To convert it all the same: --toa-std {std:.2g}'
        )
    report.notes['resolution'] = f'{text}; the standard deviation of arrivals is {std:.2g} s'
    return std


def usual_period(receiver: IntArray, seconds: FloatArray) -> float:
    """The median time between detections of one tag by the same receiver, s; infinite without."""
    steps = [np.diff(np.sort(seconds[receiver == each])) for each in np.unique(receiver)]
    every = np.concatenate([*steps, np.empty(0)])
    return float(np.median(every)) if len(every) else np.inf


def _window(
    receiver: IntArray, stamp_ns: IntArray, size: float, tag: str, report: ConversionReport
) -> float:
    """The longest ping, s: no longer than half of the time between pings. Raises `BagError` where
    sound takes longer across the receivers, `size` s."""
    seconds = (stamp_ns - stamp_ns.min(initial=0)) / SECOND
    half = 0.5 * usual_period(receiver, seconds)
    if half < size:
        raise BagError(
            f'the same receivers hear {tag} each {2.0 * half:.3g} s, and sound takes {size:.3g} s '
            'across them: which detections are of one ping is not clear. Say the longest time '
            f'between the first and the last of a ping, e.g. --window {size:.2g}'
        )
    if half < LONGEST_PING:
        report.notes['window'] = f'{half:.3g} s: half of the time between the pings of {tag}'
    return min(LONGEST_PING, half)


def gather(receiver: IntArray, stamp_ns: IntArray, window: float) -> list[IntArray]:
    """Rows of each transmission of one tag: those within `window` seconds of the first, each
    receiver once, with its first detection."""
    found: list[IntArray] = []
    order = np.argsort(stamp_ns, kind='stable')
    stamps, begin = stamp_ns[order], 0
    while begin < len(order):
        inside = np.searchsorted(stamps, stamps[begin] + round(window * SECOND), side='right')
        members = order[begin:inside]
        first = np.unique(receiver[members], return_index=True)[1]
        found.append(members[np.sort(first)])
        begin = int(inside)
    return found


def compare_clocks(
    received: Received,
    receivers: FloatArray,
    tags: FloatArray,
    sound_speed: float,
    interval: float,
) -> Clocks:
    """Compare the clocks of receivers (R, 3) by tags (T, 3), NaN for those that move; m, s.

    interval: seconds from knot to knot. The offsets are against the first of the receivers that
    are connected with the most others.
    """
    begin_ns = int(received.stamp_ns.min()) if len(received.stamp_ns) else 0
    seconds = (received.stamp_ns - begin_ns) / SECOND
    end = seconds.max(initial=0.0)
    knots = np.linspace(0.0, max(end, 1.0), max(1, int(np.ceil(end / interval))) + 1)
    groups, reduced = _sync_groups(received, seconds, receivers, tags, sound_speed)
    if not groups:
        nothing = np.full((len(receivers), len(knots)), np.nan)
        return Clocks(begin_ns, knots, nothing, np.nan, 0)
    row = np.concatenate(groups)
    ping = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    keep = np.ones(len(row), bool)
    for _ in range(ROUNDS):
        offset = _solve(received.receiver[row[keep]], seconds[row[keep]], reduced[row[keep]],
                        ping[keep], knots, len(receivers))  # fmt: skip
        rest = reduced[row] - _at(offset, knots, received.receiver[row], seconds[row])
        rest = rest - ndimage.median(rest, ping, np.arange(len(groups)))[ping]
        sigma = max(1.4826 * float(np.median(np.abs(rest[keep]))), LEAST)
        better = np.abs(rest) <= FAR * sigma
        better &= np.bincount(ping, better)[ping] > 1.0
        if (better == keep).all() or better.sum() < 2:
            break
        keep = better
    linked = _connected(received.receiver[row[keep]], ping[keep], len(receivers))
    offset[~linked] = np.nan
    offset -= offset[np.flatnonzero(linked)[0]]
    free = keep.sum() - len(np.unique(ping[keep])) - linked.sum() * len(knots) + len(knots)
    centred = rest[keep] - _means(rest[keep], ping[keep])
    std = float(np.sqrt((centred**2).sum() / max(free, 1)))
    return Clocks(begin_ns, knots, offset, std, int(keep.sum()))


def _sync_groups(
    received: Received,
    seconds: FloatArray,
    receivers: FloatArray,
    tags: FloatArray,
    sound_speed: float,
) -> tuple[list[IntArray], FloatArray]:
    """Rows of the transmissions of fixed tags that two or more receivers detected, and the times
    (n,) without the travel from the tag."""
    distance = np.linalg.norm(tags[received.tag] - receivers[received.receiver], axis=1)
    reduced = seconds - distance / sound_speed
    groups: list[IntArray] = []
    for tag in np.flatnonzero(np.isfinite(tags).all(axis=1)):
        own = np.flatnonzero(received.tag == tag)
        window = min(LONGEST_SYNC, 0.5 * usual_period(received.receiver[own], seconds[own]))
        stamps = np.round(reduced[own] * SECOND).astype(np.int64)
        groups += [own[found] for found in gather(received.receiver[own], stamps, window)]
    return [group for group in groups if len(group) > 1], reduced


def _hats(knots: FloatArray, seconds: FloatArray) -> tuple[IntArray, FloatArray]:
    """The knot before each time, and the weight of the one after it."""
    before = np.clip(np.searchsorted(knots, seconds, side='right') - 1, 0, len(knots) - 2)
    return before, (seconds - knots[before]) / (knots[before + 1] - knots[before])


def _at(
    offset: FloatArray, knots: FloatArray, receiver: IntArray, seconds: FloatArray
) -> FloatArray:
    before, weight = _hats(knots, seconds)
    after = offset[receiver, before + 1]
    return np.asarray(offset[receiver, before] * (1.0 - weight) + after * weight)


def _solve(
    receiver: IntArray,
    seconds: FloatArray,
    reduced: FloatArray,
    ping: IntArray,
    knots: FloatArray,
    receivers: int,
) -> FloatArray:
    """Offsets (receivers, knots) of least squares, the smallest of those that are as good."""
    rows, size = len(receiver), receivers * len(knots)
    before, weight = _hats(knots, seconds)
    column = receiver * len(knots) + before
    index = np.arange(rows)
    hat = coo_array(
        (
            np.concatenate([1.0 - weight, weight]),
            (np.concatenate([index, index]), np.concatenate([column, column + 1])),
        ),
        shape=(rows, size),
    ).tocsr()
    counts = np.bincount(ping)
    mean = csr_array((1.0 / counts[ping], (ping, index)), shape=(len(counts), rows))
    design = hat - (mean @ hat)[ping]
    wanted = reduced - _means(reduced, ping)
    # Where nobody was heard a clock goes on as it was.
    link = diags_array([-1e-3, 1e-3], offsets=[0, 1], shape=(size, size)).tocsr()
    link = link[np.arange(size) % len(knots) != len(knots) - 1]
    # A common shift of all clocks is free: the least of all is taken.
    normal = design.T @ design + link.T @ link + diags_array(np.full(size, 1e-9))
    solved = spsolve(normal.tocsc(), design.T @ wanted)
    return np.asarray(solved.reshape(receivers, len(knots)))


def _means(values: FloatArray, ping: IntArray) -> FloatArray:
    counts = np.bincount(ping)
    return np.asarray((np.bincount(ping, values) / np.maximum(counts, 1))[ping])


def _connected(receiver: IntArray, ping: IntArray, receivers: int) -> BoolArray:
    """Which receivers (receivers,) are connected by common pings: the largest such group."""
    pings = int(ping.max(initial=0)) + 1
    size = receivers + pings
    graph = coo_array((np.ones(len(receiver)), (receiver, receivers + ping)), (size, size))
    label = connected_components(graph, directed=False)[1][:receivers]
    received = np.isin(np.arange(receivers), receiver)
    largest = np.bincount(label[received]).argmax()
    return np.asarray((label == largest) & received)
