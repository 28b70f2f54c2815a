# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""What times of tables mean: input, and the expected value or sentence."""

from datetime import datetime, timezone

import pytest

from sonar_imm_tools.recordings.csv_table import CsvTable
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.recordings.tables import CsvOptions
from sonar_imm_tools.recordings.times import BadRow


@pytest.fixture
def stamps(tmp_path):
    def read(header, *cells, **options):
        path = tmp_path / 'a.csv'
        path.write_text('\n'.join([header, *cells]) + '\n', encoding='utf-8')
        return [row.stamp_ns() for row in CsvTable(path, CsvOptions(**options))]

    return read


def ns(text):
    moment = datetime.fromisoformat(text).replace(tzinfo=timezone.utc)
    return round(moment.timestamp() * 1e6) * 1000


@pytest.mark.parametrize(
    'header, cells, wanted',
    [
        ('Date,Time', ['20210504,095958'], '2021-05-04 09:59:58'),
        ('Date,Time', ['2021-05-04,95958', '2021-05-04,100000'], '2021-05-04 09:59:58'),
        ('Datum,Zeit', ['04.05.2021,000001', '04.05.2021,000002'], '2021-05-04 00:00:01'),
        ('Date,Time', ['20210504,095958.250'], '2021-05-04 09:59:58.25'),
        ('Date,Time', ['20210504,10259', '20210504,10300', '20210504,10301'],
         '2021-05-04 01:02:59'),
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
    ],
)  # fmt: skip
def test_forms_of_dates_and_times(stamps, header, cells, wanted):
    if wanted == 'no date':
        with pytest.raises(BadRow, match='is no date|several ways'):
            stamps(header, *cells, time_zone='UTC')
    else:
        assert stamps(header, *cells, time_zone='UTC')[0] == ns(wanted)


def test_times_of_day_in_one_number_pass_minutes_and_hours(stamps):
    clock = [f'{h:02d}{m:02d}{s:02d}' for h in (9, 10) for m in (0, 1, 59) for s in (0, 1, 58, 59)]
    found = stamps('Date,Time', *(f'20210504,{text}' for text in clock), time_zone='UTC')
    assert found == [ns(f'2021-05-04 {text[:2]}:{text[2:4]}:{text[4:]}') for text in clock]


@pytest.mark.parametrize(
    'header, cells, words, options',
    [
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
    ],
)  # fmt: skip
def test_two_readings_are_a_question_with_an_option_for_each(
    stamps, header, cells, words, options
):
    with pytest.raises(BagError, match=words):
        stamps(header, *cells, time_zone='UTC')
    for unit, wanted in options.items():
        assert stamps(header, *cells, time_zone='UTC', time_unit=unit)[0] == ns(wanted)


@pytest.mark.parametrize(
    'date, order, wanted',
    [
        ('05/06/2019', 'DMY', '2019-06-05'),
        ('05/06/2019', 'MDY', '2019-05-06'),
        ('12-Sep-17', 'DMY', '2017-09-12'),
        ('12-Sep-17', 'YMD', '2012-09-17'),
        ('190917', 'DMY', '2017-09-19'),
        ('190917', 'YMD', '2019-09-17'),
    ],
)
def test_the_order_of_a_date_is_asked_for_and_stated(stamps, date, order, wanted):
    cells = f'{date},18:01:08'
    with pytest.raises(BadRow, match=f'--date-order .*{order}'):
        stamps('date,time', cells, time_zone='UTC')
    assert stamps('date,time', cells, time_zone='UTC', date_order=order) == [
        ns(f'{wanted} 18:01:08')
    ]


@pytest.mark.parametrize(
    'column, cell, part',
    [
        ('Millisecond', '250', 250_000_000),
        ('ms_fraction', '250', 0),
        ('Milliseconds', '0', 0),
        ('usec', '250000', 250_000_000),
        ('Nanoseconds', '250', 250),
        ('Fraction', '.25', 250_000_000),
        ('Millisekunden', '250', 250_000_000),
        ('Milliseconds', '123456', 0),  # of something else
        ('Fraction', '2.5', 0),
    ],
)
def test_the_fraction_of_a_second_beside(stamps, column, cell, part):
    wanted = ns('2021-05-04 10:00:00') + part
    assert stamps(f'time,{column}', f'2021-05-04T10:00:00Z,{cell}') == [wanted]


def test_a_fraction_in_both_columns_counts_once_and_has_to_agree(stamps):
    assert stamps('time,Millisecond', '2021-05-04T10:00:00.250Z,250') == [
        ns('2021-05-04 10:00:00.25')
    ]
    with pytest.raises(BadRow, match='another part of a second'):
        stamps('time,Millisecond', '2021-05-04T10:00:00.250Z,750')


def test_a_time_of_day_in_one_number_needs_a_date(stamps):
    with pytest.raises(BadRow, match='a time of day as HHMMSS, and no column holds the date'):
        stamps('time,x', *(f'{clock},1' for clock in ('095958', '095959', '100000')))


@pytest.mark.parametrize('numbers', [range(1, 30), range(100000, 100090), [0.1, 0.2]])
def test_counts_of_seconds_stay(stamps, numbers):
    found = stamps('time,x', *(f'{number},1' for number in numbers))
    assert found == [round(number * 1e9) for number in numbers]


@pytest.mark.parametrize(
    'header, wanted',
    [
        ('Date Time (GMT+02:00)', '2021-05-04 08:00:00'),
        ('"Date Time, GMT-05:00"', '2021-05-04 15:00:00'),
        ('time_utc_+2', '2021-05-04 08:00:00'),
        ('Zeit (UTC -3)', '2021-05-04 13:00:00'),
        ('Time [UTC+0530]', '2021-05-04 04:30:00'),
        ('Time (UTC)', '2021-05-04 10:00:00'),
    ],
)
def test_zones_of_headers(stamps, header, wanted):
    columns = {'columns': {'stamp': header}} if header.startswith('time_') else {}
    assert stamps(f'{header},x', '2021-05-04 10:00:00,1', **columns) == [ns(wanted)]


@pytest.mark.parametrize(
    'cells, unit, wanted',
    [
        (['2021-05-04,36000.5', '2021-05-04,36001.5'], 's', '2021-05-04 10:00:00.5'),
        (['04.05.2021,0.4375', '04.05.2021,0.43751'], 'excel', '2021-05-04 10:30:00'),
    ],
)
def test_numbers_beside_a_date_count_from_its_midnight_or_are_asked(stamps, cells, unit, wanted):
    with pytest.raises(BagError, match=f'--time-unit {unit} or --ignore date'):
        stamps('Date,Time', *cells, time_zone='UTC')
    assert stamps('Date,Time', *cells, time_zone='UTC', time_unit=unit)[0] == ns(wanted)
    later = stamps('Date,Time', *cells, time_zone='+02:00', time_unit=unit)
    assert later[0] == ns(wanted) - 7200 * 10**9
    assert stamps('Date,Time', *cells, ignore=['date'])[0] == float(cells[0].split(',')[1]) * 1e9


@pytest.mark.parametrize('text', ['2024-10-27 02:30:00', '2024-03-31 02:30:00'])
def test_times_within_a_clock_change_are_left_out(stamps, text):
    """One is twice on the clocks of Berlin, the other one never."""
    with pytest.raises(BadRow, match='twice, or not at all.*--time-zone'):
        stamps('time,x', f'{text},1', time_zone='Europe/Berlin')
    assert stamps('time,x', f'{text},1', time_zone='+01:00') == [ns(text) - 3600 * 10**9]
