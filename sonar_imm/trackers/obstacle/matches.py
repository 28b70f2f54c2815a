# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Values of the association: tracks beside echoes, and what their joint events say (`events`)."""

from __future__ import annotations

from typing import NamedTuple

from ...estimation.arrays import append, BoolArray, FloatArray, IndexArray, IntArray
from .bodies import Bodies
from .filters import Mixture


class Compared(NamedTuple):
    """T tracks beside D echoes: M pairs of a track and an echo in its gate."""

    target: IndexArray
    """(M,) rising."""
    echo: IndexArray
    """(M,)"""
    given: Mixture
    """(M,) mixtures, if the echo is the track's."""
    log: FloatArray
    """(M,) log density of the echo."""
    seen: FloatArray
    """(M,) the same with s V, as a share of it."""
    bodies: Bodies
    """(M,)"""
    innovation: FloatArray
    """(M, 2) mean of the mixture's."""
    variance: FloatArray
    """(M, 2) of it."""
    nis: FloatArray
    """(M,)"""
    visible: FloatArray
    """(T, K, E) probability that the beam holds each component, by parts of its height."""
    ahead: BoolArray
    """(T,)"""

    def joined(self, other: Compared, T: int) -> Compared:
        """Return both, the tracks of the other one behind the T of these."""
        return append(self, other._replace(target=other.target + T))


class Match(NamedTuple):
    """What the joint events say of T tracks and D echoes."""

    compared: Compared
    density: FloatArray
    """(D,) of false echoes."""
    detected: FloatArray
    """(T, C) detection probability in the beam."""
    beta: FloatArray
    """(T, D) probability that the track exists and gave the echo."""
    classes: FloatArray
    """(T, C) existence after the ping."""
    hit: BoolArray
    """(T,) tracks that more probably gave an echo than not, if they exist."""
    pair: IntArray
    """(T,) the pair of their most probable echo; only where `hit`."""
