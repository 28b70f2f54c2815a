# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""What columns of tables mean: input, and the expected value or sentence."""

import re

from helpers.field_files import measured
import pytest

from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.convert import sniff
from sonar_imm_tools.recordings.places import Degrees
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.recordings.tables import CsvOptions
from sonar_imm_tools.recordings.times import BadRow

HEADERS = """
Zeitpunkt;Geogr. Breite;Geogr. Länge;Tiefe -> stamp latitude longitude depth
Zeitstempel;Breitengrad;Längengrad;Genauigkeit -> stamp latitude longitude std
Uhrzeit;Rechtswert;Hochwert;Gültig -> stamp x y valid
Horodatage;Est;Nord;Écart-type;Valide -> stamp x y std valid
Date;Heure;Latitude;Longitude;Profondeur -> date stamp latitude longitude depth
Fecha;Hora;Latitud;Longitud;Profundidad -> date stamp latitude longitude depth
Dato;Klokkeslett;Breddegrad;Lengdegrad;Dybde -> date stamp latitude longitude depth
Tidspunkt;Øst;Nord;Navn -> stamp x y id
Data;Hora;Leste;Norte;Alvo -> date stamp x y id
BaseDateTime;MMSI;LAT;LON -> stamp id latitude longitude
Zeit;Schiff Breite;Schiff Länge -> stamp vessel_latitude vessel_longitude
Heure;Latitude navire;Longitude navire -> stamp vessel_latitude vessel_longitude
time;Boat Easting;Boat Northing;Gyro -> stamp vessel_x vessel_y heading
time;Distance;Relèvement;Cap -> stamp range bearing heading
Zeit;Entfernung;Peilung;Zielnummer -> stamp range bearing id
time;Target Lat;Target Lon -> stamp latitude longitude
Latitude_deg;lon [deg] -> latitude longitude
GPS Lat;GPS Long -> latitude longitude
lat_dd;lon_dd -> latitude longitude
Zeitstempel;Empfänger;Sender-ID -> stamp receiver tag
Tid;x fartoy;y fartoy;Forover (m);Styrbord (m) -> stamp vessel_x vessel_y forward starboard
heading;Voraus;Steuerbord -> heading forward starboard
Fecha y hora;Receptor;Transmisor -> stamp receiver tag
Tempo;Alcance;Azimute;Rumo -> stamp range bearing heading
Time;Rng (NM);rel_bearing;Rumbo buque -> stamp range bearing heading
"""


def test_headers_in_six_languages(table):
    for line in HEADERS.strip().splitlines():
        headers, found = line.split(' -> ')
        index = table(f'{headers}\n').index
        assert [index.get(name) for name in found.split()] == list(range(len(found.split()))), line
    # The position of the target comes first, and a hemisphere is no northing.
    assert 'y' not in table('time,lat,N/S,lon,E/W\n').index
    made = table('time,lat,lon,target_lat,target_lon\n')
    assert (made.index['latitude'], made.index['longitude']) == (3, 4)


def test_units_of_headers_are_heeded(table):
    for name, header, cell, value in (
        ('x', 'East (km)', 1.5, 1500.0), ('x', 'x_cm', 150, 1.5),
        ('depth', 'Depth (ft)', 10, 3.048), ('depth', 'depth_ft', 10, 3.048),
        ('depth', 'Depth (below surface)', 10, 10), ('depth', 'Tiefe [m]', 10, 10),
        ('range', 'Range [km]', 0.2, 200), ('range', 'Distance (NM)', 1, 1852),
        ('var_x', 'var_x_cm2', 1e4, 1), ('var_x', 'var_x [m^2]', 4, 4),
        ('vx', 'vx (kn)', 1, 0.514444), ('std_toa', 'std_toa_ms', 2, 0.002),
        ('heading', 'Heading [rad]', 1.5707963, 90), ('heading', 'Heading (°T)', 90, 90),
        ('latitude', 'lat_rad', 1.0372492, 59.43), ('bearing', 'bearing', 0.5, 0.5),
        ('bearing', 'bearing_deg', 180, 3.14159265), ('bearing', 'Peilung [°]', 180, 3.14159265),
        ('x', 'Est (pieds)', 10, 3.048), ('x', 'East [yd]', 100, 91.44),
        ('y', 'X (North)', 3, 3), ('x', 'Y (Rechtswert)', 3, 3),
    ):  # fmt: skip
        (row,) = table(f'{header};time\n{cell};1\n')
        assert row.number(name) == pytest.approx(value, rel=1e-5), header


