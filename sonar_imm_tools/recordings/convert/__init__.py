# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Conversion of other people's recordings into bags: what a file is, and who converts it.

Every converter takes the file, the path of the new bag and options, and gives a
`ConversionReport`. Rows that cannot be used are counted and listed by line. Only a file without a
usable row raises `BagError`. Records are written in the order of their stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import contextlib
from pathlib import Path
import zipfile

from attrs import frozen

from sonar_imm.trackers import SYSTEMS

from ..conversion import ConversionReport
from ..measurements import made_topics
from ..reader import BagReader
from ..segy_lines import is_segy
from ..sources import BagError, is_recording, quoted, start_of, SUFFIXES
from ..table_files import CsvTable, kind_of_text
from ..tables import CsvOptions
from ..truth import convert_truth
from .archives import convert_snapshots, convert_traces
from .archives import NAMES as SNAPSHOT_NAMES
from .arrivals import convert_arrivals, name_columns, names_tags
from .detections import convert_detections
from .fathometer import convert_hydrophones, convert_segy
from .fixes import convert_fixes, convert_relative
from .images import convert_images, convert_interferometer, convert_pictures
from .nmea import convert_nmea, SENTENCE
from .xtf import convert_xtf

KINDS: dict[str, Callable[..., ConversionReport]] = {
    convert.__name__.removeprefix('convert_'): convert
    for convert in (
        *(convert_fixes, convert_relative, convert_nmea, convert_arrivals, convert_detections),
        *(convert_truth, convert_snapshots, convert_traces, convert_images, convert_pictures),
        *(convert_interferometer, convert_segy, convert_xtf, convert_hydrophones),
    )
}
"""The converters by the name that the command gives them."""
STATE_IT = 'where you know what it is, sonar-imm convert KIND IN OUT_BAG states it'
RAW_FILE = (
    'is a raw file of an echo sounder, which is not read any more: convert it to npz (kind '
    'snapshots) or XTF'
)
SCANS = (
    'is JSON and no GeoJSON: scans in JSON are not read any more, write the positions as CSV '
    '(kind fixes)'
)
PICTURES = ('.png', '.jpg', '.jpeg')


@frozen
class Guess:
    """kind: of conversion; why: what the file looks like."""

    kind: str
    why: str


def sniff(path: Path, columns: Mapping[str, str] | None = None) -> Guess:
    """What a file is; columns: headers of a table that its user names, as in `CsvOptions`. Raises
    `BagError` with what it could be and what would settle it."""
    if path.is_dir() and of_pictures(path):
        return Guess('pictures', 'a folder of pictures')
    if path.is_dir() and not is_recording(path):
        return _of_folder(path)
    if path.is_dir() or path.suffix.lower() in SUFFIXES:
        return _of_bag(path)
    start = start_of(path)
    if not start:
        raise BagError(f'{path} is empty')
    riff = start[:4] in (b'RIFF', b'RIFX') and start[8:12] == b'WAVE'
    if riff or start[:4] in (b'fLaC', b'RF64'):
        return Guess('hydrophones', 'sound of hydrophones')
    if start[:2] == b'PK':
        return _of_archive(path)
    if is_segy(start) or path.suffix.lower() == '.su':
        return Guess('segy', 'traces in SEG-Y or SU')
    # Of a Simrad EK60 or EK80, or a KMALL or .all of a Kongsberg.
    kmall = start[4:5] == b'#' and start[5:8].isalpha() and start[5:8].isupper()
    maker = start[4:8] in (b'XML0', b'CON0', b'FIL1') or start[4:6] in (b'\x02I', b'\x02i')
    if b'\0' in start[:64] and (kmall or maker):
        raise BagError(f'{path} {RAW_FILE}')
    if start[0] == 123 and b'\0' in start[1:200]:
        return Guess('xtf', 'side scan or soundings in XTF')
    if kind := kind_of_text(path):
        if kind == 'json':
            raise BagError(f'{path} {SCANS}')
        return Guess('fixes', f'a {kind.upper()} file of positions')
    text = start.decode('ascii', errors='replace')
    lines = [line for line in text.splitlines()[:20] if line.strip()]
    if 2 * sum(map(bool, map(SENTENCE.match, lines))) >= max(len(lines) - 1, 1):
        return Guess('nmea', 'NMEA 0183 or AIS sentences')
    try:
        table = CsvTable(path, CsvOptions(columns=columns or {}))
    except BagError as error:
        raise BagError(f'{error}; {STATE_IT}') from None
    return _of_table(table)


