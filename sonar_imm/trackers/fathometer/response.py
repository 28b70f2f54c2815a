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

"""From what an array or a profiler heard to one row of numbers: the depth response of a record.

A `Lattice` of depths is laid out at the first record and kept. Every record, wherever the array
was, is put onto it: its `Response` is what the particles see.
"""

from __future__ import annotations

from pathlib import Path

from attrs import evolve, field, frozen
import numpy as np

from ...acoustics import fathometer
from ...acoustics.pulse import band_pulse, envelope_pulse, gaussian_pulse, measured_pulse, Pulse
from ...estimation.arrays import FloatArray
from ...estimation.set_model import walk_reach
from ...estimation.set_shifts import Shift
from ...measurements import Rejection, Trace
from ...parameters import ConfigError
from .config import FathometerConfig

MAX_CELLS = 100_000
MAX_MOVES = 8_000_000
"""Of a lattice: cells times the cells that a reflector can move to. Each takes 16 bytes in the
tables of moves, 32 where reflectors of either sign are looked for."""
MAX_SIGMAS = 1e6
LOUDEST = 1e100
"""Of a trace, whatever its unit: squares of what is louder are beyond numbers."""
LEAST_NOISE_SAMPLES = 50
_SINGULAR = 'the cross-spectral matrices are singular: use more loading or more snapshots'


@frozen
class Lattice:
    """Depths ``first + step * (0 .. cells - 1)``, m."""

    first: float
    step: float
    cells: int

    @property
    def depth(self) -> FloatArray:
        return self.first + self.step * np.arange(self.cells)

    def padded(self, cells: int) -> Lattice:
        """With so many more cells at either end."""
        return Lattice(self.first - cells * self.step, self.step, self.cells + 2 * cells)


@frozen(eq=False)
class Response:
    """The depth response of one record.

    depth, amplitude, sigma (n,): on the lattice, with the standard deviation of the noise.
    reference_depth: of the array, m, NaN when not known. aperture: length of the array, m, 0 for
    traces; snapshot_seconds: of what was averaged, 0 for traces. pulse: of this record, None for
    the one that is configured. noise_unknown: sigma is that of the whole trace, reflectors
    included.
    """

    stamp_ns: int
    frame_id: str
    depth: FloatArray = field(repr=False)
    amplitude: FloatArray = field(repr=False)
    sigma: FloatArray = field(repr=False)
    reference_depth: float = np.nan
    aperture: float = 0.0
    snapshot_seconds: float = 0.0
    pulse: Pulse | None = field(default=None, repr=False)
    noise_unknown: bool = False


def pulse_of(config: FathometerConfig) -> Pulse:
    """The pulse that is configured, that of the band where each record has its own.
    Raises `ConfigError` for a file that cannot be used."""
    if config.pulse in ('band', 'processor'):
        return band_pulse(config.frequency_min, config.frequency_max, config.sound_speed)
    if config.pulse == 'envelope':
        return envelope_pulse(config.frequency_min, config.frequency_max, config.sound_speed)
    if config.pulse == 'gaussian':
        return gaussian_pulse(config.pulse_width)
    try:
        rows = Path(config.pulse_file).read_text(encoding='utf-8-sig').split('\n')
        # The first line may name the columns.
        named = any(character.isalpha() for character in rows[0].replace('e', ''))
        table = [[float(cell) for cell in row.split(',')] for row in rows[named:] if row.strip()]
        return measured_pulse([row[0] for row in table], [row[1] for row in table])
    except OSError as error:
        raise ConfigError(f'pulse_file {config.pulse_file}: {error.strerror}') from None
    except (ValueError, IndexError) as error:
        raise ConfigError(f'pulse_file {config.pulse_file}: {error}') from None


def lattice_of_trace(trace: Trace, config: FathometerConfig) -> Lattice:
    """The depths of the trace that lie in the window; more of them where reflectors move too
    little for its own. Raises `Rejection` when none do."""
    low, high = _window(config, (trace.depth[0], trace.depth[-1]))
    step = config.depth_step
    if not step:
        step = trace.step / np.ceil(0.5 * trace.step / config.depth_std)
    first = trace.depth[0] + step * np.ceil((low - trace.depth[0]) / step - 1e-6)
    return _checked(float(first), float(step), min(high, float(trace.depth[-1])), config)


def lattice_of_array(reference_depth: float, config: FathometerConfig) -> Lattice:
    """The depths in the window. Raises `Rejection` when there are none."""
    low, high = depths_wanted(config, reference_depth)
    step = config.depth_step or config.sound_speed / (12.0 * config.frequency_max)
    return _checked(low, step, high, config)


def depths_wanted(config: FathometerConfig, reference_depth: float) -> tuple[float, float]:
    """First and last depth to be tracked below an array, m."""
    return _window(config, (reference_depth + 10.0, reference_depth + 110.0))


