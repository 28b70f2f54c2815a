# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Files and folders that are either whole or not there, and folders that are replaced as a whole.

Output is first written to a new folder beside its place, named after it with ``.unfinished-`` and
some letters. Only when it is finished, and on the disk, it is moved to its place, by one rename,
which no program can see half of, nor a power cut leave half of. A process that is killed leaves
such a folder behind, which the next one to write there removes.

Only folders with the file `MARKER` are ever removed or replaced. The marker is written when a
folder is made. It names what the folder is, and a folder of unfinished output by its own name, so
that a copy, or a folder that a user named alike, is not taken for one. `replaced` moves the old
folder into the unfinished one, renames the new folder to its place, and only then deletes the old
one. Where a process was killed between the two renames, the next command moves the old folder
back.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
import contextlib
import errno
import glob
import json
import os
from pathlib import Path
import re
import shutil
import stat
import tempfile
import time
from typing import Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

UNFINISHED = '.unfinished-'
MARKER = '.sonar_imm'
"""In each folder that this package made and may replace: a line of JSON that says what it is."""
OLD = '.sonar_imm_old'
DELETED = '.sonar_imm_deleted'
"""In an unfinished folder: the folder that is being replaced, and once the new one is there."""
MOST_MARKER = 65536
LONGEST_PREFIX = 200
"""Bytes of a name that the unfinished folder repeats: file systems allow 255 in all."""


@contextlib.contextmanager
def whole(path: str | Path, *, follow: bool = True) -> Iterator[Path]:
    """Yields where to write the file or folder `path`: the same name elsewhere.

    Moved to `path` at the end of the block, or thrown away by an exception. A file that is there
    is replaced, a folder only when it is empty; a device or a pipe is written to as it is. The
    folder around `path` is made. follow: write to the file that a link at `path` names; otherwise
    the link itself is replaced, for names that a user did not state. Raises OSError, which names
    `path`.
    """
    target = Path(os.path.realpath(path)) if follow else _unfollowed(Path(path))
    if follow and target.exists() and not (target.is_file() or target.is_dir()):
        yield target
        return
    with _named(path):
        target.parent.mkdir(parents=True, exist_ok=True)
        with beside(target) as place:
            yield place / target.name
            on_disk(place / target.name)
            os.replace(place / target.name, target)
            sync_folder(target.parent)


def _unfollowed(path: Path) -> Path:
    """Return `path` with the links in its folder resolved, and not that of its last name."""
    return Path(os.path.realpath(path.parent)) / path.name


def mark(folder: Path, kind: str, **facts: Any) -> None:
    """Write the marker of a folder that this package made. kind: what it is, e.g. 'results'.
    Raises OSError, also when a marker is there already."""
    text = json.dumps({'made_by': 'sonar_imm', 'kind': kind, **facts}) + '\n'
    with (folder / MARKER).open('x', encoding='utf-8') as file:
        file.write(text)


def marked(folder: Path) -> dict[str, Any]:
    """Return the content of the marker of `folder`; empty where there is none, or where the folder
    or the marker is a link."""
    path = folder / MARKER
    try:
        if not (_is_real(folder, stat.S_ISDIR) and _is_real(path, stat.S_ISREG)):
            return {}
        with path.open(encoding='utf-8') as file:
            content = json.loads(file.read(MOST_MARKER))
    except (OSError, ValueError, RecursionError):
        return {}
    ours = isinstance(content, dict) and content.get('made_by') == 'sonar_imm'
    return content if ours else {}


def _is_real(path: Path, kind: Callable[[int], bool]) -> bool:
    """Whether `path` itself, not what a link at it names, is of a kind."""
    return kind(os.lstat(path).st_mode)


@contextlib.contextmanager
def replaced(target: Path, own: Collection[str]) -> Iterator[Path]:
    """Yield a new empty folder that takes the place of the folder `target` at the end of the
    block, or is thrown away by an exception.

    own: names in `target` that are deleted with it; everything else in it is moved into the new
    folder. `hindrance` tells whether `target` can be replaced. Raises OSError, which names
    `target`; then the old folder is at its place as it was, or the new one is.
    """
    target = _unfollowed(target)
    with _named(target), beside(target, own) as place:
        new = place / target.name
        new.mkdir()
        yield new
        on_disk(new)
        os.rename(target, place / OLD)
        os.rename(new, target)  # a failure here ends in `_clear`, which moves the old one back
        sync_folder(target.parent)


