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

Kernels are compiled on their first call and kept on disk: beside the source when that is writable,
else in the user's cache folder; with ``NUMBA_CACHE_DIR`` in that folder and in no other. Where
none can be written, as in a locked-down container, the kernel still works and is compiled anew in
each process. What lies beside the source is loaded also by those who cannot write there.

Compiled code contains the kernels it calls and the constants it names, wherever they are defined.
numba itself compiles anew only when the kernel's own file changes. Here a compiled kernel is valid
as long as its own file and every file of the package that it imports, directly or not, have the
same contents. Their dates do not matter, so a copy, a checkout or a wheel keeps what is compiled.

numba numbers its files of code. Processes that compile at the same time take the same number for
different code, and one then runs the other's. Here each file has the name of what it holds, and
says it inside. It begins with a checksum of the rest, so that LLVM never sees a damaged one. A
process that needs what another one compiles waits, and loads it.

No cache is a condition. What cannot be loaded is compiled, and what cannot be kept (a full disk, a
folder of another user) is compiled anew by each process; a warning says so once.

Whoever compiles has some 70 MB more for as long as it lives: numba and LLVM give little back.
`Elsewhere` is another process that compiles for one that runs long.

numba has no public way to do this. The private parts in use are

* ``numba.core.caching.FunctionCache(function)``, which finds the folder and turns compiled code
  into data; its attribute ``_cache_file``, which is replaced, and of which it calls ``load(key)``,
  ``save(key, data)`` and ``flush()``; and its methods ``load_overload(signature, context)`` and
  ``save_overload(signature, data)``, which are guarded;
* the attribute ``_cache`` of a compiled function;
* ``numba.core.serialize.dumps``, which pickles that data;
* what `lowering` changes, without which it only takes longer.

They are the same in numba 0.58 to 0.68. Where one of the others is missing or has another form,
numba's own cache is used, and a warning says so.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
import contextlib
from functools import cache
import hashlib
import inspect
import json
import os
from pathlib import Path
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
from types import CodeType, ModuleType
from typing import Any, cast, TypeVar
import uuid
import warnings

import numba
from numba.core import types
from numba.core.dispatcher import Dispatcher

from .lowering import fewer_passes

F = TypeVar('F', bound=Callable[..., Any])

KEPT_SECONDS = 7 * 86400.0
"""How long code is kept that was compiled of sources as they no longer are."""

kernels: Counter[str] = Counter()
"""How many kernels this process has 'loaded' and 'compiled', one for each signature; what was
compiled for it `Elsewhere` counts as well."""

listeners: list[Callable[[], object]] = []
"""Called after each kernel that was compiled."""

present: dict[str, int] = {}
"""The kernels that this process can run, by name, each with its lines of source: what was compiled
or loaded, and what it calls."""

LONGEST_SECONDS = 120.0
"""How long a process waits for a kernel that another one compiles. No kernel takes as long: the
other was stopped, and is not waited for again."""

_CHECKSUM = hashlib.sha256().digest_size

_OPTIONS: dict[str, Any] = {'nogil': True, 'error_model': 'numpy', 'no_cfunc_wrapper': True}
"""Nobody hands a kernel to C, and what that would need is a tenth of the code."""
_OPTIONS |= fewer_passes()

_PACKAGE = Path(__file__).resolve().parents[1]
_IMPORT = re.compile(r'^from +(\.*)([\w.]*) +import +(\([^)]*\)|[^\n]*)', re.MULTILINE)


def kernel(function: F) -> F:
    """Compile `function` with numba, kept on disk when any cache folder can be written.

    No fast-math and no threads: the same input gives the same bits on every call.
    """
    compiled: Any = numba.njit(**_OPTIONS)(function)
    if compiled is function:  # with NUMBA_DISABLE_JIT
        return function
    for_types = compiled.get_call_template  # else there is one for each number a caller writes
    compiled.get_call_template = lambda args, kws: for_types([*map(types.unliteral, args)], kws)
    try:
        _attach_cache(compiled, function)
    except (ImportError, AttributeError, TypeError):
        _warn_of_other_numba()
        with contextlib.suppress(RuntimeError):
            compiled = numba.njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # numba: 'cannot cache function ...: no locator available'
        _warn_of_no_cache('no folder can be written')
    return cast(F, compiled)


