# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Every reader with files that are not as they should be: one sentence each, and what can be used
is kept and counted."""

from helpers.field_files import FORMATS, line
import pytest

from sonar_imm_tools.cli import main

READ = [each for each in FORMATS if each.kind != 'none']
COUNT = 20
LONELY, NOWHERE = 6, (0, 11)
"""Which moment has a clock that is off, and which have a receiver without a fix."""
# An archive of numpy has its table of contents at its end.
LOST_WHEN_CUT = ('pings.npz', 'traces.npz')
TIMES = 'its clock is off'
FIXES = 'latitude 0, longitude 0 is what receivers without a fix write'
SHIP = 'pings have no position (0, 0 is none)'
TWO = 'does the file hold two vessels?'
EXPECTED = {
    'usbl.csv': [TIMES, FIXES],
    'vessel.csv': [TIMES, FIXES, TWO],
    'dive.gpx': [TIMES, FIXES],
    'dive.kml': [TIMES, FIXES],
    'dive.geojson': [TIMES, FIXES],
    'gps.log': [TIMES, FIXES, TWO],
    'harbour.nmea': [TIMES, FIXES],
    'vue.csv': ['the clock jumps by'],
    'arrivals.csv': [TIMES],
    'array_20240531_100000.wav': [],  # one clock, and no place
    'line.seg': [TIMES],
    'pings.npz': [TIMES],
    'traces.npz': [TIMES],
    'traces.csv': [TIMES],
    'line.xtf': [TIMES, SHIP, TWO],
    'swath.xtf': [TIMES, SHIP, TWO],
    'frames': [TIMES, SHIP],
}
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
def test_a_file_that_is_cut_off(tmp_path, each, capsys):
    each.make(tmp_path / each.name, line(COUNT, each.step))
    path = content_of(tmp_path / each.name)
    whole = path.read_bytes()
    cut = len(whole) * 3 // 5 + 7
    if each.name.endswith(('.csv', '.log', '.nmea')):  # in a line, not behind it
        cut = whole.rfind(b'\n', 0, cut) + 8
    path.write_bytes(whole[:cut])
    code, printed = converted(each, tmp_path, capsys)
    if each.name in LOST_WHEN_CUT:
        assert code == 2
        return
    assert code == 0 and 'left out: ' in printed


@pytest.mark.parametrize('each', READ, ids=lambda each: each.name)
@pytest.mark.parametrize('what', ['empty', 'of another version'])
def test_a_file_that_is(tmp_path, each, what, capsys):
    each.make(tmp_path / each.name, line(COUNT, each.step))
    path = content_of(tmp_path / each.name)
    path.write_bytes(b'' if what == 'empty' else bytes(range(200, 216)) + path.read_bytes()[16:])
    code, printed = converted(each, tmp_path, capsys)
    # A log of sentences has no head: only its first one is lost.
    good = what != 'empty' and each.name in ('gps.log', 'harbour.nmea')
    assert (code, 'left out: ' in printed) == ((0, True) if good else (2, False))


@pytest.mark.parametrize('each', READ, ids=lambda each: each.name)
def test_a_file_without_a_ping(tmp_path, each, capsys):
    if each.name == 'line.seg':
        pytest.skip('segyio writes none')
    each.make(tmp_path / each.name, [])
    assert converted(each, tmp_path, capsys)[0] == 2


@pytest.mark.parametrize('name', EXPECTED)
def test_two_vessels_a_clock_that_jumps_and_a_receiver_without_a_fix(tmp_path, name, capsys):
    (each,) = (each for each in FORMATS if each.name == name)
    spots = []
    for k, spot in enumerate(line(COUNT, each.step)):
        far = 30_000.0 * (k % 2)
        spot = spot._replace(name=str(1 + k % 2), place=(spot.place[0] + far, spot.place[1]))
        spot = spot._replace(seconds=spot.seconds + 4e6 * (k == LONELY))
        spots.append(spot._replace(place=None) if k in NOWHERE else spot)
    each.make(tmp_path / name, spots)
    code, printed = converted(each, tmp_path, capsys)
    assert code == 0 and not [words for words in EXPECTED[name] if words not in printed]
    if TIMES in EXPECTED[name]:
        assert '1 clock off' in printed
    if FIXES in EXPECTED[name]:
        assert 'no position' in printed and 'origin: latitude 0' not in printed


def test_each_reader_has_been_asked():
    assert {each.name for each in READ if not each.name.endswith('.bag')} == set(EXPECTED)
