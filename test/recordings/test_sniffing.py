# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a file is taken for, by its content alone."""

import numpy as np
import pytest

from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sniffing import sniff
from sonar_imm_tools.recordings.sources import BagError


def segy(letter=b'\xc3'):
    header = bytearray(3600)
    header[:1] = letter
    header[3220:3222], header[3224:3226] = (500).to_bytes(2, 'big'), (5).to_bytes(2, 'big')
    return bytes(header)


FILES = {
    'fixes': b'stamp,x,y\n1,2,3\n',
    'fixes ': b'\xef\xbb\xbf<?xml version="1.0"?><gpx></gpx>',
    'fixes  ': b'{ "type" : "FeatureCollection", "features": []}',
    'relative': b'stamp,range,bearing,vessel_x,vessel_y,heading\n',
    'arrivals': b'ping;receiver;arrival\n',
    'arrivals ': b'stamp,transmitter,receiver,toa\n',
    'detections': b'Date and Time (UTC),Receiver,Transmitter,Latitude,Longitude\n',
    'traces': b'stamp,depth,amplitude\n',
    'nmea': b'$GPHDT,45.0,T*04\r\n!AIVDM,1,1,,A,13u?etPv2;0n:dDPwUM1U1Cb069D,0*24\r\n',
    'nmea ': b'half a line\r\n1717199990.1 $GPHDT,45.0,T*04\r\n',
    'segy': segy(),
    'segy ': segy(b'C'),
    'hydrophones': b'RIFF\0\0\0\0WAVEfmt ',
    'hydrophones ': b'fLaC\0',
    'xtf': b'\x7b\x01' + bytes(1100),
}
RAW = (b'XML0', b'CON0', b'FIL1', b'#IIP', b'\x02I', b'\x02i')
"""What stands behind the first four bytes of EK80, EK60, KMALL and .all."""


@pytest.mark.parametrize('kind', FILES)
def test_the_content_says_the_kind(tmp_path, kind):
    (tmp_path / 'file.dat').write_bytes(FILES[kind])
    assert sniff(tmp_path / 'file.dat').kind == kind.strip()


def test_archives(tmp_path):
    np.savez(tmp_path / 'a.npz', iq=np.zeros((3, 2), complex), range=np.zeros(3))
    np.savez(tmp_path / 'b.npz', depth=np.zeros(3), amplitude=np.zeros(3))
    np.savez(tmp_path / 'c.npz', other=np.zeros(3))
    assert sniff(tmp_path / 'a.npz').kind == 'snapshots'
    assert sniff(tmp_path / 'b.npz').kind == 'traces'
    with pytest.raises(BagError, match='--name iq=ARRAY'):
        sniff(tmp_path / 'c.npz')


@pytest.mark.parametrize(
    'content, wanted',
    [
        (b'', 'is empty'),
        (b'Wann,Rechts,Hoch\n1,2,3\n', '--column stamp=HEADER'),
        (b'stamp,Rechts,Hoch\n', '--column x=HEADER'),
        (bytes(range(256)) * 4, 'no text'),
        (b'PK\x03\x04 and nothing', 'damaged archive'),
        *((b'\0\0\0\x10' + name + bytes(100), 'raw file of an echo sounder') for name in RAW),
        (b'[{"measurement": []}]', r'JSON and no GeoJSON.* as CSV \(kind fixes\)'),
    ],
)
def test_what_is_not_known_is_said_with_what_would_help(tmp_path, content, wanted):
    (tmp_path / 'file.dat').write_bytes(content)
    with pytest.raises(BagError, match=wanted):
        sniff(tmp_path / 'file.dat')


@pytest.mark.parametrize('words', [(), ('ek80',), ('kongsberg',)])
def test_a_raw_file_of_an_echo_sounder_says_what_to_do(tmp_path, capsys, words):
    path = tmp_path / 'D20221108.raw'
    path.write_bytes((100).to_bytes(4, 'little') + b'XML0' + bytes(100))
    assert main(['convert', *words, str(path), str(tmp_path / 'bag')]) == 2
    (sentence,) = (
        line for line in capsys.readouterr().err.splitlines() if 'kind snapshots' in line
    )
    assert 'XTF' in sentence and not (tmp_path / 'bag').exists()


def test_a_table_is_not_taken_for_one(tmp_path):
    (tmp_path / 'usbl.csv').write_text('time#UTC,x,y\n1,2,3\n')
    assert sniff(tmp_path / 'usbl.csv').kind == 'fixes'


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
