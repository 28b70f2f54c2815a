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

"""The one place that knows how hot loops are compiled.

Kernels are compiled on their first call and kept in numba's cache: beside the source when that is
writable, else in the user's cache folder (or ``NUMBA_CACHE_DIR``). Where neither can be written,
as in a locked-down container, the kernel still works and is compiled anew in each process.

Compiled code contains the kernels it calls and the constants it names, wherever they are defined.
numba itself compiles anew only when the kernel's own file changes. Here a cached kernel is valid
only while every source file that its own file imports, directly or not, is unchanged.

numba keeps an index file beside files of code with running numbers. Processes that compile at the
same time take the same number for different code, and one then runs the other's. Here each file
has the name of what it holds, and says it inside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
from functools import cache
import hashlib
import inspect
from pathlib import Path
import re
import time
from typing import Any, cast, TypeVar

import numba
from numba import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

F = TypeVar('F', bound=Callable[..., Any])

KEPT_SECONDS = 7 * 86400.0
"""How long code is kept that was compiled of sources as they no longer are."""

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


class _FilePerKey(IndexDataCacheFile):
    """One file for each source stamp and key, instead of an index."""

    def load(self, key: Any) -> Any:
        try:
            stamp, held, data = self._load_data(self._name_of(key))
        except OSError:
            return None
        return data if (stamp, held) == (self._source_stamp, key) else None

    def save(self, key: Any, data: Any) -> None:
        self._save_data(self._name_of(key), (self._source_stamp, key, data))
        self._tidy()

    def flush(self) -> None:
        for path in self._files():
            path.unlink(missing_ok=True)

    def _name_of(self, key: Any) -> str:
        return f'{self._stem}{_short_digest(key)}.nbc'

    @property
    def _stem(self) -> str:
        """How the names of files of this state of the sources begin."""
        return self._data_name(0).removesuffix('0.nbc') + _short_digest(self._source_stamp) + '.'

    def _files(self) -> Iterator[Path]:
        """The files of this kernel, of any state of the sources."""
        base = self._data_name(0).removesuffix('0.nbc')
        for path in Path(self._cache_path).iterdir():
            if path.name.startswith(base) and path.suffix == '.nbc':
                yield path

    def _tidy(self) -> None:
        """Remove what was compiled of other sources long ago."""
        oldest = time.time() - KEPT_SECONDS
        for path in self._files():
            with contextlib.suppress(OSError):
                if not path.name.startswith(self._stem) and path.stat().st_mtime < oldest:
                    path.unlink()


class _KernelCache(FunctionCache):
    _impl_class = _KernelCacheImpl

    def __init__(self, function: Callable[..., Any]):
        super().__init__(function)
        self._cache_file = _FilePerKey(
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=self._impl.locator.get_source_stamp(),
        )


def _short_digest(value: Any) -> str:
    return hashlib.sha256(repr((numba.__version__, value)).encode()).hexdigest()[:16]


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
