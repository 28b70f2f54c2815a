# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables as text: columns, numbers and lines, and what their times mean."""

from datetime import datetime, timezone
import tracemalloc

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.recordings.table_files import CsvTable
from sonar_imm_tools.recordings.tables import CsvOptions
from sonar_imm_tools.recordings.times import BadRow


def test_usual_names_and_delimiters_are_recognised(table):
    for header in (
        'stamp,x,y', 'Time [s];East (m);North (m)', 'timestamp\teasting\tnorthing', 'T  X  Y',
        '\ufefftime_s | east_m | north_m', '"Unix Time","UTM_E","UTM_N"',
    ):  # fmt: skip
        found = table(header + '\n')
        assert [found.index.get(name) for name in ('stamp', 'x', 'y')] == [0, 1, 2]
    # Columns mapped by hand win, and a missing one is named with what is there.
    found = table('time,x,a\n5,1,2\n', columns={'x': 'a'})
    assert next(iter(found)).number('x') == 2.0
    with pytest.raises(BagError, match='no column for x and y; it has time, foo'):
        table('time,foo\n').require('stamp', 'x', 'y')
    for options, words in (
        ({'columns': {'x': 'eest'}}, "no column 'eest' (did you mean 'east'?)"),
        ({'columns': {'xx': 'east'}}, "no quantity 'xx'"),
        ({'time_unit': 'week'}, 's, ms, us, ns'),
    ):
        with pytest.raises(BagError) as caught:
            table('time,east\n', **options)
        assert words in caught.value.sentence


TIMES = [
    ('stamp_s', '1568052068.920238', 1568052068920238000),
    ('time', '1568052068.920238123', 1568052068920238123),
    ('time_ms', '1568052068920.5', 1568052068920500000),
    ('time_us', '1568052068920238', 1568052068920238000),
    ('time_ns', '1568052068920238123', 1568052068920238123),
    ('time [ms]', '1568052068920', 1568052068920000000),
    ('time', '1.568052068e9', 1568052068000000000),
    ('time', '2019-09-09T18:01:08.920238123Z', 1568052068920238123),
    ('time_utc', '2019-09-09 18:01:08', 1568052068000000000),
    ('time', '0', 1), ('time', '1,5', 1_500_000_000),
    ('time', '2019-09-09T20:01:08,5+02:00', 1568052068500000000),
    ('time', '2019-09-09T14:01:08-0400', 1568052068000000000),
    # date and time of day in two columns
    ('date;time_utc', '2019-09-09;18:01:08.5', 1568052068500000000),
    ('UTC Date;time', '2019/9/9;18:01:08', 1568052068000000000),
    ('date;time', '20190909;20:01:08+02:00', 1568052068000000000),
    ('day;utc', '9.9.2019;6:01', 1568008860000000000),
    ('date;time', '2019-09-09;1568052068', 1568052068000000000),
]  # fmt: skip


def test_times_are_exact_in_every_unit(table):
    for header, cell, stamp in TIMES:
        (row,) = table(f'{header};x\n{cell};1\n')
        assert row.stamp_ns() == stamp
        (later,) = table(f'{header};x\n{cell};1\n', time_offset_ns=10**17)
        assert later.stamp_ns() - (stamp if cell != '0' else 0) == 10**17


def test_bad_times_are_bad_rows(table):
    for cell, words in (
        ('', 'not a time'), ('noon', "'noon', not a time"), ('nan', 'not a time'),
        ('-5', 'time unit'), ('1568052068920238123', 'time unit'), ('1e400', 'time unit'),
        ('inf', 'time unit'), ('1e9999999999', ''), ('18:01:08', 'no column holds the date'),
        ('2019-09-09 18:01:08', '--time-zone UTC'), ('2019-13-45T00:00:00Z', 'calendar'),
    ):  # fmt: skip
        (row,) = table(f'time,x\n{cell},1\n')
        with pytest.raises(BadRow) as caught:
            row.stamp_ns()
        assert words in str(caught.value)


def test_a_zone_can_be_stated_and_that_of_a_cell_wins(table):
    text = 'time,x\n2019-09-09 18:01:08,1\n2019-09-09 18:01:08Z,1\n'
    for zone, stamp in (
        ('UTC', 1568052068), ('+02:00', 1568044868), ('-0330', 1568064668),
        ('Europe/Berlin', 1568044868),  # summer time
    ):  # fmt: skip
        first, second = table(text, time_zone=zone)
        assert first.stamp_ns() == stamp * 10**9 and second.stamp_ns() == 1568052068 * 10**9
    with pytest.raises(BagError, match='no time zone'):
        CsvOptions(time_zone='Berlin')


