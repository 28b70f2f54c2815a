# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The folder of a tracked recording: what ``track`` writes and ``evaluate`` reads.

estimate/      the estimates as a bag, topic ``/<system>/estimate``
soundings.csv  what of them goes into a chart, when a sonar with navigation was tracked; in the bag
               as the topic ``/<system>/soundings``
estimate.csv   the same rows as text: stamp_ns, then the columns of the contract
run.json       input, parameters, versions; a folder without it is unfinished
metrics.json   and report.html, once evaluated
.sonar_imm     shows that sonar_imm made the folder; only then `--overwrite` replaces it

With ``--parquet`` there are estimate.parquet and soundings.parquet in place of the CSV, and bins
that have soundings are in the table alone; with ``--no-table`` neither. Without CSV the bag is
compressed by zstd. A run is written elsewhere and moved to its folder when it is finished, see
`sonar_imm.files`.

Bag and tables hold nothing that depends on the time of the run: the same command writes the same
bytes. Times and versions are in run.json. In one file, since all of it is the layout of a folder.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import contextlib
import hashlib
from importlib.metadata import version
import json
import math
import os
from pathlib import Path
import platform
from typing import Any, IO

import numba
import numpy as np
import scipy

from msg_adapters.estimates import read_estimate, write_estimate
from msg_adapters.soundings import write_soundings
from sonar_imm import __version__
from sonar_imm import files as disk
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Rejection
from sonar_imm.soundings import soundings_of
from sonar_imm.trackers import SYSTEMS

from ..recordings.export import CsvWriter, ROWS_IN_A_BLOCK
from ..recordings.export.points import read_parquet
from ..recordings.measurements import measurements_of
from ..recordings.reader import BagError, BagReader
from ..recordings.truth import TRUTH_TOPIC
from ..recordings.writer import BagWriter, naming, ros_message

BAG, CSV, SOUNDINGS = 'estimate', 'estimate.csv', 'soundings.csv'
RUN, METRICS, REPORT = 'run.json', 'metrics.json', 'report.html'
PARQUET = {CSV: 'estimate.parquet', SOUNDINGS: 'soundings.parquet'}
"""The same tables as Parquet."""
AS_CSV, AS_PARQUET, NO_TABLE = 'csv', 'parquet', 'none'
"""What tables a run gets."""
SUMMARY, SHARD_SUMMARY = 'summary.json', 'summary-{}-of-{}.json'
"""In a folder of several runs, which are below it: where they are, see `batch`."""
_RUN_FILES = (RUN, METRICS, REPORT, BAG, CSV, SOUNDINGS, *PARQUET.values())
"""All that belongs to a run; without the first one there is no finished run."""
KIND = 'results'
"""What the marker of a run says."""
MOST_JSON = 1 << 26
"""Characters of a run.json or summary.json."""

_KINDS = {
    'system': str,
    'bag': str,
    'world_frame': str,
    **dict.fromkeys(('topics', 'parameters', 'counts', 'refused', 'versions'), dict),
}
"""What of run.json is read again; what is not required may be missing."""
_NAMES = {str: 'a text', dict: 'a mapping'}


class Table:
    """A table whose rows come stamp by stamp; use it in a ``with`` statement. Rows are held until
    there are enough for a block."""

    rows_in_a_block: int

    def __init__(self, path: Path, file: IO[Any]):
        self._path = path
        self._file = file
        self._held: list[dict[str, np.ndarray]] = []
        self._rows_held = 0
        self._types: dict[str, np.dtype] = {}

    def __enter__(self) -> Table:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        with naming(self._path), self._file:
            if kind is None:
                self._write_held()
            self._finish()

    def write(self, stamp_ns: int, columns: Mapping[str, Any]) -> None:
        """Append the rows (n,) of one stamp. Raises ValueError when the columns change."""
        rows = len(next(iter(columns.values()), ()))
        found = {'stamp_ns': np.full(rows, stamp_ns, np.int64)}
        found |= {name: np.array(column) for name, column in columns.items()}
        if self._types and list(self._types) != list(found):
            raise ValueError('the columns change from one estimate to another')
        types = {name: column.dtype for name, column in found.items()}
        if types != self._types or self._rows_held >= self.rows_in_a_block:
            with naming(self._path):
                self._write_held()
        self._types = types
        self._held.append(found)
        self._rows_held += rows

    def _write_held(self) -> None:
        if self._held:
            self._write(
                {name: np.concatenate([rows[name] for rows in self._held]) for name in self._types}
            )
        self._held, self._rows_held = [], 0

    def _write(self, columns: dict[str, np.ndarray]) -> None:
        """Write a block of rows."""
        raise NotImplementedError

    def _finish(self) -> None:
        """Write what stands at the end."""


