# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Sources of recorded messages: rosbags for whole files, a scan of the records for damaged ones.

rosbags raises many kinds of exception on damaged files. Each becomes a `BagError` or a problem of
one sentence here, in both sources alike, with what each falls back on.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
import os
from pathlib import Path
import shlex
import subprocess
from typing import Any, NamedTuple

from attrs import frozen
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores

from sonar_imm.parameters import ConfigError, small_text, yaml_tree
from sonar_imm.texts import in_one_line, visible

from .mcap_records import (
    Channel,
    McapScan,
    oversized_chunk,
    oversized_file,
    TooLargeError,
    unpack,
    wrong_sums,
    zstd,
)
from .messages import decode_cdr, typestore

MOST_MESSAGES = 1 << 48
"""Messages of a topic: nobody counts further."""
MOST_LINES = 4000
"""Lines of a definition without its comments; those that are in use have some hundreds."""
SUFFIXES = ('.mcap', '.db3', '.bag')
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
TARGET_NAMES = 'target_names'
"""Note of a bag and of run.json: the names of targets by target ID, a mapping in JSON."""


class BagError(Exception):
    """A recording that cannot be used, in one sentence for the user."""

    def __init__(self, sentence: str):
        self.sentence = in_one_line(sentence)
        super().__init__(self.sentence)


def names_of_targets(value: Any) -> dict[str, str]:
    """Return the texts of a mapping from target ID to name that is read from a file."""
    if not isinstance(value, dict):
        return {}
    return {str(key): name for key, name in value.items() if isinstance(name, str)}


class NoRecordingError(BagError):
    """What lies at a path is something else."""

    def __init__(self, path: Path, sentence: str):
        super().__init__(sentence)
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:  # it goes from one process to another
        return NoRecordingError, (self.path, self.sentence)


@frozen
class TopicInfo:
    """One topic of a recording.

    `decodable` is False when the message definition is neither in the bag nor known;
    `offered_qos` holds the profiles (rosbags `Qos`) the recorder saw, empty when unknown.
    """

    name: str
    type_name: str
    count: int
    decodable: bool = True
    offered_qos: tuple[Any, ...] = ()


class RawMessage(NamedTuple):
    """A recorded message before decoding. `raw` is CDR (ROS 1 serialization in a ROS 1 bag)."""

    topic: str
    type_name: str
    log_ns: int
    raw: bytes


class _FolderPath(type(Path())):  # type: ignore[misc]
    """A folder whose name may end in .bag, which rosbags would take for a file of ROS 1."""

    @property
    def suffix(self) -> str:
        return super().suffix.removesuffix('.bag')


