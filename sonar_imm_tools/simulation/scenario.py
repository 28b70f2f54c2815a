# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the scenes of all systems share: their parameters, when they begin, noise that lasts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from typing import Any, ClassVar, TypeVar

from attrs import frozen
import numpy as np
from numpy.random import Generator
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import nanoseconds
from sonar_imm.parameters import Config, ConfigError, did_you_mean

S = TypeVar('S', bound='Scenario')
Scenarios = dict[str, tuple[str, dict[str, Any]]]
"""Named scenes: what each is, and what differs from the defaults of its parameters."""

FIRST_STAMP_NS = 1_700_000_000_000_000_000
"""When scenes begin."""


@frozen(kw_only=True)
class Scenario(Config):
    """Base class of the parameters of a scene.

    INSTRUMENT: names of parameters of the instrument that the tracker has under the same name.
    """

    INSTRUMENT: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def among(cls: type[S], scenarios: Scenarios) -> Callable[..., S]:
        """The function ``scenario(name, overrides)``: one of `scenarios`, some values replaced.
        It raises `ConfigError` naming mistakes."""

        def scenario(name: str, overrides: Mapping[str, Any] | None = None) -> S:
            if name not in scenarios:
                raise ConfigError(
                    f"unknown scenario '{name}'{did_you_mean(name, scenarios)}; there are "
                    f'{", ".join(scenarios)}'
                )
            return cls.from_mapping({**scenarios[name][1], **(overrides or {})})

        return scenario

    def instruments(self) -> dict[str, Any]:
        """What a tracker has to know of the instruments, by the names of its parameters."""
        return {name: getattr(self, name) for name in self.INSTRUMENT}

    def feeder_instruments(self) -> dict[str, Any]:
        """What a node before that of the tracker has to know of the instruments."""
        return {}


def stamps_of(seconds: FloatArray) -> np.ndarray:
    """Stamps (n,), ns, of times (n,) since a scene began."""
    return FIRST_STAMP_NS + np.round(seconds * 1e9).astype(np.int64)


def delay_ns(config: Any, longest: float, rng: Generator) -> int:
    """By how much a scan is received late, `longest` s at the most: most are not."""
    return nanoseconds(longest * rng.uniform() if rng.uniform() < config.late_fraction else 0.0)


def lasting(white: FloatArray, keep: float) -> FloatArray:
    """White noise (n, ...) of unit variance, each value of which keeps a share of the one before:
    Gauss and Markov's, whose variance is one throughout."""
    white = white.copy()
    white[1:] *= math.sqrt(1.0 - keep * keep)
    return np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0))


def smoothed(white: FloatArray, width: float) -> FloatArray:
    """White noise (n, ...) of unit variance, smoothed over `width` samples to unit variance."""
    impulse = np.zeros(len(white))
    impulse[len(white) // 2] = 1.0
    kernel = gaussian_filter1d(impulse, width, mode='wrap')
    smooth = gaussian_filter1d(white, width, axis=0, mode='wrap')
    return np.asarray(smooth / np.linalg.norm(kernel))
