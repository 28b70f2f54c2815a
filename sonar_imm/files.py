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

"""Files and folders that are either whole or not there.

What is written is at first in a folder of its own beside its place, named after it with
``.unfinished-`` and some letters. Only when it is finished, and on the disk, it is moved to its
place, by one rename, which no program can see half of, nor a power cut leave half of. A process
that is killed leaves such a folder behind, which the next one to write there removes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import errno
import glob
import os
from pathlib import Path
import shutil
import tempfile

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

UNFINISHED = '.unfinished-'


@contextlib.contextmanager
def whole(path: str | Path) -> Iterator[Path]:
    """Yields where to write the file or folder `path`: the same name elsewhere.

    Moved to `path` at the end of the block, or thrown away by an exception. A file that is there
    is replaced, a folder only when it is empty; a device or a pipe is written to as it is. The
    folder around `path` is made. Raises OSError, which names `path`.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not (target.is_file() or target.is_dir()):
        yield target
        return
    with _named(path):
        target.parent.mkdir(parents=True, exist_ok=True)
        with beside(target) as place:
            yield place / target.name
            on_disk(place / target.name)
            os.replace(place / target.name, target)
            sync_folder(target.parent)


def on_disk(path: Path) -> None:
    """Wait until a file, or a folder with all that is in it, is on the disk. Without that a rename
    may be there after a power cut, and what was renamed may not. Raises OSError."""
    if not path.is_dir():
        with path.open('rb') as file, _where_it_can():
            os.fsync(file.fileno())
        return
    for item in path.iterdir():
        if not item.is_symlink():
            on_disk(item)
    sync_folder(path)


def sync_folder(path: Path) -> None:
    """Wait until the names in a folder are on the disk, where the file system can."""
    with _folder(path) as handle, contextlib.suppress(OSError):  # some sync files only
        os.fsync(handle)


@contextlib.contextmanager
def _folder(path: Path) -> Iterator[int]:
    """An open folder; -1, which no call takes, where folders cannot be opened (Windows)."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except PermissionError:
        if fcntl is not None:
            raise
        yield -1
        return
    try:
        yield handle
    finally:
        os.close(handle)


@contextlib.contextmanager
def _where_it_can() -> Iterator[None]:
    """Windows syncs only what is open for writing."""
    try:
        yield
    except OSError as error:
        if fcntl is not None or error.errno != errno.EBADF:
            raise


def lock(handle: int) -> None:
    """Lock an open file or folder for this process. Raises BlockingIOError where another one has
    it, and another OSError where there are no locks."""
    if fcntl is None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def remove_leftovers(path: Path) -> None:
    """Remove what killed processes left of `path`. What a living one is writing is left alone."""
    for place in path.parent.glob(f'{glob.escape(path.name)}{UNFINISHED}*'):
        with contextlib.suppress(OSError), _folder(place) as handle:
            # Nobody holds it: the process that made it is gone.
            lock(handle)
            shutil.rmtree(place, ignore_errors=True)


@contextlib.contextmanager
def beside(target: Path) -> Iterator[Path]:
    """A new folder beside `target` for what is not finished, removed at the end. It is locked
    while this process lives."""
    remove_leftovers(target)
    with contextlib.ExitStack() as stack:
        while True:
            place = Path(tempfile.mkdtemp(prefix=target.name + UNFINISHED, dir=target.parent))
            try:
                handle = stack.enter_context(_folder(place))
            except FileNotFoundError:
                continue  # taken for a leftover by another process, before the lock
            with contextlib.suppress(OSError):  # without locks: leftovers stay there
                lock(handle)
            if place.exists():
                break
            stack.close()
        try:
            yield place
        finally:
            shutil.rmtree(place, ignore_errors=True)


def hold(path: Path) -> Callable[[], None] | None:
    """Keep the file `path` for this caller alone, until what is given is called or the process
    ends; None where another caller has it. `path` itself is not touched: a file beside it is
    locked, on a file system without locks nothing is. Raises OSError where none can be written."""
    beside_it = path.with_name(f'{path.name}.lock')
    while True:
        handle = os.open(beside_it, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            lock(handle)
        except BlockingIOError:
            os.close(handle)
            return None
        except OSError:
            pass
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(handle), os.stat(beside_it)):
                break
        os.close(handle)  # removed by the one before, between our two calls

    def release() -> None:
        beside_it.unlink(missing_ok=True)
        os.close(handle)

    return release


@contextlib.contextmanager
def _named(path: str | Path) -> Iterator[None]:
    """Give an error of the operating system the name `path` where it names the folder of what is
    unfinished, or nothing."""
    try:
        yield
    except OSError as error:
        if not error.errno or (error.filename and UNFINISHED not in str(error.filename)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None
