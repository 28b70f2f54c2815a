# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer tracker over measurements, and the traces of `vectors/fathometer_sea`: records a
second apart, and what was there."""

from typing import NamedTuple

import numpy as np

from helpers.vector_files import load_vectors
from sonar_imm.estimation.consistency import ospa
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker


def run(measurements, **parameters):
    """The tracker, and its estimates by stamp."""
    tracker = FathometerTracker(FathometerConfig(**parameters))
    found = {}
    for item in measurements:
        found.update((each.stamp_ns, each) for each in tracker.process(item))
    return tracker, found


def order_of(estimate):
    """The most probable number of reflectors."""
    return int(estimate.model_names[estimate.probabilities[0].argmax()].split('_')[1])


def near_true(estimate, true):
    """For each reflector the number of the true depth (K,) nearest to it, and how far it is."""
    off = np.abs(estimate.state[:, :1] - true)
    return off.argmin(axis=1), off.min(axis=1)


class Scene(NamedTuple):
    """depth (n,), response (T, n), reflector_depth (T, K), amplitude (K,); file: all it has."""

    depth: np.ndarray
    response: np.ndarray
    reflector_depth: np.ndarray
    amplitude: np.ndarray
    array_depth: float
    file: dict

    def traces(self, records=None, sigma=True):
        noise = np.ones(len(self.depth)) if sigma else None
        known = {'depth': self.depth, 'sigma': noise, 'reference_depth': self.array_depth}
        for k in range(len(self.response)) if records is None else records:
            yield Trace(stamp_ns=(k + 1) * 10**9, amplitude=self.response[k], **known)

    def depth_at(self, stamp_ns):
        return self.reflector_depth[stamp_ns // 10**9 - 1]


class Score(NamedTuple):
    right: float
    ospa: float


def sea_scene(name):
    found = load_vectors(f'fathometer_sea/{name}')
    return Scene(
        found['depth'].astype(float), found['amplitude'].astype(float), found['reflector_depth'],
        found['reflector_amplitude'], float(found['array_depth']), found,
    )  # fmt: skip


def score_scene(found, depth_at, after=0):
    """Share of the records later than `after` whose number of reflectors is right, and OSPA;
    depth_at(stamp): what is there."""
    right, distance = [], []
    for stamp, estimate in found.items():
        if stamp > after * 10**9:
            there = depth_at(stamp)
            right.append(order_of(estimate) == len(there))
            seen = estimate.state[np.isfinite(estimate.state[:, 0]), :1]
            distance.append(ospa(seen, there[:, None], cutoff=2.0, order=2.0))
    return Score(float(np.mean(right)), float(np.mean(distance)))