class RosbagsSource:
    """A bag directory or storage file read by rosbags."""

    def __init__(self, path: Path):
        self._path = path
        _require_regular(path)
        for file in self._mcaps():
            if oversized := oversized_chunk(file):
                raise BagError(oversized)
            if wrong := wrong_sums(file):
                raise BagError(f'the checksum of {" and of ".join(wrong)} in {file.name} is wrong')
        for file in path.glob('*.zstd') if path.is_dir() else []:
            if oversized := oversized_file(file):
                raise BagError(f'{file.name} cannot be unpacked: {oversized}')
        if (path / 'metadata.yaml').exists():
            _check_metadata(path / 'metadata.yaml')
        place = _FolderPath(path) if path.is_dir() else path
        self._reader = AnyReader([place], default_typestore=typestore())
        for reader in self._reader.readers:
            _check_definitions_of(reader)
        self._reader.open()
        for storage in self._storages():
            # Compressed messages are handed out as they are: rosbags unpacks without a limit.
            if getattr(getattr(storage, 'metadata', None), 'compression_mode', None) == 'message':
                storage.metadata = storage.metadata._replace(compression_mode=None)
        if trouble := self._trouble():
            self._reader.close()
            raise BagError(f'metadata.yaml has {trouble}')
        # rosbags ignores its default types as soon as the bag defines a single one
        self.types = self._reader.typestore
        _add_known_types(self.types, [link.msgtype for link in self._reader.connections])

    def _storages(self) -> list[Any]:
        """What each reader of rosbags reads from; None for ROS 1."""
        return [getattr(reader, 'storage', None) for reader in self._reader.readers]

    def _mcaps(self) -> list[Path]:
        if self._path.is_dir():
            return sorted(self._path.glob('*.mcap'))
        return [self._path] if self._path.suffix == '.mcap' else []

    def rescue(self) -> ScanSource | None:
        """A scan of its one MCAP file, which gives the same messages in the same order without
        those of damaged chunks; None where it has no such file."""
        files = self._mcaps()
        return ScanSource(files[0]) if len(files) == 1 else None

    def _trouble(self) -> str:
        """What of the metadata is of a wrong kind, empty when nothing is; rosbags does not ask."""
        links = self._reader.connections
        for link in links:
            if not (isinstance(link.msgcount, int) and 0 <= link.msgcount < MOST_MESSAGES):
                return f'a message count of {visible(str(link.msgcount)[:40])}'
        if not all(isinstance(text, str) for link in links for text in (link.topic, link.msgtype)):
            return 'a topic whose name or type is no text'
        for storage in self._storages():
            if not isinstance(getattr(storage, 'files', []), list):
                storage.files = []  # rosbags could not close it
                return 'a list of files that is none'
        return ''

    @property
    def custom_data(self) -> dict[str, str]:
        """What the recorder noted beside the messages."""
        metadata = getattr(self._storages()[0], 'metadata', None)
        return dict(getattr(metadata, 'custom', None) or {})

    @property
    def unordered(self) -> bool:
        """True for MCAP without chunks: rosbags refuses it when log times are not sorted."""
        storage = self._storages()[0]
        return any(
            hasattr(file, 'chunks') and not file.chunks and file.metadata.message_count
            for file in getattr(storage, 'storages', [storage])
        )

    def topics(self) -> list[TopicInfo]:
        return [
            TopicInfo(
                link.topic,
                link.msgtype,
                link.msgcount,
                link.msgtype in self.types.fielddefs,
                tuple(getattr(link.ext, 'offered_qos_profiles', ())),
            )
            for link in self._reader.connections
        ]

    def messages(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        chosen = [
            link for link in self._reader.connections if topics is None or link.topic in topics
        ]
        if chosen:
            for link, log_ns, raw in self._reader.messages(connections=chosen):
                yield RawMessage(link.topic, link.msgtype, log_ns, _unpacked(raw))

    def decode(self, type_name: str, raw: bytes) -> Any:
        if raw[:4] == _ZSTD_MAGIC:
            unpack(raw, 'zstd')  # says why it is still packed
        if self._reader.is2:
            return decode_cdr(self.types, type_name, raw)
        return self._reader.deserialize(raw, type_name)

    def close(self) -> None:
        self._reader.close()


class ScanSource:
    """An MCAP file without a usable index."""

    def __init__(self, path: Path):
        self._file = path
        self._scan = McapScan(path)
        self.types = _types_of(frozenset(self._scan.channels.values()))

    def rescue(self) -> None:
        return None

    @property
    def is_short(self) -> bool:
        """Whether the index speaks of more messages than there are."""
        return (self._scan.stated or 0) > self._scan.counts.total()

    @property
    def damage(self) -> str:
        """What is lost, and what is not, as a sentence."""
        file, count, stated = self._file, self._scan.counts.total(), self._scan.stated
        if lost := self._scan.lost:
            of = f' of {stated}' if stated is not None else ''
            return f'{file} {lost}; {count}{of} messages were recovered, the rest is lost'
        if self.is_short:
            return f'{file} holds {count} messages; its index says {stated}'
        return f'{file} is damaged beside its messages; all {count} messages were recovered'

    def topics(self) -> list[TopicInfo]:
        known, counts = self.types.fielddefs, self._scan.counts
        return [
            TopicInfo(channel.topic, channel.type_name, counts[number], channel.type_name in known)
            for number, channel in self._scan.channels.items()
        ]

    def messages(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        chosen = {
            number: channel
            for number, channel in self._scan.channels.items()
            if topics is None or channel.topic in topics
        }
        for number, log_ns, raw in self._scan.messages(chosen):
            yield RawMessage(chosen[number].topic, chosen[number].type_name, log_ns, raw)

    def decode(self, type_name: str, raw: bytes) -> Any:
        return decode_cdr(self.types, type_name, raw)

    def close(self) -> None:
        self._scan.close()


Source = RosbagsSource | ScanSource
"""One storage that yields its messages by log time. ``types`` are those that it can decode."""


def is_recording(path: Path) -> bool:
    """Whether a recording lies at `path`, by names alone."""
    if not path.is_dir():
        return path.suffix in SUFFIXES
    return (path / 'metadata.yaml').is_file() or any(
        file.suffix in SUFFIXES and file.is_file() for file in path.iterdir()
    )


def open_sources(path: Path) -> tuple[list[Source], list[str]]:
    """Open what lies at `path`: a bag directory, a storage file or a ROS 1 bag.

    Gives the sources and sentences about what is wrong with them. Raises `BagError` when nothing
    can be read at all.
    """
    if not path.exists():
        raise BagError(f'{path} does not exist')
    if not path.is_file():
        return _open_directory(path)
    if path.name == 'metadata.yaml':
        return open_sources(path.parent)
    if path.suffix not in SUFFIXES:
        names = f'the names of recordings end in {", ".join(SUFFIXES)}{packed_hint([path])}'
        raise NoRecordingError(path, f'{path} is not a recording: {names}')
    return _open_files([path], [])


def _open_directory(path: Path) -> tuple[list[Source], list[str]]:
    """Open a bag directory through its metadata.yaml or, when that fails, file by file."""
    problems = []
    if (path / 'metadata.yaml').exists():
        try:
            source = RosbagsSource(path)
        except Exception as error:  # see the module docstring
            problems.append(
                f'{path}: the bag as a whole cannot be read ({one_line(error)}), '
                'its files are read one by one'
            )
        else:
            if not source.unordered:
                return [source], leftovers(path)
            source.close()
    # Of a split bag name_2 comes before name_10.
    files = sorted(
        (file for file in path.iterdir() if file.suffix in SUFFIXES),
        key=lambda file: (len(file.name), file.name),
    )
    if not files:
        if problems:
            raise BagError(problems[0])
        ends = f'ends in {", ".join(SUFFIXES)}{packed_hint(path.iterdir())}'
        sentence = f'it holds neither metadata.yaml nor a file that {ends}'
        raise NoRecordingError(path, f'{path} is not a recording: {sentence}')
    if not problems and not (path / 'metadata.yaml').exists():
        problems.append(f'{path} has no metadata.yaml, its files are read one by one')
    return _open_files(files, problems)


def _open_files(files: list[Path], problems: list[str]) -> tuple[list[Source], list[str]]:
    """Open storage files one by one; those that cannot be read become problems."""
    sources: list[Source] = []
    failures = []
    for file in files:
        try:
            source, damage = _open_file(file)
        except Exception as error:  # see the module docstring
            recover = f' (sqlite3 {file.name} .recover may save some of it)'
            hint = recover if file.suffix == '.db3' else ''
            failures.append(f'{file} cannot be read: {one_line(error)}{hint}')
        else:
            sources.append(source)
            problems += damage + leftovers(file)
    if not sources:
        raise BagError('; '.join(failures))
    return sources, problems + failures


def _open_file(file: Path) -> tuple[Source, list[str]]:
    """Open one storage file by rosbags or, for MCAP that it refuses, by a scan."""
    try:
        source = RosbagsSource(file)
    except Exception:
        if file.suffix != '.mcap' or not file.stat().st_size:
            raise
        scan = ScanSource(file)
        return scan, [scan.damage]
    if not source.unordered:
        return source, []
    source.close()
    scan = ScanSource(file)
    return scan, [scan.damage] if scan.is_short else []


def _unpacked(raw: bytes) -> bytes:
    """Undo the compression of a message; one that cannot be unpacked stays as it is."""
    with suppress(TooLargeError, zstd.ZstdError):
        if raw[:4] == _ZSTD_MAGIC:
            return unpack(raw, 'zstd')
    return bytes(raw)


def _require_regular(path: Path) -> None:
    """Raise `BagError` for a file, or one in a folder, that is a pipe or a device: to open a pipe
    would wait for somebody who writes, and a device has no end."""
    for file in [path, *path.iterdir()] if path.is_dir() else [path]:
        if file.exists() and not (file.is_file() or file.is_dir()):
            raise BagError(f'{file} is not YAML or messages: it is no regular file')


@lru_cache(maxsize=8)
def _check_metadata(path: Path) -> None:
    """Raise `BagError` for metadata that rosbags would unpack without an end."""
    try:
        yaml_tree(small_text(path, errors='replace'))
    except ConfigError as error:
        raise BagError(f'{path.name} is {error}') from None


def _check_definitions_of(reader: Any) -> None:
    """Have a reader of rosbags look at the size of definitions after it is opened, before they are
    parsed."""
    open_files = reader.open

    def open_and_check() -> None:
        open_files()
        try:
            for link in reader.connections:
                _check_definition(link.msgtype, link.msgdef.data)
        except BagError:
            reader.close()
            raise

    reader.open = open_and_check


def _check_definition(type_name: str, definition: str) -> None:
    """Raise `BagError` for the definition of a message that takes minutes to parse."""
    lines = [line for line in definition.splitlines() if not line.lstrip().startswith('#')]
    if len(lines) > MOST_LINES or sum(map(len, lines)) > MOST_LINES * 100:
        raise BagError(f'the definition of {type_name} is larger than that of any message')


def _types_of(channels: frozenset[Channel]) -> Any:
    """What these channels define, and what is known of the rest. To parse it takes a while."""
    types = get_typestore(Stores.EMPTY)
    for channel in sorted(channels):
        _check_definition(channel.type_name, channel.definition)
        if channel.definition and 'idl' in channel.definition_encoding:
            types.register(get_types_from_idl(channel.definition))
        elif channel.definition:
            types.register(get_types_from_msg(channel.definition, channel.type_name))
    _add_known_types(types, [channel.type_name for channel in channels])
    return types


def _add_known_types(types: Any, names: list[str]) -> None:
    """Let `types` fall back on the Jazzy definitions for what the recording does not define."""
    known = typestore().fielddefs
    if any(name in known and name not in types.fielddefs for name in names):
        types.register({name: known[name] for name in known if name not in types.fielddefs})


def one_line(error: Exception) -> str:
    """The text of any exception as one line without a full stop."""
    text = ' '.join(str(error).split()).rstrip('.')
    return text if text and not isinstance(error, KeyError) else f'{type(error).__name__} {text}'


def leftovers(path: Path) -> list[str]:
    """Sentences about write-ahead logs that a crashed recorder left, whose rows are not read."""
    logs = path.glob('*.db3-wal') if path.is_dir() else [path.with_name(path.name + '-wal')]
    return [
        f'{log} holds {log.stat().st_size} bytes that the recorder did not finish writing; '
        f"the messages in it are not read (sqlite3 {log.name[:-4]} 'pragma wal_checkpoint' "
        'merges them)'
        for log in logs
        if log.exists() and log.stat().st_size
    ]


def start_of(path: Path, size: int = 4096) -> bytes:
    """The first bytes of a file. Raises `BagError`."""
    try:
        with path.open('rb') as file:
            return file.read(size)
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from None


def quoted(word: object, windows: bool = os.name == 'nt') -> str:
    """A word of a command as the shell of this machine takes it; bytes of a name that cannot be
    printed as escapes, which bash and zsh read."""
    text = str(word)
    if windows:
        return subprocess.list2cmdline([text])
    if text.isprintable():
        return shlex.quote(text)
    plain = (
        chr(b) if 32 <= b < 127 and b not in b"'\\" else f'\\x{b:02x}' for b in os.fsencode(text)
    )
    return f"$'{''.join(plain)}'"


def packed_hint(files: Iterable[Path]) -> str:
    packed = [file.name for file in files if file.suffix in ('.zstd', '.zst')]
    return f'; {packed[0]} is compressed, unpack it with zstd first' if packed else ''
