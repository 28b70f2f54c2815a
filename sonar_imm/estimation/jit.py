# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How hot loops are compiled: by numba, with its documented options.

A kernel is compiled at its first call and kept on disk by numba: in `NUMBA_CACHE_DIR` if that is
set, else beside the source if that can be written, else in the user's cache folder. numba compiles
anew when the kernel's own file changes, so no kernel calls one of another file.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, cast, TypeVar
import warnings

import numba

F = TypeVar('F', bound=Callable[..., Any])

kernels: list[Any] = []


def kernel(function: F) -> F:
    """Compile `function` at its first call; keep the code on disk if any folder can be written.

    Division by zero gives infinity or NaN. No fast-math and no threads: the same input gives the
    same bits on every call.
    """
    options: dict[str, Any] = {'nogil': True, 'error_model': 'numpy'}
    try:
        compiled: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # numba: 'cannot cache function ...: no locator available'
        _warn_of_no_cache()
        compiled = numba.njit(**options)(function)
    if compiled is not function:  # as it is with NUMBA_DISABLE_JIT
        kernels.append(compiled)
    return cast(F, compiled)


def counts() -> tuple[int, int]:
    """How many kernels this process has compiled and loaded, one for each kind of arguments."""
    stats = [each.stats for each in kernels]
    compiled = sum(sum(each.cache_misses.values()) for each in stats)
    return compiled, sum(sum(each.cache_hits.values()) for each in stats)


def folder() -> str:
    """Where compiled kernels are kept."""
    paths = {str(each.stats.cache_path) for each in kernels}
    return getattr(numba.config, 'CACHE_DIR', '') or ', '.join(sorted(paths))


@cache
def _warn_of_no_cache() -> None:
    warnings.warn(
        'compiled kernels cannot be kept, since no folder can be written: each process compiles '
        'them; NUMBA_CACHE_DIR can name a folder',
        RuntimeWarning,
        stacklevel=3,
    )
