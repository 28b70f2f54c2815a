"""From what an array or a profiler heard to one row of numbers: the depth response of a record.

A `Lattice` of depths is laid out at the first record and kept. Every record, wherever the array
was, is put onto it: its `Response` is what the particles see.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from attrs import evolve, field, frozen
import numpy as np
from numpy.typing import NDArray

from ...acoustics import fathometer
from ...acoustics.pulse import band_pulse, gaussian_pulse, measured_pulse, Pulse
from ...acoustics.spectra import noise_taper
from ...estimation.arrays import FloatArray
from ...estimation.set_model import move_reach
from ...estimation.set_shifts import Shift
from ...measurements import CrossSpectra, Rejection, Trace
from ...parameters import ConfigError
from .config import FathometerConfig

MAX_CELLS = 100_000
MAX_MOVES = 8_000_000
"""Of a lattice: cells times the cells that a reflector can move to. Each takes 16 bytes in the
tables of moves, 32 where reflectors of either sign are looked for."""
MAX_SIGMAS = 1e6
_LEAST_NOISE_SAMPLES = 50
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
    traces. noise_unknown: sigma is that of the whole trace, reflectors included.
    """

    stamp_ns: int
    frame_id: str
    depth: FloatArray = field(repr=False)
    amplitude: FloatArray = field(repr=False)
    sigma: FloatArray = field(repr=False)
    reference_depth: float = np.nan
    aperture: float = 0.0
    noise_unknown: bool = False


def pulse_of(config: FathometerConfig) -> Pulse:
    """The pulse that is configured. Raises `ConfigError` for a file that cannot be used."""
    if config.pulse == 'band':
        return band_pulse(config.frequency_min, config.frequency_max, config.sound_speed)
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
    low, high = _window(config, (reference_depth + 10.0, reference_depth + 110.0))
    step = config.depth_step or config.sound_speed / (12.0 * config.frequency_max)
    return _checked(low, step, high, config)


def trace_response(
    trace: Trace, lattice: Lattice, config: FathometerConfig, reference_depth: float
) -> Response:
    """Put a trace onto the lattice; where it does not reach, the response is zero. Raises
    `Rejection` when it has no noise to compare with, or lies elsewhere."""
    amplitude = np.where(np.isfinite(trace.amplitude), trace.amplitude, 0.0)
    noise_unknown = False
    quiet = (trace.depth >= config.noise_depth_min) & (trace.depth <= config.noise_depth_max)
    quiet &= np.isfinite(trace.amplitude)
    if np.count_nonzero(quiet) < _LEAST_NOISE_SAMPLES:
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
            sigma[:] = _measured_sigma(amplitude[quiet])
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


def array_response(
    record: CrossSpectra, lattice: Lattice, config: FathometerConfig, reference_depth: float
) -> Response:
    """Look up and down with the array and correlate. Raises `Rejection` ('bad_band',
    'bad_frequency', 'singular', 'no_noise')."""
    gamma, first, spacing, aperture = array_coherence(record, config)

    def at(low: float, step: float, count: int) -> FloatArray:
        return fathometer.depth_response(
            gamma, first, spacing, (low, step, count), reference_depth, config.sound_speed
        )

    def taper(depth: FloatArray) -> FloatArray:
        way = 2.0 * (depth - reference_depth) / config.sound_speed
        return noise_taper(config.window, config.overlap, way / config.snapshot_seconds)

    b = at(lattice.first, lattice.step, lattice.cells)
    # Nearer than its own length the array hears itself.
    b[lattice.depth - reference_depth < aperture] = 0.0
    sigma = np.full(lattice.cells, config.noise_sigma)
    if not config.noise_sigma and config.noise_from_mirror:
        sigma[:] = mirror_sigma(at, lattice, reference_depth, aperture)
    elif not config.noise_sigma:
        span = config.noise_depth_max - config.noise_depth_min
        step = max(lattice.step, span / MAX_CELLS)
        low = max(config.noise_depth_min, reference_depth + 2.0 * aperture)
        quiet = Lattice(low, step, max(int(span / step), _LEAST_NOISE_SAMPLES))
        # The deeper, the less is left of the noise, too: it is measured deeper than it is needed.
        flat = at(quiet.first, quiet.step, quiet.cells) / taper(quiet.depth)
        sigma = _measured_sigma(flat) * taper(lattice.depth)
    return Response(
        record.stamp_ns,
        record.frame_id,
        lattice.depth,
        b,
        sigma,
        reference_depth,
        aperture,
    )