def test_a_unit_of_another_kind_is_refused(table):
    for header in ('x [px]', 'East (deg)', 'Depth (dbar)', 'Länge [m],lat'):
        made = table(f'{header},time\n1,1,1\n')
        (row,) = made
        with pytest.raises(BagError, match='name another column with --column'):
            row.number(next(iter(set(made.index) - {'latitude', 'stamp'})))


PLACES = [
    ('LATITUDE,N/S,LONGITUDE,E/W', '33.5,S,70.25,W', (-33.5, -70.25)),
    ('lat,lat_dir,lon,lon_dir', '33.5,N,70.25,W', (33.5, -70.25)),
    ('lat,foo,lon,bar', '33.5,S,70.25,E', (-33.5, 70.25)),
    ('foo,lat,bar,lon', 'south,33.5,west,70.25', (-33.5, -70.25)),
    ('lat,lon,North or South,East or West', '33.5,70.25,Sud,Ouest', (-33.5, -70.25)),
    ('lat,N/S,lon,E/W', '-33.5,S,70.25,E', (-33.5, 70.25)),
    ('lat,N/S,lon,E/W', '3330.00,S,07015.0,W', (-33.5, -70.25)),
    ('lat,lon', '5925.8,01028.2', (59.43, 10.47)),
    ('lat,lon', '-5925.8,00028.2', (-59.43, 0.47)),
    ('lat,lon', '59 25.8 N,10 28.2 E', (59.43, 10.47)),
    ('lat,lon', 'S59 25.8,W10 28.2', (-59.43, -10.47)),
    ('lat,lon', "59°25.8'S,10°28.2'W", (-59.43, -10.47)),
    ('lat,lon', '"59°25\'48.0""N","10°28\'12""W"', (59.43, -10.47)),
    ('lat,lon', '59:25:48,10:28:12', (59.43, 10.47)),
    ('lat,lon', '59d25m48s,10d28m12s', (59.43, 10.47)),
    ('lat,lon', '59d25m48sS,10D28M12S W', (-59.43, -10.47)),
    ('lat,lon', "N 59° 25.8',W 10° 28.2'", (59.43, -10.47)),
    ('lat,lon', '5.943e1,1.047e1', (59.43, 10.47)),
    ('lat,N/S,lon,E/W', '59.43S,S,10.47,W', (-59.43, -10.47)),
    ('lat,lon,NS,EW', '59.43,10.47,3.5,-7', (59.43, 10.47)),
    ('lat,lon', '59.43 S,10.47 W', (-59.43, -10.47)),
    ('lat,lon', '59.43S,10.47W', (-59.43, -10.47)),
    ('lat,lon', '-59 25.8,-10 28.2', (-59.43, -10.47)),
    # O is east beside W, and west beside E
    ('lat,ns,lon,ew', '33,S,70,O\n2,33,S,70,W', (-33.0, 70.0)),
    ('lat,ns,lon,ew', '33,S,70,O\n2,33,S,70,E', (-33.0, -70.0)),
    ('lat,ns,lon,O/W', '33,S,70,O', (-33.0, 70.0)),
    ('lat,ns,lon,E/O', '33,S,70,O', (-33.0, -70.0)),
    # an S of something else, and a diver of that name
    ('lat,lon,foo,mode,bar', '33,70,1,S,2\n2,33,70,1,N,3\n3,33,70,1,A,3', (33.0, 70.0)),
    ('name,lat,lon,id', 'S,33.5,70.25,E', (33.5, 70.25)),
    ('lat_deg,lat_min,lon_deg,lon_min', '-59,25.8,0,28.2', (-59.43, 0.47)),
    ('lat_deg,lat_min,lon_deg,lon_min', '59,25.8,-0,28.2', (59.43, -0.47)),
    ('Breite Grad,Breite Minuten,Länge Grad,Länge Minuten', '59,25.8,10,28.2', (59.43, 10.47)),
    ('Lat Deg,Lat Min,Lat Sec,ns,Lon Deg,Lon Min,Lon Sec,ew', '59,25,48,S,10,28,12,W',
     (-59.43, -10.47)),
    ('Latitude (S),Longitude (°W)', '33.5,70.25', (-33.5, -70.25)),
    ('Latitude (°S),Longitude (E+)', '33.5,-70.25', (-33.5, -70.25)),
    ('Latitud (Norte),Longitud (Oeste)', '33.5,70.25', (33.5, -70.25)),
    ('lat,N/S,lon,E/W', '33.5,X,70.25,W', "hemisphere 'X'"),
    ('lat,N/S,lon,E/W', '33.5,,70.25,W', "hemisphere 'nothing'"),
    ('lat,N/S,lon,E/W', '-33.5,N,70.25,W', "hemisphere 'N'"),
    ('lat,lon', '33.5 E,70.25 N', "hemisphere 'E'"),
    ('lat,N/S,lon,E/W', '33.5 N,S,70.25,W', "hemisphere 'S'"),
    ('lat,lon', '59 75.8,10 28.2', "lat is '59 75.8'"),
    ('lat,lon', '0,0', 'receivers without a fix'),
    ('lat,lon', '0.0000001,0.0000001', 'receivers without a fix'),
    ('lat,lon', '91,181', 'no position in AIS'),
    ('lat,lon', '-999,-999', 'not a position on Earth'),
    ('lat,lon', '59.43,null', 'lon is empty'),
]  # fmt: skip
"""Headers, cells, and the place or why it is none."""