def test_zero_is_a_time_where_the_file_counts_from_its_start(table):
    assert [row.stamp_ns() for row in table('time\n0\n0.5\n')] == [1, 500_000_000]
    missing, there = table('time\n0\n1568052068\n')
    assert there.stamp_ns() == 1568052068 * 10**9
    with pytest.raises(BadRow, match='time unit'):
        missing.stamp_ns()


def test_numbers_and_lines_and_what_was_taken(table, tmp_path):
    rows = table('Time [s],east,y,quality,\n5,1,2,3,4\n')
    for row in rows:
        row.stamp_ns(), row.number('x'), row.number('y'), row.optional('z')
    assert rows.columns_used() == ('stamp = Time [s], x = east, y', 'quality, (no name)')
    (row,) = table('x,y,z,vx,lat\n1.5, abc ,,inf,59 25.8 N\n')
    assert row.number('x') == 1.5 and row.optional('z') != row.optional('z')
    for name, words in (
        ('y', "y is 'abc', not a number"), ('latitude', "lat is '59 25.8 N', not a number"),
        ('z', 'z is empty'), ('vx', 'infinite'), ('depth', 'depth is empty'),
    ):  # fmt: skip
        with pytest.raises(BadRow, match=words):
            row.number(name)
    # Lines keep their numbers past comments and blanks.
    rows = list(table('# from a logger\n\ntime,x\n# more\n5,1\n\n6\n'))
    assert [row.line for row in rows] == [5, 7] and rows[1].text('x') == ''
    with pytest.raises(BagError, match='cannot be read: No such file'):
        CsvTable(tmp_path / 'no.csv')
    # A byte of another alphabet is text.
    assert table(b'time,east,note\n5,1,M\xfcnchen\n').has('stamp', 'x')


@given(st.binary(max_size=120))
@settings(max_examples=300)
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


def test_a_file_that_is_no_text_is_no_table(table):
    for content, words in (
        (b'', 'not a CSV file'), (b'\n\n', 'not a CSV file'), (b'\0\0\0\0', 'not a CSV file'),
        (b'# only a comment\n', 'not a CSV file'), (b'stamp,x\n\x00\x01\x02', 'no text'),
        (b'\x89PNG\r\n\x1a\n' + bytes(range(256)), 'no text'), (b'\xff\xfe\xfd' * 99, 'no text'),
        (b'PK\3\4', 'no text'), ('stamp,x,y\n1,2,3\n'.encode('utf-16'), 'is text in UTF-16'),
    ):  # fmt: skip
        with pytest.raises(BagError, match=words):
            table(content)


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


# -- times


@pytest.fixture
def stamps(table):
    def read(header, *cells, **options):
        return [row.stamp_ns() for row in table('\n'.join([header, *cells]) + '\n', **options)]

    return read


def ns(text):
    moment = datetime.fromisoformat(text).replace(tzinfo=timezone.utc)
    return round(moment.timestamp() * 1e6) * 1000


