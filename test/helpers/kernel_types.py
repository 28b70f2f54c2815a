# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which kernel types of OpenBLAS this processor can run, and which one is in effect.

OpenBLAS has kernels of its own for each family of processors. They sum in different orders and so
round differently. The variable OPENBLAS_CORETYPE, read when the library is loaded, chooses one.

As a program: prints one line for each of `TYPES`: its name, and ``in effect``, ``can run`` or
why it cannot.
"""

import ctypes
from pathlib import Path

NEEDS = {
    'Prescott': {'pni'},
    'Haswell': {'avx2', 'fma'},
    'SkylakeX': {'avx512f', 'avx512bw', 'avx512dq', 'avx512vl'},
}
"""Instruction sets of each type as /proc/cpuinfo writes them (pni is SSE3). A library that is
forced to a type the processor lacks dies of an illegal instruction."""
TYPES = tuple(NEEDS)

_ALIASES = {'katmai': 'Prescott'}
"""Builds without the oldest kernels share one table among old types and tell the oldest name."""
_QUESTIONS = tuple(
    f'{prefix}openblas_get_corename{suffix}' for prefix in ('scipy_', '') for suffix in ('64_', '')
)


def in_effect():
    """The kernel types of all OpenBLAS libraries of this process, e.g. {'SkylakeX'}; empty where
    numpy and scipy use another BLAS or it cannot be known."""
    import numpy.linalg  # noqa: F401
    import scipy.linalg  # noqa: F401

    try:
        mapped = Path('/proc/self/maps').read_text(encoding='utf-8').splitlines()
    except OSError:
        return set()
    files = {line.split(maxsplit=5)[5] for line in mapped if 'openblas' in line}
    return {name for file in files if (name := _core_name(ctypes.CDLL(file)))}


def _core_name(library):
    for question in _QUESTIONS:
        ask = getattr(library, question, None)
        if ask is not None:
            ask.restype = ctypes.c_char_p
            name = ask().decode()
            return _ALIASES.get(name.lower(), name)
    return None


def left_out():
    """Type: why it cannot run here, for those of `TYPES` that cannot."""
    if not in_effect():
        return dict.fromkeys(TYPES, 'numpy and scipy do not use an OpenBLAS that can be asked')
    lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
    flags = set(next((line for line in lines if line.startswith('flags')), '').split())
    return {
        name: f'this processor lacks {" ".join(sorted(needs - flags))}'
        for name, needs in NEEDS.items()
        if needs - flags
    }


def runnable():
    """The types of `TYPES` that this processor can run, oldest first."""
    missing = left_out()
    return [name for name in TYPES if name not in missing]


if __name__ == '__main__':
    missing, now = left_out(), in_effect()
    for name in TYPES:
        print(f'{name}: {missing.get(name) or ("in effect" if name in now else "can run")}')