def hint(path: Path) -> str:
    """What makes a recording of a file, or a folder of pictures, that is none."""
    if path.is_dir() and not of_pictures(path):
        return ''
    try:
        why = sniff(path).why
    except BagError as error:
        return f'; {error}' if path.is_file() else ''
    return f'; it looks like {why}: sonar-imm convert {quoted(path)} OUT_BAG makes one of it'


def of_pictures(folder: Path) -> bool:
    return any(each.suffix.lower() in PICTURES for each in folder.iterdir())


def _of_folder(folder: Path) -> Guess:
    """What the files of a folder are, where those that are known are of one kind."""
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.is_file() or is_recording(path):
            with contextlib.suppress(BagError):
                found.setdefault(sniff(path).kind, path)
    if len(found) == 1:
        ((kind, first),) = found.items()
        return Guess(kind, f'a folder of files such as {first.name}')
    kinds = ', '.join(f'{path.name} ({kind})' for kind, path in found.items())
    raise BagError(f'{folder} holds {kinds or "nothing that is known"}; {STATE_IT}')


def _of_bag(path: Path) -> Guess:
    with BagReader(path) as bag:
        found = [
            topic
            for system in SYSTEMS
            for topic, entry in made_topics(bag, system).items()
            if not entry.companion
        ]
    if found:
        return Guess('images', f'a recording with images of a sonar on {found[0]}')
    raise BagError(
        f'{path} is a recording already: sonar-imm info {path} shows which tracker takes it; '
        'amplitude and phase of an interferometer need sonar-imm convert interferometer'
    )


def _of_archive(path: Path) -> Guess:
    try:
        with zipfile.ZipFile(path) as packed:
            names = {Path(name).stem for name in packed.namelist()}
    except (OSError, zipfile.BadZipFile):
        raise BagError(f'{path} is a damaged archive') from None
    if names & set(SNAPSHOT_NAMES['iq']):
        return Guess('snapshots', 'a numpy archive with samples of an array')
    if {'depth', 'amplitude'} <= names:
        return Guess('traces', 'a numpy archive with traces')
    raise BagError(
        f'{path} is an archive of {", ".join(sorted(names)[:10]) or "nothing"}; of numpy archives '
        'those are taken with the array iq (sonar-imm convert snapshots, --name iq=ARRAY for '
        'another name) or the arrays depth and amplitude (sonar-imm convert traces)'
    )


def _of_table(table: CsvTable) -> Guess:
    columns = ', '.join(table.headers[:12])
    why = f'a table with the columns {columns}'
    name_columns(table)
    if table.has('receiver', 'toa') or table.has('receiver', 'ping', 'arrival'):
        return Guess('arrivals', why)
    if table.has('receiver', 'stamp') and names_tags(table):
        return Guess('detections', f'{why}: which receiver heard which tag')
    if table.has('depth', 'amplitude'):
        return Guess('traces', why)
    if table.has('stamp') and (
        table.has('vessel_x', 'vessel_y') or table.has('vessel_latitude', 'vessel_longitude')
    ):
        return Guess('relative', f'{why}: positions from a vessel')
    places = (('x', 'y'), ('latitude', 'longitude'), ('range', 'bearing'))
    if table.has('stamp') and any(table.has(*pair) for pair in places):
        return Guess('fixes', why)
    wanted = {} if table.has('stamp') else {'a time': ['stamp']}
    if not any(table.has(*pair) for pair in places):
        wanted['a position'] = ['x', 'y']
    missing = ' and '.join(wanted)
    flags = ' '.join(f'--column {name}=HEADER' for names in wanted.values() for name in names)
    raise BagError(
        f'{table.path} is {why}: no name among them stands for {missing}. It could be fixes of '
        f'divers (sonar-imm convert IN OUT {flags}), or relative, arrivals, '
        'detections or traces; sonar-imm convert lists them'
    )
