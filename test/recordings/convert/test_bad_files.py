# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Every reader with files that are not as they should be: one sentence each, and what can be used
is kept and counted."""

import re
import shutil

from helpers.field_files import FORMATS, line
import numpy as np
import pytest

from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.convert import sniff
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError

READ = [each for each in FORMATS if each.kind != 'none']
COUNT = 20
LONELY, NOWHERE = 6, (0, 11)
"""Which moment has a clock that is off, and which have a receiver without a fix."""
TIMES = 'its clock is off'
FIXES = 'latitude 0, longitude 0 is what receivers without a fix write'
SHIP = 'pings have no position (0, 0 is none)'
TWO = 'does the file hold two vessels?'
ONE, BOTH = [TIMES, FIXES], [TIMES, FIXES, TWO]
EXPECTED = {
    'array_20240531_100000.wav': [],  # one clock, and no place
    'vue.csv': ['the clock jumps by'], 'frames': [TIMES, SHIP],
    **dict.fromkeys('arrivals.csv line.seg pings.npz traces.npz traces.csv'.split(), [TIMES]),
    **dict.fromkeys('usbl.csv dive.gpx dive.kml dive.geojson harbour.nmea'.split(), ONE),
    **dict.fromkeys(['vessel.csv', 'gps.log'], BOTH),
    **dict.fromkeys(['line.xtf', 'swath.xtf'], [TIMES, SHIP, TWO]),
}  # fmt: skip
"""What is printed of a file with all that; each name of `READ` but the bags, whose reader has its
own tests and whose gaps ``info`` shows."""


def content_of(path):
    """The file whose bytes are spoilt: of a folder the table or the recording."""
    if not path.is_dir():
        return path
    return next(each for each in sorted(path.iterdir()) if each.suffix in ('.csv', '.mcap'))


def converted(each, folder, capsys):
    """Exit code and what is printed."""
    options = [option.format(folder) for option in each.options]
    words = [each.kind] if each.kind else []
    code = main(['convert', *words, str(folder / each.name), str(folder / 'bag'), *options])
    printed = capsys.readouterr()
    assert 'Traceback' not in printed.err + printed.out
    sentences = [line for line in printed.err.splitlines() if 'is taken for' not in line]
    assert len(sentences) == (0 if code == 0 else 1)  # one sentence
    assert (folder / 'bag').exists() == (code == 0)
    return code, printed.out + printed.err


@pytest.mark.parametrize('each', READ, ids=lambda each: each.name)
def test_a_file_that_is_cut_off_empty_of_another_version_or_without_a_ping(tmp_path, each, capsys):
    each.make(tmp_path / each.name, line(COUNT, each.step))
    path = content_of(tmp_path / each.name)
    whole = path.read_bytes()
    for content in (b'', bytes(range(200, 216)) + whole[16:]):
        path.write_bytes(content)
        code, printed = converted(each, tmp_path, capsys)
        # A log of sentences has no head: only its first one is lost.
        good = content and each.name in ('gps.log', 'harbour.nmea')
        assert (code, 'left out: ' in printed) == ((0, True) if good else (2, False))
        shutil.rmtree(tmp_path / 'bag', ignore_errors=True)
    cut = len(whole) * 3 // 5 + 7
    if each.name.endswith(('.csv', '.log', '.nmea')):  # in a line, not behind it
        cut = whole.rfind(b'\n', 0, cut) + 8
    path.write_bytes(whole[:cut])
    code, printed = converted(each, tmp_path, capsys)
    # An archive of numpy has its table of contents at its end.
    lost = each.name in ('pings.npz', 'traces.npz')
    assert (code, 'left out: ' in printed) == ((2, False) if lost else (0, True))
    shutil.rmtree(tmp_path / 'bag', ignore_errors=True)
    if each.name != 'line.seg':  # segyio writes none
        if path.parent != tmp_path:
            shutil.rmtree(path.parent)
        each.make(tmp_path / each.name, [])
        assert converted(each, tmp_path, capsys)[0] == 2


@pytest.mark.parametrize('name', EXPECTED)
def test_two_vessels_a_clock_that_jumps_and_a_receiver_without_a_fix(tmp_path, name, capsys):
    assert {each.name for each in READ if not each.name.endswith('.bag')} == set(EXPECTED)
    (each,) = (each for each in FORMATS if each.name == name)
    spots = []
    for k, spot in enumerate(line(COUNT, each.step)):
        far = 30_000.0 * (k % 2)
        place = None if k in NOWHERE else (spot.place[0] + far, spot.place[1])
        seconds = spot.seconds + 4e6 * (k == LONELY)
        spots.append(spot._replace(name=str(1 + k % 2), place=place, seconds=seconds))
    each.make(tmp_path / name, spots)
    code, printed = converted(each, tmp_path, capsys)
    assert code == 0 and not [words for words in EXPECTED[name] if words not in printed]
    if TIMES in EXPECTED[name]:
        assert '1 clock off' in printed
    if FIXES in EXPECTED[name]:
        assert 'no position' in printed and 'origin: latitude 0' not in printed


# -- what a file is taken for, by its content alone


def segy(letter=b'\xc3'):
    header = bytearray(3600)
    header[:1] = letter
    header[3220:3222], header[3224:3226] = (500).to_bytes(2, 'big'), (5).to_bytes(2, 'big')
    return bytes(header)


FILES = [
    ('fixes', b'stamp,x,y\n1,2,3\n'),
    ('fixes', b'time#UTC,x,y\n1,2,3\n'),
    ('fixes', b'\xef\xbb\xbf<?xml version="1.0"?><gpx></gpx>'),
    ('fixes', b'{ "type" : "FeatureCollection", "features": []}'),
    ('relative', b'stamp,range,bearing,vessel_x,vessel_y,heading\n'),
    ('arrivals', b'ping;receiver;arrival\n'),
    ('arrivals', b'stamp,transmitter,receiver,toa\n'),
    ('detections', b'Date and Time (UTC),Receiver,Transmitter,Latitude,Longitude\n'),
    ('traces', b'stamp,depth,amplitude\n'),
    ('nmea', b'$GPHDT,45.0,T*04\r\n!AIVDM,1,1,,A,13u?etPv2;0n:dDPwUM1U1Cb069D,0*24\r\n'),
    ('nmea', b'half a line\r\n1717199990.1 $GPHDT,45.0,T*04\r\n'),
    ('segy', segy()),
    ('segy', segy(b'C')),
    ('hydrophones', b'RIFF\0\0\0\0WAVEfmt '),
    ('hydrophones', b'fLaC\0'),
    ('xtf', b'\x7b\x01' + bytes(1100)),
]
RAW = (b'XML0', b'CON0', b'FIL1', b'#IIP', b'\x02I', b'\x02i')
"""What stands behind the first four bytes of EK80, EK60, KMALL and .all."""


def test_the_content_says_the_kind(tmp_path):
    path, none = tmp_path / 'file.dat', np.zeros(3)
    for kind, content in FILES:
        path.write_bytes(content)
        assert sniff(path).kind == kind
    np.savez(tmp_path / 'a.npz', iq=np.zeros((3, 2), complex), range=none)
    assert sniff(tmp_path / 'a.npz').kind == 'snapshots'
    np.savez(tmp_path / 'a.npz', depth=none, amplitude=none)
    assert sniff(tmp_path / 'a.npz').kind == 'traces'
    np.savez(tmp_path / 'a.npz', other=none)
    with pytest.raises(BagError, match='--name iq=ARRAY'):
        sniff(tmp_path / 'a.npz')


def test_what_is_not_known_is_said_with_what_would_help(tmp_path):
    for content, wanted in (
        (b'', 'is empty'),
        (b'Wann,Rechts,Hoch\n1,2,3\n', '--column stamp=HEADER'),
        (b'stamp,Rechts,Hoch\n', '--column x=HEADER'),
        (bytes(range(256)) * 4, 'no text'),
        (b'PK\x03\x04 and nothing', 'damaged archive'),
        *((b'\0\0\0\x10' + name + bytes(100), 'raw file of an echo sounder') for name in RAW),
        (b'[{"measurement": []}]', r'JSON and no GeoJSON.* as CSV \(kind fixes\)'),
    ):
        (tmp_path / 'file.dat').write_bytes(content)
        with pytest.raises(BagError, match=wanted):
            sniff(tmp_path / 'file.dat')


def test_a_raw_file_of_an_echo_sounder_says_what_to_do(tmp_path, capsys):
    path = tmp_path / 'D20221108.raw'
    path.write_bytes((100).to_bytes(4, 'little') + b'XML0' + bytes(100))
    for words in ((), ('ek80',)):
        assert main(['convert', *words, str(path), str(tmp_path / 'bag')]) == 2
        (sentence,) = re.findall('.*kind snapshots.*', capsys.readouterr().err)
        assert 'XTF' in sentence and not (tmp_path / 'bag').exists()


def test_columns_that_are_named_settle_it_without_the_kind(tmp_path, capsys):
    table, bag = tmp_path / 'ausgabe.csv', tmp_path / 'bag'
    table.write_text('Wann,Rechts,Hoch\n0,1,2\n1,2,3\n')
    named = ('--column', 'stamp=Wann', '--column=x=Rechts', '--column', 'y=Hoch')
    assert main(['convert', str(table), str(bag), *named]) == 0
    assert 'convert fixes' in capsys.readouterr().err
    with BagReader(bag) as made:
        assert [topic.name for topic in made.topics] == ['/fix']
    assert main(['convert', str(table), str(tmp_path / 'other'), *named[:3]]) == 2
    assert '--column y=HEADER' in capsys.readouterr().err