def place_of(made):
    return Degrees(made).place(next(iter(made)))


def test_degrees_in_every_spelling(table):
    for header, cells, place in PLACES:
        made = table(f'time,{header}\n1,{cells}\n')
        if isinstance(place, tuple):
            assert place_of(made) == pytest.approx(place, abs=1e-9), cells
        else:
            with pytest.raises(BadRow, match=place):
                place_of(made)


def test_o_alone_one_hemisphere_and_degrees_exchanged_are_questions(table):
    with pytest.raises(BagError, match='may be east .Ost. or west'):
        Degrees(table('lat,ns,lon,ew\n33,S,70,O\n'))
    text = 'time,Lat,Lon\n1,115.1,-33.5\n'
    with pytest.raises(BagError, match="--column 'latitude=Lon' --column 'longitude=Lat'"):
        Degrees(table(text))
    assert place_of(table(text, columns={'latitude': 'Lon', 'longitude': 'Lat'})) == (-33.5, 115.1)
    for text in ('lat,mode,lon\n33.5,S,70.25\n', 'mode,lat,lon\nS,33.5,70.25\n'):
        with pytest.raises(BagError, match="'latitude_hemisphere=mode' or --ignore latitude_h"):
            Degrees(table(text))
        south = table(text, columns={'latitude_hemisphere': 'mode'})
        assert place_of(south) == (-33.5, 70.25)
        assert place_of(table(text, ignore=['latitude_hemisphere'])) == (33.5, 70.25)


def test_commas_in_numbers(table):
    for text, value in (
        ('time,x\n1,"1,5"\n', 1.5),
        ('time,x\n1,"1,500"\n2,"1,5"\n', 1.5),
        ('time,x\n1,"1,234.5"\n', 1234.5),
        ('time;x\n1;1.234,5\n', 1234.5),
        ('time;x\n1;1,234\n', 1.234),
        ('sep=;\nZeit;x;y\n1;2,5;3\n', 2.5),  # names the delimiter
    ):
        assert next(iter(table(text))).number('x') == value
    with pytest.raises(BadRow, match='thousands or a decimal one'):
        next(iter(table('time,x\n1,"1,500"\n'))).number('x')


FLAGS = [
    ('Status', 'OK Fehler* ok nein* Fehler4?'), ('Statut', 'valide invalide*'),
    ('Estado', 'bueno malo*'), ('Gültig', 'ja nein*'), ('valid', '1 0* true'),
    ('status', 'A V*'), ('status', '4 5 0'), ('status', 'A B C'),
    ('Kvalitet', 'god feil* ok bad*'), ('quality', 'good fair invalid*'),
    ('Fix Quality', 'fix float 0 1 no*'), ('quality', 'n 0 f'),
    ('quality,valid', 'bad,1* ok,0* ok,1'),
]  # fmt: skip


def test_words_for_bad_rows(table):
    """Those with a star; one with a question mark is neither."""
    for header, words in FLAGS:
        rows = table('\n'.join([f'{header},x', *(f'{c.strip("*?")},1' for c in words.split())]))
        for cell, row in zip(words.split(), rows):
            if cell[-1] not in '*?':
                row.require_valid()
                continue
            why = 'flagged as invalid' if cell[-1] == '*' else 'neither true nor false'
            with pytest.raises(BadRow, match=why):
                row.require_valid()