FORMS = [
    ('Date,Time', ['20210504,095958'], '2021-05-04 09:59:58'),
    ('Date,Time', ['2021-05-04,95958', '2021-05-04,100000'], '2021-05-04 09:59:58'),
    ('Datum,Zeit', ['04.05.2021,000001', '04.05.2021,000002'], '2021-05-04 00:00:01'),
    ('Date,Time', ['20210504,095958.250'], '2021-05-04 09:59:58.25'),
    ('Date,Time', ['20210504,10259', '20210504,10300', '20210504,10301'], '2021-05-04 01:02:59'),
    ('time,x', ['12-Sep-2017 16:58:26.960,1'], '2017-09-12 16:58:26.96'),
    ('time,x', ['12. Okt 2017 16:58:26,1'], '2017-10-12 16:58:26'),
    ('time,x', ['12 août 2017 16:58:26,1'], '2017-08-12 16:58:26'),
    ('time,x', ['3-ene-2017 16:58:26,1'], '2017-01-03 16:58:26'),
    ('time;x', ['Sep 3, 2017 16:58:26;1'], '2017-09-03 16:58:26'),
    ('date,time', ['9 Sep 2019,18:01:08'], '2019-09-09 18:01:08'),
    ('date,time', ['25/12/2019,18:01:08', '05/12/2019,18:01:08'], '2019-12-25 18:01:08'),
    ('date,time', ['12/25/2019,18:01:08', '12/05/2019,18:01:08'], '2019-12-25 18:01:08'),
    ('Hora UTC,x', ['2019-12-25 18:01:08,1'], '2019-12-25 18:01:08'),
    ('Date (UTC);Heure UTC', ['25-12-2019;18:01:08'], '2019-12-25 18:01:08'),
    ('date,time', ['25-12-19,18:01:08', '05-13-19,18:01:08'], 'no date'),
    ('date,time', ['2512 19,18:01:08'], 'no date'),
    ('date,time', ['191225,18:01:08', '191301,18:01:08'], 'no date'),
    ('time,x', ['12/25/2019 6:01:08 PM,1'], '2019-12-25 18:01:08'),
    ('time,x', ['2019-12-25 12:01:08 AM,1'], '2019-12-25 00:01:08'),
    ('time,x', ['2019/12/25 18:01:08,1'], '2019-12-25 18:01:08'),
    ('time,x', ['2019-12-25 18:01:08 UTC,1'], '2019-12-25 18:01:08'),
    ('time,x', ['20191225T180108Z,1'], '2019-12-25 18:01:08'),
    ('time,x', ['20191225180108,1'], '2019-12-25 18:01:08'),
    ('time,x', ['2016-12-31 23:59:60,1'], '2017-01-01 00:00:00'),
    ('datenum,x', ['737061.75,1'], '2018-01-01 18:00:00'),
    ('excel_time,x', ['43101.75,1'], '2018-01-01 18:00:00'),
    ('JD,x', ['2458120.25,1'], '2018-01-01 18:00:00'),
    ('mjd,x', ['58119.75,1'], '2018-01-01 18:00:00'),
    ('Time (min),x', ['1.5,1'], '1970-01-01 00:01:30'),
    ('time_h,x', ['9.25,1'], '1970-01-01 09:15:00'),
    ('Temps [jours],x', ['2.5,1'], '1970-01-03 12:00:00'),
    ('time,x', ['2025-06-03 09:00:00-03,1'], '2025-06-03 12:00:00'),
]


def test_forms_of_dates_and_times(stamps):
    for header, cells, wanted in FORMS:
        if wanted == 'no date':
            with pytest.raises(BadRow, match='is no date|several ways'):
                stamps(header, *cells, time_zone='UTC')
        else:
            assert stamps(header, *cells, time_zone='UTC')[0] == ns(wanted)


def test_times_of_day_in_one_number_pass_minutes_and_hours(stamps):
    clock = [f'{h:02d}{m:02d}{s:02d}' for h in (9, 10) for m in (0, 1, 59) for s in (0, 1, 58, 59)]
    found = stamps('Date,Time', *(f'20210504,{text}' for text in clock), time_zone='UTC')
    assert found == [ns(f'2021-05-04 {text[:2]}:{text[2:4]}:{text[4:]}') for text in clock]
    # Such a one needs a date.
    with pytest.raises(BadRow, match='a time of day as HHMMSS, and no column holds the date'):
        stamps('time,x', *(f'{clock},1' for clock in ('095958', '095959', '100000')))


def test_two_readings_are_a_question_with_an_option_for_each(stamps):
    for header, cells, words, options in (
        ('Date,Time', ['20210504,10203', '20210504,10204'], 'HHMMSS or seconds',
         {'HHMMSS': '2021-05-04 01:02:03', 's': '2021-05-04 02:50:03'}),
        ('time,x', ['736950.70795,1', '736950.70796,1', '736950.70797,1'],
         'may count days .datenum. or seconds',
         {'datenum': '2017-09-12 16:59:26.880', 's': '1970-01-09 12:42:30.70795'}),
        ('time,x', ['45000.50000,1', '45000.50001,1', '45000.50002,1'],
         'may count days .excel. or seconds',
         {'excel': '2023-03-15 12:00:00', 's': '1970-01-01 12:30:00.5'}),
        ('gps_time,x', ['1432980012.25,1', '1432980013.25,1'], 'GPS time, since 1980',
         {'gps': '2025-06-03 09:59:54.25', 's': '2015-05-30 10:00:12.25'}),
    ):  # fmt: skip
        with pytest.raises(BagError, match=words):
            stamps(header, *cells, time_zone='UTC')
        for unit, wanted in options.items():
            assert stamps(header, *cells, time_zone='UTC', time_unit=unit)[0] == ns(wanted)


