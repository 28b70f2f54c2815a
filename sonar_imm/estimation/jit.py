"""The one place that knows how hot loops are compiled.

Kernels are compiled on their first call and kept in numba's cache: beside the source when that is
writable, else in the user's cache folder (or ``NUMBA_CACHE_DIR``). Where neither can be written,
as in a locked-down container, the kernel still works and is compiled anew in each process.

Compiled code contains the kernels it calls and the constants it names, wherever they are defined.
numba itself compiles anew only when the kernel's own file changes. Here a cached kernel is valid
only while every source file that its own file imports, directly or not, is unchanged; what is no
longer valid is overwritten.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
import hashlib
import inspect
from pathlib import Path
import re
from typing import Any, cast, TypeVar

import numba
from numba import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.dispatcher import Dispatcher

F = TypeVar('F', bound=Callable[..., Any])

_PACKAGE = Path(__file__).resolve().parents[1]
_IMPORT = re.compile(r'^from +(\.*)([\w.]*) +import +(\([^)]*\)|[^\n]*)', re.MULTILINE)


def kernel(function: F) -> F:
    """Compile `function` with numba, cached when any cache folder can be written.

    No fast-math and no threads: the same input gives the same bits on every call.
    """
    compiled: Any = numba.njit(nogil=True, error_model='numpy')(function)
    if isinstance(compiled, Dispatcher):  # not with NUMBA_DISABLE_JIT
        try:
            compiled._cache = _KernelCache(function)  # type: ignore[attr-defined]
        except RuntimeError:  # numba: 'cannot cache function ...: no locator available'
            pass
    return cast(F, compiled)


class _KernelCacheImpl(CompileResultCacheImpl):
    """Adds to numba's stamp of a function's file those of the files it depends on."""

    def __init__(self, function: Callable[..., Any]):
        super().__init__(function)
        own_stamp, digest = self._locator.get_source_stamp, digest_of(inspect.getfile(function))
        checked = bool(config.BOUNDSCHECK)  # type: ignore[attr-defined]
        self._locator.get_source_stamp = lambda: (own_stamp(), digest, checked)


class _KernelCache(FunctionCache):
    _impl_class = _KernelCacheImpl


@cache
def digest_of(path: str) -> str:
    """Digest of the source file at `path` and of those of this package that it imports, directly
    or not."""
    waiting, found = [Path(path)], {}
    while waiting:
        file = waiting.pop()
        if file not in found:
            found[file], imported = _read(file)
            waiting += imported
    contents = b''.join(found[file] for file in sorted(found))
    return hashlib.sha256(contents).hexdigest()


@cache
def _read(file: Path) -> tuple[bytes, tuple[Path, ...]]:
    """Digest of a source file, and the files of this package that it imports itself."""
    try:
        source = file.read_bytes()
    except OSError:  # a notebook's cell; it has no other files to go stale
        return b'', ()
    return hashlib.sha256(source).digest(), tuple(_imported_files(source.decode(), file))


def _imported_files(source: str, file: Path) -> Iterator[Path]:
    """Files that ``from ... import`` statements at the margin of `source` can mean."""
    for dots, module, names in _IMPORT.findall(source):
        parts = module.split('.') if module else []
        if dots:
            folder = file.parents[len(dots) - 1]
        elif parts[0] == _PACKAGE.name:
            folder = _PACKAGE.parent
        else:
            continue
        target = folder.joinpath(*parts)
        for candidate in (target, *(target / name for name in re.findall(r'\w+', names))):
            for source_file in (candidate.with_suffix('.py'), candidate / '__init__.py'):
                if source_file.is_file():
                    yield source_file