def hindrance(target: Path, kind: str, inputs: Iterable[Path] = (), *, known: bool = False) -> str:
    """Return why the folder `target` is not replaced, as one sentence; empty when it may be.

    kind: what its marker has to say, e.g. 'results'. inputs: files and folders that are read
    meanwhile. known: another file shows that it was made by a version that wrote no markers.
    """
    if target.is_symlink():
        return f'{target} is a link to {os.path.realpath(target)}; name that folder itself'
    if not target.is_dir():
        return f'{target} is a file; a folder is needed'
    place = Path(os.path.realpath(target))
    if place == Path(place.anchor):
        return f'{target} is the root of all folders, which is not replaced; name another folder'
    for around, what in ((Path.home, 'your home'), (Path.cwd, 'the current')):
        with contextlib.suppress(RuntimeError, OSError):  # there may be no home, or no folder
            if Path(os.path.realpath(around())).is_relative_to(place):
                return f'{target} is or holds {what} folder, which is not replaced; name another'
    for item in inputs:
        if Path(os.path.realpath(item)).is_relative_to(place):
            return f'{target} is or holds {item}, which is being read; choose another folder'
    if mounted := mount_points(place):
        return f'{mounted[0]} is a mount point, which cannot be replaced; name a folder below it'
    said = marked(target).get('kind', kind if known else None)
    if said != kind:
        what = f'holds a {said}, not a {kind}' if isinstance(said, str) else f'is no {kind} folder'
        return (
            f'{target} {what} that sonar-imm made (its file {MARKER} would say it); move it away '
            'or choose another folder'
        )
    return ''


def mount_points(folder: Path) -> list[Path]:
    """Return the mount points at and below an absolute path without links."""
    try:
        table = Path('/proc/self/mountinfo').read_bytes().splitlines()
    except OSError:  # not Linux
        return [folder] if os.path.ismount(folder) else []
    names = (line.split(b' ')[4] for line in table if line.count(b' ') > 4)
    found = (re.sub(rb'\\([0-7]{3})', lambda code: bytes([int(code[1], 8)]), n) for n in names)
    places = [Path(os.fsdecode(name)) for name in found]
    return [place for place in places if place.is_relative_to(folder)]


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


@contextlib.contextmanager
def one_at_a_time(folder: Path, patience: float) -> Iterator[None]:
    """Wait until no other process is in such a block for `folder`, `patience` seconds at most.
    Without locks nobody waits."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            handle = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, handle)
            end = time.monotonic() + patience
            while time.monotonic() < end:
                try:
                    lock(handle)
                    break
                except BlockingIOError:
                    time.sleep(0.02)
        yield


def remove_leftovers(path: Path) -> None:
    """Remove what killed processes left of `path`, and move an old folder that one of them had
    moved aside back to `path`. What a living process is writing is left alone, and so is all that
    has no marker with its own name."""
    path = _unfollowed(path)
    for place in path.parent.glob(f'{glob.escape(_prefix(path))}*'):
        about = marked(place)
        if about.get('kind') != 'unfinished' or about.get('name') != place.name:
            continue
        if about.get('target') != path.name:  # of another file whose long name begins alike
            continue
        with contextlib.suppress(OSError), _folder(place) as handle:
            # Nobody holds it: the process that made it is gone.
            lock(handle)
            _clear(place, path, about.get('own', ()))


def _prefix(target: Path) -> str:
    """Return how the names of unfinished folders beside `target` begin."""
    return os.fsdecode(os.fsencode(target.name)[:LONGEST_PREFIX]) + UNFINISHED


def _clear(place: Path, target: Path, own: Collection[str]) -> None:
    """Remove an unfinished folder. An old folder in it goes back to `target` where nothing is
    there; else all but its `own` names are moved over. Raises OSError, and then removes nothing.
    """
    old = place / OLD
    if os.path.lexists(old) and not os.path.lexists(target):
        os.rename(old, target)
        sync_folder(target.parent)
    elif os.path.lexists(old):
        for item in sorted(old.iterdir()):
            if item.name in own:
                continue
            if os.path.lexists(target / item.name):
                return  # neither is given up
            os.rename(item, target / item.name)
        sync_folder(target)
        os.rename(old, place / DELETED)  # what is half deleted never goes back
    with contextlib.suppress(OSError):
        for item in place.iterdir():
            if _is_real(item, stat.S_ISDIR):
                shutil.rmtree(item, ignore_errors=True)
            elif item.name != MARKER:
                item.unlink()
        if [item.name for item in place.iterdir()] == [MARKER]:  # what is left is still ours
            (place / MARKER).unlink()
        place.rmdir()


@contextlib.contextmanager
def beside(target: Path, own: Collection[str] = ()) -> Iterator[Path]:
    """A new folder beside `target` for what is not finished, removed at the end. It is locked
    while this process lives. own: see `replaced`."""
    if target.name in ('', MARKER, OLD, DELETED):
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL), str(target))
    remove_leftovers(target)
    with contextlib.ExitStack() as stack:
        place = Path(tempfile.mkdtemp(prefix=_prefix(target), dir=target.parent))
        handle = stack.enter_context(_folder(place))
        with contextlib.suppress(OSError):  # without locks: leftovers stay there
            lock(handle)
        # Another process takes it for a leftover only once it has its marker, and then it is held.
        facts = {'name': place.name, 'target': target.name, 'own': sorted(own)}
        try:
            mark(place, 'unfinished', **facts)
            yield place
        finally:
            _clear(place, target, own)


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
        if not os.fstat(handle).st_size:  # a file with content is the user's
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