def mirror_sigma(
    at: Callable[[float, float, int], FloatArray],
    lattice: Lattice,
    reference_depth: float,
    aperture: float,
) -> float:
    """Noise of a response where it holds no echo: at the lags of the lattice, negative, that is at
    the depths 2 reference_depth - z. It fades there as it does on the lattice. Left out: what is
    nearer than the aperture. at(first, step, count): the response."""
    # A short lattice is made longer.
    count = max(lattice.cells, 4 * _LEAST_NOISE_SAMPLES)
    first = 2.0 * reference_depth - lattice.first - lattice.step * (count - 1)
    depth = first + lattice.step * np.arange(count)
    quiet = reference_depth - depth >= aperture
    if np.count_nonzero(quiet) < _LEAST_NOISE_SAMPLES:
        raise Rejection('no_noise', 'nothing of the mirrored depths is free of the array itself')
    noise = at(first, lattice.step, count)[quiet]
    # The noise of a coherence has mean zero: no median of it is taken off.
    return _measured_sigma(np.append(noise, -noise))


def residual_sigma(response: Response, fitted: FloatArray) -> Response:
    """`response` with the noise that is left where the reflectors' own response `fitted` (n,) is
    taken off; as it was when that has no noise."""
    heard = response.amplitude != 0.0
    try:
        sigma = _measured_sigma((response.amplitude - fitted)[heard])
    except Rejection:
        return response
    return evolve(response, sigma=np.full(len(response.depth), sigma))


def array_coherence(
    record: CrossSpectra, config: FathometerConfig
) -> tuple[NDArray[np.complexfloating], float, float, float]:
    """gamma (F,) at the frequencies ``first + spacing * row``, NaN where there is none; first and
    spacing in Hz; and the length of the array, m."""
    rows = np.flatnonzero(
        (record.frequency >= config.frequency_min - 1e-6)
        & (record.frequency <= config.frequency_max + 1e-6)
    )
    if len(rows) < 2:
        raise Rejection(
            'bad_band',
            f'{len(rows)} frequencies lie between {config.frequency_min:g} Hz and '
            f'{config.frequency_max:g} Hz; 2 are needed',
        )
    index, spacing = _comb(record.frequency[rows])
    use = record.usable[rows]
    if not use.any():
        raise Rejection('nan', 'no frequency of the band has only finite, positive powers')
    if config.processor == 'mvdr' and config.loading < 1e-9 and rank_deficient(record):
        raise Rejection('singular', _SINGULAR)
    alive = np.flatnonzero(record.alive)
    heights = config.element_spacing * alive
    csdm = record.csdm[rows[use]][:, alive[:, None], alive]
    w = fathometer.steering(record.frequency[rows[use]], heights, config.sound_speed)
    try:
        heard = fathometer.coherence(
            csdm,
            w,
            config.processor,
            loading=config.loading,
            gain_db=config.white_noise_gain_db,
        )
    except np.linalg.LinAlgError:
        heard = np.full(len(csdm), np.nan)
    # A coherence above one is rounding: nothing was left of the matrix.
    heard[np.abs(heard) > 1.0 + 1e-6] = np.nan
    if not np.isfinite(heard).any():
        raise Rejection('singular', _SINGULAR)
    gamma = np.full(index[-1] + 1, np.nan, np.complex128)
    gamma[index[use]] = heard
    return gamma, float(record.frequency[rows[0]]), spacing, float(heights[-1] - heights[0])


def rank_deficient(record: CrossSpectra) -> bool:
    """True when the matrix in the middle of the band says less than its size: fewer snapshots than
    hydrophones, or hydrophones that hear the same."""
    middle = np.flatnonzero(record.usable)[record.usable.sum() // 2]
    values = np.linalg.eigvalsh(record.csdm[middle][np.ix_(record.alive, record.alive)])
    return bool(values[0] < 1e-6 * values[-1])


def _comb(frequency: FloatArray) -> tuple[NDArray[np.int64], float]:
    """Whole numbers (F,), from 0 on, and the spacing they multiply."""
    apart = np.diff(frequency)
    steps = np.round(apart / np.min(apart))
    # The smallest of many distances in single precision is too small: round twice.
    steps = np.round(apart / (apart[steps == 1.0].mean()))
    index = np.append(0, np.cumsum(steps)).astype(np.int64)
    spacing = float(frequency[-1] - frequency[0]) / float(index[-1])
    if index[-1] > 1_000_000 or (
        np.abs(frequency - frequency[0] - spacing * index).max() > 0.01 * spacing
    ):
        raise Rejection('bad_frequency', 'the frequencies are no multiples of one spacing')
    return index, spacing


def _measured_sigma(quiet: FloatArray) -> float:
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
    reach = move_reach(config.depth_std / step)
    if heard * (2.0 * reach + 1.0) > MAX_MOVES:
        raise Rejection(
            'too_large',
            f'{heard:.0f} steps of {step:g} m, from each of which a reflector can move by '
            f'{reach:.0f} (depth_std {config.depth_std:g} m), are '
            f'{heard * (2.0 * reach + 1.0):.3g} moves; {MAX_MOVES} at most: use a greater '
            'depth_step or fewer depths',
        )
    return Lattice(first, step, int(wanted))
