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

"""Snapshots of an array from sonar images: amplitude and phase, or one image per stave.

Interferometers are often recorded as images without a place for complex numbers. A ping is then
spread over messages, which are taken apart by the names of their fields, so that RawSonarImage of
marine_acoustic_msgs and messages like it serve alike:

* amplitude and phase of two staves: one value of each per range, the phase of stave 1 against
  stave 0; or amplitude and phase of every stave, one "beam" a stave;
* in-phase and quadrature samples: one message per stave, stave 0 first, with two "beams" or with
  the two numbers in turn.

Samples are an image with its own datatype (``dtype``, ``beam_count``, ``is_bigendian``, ``data``)
or an array of numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from typing import Any

import numpy as np

from sonar_imm.estimation.arrays import ComplexArray, FloatArray
from sonar_imm.measurements import Rejection, Snapshot
from sonar_imm.measurements.bathymetry import MAX_BINS, MAX_STAVES

from .detections import SOUND_SPEEDS
from .headers import stamp_ns
from .sonar_images import DTYPES, image_samples

FIELDS: dict[str, str] = {
    'amplitude': 'image',
    'phase': 'image',
    'iq': 'image',
    'sample_rate': 'sample_rate',
    'sample0': 'sample0',
    'frequency': 'ping_info.frequency',
    'sound_speed': 'ping_info.sound_speed',
}
"""Where things stand in a message, as in RawSonarImage; a dot leads into a message inside."""


def snapshot_of_phase(
    amplitude: Any, phase: Any, *, radians_per_count: float | None = None, **how: Any
) -> Snapshot:
    """The snapshot of an image of amplitudes and one of phases, with the same shape.

    radians_per_count: what one count of the phase is; None: 1 for floats, and for whole numbers
    the full circle over their range. `how`: see `_snapshot`. Raises `Rejection`.
    """
    fields, order = how.get('fields', FIELDS), how.get('order', 'range_major')
    size, _ = _samples(amplitude, fields['amplitude'], order)
    turn, counts = _samples(phase, fields['phase'], order)
    if size.shape != turn.shape:
        raise Rejection(
            'bad_shape',
            f'{size.shape[0]} ranges and {size.shape[1]} channels of amplitude do not fit '
            f'{turn.shape[0]} and {turn.shape[1]} of phase',
        )
    scale = radians_per_count
    if scale is None:
        scale = 1.0 if counts is None else 2.0 * math.pi / counts
    wave = np.exp(1j * scale * turn)
    iq = size * wave if size.shape[1] > 1 else np.column_stack([size + 0j, size * wave])
    return _snapshot(amplitude, iq, **how)


def snapshot_of_staves(messages: Sequence[Any], **how: Any) -> Snapshot:
    """The snapshot of one message per stave with in-phase and quadrature samples; see
    `snapshot_of_phase`."""
    fields, order = how.get('fields', FIELDS), how.get('order', 'range_major')
    staves = [_in_quadrature(_samples(message, fields['iq'], order)[0]) for message in messages]
    if len({len(stave) for stave in staves}) > 1:
        raise Rejection(
            'bad_shape', f'the staves have {", ".join(str(len(stave)) for stave in staves)} ranges'
        )
    return _snapshot(messages[0], np.column_stack(staves), **how)


def _snapshot(
    message: Any,
    iq: ComplexArray,
    *,
    fields: Mapping[str, str] = FIELDS,
    order: str = 'range_major',
    sound_speed: float = 1500.0,
    element_spacing: float | None = None,
    side: str = '',
) -> Snapshot:
    """fields: as `FIELDS`; order: of samples in an image, see `sonar_images`; sound_speed: m/s,
    where the message states none; element_spacing: m."""
    rate = _number(message, fields['sample_rate'])
    if rate is None or not rate > 0.0:
        raise Rejection(
            'out_of_range', f"no sample rate in the field '{fields['sample_rate']}': it is {rate}"
        )
    stated = _number(message, fields['sound_speed'])
    known = stated is not None and SOUND_SPEEDS[0] <= stated <= SOUND_SPEEDS[1]
    speed = stated if known else sound_speed
    first = _number(message, fields['sample0']) or 0.0
    frequency = _number(message, fields['frequency'])
    assert speed is not None
    return Snapshot(
        stamp_ns=stamp_ns(message),
        frame_id=str(message.header.frame_id),
        range=(first + np.arange(len(iq))) * speed / (2.0 * rate),
        iq=iq.astype(np.complex64),
        sound_speed=speed,
        frequency=frequency if frequency else None,
        element_spacing=element_spacing,
        sample_rate=rate,
        side=side,
    )


def _find(message: Any, path: str) -> Any:
    """What stands at a dotted path; None when it is not there."""
    for name in path.split('.'):
        message = getattr(message, name, None)
    return message


def _number(message: Any, path: str) -> float | None:
    value = _find(message, path)
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _samples(message: Any, path: str, order: str) -> tuple[FloatArray, int | None]:
    """Samples (ranges, channels), and how many values their datatype has, None for floats."""
    found = _find(message, path)
    if found is None:
        raise Rejection('missing_column', f"the message has no field '{path}'")
    most = MAX_BINS * MAX_STAVES
    if hasattr(found, 'beam_count'):
        beams, code = int(found.beam_count), int(found.dtype)
        if not 0 <= code < len(DTYPES):
            raise Rejection('bad_field', f'the image has the unknown datatype {code}')
        dtype = np.dtype(DTYPES[code])
        count = len(memoryview(found.data).cast('B')) // dtype.itemsize
        if not 1 <= beams <= MAX_STAVES or count > most:
            raise Rejection('too_large', f'an image of {count} samples in {beams} channels')
        return image_samples(found, count // beams, beams, order), _values_of(dtype)
    values = np.asarray(found)
    if values.dtype.kind not in 'iuf' or values.ndim != 1:
        raise Rejection('bad_field', f"the field '{path}' holds no row of numbers")
    if len(values) > most:
        raise Rejection('too_large', f"the field '{path}' holds {len(values)} samples")
    return values.astype(np.float64)[:, None], _values_of(values.dtype)


def _values_of(dtype: np.dtype) -> int | None:
    return 256**dtype.itemsize if dtype.kind in 'iu' else None


def _in_quadrature(samples: FloatArray) -> ComplexArray:
    """Complex samples (ranges,) of two channels, or of one with both in turn."""
    if samples.shape[1] == 1 and len(samples) % 2 == 0:
        samples = samples.reshape(-1, 2)
    if samples.shape[1] != 2:
        raise Rejection(
            'bad_shape',
            f'in-phase and quadrature samples are two channels, not {samples.shape[1]} of '
            f'{len(samples)} ranges',
        )
    return np.asarray(samples[:, 0] + 1j * samples[:, 1])