def trace_response(
    trace: Trace, lattice: Lattice, config: FathometerConfig, reference_depth: float
) -> Response:
    """Put a trace onto the lattice; where it does not reach, the response is zero. Raises
    `Rejection` when it has no noise to compare with, or lies elsewhere."""
    amplitude = np.where(np.isfinite(trace.amplitude), trace.amplitude, 0.0)
    loudest = max(float(np.max(np.abs(amplitude))), _loudest_noise(trace))
    if loudest > LOUDEST:
        raise Rejection(
            'out_of_range', f'the trace holds {loudest:.3g}; {LOUDEST:g} is possible at most'
        )
    noise_unknown = False
    quiet = (trace.depth >= config.noise_depth_min) & (trace.depth <= config.noise_depth_max)
    quiet &= np.isfinite(trace.amplitude)
    if np.count_nonzero(quiet) < LEAST_NOISE_SAMPLES:
        quiet = np.isfinite(trace.amplitude)
    if config.remove_background:
        amplitude = amplitude - np.median(amplitude[quiet])
    depth = lattice.depth
    if depth[0] > trace.depth[-1] or depth[-1] < trace.depth[0]:
        raise Rejection('other_depths', 'the trace lies outside of the depths that are tracked')
    sigma = np.full(len(depth), config.noise_sigma)
    if not config.noise_sigma:
        if trace.sigma is not None:
            finite = np.isfinite(trace.sigma)
            sigma = np.interp(depth, trace.depth[finite], trace.sigma[finite])
        else:
            sigma[:] = measured_sigma(amplitude[quiet])
            noise_unknown = config.noise_from_mirror
    return Response(
        trace.stamp_ns,
        trace.frame_id,
        depth,
        np.interp(depth, trace.depth, amplitude, left=0.0, right=0.0),
        sigma,
        reference_depth,
        noise_unknown=noise_unknown,
    )


def _loudest_noise(trace: Trace) -> float:
    sigma = trace.sigma
    return 0.0 if sigma is None else float(np.max(sigma[np.isfinite(sigma)], initial=0.0))


def residual_sigma(response: Response, fitted: FloatArray) -> Response:
    """`response` with the noise that is left where the reflectors' own response `fitted` (n,) is
    taken off; as it was when that has no noise."""
    heard = response.amplitude != 0.0
    try:
        sigma = measured_sigma((response.amplitude - fitted)[heard])
    except Rejection:
        return response
    return evolve(response, sigma=np.full(len(response.depth), sigma))


def measured_sigma(quiet: FloatArray) -> float:
    sigma = fathometer.noise_sigma(quiet)
    if not sigma > 0.0:
        # Coarse steps of a converter leave no deviation of the median.
        sigma = float(np.std(quiet))
    if not (np.isfinite(sigma) and sigma > 0.0):
        raise Rejection('no_noise', 'the record has no noise to compare its peaks with')
    return sigma


def _window(config: FathometerConfig, otherwise: tuple[float, float]) -> tuple[float, float]:
    return (config.depth_min, config.depth_max) if config.depth_max else otherwise


def heave_shift(config: FathometerConfig, step: float) -> Shift | None:
    """The heave as a shift in cells of `step` m: on a grid that is finer than reflectors move and
    than the heave changes."""
    if config.heave == 'none':
        return None
    memory = config.heave_memory if config.heave == 'memory' else 0.0
    std = config.array_depth_std / step
    fine = min(config.depth_std / step / 3.0, 0.5 * std * np.sqrt(1.0 - memory**2))
    return Shift(std=std, memory=memory, step=int(max(1.0, fine, np.ceil(4.0 * std / 200.0))))


def _checked(first: float, step: float, high: float, config: FathometerConfig) -> Lattice:
    wanted = (high - first) / step + 1.0 + 1e-6
    if not wanted >= 2.0:
        raise Rejection('other_depths', 'the record does not reach the depths to be tracked')
    # With heave the record is looked at further up and down.
    heard = wanted + (9.0 * config.array_depth_std / step if config.heave != 'none' else 0.0)
    if heard > MAX_CELLS:
        raise Rejection(
            'too_large',
            f'the depths to be tracked make {heard:.0f} steps of {step:g} m; {MAX_CELLS} at most',
        )
    reach = walk_reach(config.depth_std / step)
    if heard * (2.0 * reach + 1.0) > MAX_MOVES:
        raise Rejection(
            'too_large',
            f'{heard:.0f} steps of {step:g} m, from each of which a reflector can move by '
            f'{reach:.0f} (depth_std {config.depth_std:g} m), are '
            f'{heard * (2.0 * reach + 1.0):.3g} moves; {MAX_MOVES} at most: use a greater '
            'depth_step or fewer depths',
        )
    return Lattice(first, step, int(wanted))
