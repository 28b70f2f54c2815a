# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Writing recordings: rosbag2 version 8, which Humble reads too; same input, same bytes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
import contextlib
import os
from pathlib import Path
import sqlite3
from typing import Any

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter

from sonar_imm.files import whole
from sonar_imm.texts import visible

from .mcap_records import seal
from .messages import cdr_of, ros_message, typestore
from .own_files import write_own_parameters
from .sources import BagError

__all__ = ['BagWriter', 'naming', 'ros_message', 'STORAGES']

STORAGES = ('mcap', 'sqlite3')

CHUNK_BYTES = 1 << 18
CHUNK_NS = 10 * 10**9
CHUNK_LEAST = 1 << 12
"""A chunk of an MCAP file is closed when it holds so many bytes of messages, or so much time and
not too little: a bit that turns costs the chunk that it is in."""

PLAIN = 'recording'
"""Name of the storage file in a folder whose own name metadata.yaml cannot hold."""

_RELIABLE = Qos(
    *(QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.VOLATILE, QosTime(0, 0)),
    *(QosTime(0, 0), QosLiveliness.SYSTEM_DEFAULT, QosTime(0, 0), False),
)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the file name to an error of the operating system that lacks it, e.g. a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename:
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None
    except sqlite3.OperationalError as error:
        raise BagError(f'{path} cannot be written: {error}') from None


class BagWriter:
    """A new recording at `path`, a directory that must not exist; use it in a ``with`` statement.

    compressed: by zstd, an mcap by chunks, as ``ros2 bag record`` does with the profile zstd_fast.
    custom_data: notes kept in the metadata of the bag, e.g. where the data come from. parameters:
    what the file of parameters beside the recording says, by the names of nodes. The bag is at
    `path` once it is closed, as a whole; an exception leaves nothing. Raises `BagError` when the
    bag cannot be made.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        storage: str = 'mcap',
        compressed: bool = False,
        custom_data: Mapping[str, str] | None = None,
        parameters: Mapping[str, Mapping[str, Any]] | None = None,
    ):
        if storage not in STORAGES:
            raise ValueError(f"storage must be one of {', '.join(STORAGES)}, got '{storage}'")
        self.path = Path(path)
        self.counts: Counter[str] = Counter()
        self._links: dict[tuple[str, str], Connection] = {}
        self._chunk: tuple[int, int] | None = None
        self._parameters = {} if parameters is None else parameters
        self._place = contextlib.ExitStack()
        if self.path.exists():
            raise BagError(f'{path} exists already; remove it or choose another name')
        try:
            self._unfinished = self._place.enter_context(whole(self.path))
            self._made = self._unfinished
            name = self._made.name  # of the storage file too, as `ros2 bag record` does it
            if not (name.isprintable() and len(os.fsencode(name)) < 240):
                self._made = self._made.with_name(PLAIN)
            self._writer = Writer(
                self._made, version=8, storage_plugin=StoragePlugin[storage.upper()]
            )
            for key, note in sorted((custom_data or {}).items()):
                self._writer.set_custom_data(visible(key), visible(str(note)))
            if compressed:
                mode = CompressionMode.STORAGE if storage == 'mcap' else CompressionMode.MESSAGE
                self._writer.set_compression(mode, CompressionFormat.ZSTD)
            self._writer.open()
        except OSError as error:
            with contextlib.suppress(OSError):  # thrown away, not moved to its place
                self._place.__exit__(type(error), error, error.__traceback__)
            raise BagError(f'{path} cannot be written: {error.strerror}') from None

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if kind is None:
            self.close()
            return
        with contextlib.suppress(Exception):  # the error that is already on its way says more
            self._writer.close()
        self._place.__exit__(kind, error, trace)

    def close(self) -> None:
        """Finish the bag: index, metadata, checksums and parameters; then move it to its place."""
        with naming(self.path), self._place:
            self._writer.close()
            for file in self._made.glob('*.mcap'):
                seal(file)
            write_own_parameters(self._made, self._parameters)
            self._made.replace(self._unfinished)

    def write(self, topic: str, message: Any, log_ns: int) -> None:
        """Append a message made by `ros_message` or read by `BagReader`."""
        self.write_raw(topic, message.__msgtype__, cdr_of(message), log_ns)

    def write_raw(self, topic: str, type_name: str, raw: bytes | memoryview, log_ns: int) -> None:
        """Append a message that is CDR already. Raises ValueError for a log time before 1970."""
        if log_ns < 0:
            raise ValueError(f'a recording cannot hold the log time {log_ns} ns')
        with naming(self.path):
            self._writer.write(self._link(topic, type_name), log_ns, raw)
            self._close_chunk(log_ns, len(raw))
        self.counts[topic] += 1

    def _close_chunk(self, log_ns: int, size: int) -> None:
        """Close the chunk of an MCAP file after a message of `size` bytes, if it is time."""
        first_ns, held = self._chunk or (log_ns, 0)
        held += size
        long = abs(log_ns - first_ns) >= CHUNK_NS and held >= CHUNK_LEAST
        self._chunk = (first_ns, held)
        if (long or held >= CHUNK_BYTES) and isinstance(self._writer.storage, McapWriter):
            self._writer.storage.close_chunk()
            self._chunk = None

    def _link(self, topic: str, type_name: str) -> Connection:
        if (topic, type_name) not in self._links:
            self._links[topic, type_name] = self._writer.add_connection(
                topic, type_name, typestore=typestore(), offered_qos_profiles=[_RELIABLE]
            )
        return self._links[topic, type_name]