class CsvTable(Table):
    """A table as CSV, one line per row; floats as the shortest text that reads back exactly."""

    rows_in_a_block = ROWS_IN_A_BLOCK

    def __init__(self, path: Path):
        file = path.open('w', encoding='utf-8', newline='')
        super().__init__(path, file)
        self._writer = CsvWriter(file)
        self._has_names = False

    def _write(self, columns: dict[str, np.ndarray]) -> None:
        if not self._has_names:
            self._writer.write(columns)
            self._has_names = True
        self._writer.write_columns(list(columns.values()))


def require_parquet() -> None:
    """Raise ModuleNotFoundError when Parquet cannot be written; to say so before the work."""
    import pyarrow.parquet  # noqa: F401


class ParquetTable(Table):
    """A table as Parquet, with the types of the columns: stamp_ns is int64.

    notes: texts kept in the metadata of the file, by name, as they are at the first row. Raises
    ModuleNotFoundError without pyarrow.
    """

    rows_in_a_block = 65536

    def __init__(self, path: Path, notes: Mapping[str, str] | None = None):
        import pyarrow
        import pyarrow.parquet

        super().__init__(path, path.open('wb'))  # pyarrow opens only names that are UTF-8
        self._arrow = pyarrow
        self._notes = notes or {}
        self._writer: Any = None

    def _write(self, columns: dict[str, np.ndarray]) -> None:
        table = self._arrow.table(columns)
        if self._writer is None:
            table = table.replace_schema_metadata(self._notes)
            floats = [name for name, column in columns.items() if column.dtype.kind == 'f']
            self._writer = self._arrow.parquet.ParquetWriter(
                self._file,
                table.schema,
                compression='zstd',
                use_dictionary=[name for name in columns if name not in floats],
                use_byte_stream_split=floats,
            )
        self._writer.write_table(table.cast(self._writer.schema))

    def _finish(self) -> None:
        if self._writer is None:
            self._write({'stamp_ns': np.empty(0, np.int64)})
        self._writer.close()


