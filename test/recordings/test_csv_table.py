# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import tracemalloc

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from sonar_imm_tools.recordings.csv_table import CsvTable
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.recordings.tables import CsvOptions
from sonar_imm_tools.recordings.times import BadRow


@pytest.fixture
def table(tmp_path):
    def make(text, **options):
        path = tmp_path / 'a.csv'
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return CsvTable(path, CsvOptions(**options))

    return make


@pytest.mark.parametrize(
    'header',
    [
        'stamp,x,y',
        'Time [s];East (m);North (m)',
        'timestamp\teasting\tnorthing',
        'T  X  Y',
        '\ufefftime_s | east_m | north_m',
        '"Unix Time","UTM_E","UTM_N"',
    ],
)
def test_usual_names_and_delimiters_are_recognised(table, header):
    found = table(header + '\n')
    assert [found.index.get(name) for name in ('stamp', 'x', 'y')] == [0, 1, 2]


def test_columns_mapped_by_hand_win(table):
    found = table('time,x,a\n5,1,2\n', columns={'x': 'a'})
    assert next(iter(found)).number('x') == 2.0


@pytest.mark.parametrize(
    'options, words',
    [
        ({'columns': {'x': 'eest'}}, "no column 'eest' (did you mean 'east'?)"),
        ({'columns': {'xx': 'east'}}, "no quantity 'xx'"),
        ({'time_unit': 'week'}, 's, ms, us, ns'),
    ],
)
def test_wrong_options_are_explained(table, options, words):
    with pytest.raises(BagError) as caught:
        table('time,east\n', **options)
    assert words in caught.value.sentence


def test_a_missing_column_is_named_with_what_is_there(table):
    with pytest.raises(BagError, match='no column for x and y; it has time, foo'):
        table('time,foo\n').require('stamp', 'x', 'y')


@pytest.mark.parametrize(
    'header, cell, stamp',
    [
        ('stamp_s', '1568052068.920238', 1568052068920238000),
        ('time', '1568052068.920238123', 1568052068920238123),
        ('time_ms', '1568052068920.5', 1568052068920500000),
        ('time_us', '1568052068920238', 1568052068920238000),
        ('time_ns', '1568052068920238123', 1568052068920238123),
        ('time [ms]', '1568052068920', 1568052068920000000),
        ('time', '1.568052068e9', 1568052068000000000),
        ('time', '2019-09-09T18:01:08.920238123Z', 1568052068920238123),
        ('time_utc', '2019-09-09 18:01:08', 1568052068000000000),
        ('time', '0', 1),
        ('time', '2019-09-09T20:01:08,5+02:00', 1568052068500000000),
        ('time', '2019-09-09T14:01:08-0400', 1568052068000000000),
    ],
)
def test_times_are_exact_in_every_unit(table, header, cell, stamp):
    (row,) = table(f'{header};x\n{cell};1\n')
    assert row.stamp_ns() == stamp


def test_a_stated_unit_and_an_offset_are_used(table):
    (row,) = table('time,x\n1500,1\n', time_unit='ms', time_offset_ns=10**18)
    assert row.stamp_ns() == 10**18 + 1_500_000_000


@pytest.mark.parametrize(
    'cell, words',
    [
        ('', 'not a time'),
        ('noon', "'noon', not a time"),
        ('2019-09-09 18:01:08', '--time-zone UTC'),
        ('18:01:08', 'no column holds the date'),
        ('-5', 'time unit'),
        ('1568052068920238123', 'time unit'),
        ('1e400', 'time unit'),
        ('nan', 'not a time'),
        ('inf', 'time unit'),
        ('2019-13-45T00:00:00Z', 'calendar'),
        ('1e9999999999', ''),
    ],
)
def test_bad_times_are_bad_rows(table, cell, words):
    (row,) = table(f'time,x\n{cell},1\n')
    with pytest.raises(BadRow) as caught:
        row.stamp_ns()
    assert words in str(caught.value)


@pytest.mark.parametrize(
    'header, cells, stamp',
    [
        ('date,time_utc', '2019-09-09,18:01:08.5', 1568052068500000000),
        ('UTC Date,time', '2019/9/9,18:01:08', 1568052068000000000),
        ('date,time', '20190909,20:01:08+02:00', 1568052068000000000),
        ('day,utc', '9.9.2019,6:01', 1568008860000000000),
        ('date,time', '2019-09-09,1568052068', 1568052068000000000),
    ],
)
def test_date_and_time_of_day_may_be_two_columns(table, header, cells, stamp):
    (row,) = table(f'{header},x\n{cells},1\n')
    assert row.stamp_ns() == stamp