def test_columns_that_may_be_the_vessel_are_a_question(convert):
    for header, cells, named in (
        ('Kurs [°]', '{c}', 'Kurs'), ('heading', '{c}', 'heading'), ('SNR [dB];no', '{c};{k}', ''),
        ('Rumbo buque', '{k}', 'Rumbo buque'), ('ship speed', '3', 'ship speed'),
        ('pos1;pos2', '59.4{c};10.4{c}', 'pos1, pos2'), ('note;port', 'a{k};7', ''),
    ):  # fmt: skip
        rows = [f'{k};50;{k}0;' + cells.format(k=k, c=k * k + 3) for k in range(1, 9)]
        text = '\n'.join([f'time;range;bearing_deg;{header}', *rows]) + '\n'
        if named:
            with pytest.raises(BagError, match=f'{re.escape(named)}.*--bearings north'):
                convert(text)
        how = {'bearings': 'north'} if named else {}
        assert convert(text, out=header, **how).messages == {'/fix': 8}


def test_the_heading_of_a_vessel_is_asked_for_by_the_columns_that_are_left(convert, tmp_path):
    rows = ''.join(f'{k};59,4{k};10,4{k};{80 + k * k};50;{k}0\n' for k in range(1, 9))
    head = 'Zeit;Schiff Breite;Schiff Länge;Kurs [°];Entfernung [m];Peilung [°]\n'
    with pytest.raises(BagError) as caught:
        convert(head + rows, 'relative')
    assert sniff(tmp_path / 'in.csv').kind == 'relative'
    assert "--column 'heading=Kurs [°]'" in caught.value.sentence
    named = CsvOptions(columns={'heading': 'Kurs [°]'})
    assert convert(head + rows, 'relative', options=named).messages['/heading'] == 8


def test_columns_that_are_zero_throughout_give_way_to_filled_ones(convert):
    rows = ''.join(f'{k},0,0.0,59.43,{10.47 + 1e-4 * k}\n' for k in range(9))
    notes = convert('Time,East,North,Lat,Lon\n' + rows).notes
    assert 'latitude = Lat' in notes['columns of in.csv']


def test_two_columns_of_one_quantity_are_a_question(table):
    for name, header, cells, words in (
        ('latitude', 'lat,Latitude,lon', '59.0,59.1,10', 'Latitude and lat may both be latitude'),
        ('latitude', 'lat,Latitude,lon', '59.1,59.1,10', ''),
        ('latitude', 'lat,target_lat,lon,target_lon', '59.0,59.1,10,11', ''),
        ('depth', 'Depth (m),Depth (ft)', '10,32.8', ''),
        ('depth', 'Depth (m),Tiefe', '10,32.8', 'may both be depth'),
        ('heading', 'heading,gyro', '90,95', 'may both be heading'),
        ('x', 'east,easting', '1,2', 'both be x'),
    ):
        text, ways = f'time,{header}\n1,{cells}\n', [{}]
        if words:
            with pytest.raises(BagError, match=words):
                next(iter(table(text))).number(name)
            ways = [{name: column} for column in header.split(',')[:2]]
        assert all(next(iter(table(text, columns=how))).number(name) > 0.0 for how in ways)


def test_metres_and_degrees_that_disagree_are_a_question(convert):
    def text(scale):
        steps = [(k, 1.93 * scale * 57 * k, 10 + 1e-3 * 2 * k) for k in range(20)]
        return 'time,x,y,lat,lon\n' + ''.join(f'{k},{x:.2f},0,59.0,{e:.4f}\n' for k, x, e in steps)

    assert convert(text(1.0)).messages == {'/fix': 20}
    with pytest.raises(BagError, match='--ignore x or --ignore latitude'):
        convert(text(3.0), out='no')
    for name, column in (('x', 'latitude = lat'), ('latitude', 'x')):
        notes = convert(text(3.0), out=f'no_{name}', options=CsvOptions(ignore=[name])).notes
        assert column in notes['columns of in.csv']


