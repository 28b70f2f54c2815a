"""The one place that knows how hot loops are compiled.

Kernels are compiled on their first call and kept in numba's cache: beside the source when that is
writable, else in the user's cache folder (or ``NUMBA_CACHE_DIR``). Where neither can be written,
as in a locked-down container, the kernel still works and is compiled anew in each process.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar('F', bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile `function` with numba, cached when any cache folder can be written.

    No fast-math and no threads: the same input gives the same bits on every call.
    """
    options: dict[str, Any] = {'nogil': True, 'error_model': 'numpy'}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # numba: 'cannot cache function ...: no locator available'
        return numba.njit(**options)(function)