def _attach_cache(compiled: Any, function: Callable[..., Any]) -> None:
    """Have `compiled` loaded from and saved to files of ours. ImportError, AttributeError or
    TypeError where numba's private parts are not those that we know."""
    from numba.core.caching import FunctionCache

    numbas_own: Any = FunctionCache(function)
    files: Any = type(numbas_own._cache_file)
    replaced: Any = type(compiled._cache)
    _check_verbs(files, replaced)
    ours = numbas_own._cache_file = _FilePerKey(Path(numbas_own.cache_path), function)
    numbas_own.load_overload = _or_none(numbas_own.load_overload, 'loaded', function, ours)
    numbas_own.save_overload = _or_none(numbas_own.save_overload, 'compiled', function, ours)
    compiled._cache = numbas_own


def _or_none(
    use_cache: Callable[..., Any],
    counted_as: str,
    function: Callable[..., Any],
    files: _FilePerKey,
) -> Callable[..., Any]:
    """`use_cache`, which gives None and warns where it failed: the kernel is compiled then. Counts
    in `kernels` and `present` what was found, or is to be kept."""

    def guarded(*args: Any) -> Any:
        found = None
        try:
            found = use_cache(*args)
            if found is None and getattr(_thread, 'only_kept', False):
                raise _NotKept(function.__qualname__)
            if found is not None or counted_as == 'compiled':
                kernels[counted_as] += 1
                present.update(with_callees(function))
            if counted_as == 'compiled':
                for listener in listeners:
                    listener()
            return found
        except Exception as error:  # whatever it is, it is no reason to end a node
            _warn_of_no_cache(getattr(error, 'strerror', None) or type(error).__name__)
            return None
        finally:
            if counted_as == 'compiled' or found is not None:
                files.end()

    return guarded


def with_callees(function: Callable[..., Any]) -> dict[str, int]:
    """A kernel's function and all kernels it calls: lines of source by name."""
    waiting, found = [function], dict[str, int]()
    while waiting:
        caller = waiting.pop()
        name = f'{caller.__module__}.{caller.__qualname__}'
        if name in found:
            continue
        found[name] = _lines(caller.__code__)
        names = caller.__code__.co_names
        values = [caller.__globals__.get(each) for each in names]
        for module in [value for value in values if isinstance(value, ModuleType)]:
            values += [getattr(module, each, None) for each in names]
        waiting += [value.py_func for value in values if isinstance(value, Dispatcher)]
    return found


def _lines(code: CodeType) -> int:
    return max(line or 0 for *_, line in code.co_lines()) - code.co_firstlineno + 1


class Progress:
    """How far the kernels are that something needs from now on. needed: about how many, and how
    many lines of source they have; (0, 0) where that is not known."""

    def __init__(self, needed: tuple[int, int] = (0, 0)):
        self.needed = needed
        self._before, self._compiled = frozenset(present), kernels['compiled']
        self._start = time.monotonic()

    def sentence(self) -> str:
        """Empty as long as nothing was compiled. Time goes with lines of source."""
        compiled = kernels['compiled'] - self._compiled
        if not compiled:
            return ''
        made = [lines for name, lines in [*present.items()] if name not in self._before]
        once, (count, lines) = 'kernels, once for this machine', self.needed
        if not 0 < len(made) < count:
            return f'compiling {once}: {compiled} so far'
        left = (time.monotonic() - self._start) * max(lines / sum(made) - 1.0, 0.0)
        return f'compiling {len(made) + 1} of {count} {once}, some {left:.0f} s more'


progress = Progress()
"""Of what this process is compiling for now, see `expect`."""


def expect(needed: tuple[int, int]) -> None:
    """Begin a new `progress`."""
    global progress
    progress = Progress(needed)


class _NotKept(BaseException):
    """A kernel has to be compiled. No `Exception`, which a tracker may take for bad data."""


_thread = threading.local()


def kept(step: Callable[[], object]) -> bool:
    """Run `step` until it has to compile what could be kept; whether it ran to its end."""
    _thread.only_kept = True
    try:
        step()
    except _NotKept:
        return False
    finally:
        _thread.only_kept = False
    return True


Steps = Callable[[], list[tuple[str, Callable[[], object]]]]
"""Makes steps that compile, each with a name. It is pickled."""