def test_degrees_that_are_called_otherwise_are_a_question(convert):
    degrees, radians = (-10.25, 54.5), (0.951204, -0.178896)
    for k, (header, (x, y), step, words, answer) in enumerate((
        ('x,y', degrees, 1e-5, 'as degrees do.*--column longitude=x', 'latitude=y'),
        ('x,y', degrees, 1e-5, 'or for metres --column x=x --column y=y', 'y=y'),
        ('lat,lon', radians, 1.6e-7, 'degrees or radians', 'latitude_rad'),
        ('x,y', degrees, 0.3, '', ''), ('x [m],y [m]', degrees, 1e-5, '', ''),
        ('lat_rad,lon_rad', radians, 1.6e-7, '', ''),
        ('lat,lon', (0.951204, -3.178896), 1e-5, '', ''),
    )):  # fmt: skip
        text = f'time,{header}\n' + ''.join(f'{k},{x:.9f},{y + step * k:.9f}\n' for k in range(9))
        if words:
            with pytest.raises(BagError, match=words) as caught:
                convert(text)
            assert answer in str(caught.value)
        how = CsvOptions(columns={'x': 'x', 'y': 'y'} if answer == 'y=y' else {})
        if not words or answer == 'y=y':
            assert convert(text, out=f'{k}', options=how).messages == {'/fix': 9}


def test_positions_beside_range_and_bearing_are_a_question(convert):
    """Those of the target or those of a vessel: each reading has its option."""
    rows = ''.join(f'{k};59.4;10.{k};{80 + k * k};50;{k}0\n' for k in range(1, 9))
    for places in ('lat;lon', 'Breite;Länge', 'x;y'):
        text = f'time;{places};heading;range;bearing_deg\n{rows}'
        with pytest.raises(BagError) as caught:
            convert(text)
        sentence = caught.value.sentence
        assert '--ignore range' in sentence and 'convert relative' in sentence
        how = CsvOptions(ignore=['range'])
        assert convert(text, out=places, options=how).messages == {'/fix': 8}
        pairs = re.findall("--column '(vessel_[a-z]+)=([^']+)'", sentence)
        how = CsvOptions(columns=dict(pairs))
        assert convert(text, 'relative', f'{places}2', options=how).messages['/relative'] == 8


def test_bearings_whose_word_is_of_another_direction_are_a_question(convert):
    parts = {'relative': ('boat_x;boat_y;heading;range', '0;{k};90;50'), 'fixes': ('range', '50')}
    for kind, header, asked in (
        ('relative', 'Azimut [°]', True), ('relative', 'Demora (°)', True),
        ('relative', 'Bearing true (deg)', True), ('relative', 'Gisement [deg]', False),
        ('relative', 'bearing_deg', False), ('fixes', 'Gisement [deg]', True),
        ('fixes', 'relative_bearing_deg', True), ('fixes', 'Relèvement [deg]', False),
    ):  # fmt: skip
        head, cells = parts[kind]
        rows = ''.join(f'{k};{cells.format(k=k)};{k}0\n' for k in range(1, 9))
        text, ways = f'time;{head};{header}\n{rows}', [{}]
        if asked:
            with pytest.raises(BagError, match='--bearings (bow or --bearings n|north or --bear)'):
                convert(text, kind)
            known = ('north', 'bow') if kind == 'relative' else ()
            ways = [{'bearings': bearings} for bearings in known]
        for n, how in enumerate(ways):
            assert convert(text, kind, f'{kind}{header}{n}', **how).messages


def test_a_depth_that_is_not_tracked_is_said_and_the_advice_helps(convert):
    text = 'time;x;y;Tiefe [m]\n' + ''.join(f'{k};1;{k};6,0\n' for k in range(1, 9))
    note = convert(text).notes['depth']
    assert 'Tiefe [m] is not tracked' in note and '--depth-std' in note
    report = convert(text, out='with', depth_std=0.5)
    assert report.notes['depth'] == 'is tracked with --set dimensions=3'
    first = measured(report.path)[0]
    assert first.position[2] == -6.0 and first.covariance[2, 2] == 0.25


def test_positions_near_a_stated_origin_only_when_exchanged_are_a_question(convert):
    exchanged = CsvOptions(columns={'latitude': 'lon', 'longitude': 'lat'})
    with pytest.raises(BagError, match="--column 'latitude=lon' --column 'longitude=lat'"):
        convert('time,lat,lon\n1,10.47,59.43\n', origin=(59.4, 10.4))
    for place, how in (('10.47,59.43', exchanged), ('59.43,10.47', None), ('-20,150', None)):
        text, out = f'time,lat,lon\n1,{place}\n', f'out_{place}'
        assert convert(text, out=out, origin=(59.4, 10.4), options=how).messages