def test_the_order_of_a_date_is_asked_for_and_stated(stamps):
    for date, order, wanted in (
        ('05/06/2019', 'DMY', '2019-06-05'), ('05/06/2019', 'MDY', '2019-05-06'),
        ('12-Sep-17', 'DMY', '2017-09-12'), ('12-Sep-17', 'YMD', '2012-09-17'),
        ('190917', 'DMY', '2017-09-19'), ('190917', 'YMD', '2019-09-17'),
    ):  # fmt: skip
        cells = f'{date},18:01:08'
        with pytest.raises(BadRow, match=f'--date-order .*{order}'):
            stamps('date,time', cells, time_zone='UTC')
        found = stamps('date,time', cells, time_zone='UTC', date_order=order)
        assert found == [ns(f'{wanted} 18:01:08')]


def test_the_fraction_of_a_second_beside(stamps):
    """One in both columns counts once and has to agree."""
    for column, cell, part in (
        ('Millisecond', '250', 250_000_000), ('Millisekunden', '250', 250_000_000),
        ('Milliseconds', '0', 0), ('usec', '250000', 250_000_000), ('Nanoseconds', '250', 250),
        ('Fraction', '.25', 250_000_000), ('ms_fraction', '250', 0),
        ('Milliseconds', '123456', 0), ('Fraction', '2.5', 0),  # of something else
    ):  # fmt: skip
        wanted = ns('2021-05-04 10:00:00') + part
        assert stamps(f'time,{column}', f'2021-05-04T10:00:00Z,{cell}') == [wanted]
    both = 'time,Millisecond', '2021-05-04T10:00:00.250Z,{}'
    assert stamps(both[0], both[1].format(250)) == [ns('2021-05-04 10:00:00.25')]
    with pytest.raises(BadRow, match='another part of a second'):
        stamps(both[0], both[1].format(750))


def test_counts_of_seconds_stay(stamps):
    for numbers in (range(1, 30), range(100000, 100090), [0.1, 0.2]):
        found = stamps('time,x', *(f'{number},1' for number in numbers))
        assert found == [round(number * 1e9) for number in numbers]


def test_zones_of_headers(stamps):
    for header, wanted in (
        ('Date Time (GMT+02:00)', '08:00'), ('"Date Time, GMT-05:00"', '15:00'),
        ('time_utc_+2', '08:00'), ('Zeit (UTC -3)', '13:00'), ('Time [UTC+0530]', '04:30'),
        ('Time (UTC)', '10:00'),
    ):  # fmt: skip
        columns = {'columns': {'stamp': header}} if header.startswith('time_') else {}
        found = stamps(f'{header},x', '2021-05-04 10:00:00,1', **columns)
        assert found == [ns(f'2021-05-04 {wanted}')]


def test_numbers_beside_a_date_count_from_its_midnight_or_are_asked(stamps):
    for cells, unit, wanted in (
        (['2021-05-04,36000.5', '2021-05-04,36001.5'], 's', '2021-05-04 10:00:00.5'),
        (['04.05.2021,0.4375', '04.05.2021,0.43751'], 'excel', '2021-05-04 10:30:00'),
    ):
        with pytest.raises(BagError, match=f'--time-unit {unit} or --ignore date'):
            stamps('Date,Time', *cells, time_zone='UTC')
        for zone, ahead in (('UTC', 0), ('+02:00', 7200)):
            found = stamps('Date,Time', *cells, time_zone=zone, time_unit=unit)[0]
            assert found == ns(wanted) - ahead * 10**9
        alone = stamps('Date,Time', *cells, ignore=['date'])[0]
        assert alone == float(cells[0].split(',')[1]) * 1e9


def test_times_within_a_clock_change_are_left_out(stamps):
    """One is twice on the clocks of Berlin, the other one never."""
    for text in ('2024-10-27 02:30:00', '2024-03-31 02:30:00'):
        with pytest.raises(BadRow, match='twice, or not at all.*--time-zone'):
            stamps('time,x', f'{text},1', time_zone='Europe/Berlin')
        assert stamps('time,x', f'{text},1', time_zone='+01:00') == [ns(text) - 3600 * 10**9]