class Elsewhere:
    """Another process, which compiles what this one loads from disk afterwards."""

    one_at_a_time = threading.Lock()
    """For the threads of this process: they need much the same kernels."""
    _PROGRAM = (
        'import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); '
        f'from {__name__} import _compile_for_another; _compile_for_another()'
    )

    @classmethod
    def begin(cls, steps: Steps) -> Elsewhere | None:
        """None where the steps cannot be pickled, or no process can be started."""
        try:
            return cls(steps)
        except (OSError, pickle.PicklingError, AttributeError, TypeError):
            return None

    def __init__(self, steps: Steps):
        request = pickle.dumps([entry or os.getcwd() for entry in sys.path]) + pickle.dumps(steps)
        pipe, nowhere = subprocess.PIPE, subprocess.DEVNULL
        program = [sys.executable, '-c', self._PROGRAM]
        self._process = subprocess.Popen(program, stdin=pipe, stdout=pipe, stderr=nowhere)
        self._say(request)

    def compile(self, name: str) -> None:
        """Compile the step `name` there, and count here what it has compiled. Returns early when
        it cannot, or was stopped: what is not on disk then is compiled by whoever needs it."""
        if not self._say(f'{json.dumps(name)}\n'.encode()):
            return
        assert self._process.stdout
        for line in self._process.stdout:
            if not line.endswith(b'\n') or not (made := json.loads(line)):
                return
            present.update(made)
            kernels['compiled'] += 1

    def stop(self) -> None:
        """End it now."""
        self._process.terminate()

    def close(self) -> None:
        """End it, and wait."""
        self.stop()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                pipe.close() if pipe else None

    def _say(self, request: bytes) -> bool:
        assert self._process.stdin
        try:
            self._process.stdin.write(request)
            self._process.stdin.flush()
        except OSError:  # it has ended
            return False
        return True