def test_a_depth_that_is_negative_throughout_is_asked_about(convert):
    for depths, asked in (((-5, -6), True), ((-0.1, 6), False), ((0, 0), False)):
        rows = ''.join(f'{k},1,{k},{depth}\n' for k, depth in enumerate(depths, start=1))
        report = convert(f'time,x,y,Depth\n{rows}', out=f'out{depths}')
        assert any("'z=Depth' meant" in question for question in report.questions) == asked
    how = CsvOptions(columns={'z': 'Depth'})
    assert not convert('time,x,y,Depth\n1,1,1,-5\n2,1,2,-6\n', out='up', options=how).questions


def test_names_of_targets_travel_to_the_export(convert, tmp_path):
    """From the table by bag and run.json to the name of the track."""
    of_vessel = 'time;boat_lat;boat_lon;heading;range;bearing_deg;Zielname'
    for kind, head, cells in (
        ('fixes', 'time;lat;lon;Name', '{k};59.4;{x};Schmidt'),
        ('relative', of_vessel, '{k};59.4;{x};90;50;10;Schmidt'),
    ):
        rows = [cells.format(k=k, x=10.0 + 1e-5 * k) for k in range(1, 31)]
        bag = convert('\n'.join([head, *rows]) + '\n', kind, kind).path
        assert main(['track', str(bag), str(tmp_path / f'run_{kind}')]) == 0
        for end in ('gpx', 'kml', 'geojson', 'csv'):
            out = tmp_path / f'{kind}.{end}'
            assert main(['export', str(tmp_path / f'run_{kind}'), str(out)]) == 0
            wanted = '<name>Schmidt</name>' if end == 'gpx' else 'Schmidt'
            assert wanted in out.read_text(encoding='utf-8')


def test_forms_that_were_found_out_are_said(convert):
    rows = ''.join(f'25/12/2019;0959{k};5925.8;01028.{k}\n' for k in range(10, 20))
    notes = convert('Date;Time;Lat;Lon\n' + rows, options=CsvOptions(time_zone='UTC')).notes
    assert notes['stamp of in.csv'] == 'Time is HHMMSS'
    assert notes['date of in.csv'] == 'Date is DMY'
    assert 'DDMM.MM' in notes['degrees']


def test_units_in_a_row_below_the_headers(table):
    made = table('time,x,bearing,depth (ft)\n(min),km,rad,m\n1.5,2,0.5,10\n')
    (row,) = made
    assert (row.number('x'), row.number('depth')) == (2000.0, pytest.approx(3.048))
    assert row.stamp_ns() == 90 * 10**9
    assert made.with_unit('bearing') == 'bearing [rad]'
    # A row of words that are no units is a row.
    assert len(list(table('time,x,id\n1,2,km\n'))) == 1
    assert len(list(table('time,x,status\nnone,none,bad\n1,2,ok\n'))) == 2


def test_letters_below_n_and_e_are_hemispheres_and_an_altitude_beside_a_depth_is_no_height(
    convert,
):
    report = convert('time,lat,N,lon,E\n1,33.5,S,70.25,W\n2,33.6,S,70.25,W\n')
    assert measured(report.path)[1].position[1] == pytest.approx(-11_094, abs=10)
    report = convert('time,lat,lon,depth,altitude\n1,59.43,10.47,12.5,3.2\n', out='other')
    assert measured(report.path)[0].position == pytest.approx([0.0, 0.0, -12.5], abs=1e-6)


def test_ranges_are_slant_or_horizontal_where_the_depth_matters(convert):
    for header, ranges, depth, x in (
        ('slant range', '', 30, 40.0), ('Distance oblique (m)', '', 30, 40.0),
        ('range', 'slant', 30, 40.0), ('range', 'horizontal', 30, 50.0),
        ('horizontal range', '', 30, 50.0), ('range', '', 30, None),
        ('range', '', 3, 50.0),  # hardly matters
    ):  # fmt: skip
        text = f'time,{header},bearing_deg,depth\n1,50,90,{depth}\n2,50,90,{depth}\n'
        how = {'out': f'{header}{ranges}{depth}', **({'ranges': ranges} if ranges else {})}
        if x is None:
            with pytest.raises(BagError, match='say --ranges slant or --ranges horizontal'):
                convert(text, bearings='north', **how)
        else:
            place = measured(convert(text, bearings='north', **how).path)[0].position
            assert place == pytest.approx([x, 0.0, -depth], abs=0.1 * (depth == 3))