class RunFolder:
    """The folder of one run."""

    def __init__(self, path: Path):
        self.path = path

    @contextlib.contextmanager
    def fresh(
        self, *, overwrite: bool = False, inputs: Sequence[Path] = ()
    ) -> Iterator[RunFolder]:
        """Yields a folder elsewhere to write a run into; at the end of the block the run is moved
        here as a whole. An exception leaves everything as it was.

        inputs: what is read meanwhile. Files that do not belong to a run are left alone, and come
        along where an earlier run is replaced. Raises `BagError` when a run is here and may not be
        overwritten, or when nothing shows that this package made it.
        """
        disk.remove_leftovers(self.path)
        if self.path.exists() and not self.path.is_dir():
            raise BagError(f'{self.path} is a file; a folder is needed')
        is_input = os.path.realpath(self.path) in map(os.path.realpath, inputs)
        if (self.path / 'metadata.yaml').exists() or is_input:
            raise BagError(f'{self.path} is a recording; choose another folder for the run')
        old = [name for name in _RUN_FILES if os.path.lexists(self.path / name)]
        if old and not overwrite:
            raise BagError(
                f'{self.path} holds a run already ({old[0]}); choose another '
                'folder or say --overwrite'
            )
        if old:
            if why := self._hindrance(inputs):
                raise BagError(why)
            with disk.replaced(self.path, (*_RUN_FILES, disk.MARKER)) as place:
                disk.mark(place, KIND)
                yield RunFolder(place)
        elif not self.path.exists():
            with disk.whole(self.path) as place:
                place.mkdir()
                disk.mark(place, KIND)
                yield RunFolder(place)
        else:
            with disk.beside(self.path / 'run') as place:
                yield RunFolder(place)
                disk.on_disk(place)
                self._take_in(place)

    def _hindrance(self, inputs: Sequence[Path]) -> str:
        """Return why the run here is not replaced; empty when it may be."""
        try:  # versions without markers wrote these
            known = 'sonar_imm' in self.read_run().get('versions', {})
        except BagError:
            known = False
        if why := disk.hindrance(self.path, KIND, inputs, known=known):
            return why
        bag = self.path / BAG
        others = [
            item.name
            for item in (bag.iterdir() if bag.is_dir() and not bag.is_symlink() else ())
            if item.suffix not in ('.mcap', '.db3') and item.name != 'metadata.yaml'
        ]
        return f'{bag} holds {others[0]}, which is of no run; move it away' if others else ''

    def _take_in(self, place: Path) -> None:
        """Move a run from `place` to this folder, run.json as the last; all of it or nothing."""
        moved = []
        try:
            if not os.path.lexists(self.path / disk.MARKER):
                disk.mark(self.path, KIND)
                moved.append(disk.MARKER)
            for name in reversed(_RUN_FILES):
                if (place / name).exists():
                    os.rename(place / name, self.path / name)
                    moved.append(name)
            disk.sync_folder(self.path)
        except BaseException:
            for name in reversed(moved):
                os.rename(self.path / name, place / name)
            raise

    def write_estimates(
        self,
        estimates: Iterable[Estimate],
        system: str,
        *,
        tables: str = AS_CSV,
        notes: Mapping[str, str] | None = None,
    ) -> dict[str, int]:
        """Write bag and tables while the estimates come; gives the number of estimates and rows,
        the stamp of the first estimate, and the number of soundings where there are any. notes:
        what the metadata of Parquet files say."""
        written, notes = {'estimates': 0, 'rows': 0}, dict(notes or {})
        with contextlib.ExitStack() as stack:

            def table(name: str) -> list[Table]:
                if tables == NO_TABLE:
                    return []
                if tables == AS_CSV:
                    return [stack.enter_context(CsvTable(self.path / name))]
                return [stack.enter_context(ParquetTable(self.path / PARQUET[name], notes))]

            compressed = tables != AS_CSV  # with CSV beside it, it would save a twentieth
            bag = stack.enter_context(BagWriter(self.path / BAG, compressed=compressed))
            bins, chart = table(CSV), []
            for estimate in estimates:
                soundings = soundings_of(estimate)
                if soundings is None or tables != AS_PARQUET:
                    message = write_estimate(estimate, ros_message)
                    bag.write(f'/{system}/estimate', message, estimate.stamp_ns)
                notes.setdefault('frame_id', estimate.frame_id)
                for each in bins:
                    each.write(estimate.stamp_ns, estimate.columns())
                written.setdefault('first_stamp_ns', estimate.stamp_ns)
                written['estimates'] += 1
                written['rows'] += len(estimate)
                if soundings is None:
                    continue
                if 'soundings' not in written:
                    written['soundings'], chart = 0, table(SOUNDINGS)
                message = write_soundings(soundings, ros_message)
                bag.write(f'/{system}/soundings', message, estimate.stamp_ns)
                for each in chart:
                    each.write(soundings.stamp_ns, soundings.columns)
                written['soundings'] += len(soundings)
        return written

    def write_json(self, name: str, content: Any) -> Path:
        """Write `content` as JSON; NaN and infinity, which JSON lacks, become null."""
        path = self.path / name
        with disk.whole(path, follow=False) as unfinished:
            text = json.dumps(finite(content), indent=2) + '\n'
            unfinished.write_text(text, encoding='utf-8')
        return path

    def read_run(self) -> dict[str, Any]:
        """The content of run.json. Raises `BagError` when the folder holds no finished run."""
        path = self.path / RUN
        if not self.path.exists():
            disk.remove_leftovers(self.path)  # a killed command may have moved it aside
        if not os.path.lexists(path) and (lists := summaries(self.path)):
            raise BagError(
                f'{self.path} holds several runs, which {lists[0].name} lists; name the folder of '
                'one'
            )
        if not os.path.lexists(path):
            raise BagError(
                f'{self.path} holds no finished run: {RUN} is missing; '
                'make one with sonar-imm track'
            )
        run = read_json(path)
        try:
            _check_run(run)
        except (ValueError, AttributeError, TypeError) as error:
            raise BagError(f'{path} cannot be understood: {error}') from None
        return dict(run)

    def keep_from(self, out: Path, *, but: str = '') -> None:
        """Raise `BagError` where the file `out` would take the place of a file of this run, except
        the one called `but`, or of a file of its recording."""
        place = Path(os.path.realpath(out))
        here = Path(os.path.realpath(self.path))
        named = [here / name for name in (*_RUN_FILES, disk.MARKER)]
        own = [*named, *(Path(os.path.realpath(name)) for name in named)]
        if place != here / but and any(place.is_relative_to(item) for item in own):
            raise BagError(f'{out} is a file of the run {self.path}; choose another name')
        bag = self.read_run()['bag']
        if bag and place.is_relative_to(os.path.realpath(bag)):
            raise BagError(f'{out} is in the recording of {self.path}; choose another name')

    def soundings(self) -> Path | None:
        """Where the soundings of the run are: in its table, or in its bag where it has none. None
        for a run without soundings."""
        places = [self.path / name for name in (PARQUET[SOUNDINGS], SOUNDINGS)]
        if 'soundings' in self.read_run():
            places.append(self.path / BAG)
        return next((place for place in places if place.exists()), None)

    def bins(self) -> Path | None:
        """The table of a run whose bag lacks the estimates; None where the bag has them."""
        table = self.path / PARQUET[CSV]
        return table if table.exists() and 'soundings' in self.read_run() else None

    def read_estimates(self) -> list[Estimate]:
        """The estimates of the run, as written. Raises `BagError` when its files are damaged, and
        ModuleNotFoundError without pyarrow where they are Parquet."""
        table = self.bins()
        return _read_estimates(self.path / BAG) if table is None else _read_bins(table)


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises `BagError` for what is none: also for a pipe, which may
    never end, and for one larger than `MOST_JSON`."""
    try:
        if not path.is_file():
            raise ValueError('it is no regular file')
        with path.open(encoding='utf-8') as file:
            text = file.read(MOST_JSON + 1)
        if len(text) > MOST_JSON:
            raise ValueError(f'it has more than {MOST_JSON} characters')
        return json.loads(text)
    except RecursionError:
        raise BagError(f'{path} cannot be understood: it is nested too deeply') from None
    except ValueError as error:
        raise BagError(f'{path} cannot be understood: {error}') from None
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from None


def summaries(folder: Path) -> list[Path]:
    """The lists of runs in a folder: of a command for all recordings, and of its shards."""
    whole = [folder / SUMMARY] if (folder / SUMMARY).is_file() else []
    return whole + sorted(folder.glob(SHARD_SUMMARY.format('*', '*')))


def _check_run(run: Any) -> None:
    """Raise ValueError or TypeError for a run.json whose entries are not what they must be."""
    if not {'system', 'bag', 'topics', 'parameters'} <= run.keys():
        raise ValueError('keys are missing')
    for name, kind in _KINDS.items():
        if not isinstance(run.get(name, kind()), kind):
            raise ValueError(f"'{name}' is not {_NAMES[kind]}")
    if run['system'] not in SYSTEMS:
        raise ValueError(f"there is no system '{run['system']}'")
    if run.get('world_frame', 'enu') not in ('enu', 'ned'):
        raise ValueError("'world_frame' is neither enu nor ned")
    if not all(isinstance(name, str) for name in run['topics'].values()):
        raise ValueError("'topics' does not give the name of an input for each topic")
    for reason, entry in run.get('refused', {}).items():
        if not (isinstance(entry, dict) and {'count', 'example'} <= entry.keys()):
            raise ValueError(f"'refused' has no count and example for '{reason}'")


def read_truth(
    run: Mapping[str, Any], truth_bag: Path | None = None, topic: str = TRUTH_TOPIC
) -> list[Estimate] | None:
    """The truth tables in `truth_bag`, by default in the recording that was tracked.

    None when the recording has no truth or is gone. Raises `BagError`, also when `truth_bag` holds
    no truth.
    """
    path = truth_bag or Path(run['bag'])
    if truth_bag is None and not path.exists():
        return None
    estimates = _read_estimates(path, [topic])
    if not estimates and truth_bag is not None:
        raise BagError(f'{truth_bag} has no topic {topic}')
    return estimates or None


def read_measurements(run: Mapping[str, Any]) -> Iterator[Any]:
    """The measurements that went into `run`, in the order recorded, without those refused.

    Nothing when the recording is gone. Raises `BagError`.
    """
    if not Path(run['bag']).exists():
        return
    with BagReader(run['bag']) as bag:
        for item in measurements_of(
            bag,
            run['system'],
            run['topics'],
            world_frame=run.get('world_frame', 'enu'),
            settings=run.get('parameters'),
            detector=run.get('detector'),
        ):
            if item.measurement is not None and not isinstance(item.measurement, Rejection):
                yield item.measurement


def _read_estimates(path: Path, topics: list[str] | None = None) -> list[Estimate]:
    try:
        with BagReader(path) as bag:
            if topics is None:  # of a run: everything but the estimates is there for others
                topics = [topic.name for topic in bag.topics if topic.name.endswith('/estimate')]
            return [read_estimate(item.message) for item in bag.messages(topics)]
    except Rejection as rejection:
        raise BagError(f'{path}: {rejection}') from None


def _read_bins(path: Path) -> list[Estimate]:
    """The estimates of a table of bins: rows of one stamp and side that follow one another."""
    table = read_parquet(path)
    try:
        columns = {name: table[name].to_numpy() for name in table.column_names}
        frame_id = (table.schema.metadata or {}).get(b'frame_id', b'').decode()
        stamps = columns.pop('stamp_ns')
        changes = (np.diff(stamps) != 0) | (np.diff(columns['side']) != 0)
        ends = [*np.flatnonzero(changes) + 1, len(stamps)] if len(stamps) else []
        return [
            Estimate.from_columns(
                {name: column[start:end] for name, column in columns.items()},
                stamp_ns=int(stamps[start]),
                frame_id=frame_id,
            )
            for start, end in zip([0, *ends], ends)
        ]
    except (LookupError, RuntimeError, TypeError, ValueError) as error:
        raise BagError(f'{path} is no table of estimates: {error}') from None


def run_record(**facts: Any) -> dict[str, Any]:
    """The content of run.json: `facts` and the versions of the software."""
    versions = {
        'sonar_imm': __version__,
        'python': platform.python_version(),
        'numpy': np.__version__,
        'scipy': scipy.__version__,
        'numba': numba.__version__,
        'rosbags': version('rosbags'),
    }
    return {**facts, 'versions': versions}


def fingerprint(path: Path) -> dict[str, Any]:
    """Size and SHA-256 of a recording: of the file, or of all files of the folder in order."""
    files = sorted(item for item in path.rglob('*') if item.is_file()) if path.is_dir() else [path]
    digest, size = hashlib.sha256(), 0
    for file in files:
        if path.is_dir():
            digest.update(os.fsencode(file.relative_to(path).as_posix()))
        with file.open('rb') as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
                size += len(block)
    return {'bag_bytes': size, 'bag_sha256': digest.hexdigest()}


def finite(value: Any) -> Any:
    """`value` with None for floats that are not finite, so that any JSON parser reads it."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return value