def _compile_for_another() -> None:
    """What the process of `Elsewhere` does: for each name it reads one line for each kernel it has
    compiled, with all that are new since the last line, and an empty one at the end."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if hasattr(os, 'nice'):  # on Windows there is none; the node answers first
        os.nice(5)
    answers = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)  # whatever else is printed
    # Where nothing can be kept the other process compiles; numba's own cache it does not know.
    warnings.simplefilter('error', RuntimeWarning)
    steps = dict(pickle.load(sys.stdin.buffer)())
    reported = dict[str, int]()

    def compiled() -> None:
        new = {name: lines for name, lines in present.items() if name not in reported}
        reported.update(new)
        print(json.dumps(new or reported), file=answers, flush=True)

    listeners.append(compiled)
    for line in sys.stdin.buffer:
        steps[json.loads(line)]()
        print('{}', file=answers, flush=True)


@cache
def _warn_of_no_cache(reason: str) -> None:
    warnings.warn(
        f'compiled code cannot be kept or loaded ({reason}): it is compiled in memory, at each '
        'start anew; NUMBA_CACHE_DIR can name another folder',
        RuntimeWarning,
        stacklevel=2,
    )


@cache
def _check_verbs(files: Any, kernel_cache: Any) -> None:
    """AttributeError or TypeError where these classes are not called as ours are."""
    inspect.signature(files.load).bind('self', 'key')
    inspect.signature(files.save).bind('self', 'key', 'data')
    inspect.signature(files.flush).bind('self')
    inspect.signature(kernel_cache.load_overload).bind('self', 'signature', 'context')
    inspect.signature(kernel_cache.save_overload).bind('self', 'signature', 'data')


@cache
def _warn_of_other_numba() -> None:
    warnings.warn(
        f'numba {numba.__version__} keeps compiled code in a way that sonar_imm does not know. '
        "numba's own cache is used: after every update of sonar_imm delete its __pycache__ "
        'folders, or code of the old version may run.',
        RuntimeWarning,
        stacklevel=3,
    )


class _FilePerKey:
    """One file for each state of the sources and each key, which numba makes of the argument
    types, the processor and the bytecode."""

    patience = LONGEST_SECONDS

    def __init__(self, folder: Path, function: Callable[..., Any]):
        self.folder, self._locked = folder, list[tuple[Path, int]]()
        # Who installed the package may have compiled it for those who can only read it.
        beside = Path(inspect.getfile(function)).parent / '__pycache__'
        self._readable = [folder] if getattr(numba.config, 'CACHE_DIR', '') else [folder, beside]
        path, code = inspect.getfile(function), function.__code__
        name = re.sub('[<>]', '', f'{Path(path).stem}.{function.__qualname__}')
        python = f'py{sys.version_info[0]}{sys.version_info[1]}{getattr(sys, "abiflags", "")}'
        self._base = f'{name}-{code.co_firstlineno}.{python}.'
        checked = bool(getattr(numba.config, 'BOUNDSCHECK', False))
        self._stamp = (numba.__version__, digest_of(path) or _cell_digest(function), checked)
        self._stem = f'{self._base}{_short_digest(self._stamp)}.'

    def load(self, key: Any) -> Any:
        found = self._find(key)
        if found is None and not getattr(_thread, 'only_kept', False):
            self._begin(key)
            found = self._find(key)
        return found

    def _begin(self, key: Any) -> None:
        """Wait for another process that compiles this kernel, and have others wait for this one
        until `end`. Callees wait for nobody who waits for them, so no two wait for each other."""
        from ..files import lock  # here, because compiled code does not depend on that file

        give_up = time.monotonic() + _FilePerKey.patience
        path = self._path_of(key).with_suffix('.lock')
        with contextlib.suppress(OSError):  # no folder, no locks, or a file of another user
            handle = os.open(path, os.O_RDWR | os.O_CREAT)
            self._locked.append((path, handle))
            while time.monotonic() < give_up:
                try:
                    return lock(handle)
                except BlockingIOError:
                    time.sleep(0.02)
            _FilePerKey.patience = 0.0

    def end(self) -> None:
        """Let others load what this process has compiled, or not."""
        while self._locked:
            path, handle = self._locked.pop()
            path.unlink(missing_ok=True)  # who waits for it has it open, and looks again
            os.close(handle)

    def _find(self, key: Any) -> Any:
        for folder in self._readable:
            found = self._load(folder / self._path_of(key).name, key)
            if found is not None:
                return found
        return None

    def _load(self, path: Path, key: Any) -> Any:
        try:
            content = path.read_bytes()
        except OSError:
            return None
        checksum, packed = content[:_CHECKSUM], content[_CHECKSUM:]
        if hashlib.sha256(packed).digest() != checksum:
            return None
        stamp, held, data = pickle.loads(packed)
        return data if (stamp, held) == (self._stamp, key) else None

    def save(self, key: Any, data: Any) -> None:
        from numba.core.serialize import dumps

        path = self._path_of(key)
        written = path.with_name(f'{path.name}.{uuid.uuid4().hex[:16]}')
        try:
            packed = dumps((self._stamp, key, data))
            written.write_bytes(hashlib.sha256(packed).digest() + packed)
            os.replace(written, path)
        finally:
            written.unlink(missing_ok=True)
        self._tidy()

    def flush(self) -> None:
        for path in self._files():
            path.unlink(missing_ok=True)

    def _path_of(self, key: Any) -> Path:
        return self.folder / f'{self._stem}{_short_digest(key)}.nbc'

    def _files(self) -> Iterator[Path]:
        """The files of this kernel, of any state of the sources."""
        for path in self.folder.iterdir():
            if path.name.startswith(self._base) and path.suffix in ('.nbc', '.lock'):
                yield path

    def _tidy(self) -> None:
        """Remove what was compiled of other sources long ago."""
        oldest = time.time() - KEPT_SECONDS
        for path in self._files():
            with contextlib.suppress(OSError):
                if not path.name.startswith(self._stem) and path.stat().st_mtime < oldest:
                    path.unlink()


def _short_digest(value: Any) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()[:16]


def _cell_digest(function: Callable[..., Any]) -> str:
    """Digest of a function without a file, as in a notebook."""
    try:
        return hashlib.sha256(inspect.getsource(function).encode()).hexdigest()
    except (OSError, TypeError):
        return ''


def digest_of(path: str) -> str:
    """Digest of the source file at `path` and of those of this package that it imports, directly
    or not; '' where there is no such file."""
    waiting, found = [path], dict[str, bytes]()
    while waiting:
        file = waiting.pop()
        if file not in found:
            try:
                status = os.stat(file)
                found[file], imported = _read(file, status.st_mtime_ns, status.st_size)
            except OSError:
                continue
            waiting += imported
    contents = b''.join(found[file] for file in sorted(found))
    return hashlib.sha256(contents).hexdigest() if found else ''


@cache
def _read(file: str, mtime_ns: int, size: int) -> tuple[bytes, tuple[str, ...]]:
    """Digest of a source file of this date and size, and the files of this package that it
    imports itself."""
    source = Path(file).read_bytes()
    imported = _imported_files(source.decode(), Path(file))
    return hashlib.sha256(source).digest(), tuple(map(str, imported))


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