@pytest.mark.parametrize(
    'zone, stamp',
    [
        ('UTC', 1568052068),
        ('+02:00', 1568044868),
        ('-0330', 1568064668),
        ('Europe/Berlin', 1568044868),  # summer time
    ],
)
def test_a_zone_can_be_stated_and_that_of_a_cell_wins(table, zone, stamp):
    first, second = table(
        'time,x\n2019-09-09 18:01:08,1\n2019-09-09 18:01:08Z,1\n', time_zone=zone
    )
    assert first.stamp_ns() == stamp * 10**9 and second.stamp_ns() == 1568052068 * 10**9
    with pytest.raises(BagError, match='no time zone'):
        CsvOptions(time_zone='Berlin')


def test_zero_is_a_time_where_the_file_counts_from_its_start(table):
    assert [row.stamp_ns() for row in table('time\n0\n0.5\n')] == [1, 500_000_000]
    missing, there = table('time\n0\n1568052068\n')
    assert there.stamp_ns() == 1568052068 * 10**9
    with pytest.raises(BadRow, match='time unit'):
        missing.stamp_ns()


def test_what_was_taken_and_what_was_not(table):
    rows = table('Time [s],east,y,quality,\n5,1,2,3,4\n')
    for row in rows:
        row.stamp_ns(), row.number('x'), row.number('y'), row.optional('z')
    assert rows.columns_used() == ('stamp = Time [s], x = east, y', 'quality, (no name)')


def test_numbers(table):
    (row,) = table('x,y,z,vx,lat\n1.5, abc ,,inf,59 25.8 N\n')
    assert row.number('x') == 1.5 and row.optional('z') != row.optional('z')
    for name, words in (
        ('y', "y is 'abc', not a number"),
        ('latitude', "lat is '59 25.8 N', not a number"),
        ('z', 'z is empty'),
        ('vx', 'infinite'),
        ('depth', 'depth is empty'),
    ):
        with pytest.raises(BadRow, match=words):
            row.number(name)


def test_a_decimal_comma_is_read_between_semicolons(table):
    (row,) = table('time;x\n1,5;2,25\n', time_offset_ns=1)
    assert row.number('x') == 2.25 and row.stamp_ns() == 1_500_000_001


def test_lines_keep_their_numbers_past_comments_and_blanks(table):
    rows = list(table('# from a logger\n\ntime,x\n# more\n5,1\n\n6\n'))
    assert [row.line for row in rows] == [5, 7] and rows[1].text('x') == ''


@pytest.mark.parametrize('content', [b'', b'\n\n', b'\0\0\0\0', b'# only a comment\n'])
def test_what_is_no_csv_is_one_sentence(table, content):
    with pytest.raises(BagError, match='not a CSV file'):
        table(content)


def test_a_missing_file_is_one_sentence(tmp_path):
    with pytest.raises(BagError, match='cannot be read: No such file'):
        CsvTable(tmp_path / 'no.csv')


@given(st.binary(max_size=120))
@settings(max_examples=300, deadline=None)
def test_any_bytes_give_rows_bad_rows_or_a_bag_error(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / 'any.csv'
    path.write_bytes(b'time,x,y\n' + content)
    try:
        for row in CsvTable(path):
            try:
                assert row.stamp_ns() > 0 and row.number('x') == row.number('x')
            except BadRow as error:
                assert str(error)
    except BagError as error:
        assert error.sentence


@pytest.mark.parametrize(
    'content',
    [
        b'stamp,x\n\x00\x01\x02',
        b'\x89PNG\r\n\x1a\n' + bytes(range(256)),
        b'\xff\xfe\xfd' * 99,
        b'PK\3\4',
    ],
)
def test_a_file_that_is_no_text_is_no_table(table, content):
    with pytest.raises(BagError, match='no text'):
        table(content)


def test_a_byte_of_another_alphabet_is_text(table):
    assert table(b'time,east,note\n5,1,M\xfcnchen\n').has('stamp', 'x')


def test_text_in_utf_16_is_said(tmp_path):
    (tmp_path / 'wide.csv').write_bytes('stamp,x,y\n1,2,3\n'.encode('utf-16'))
    with pytest.raises(BagError, match='is text in UTF-16'):
        CsvTable(tmp_path / 'wide.csv')


def test_a_line_without_an_end_takes_no_room(tmp_path):
    """Text of 64 MB without a line feed: what is held of it is a part of a megabyte or so."""
    path = tmp_path / 'endless.csv'
    for head in (b'', b'stamp,x,y\n'):
        path.write_bytes(head + b'1' * (1 << 26))
        tracemalloc.start()
        with pytest.raises(BagError, match='no line of a CSV file|no column'):
            made = CsvTable(path)
            made.require('stamp')
            list(made)
        assert tracemalloc.get_traced_memory()[1] < 1 << 24
        tracemalloc.stop()
