# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Columns of tables: the names and units of headers and the words of cells, in six languages.

Each quantity has one name here (``x``, ``stamp``, ...) and a list of usual names, in English,
German, French, Spanish, Norwegian and Portuguese, without accents. A word for a vessel before or
behind the name of a position or heading makes that of the vessel.
"""

from __future__ import annotations

import math
import re
import unicodedata

from .sources import BagError

USUAL_NAMES = {
    'stamp': (
        'time timestamp t datetime date_time utc utc_time time_utc timestamp_utc datetime_utc '
        'date_time_utc epoch unix_time date_and_time device_time detection_timestamp '
        'detection_timestamp_utc datecollectedutc date_collected_utc basedatetime '
        'base_date_time gps_time datenum matlab_time excel_time mjd jd julian_date elapsed '
        'elapsed_time zeit zeitstempel zeitpunkt '
        'uhrzeit datum_zeit datum_uhrzeit horodatage date_heure heure temps tempo fecha_hora '
        'fecha_y_hora hora tiempo data_hora data_e_hora tidspunkt tidsstempel klokkeslett tid'
    ),
    'date': 'utc_date gps_date date_utc day datum fecha dato data',
    'fraction': (
        'fraction fractional_second fraction_of_second subsecond millisecond milliseconds '
        'millis msec microsecond microseconds usec nanosecond nanoseconds nsec millisekunde '
        'millisekunden mikrosekunden milliseconde millisecondes milisegundo milisegundos '
        'millisekund millisekunder'
    ),
    'x': (
        'east easting px pos_x position_x utm_e utm_x utm_east utm_easting e ost rechtswert '
        'ostwert est este leste ost_utm'
    ),
    'y': (
        'north northing py pos_y position_y utm_n utm_y utm_north utm_northing n nord hochwert '
        'nordwert norte'
    ),
    'z': 'up pz pos_z position_z',
    'depth': 'down tiefe tauchtiefe profondeur profundidad profundidade dybde dyp',
    'latitude': (
        'lat gps_latitude gps_lat decimal_latitude lat_dd breite breitengrad geogr_breite '
        'geographische_breite latitud bredde breddegrad'
    ),
    'longitude': (
        'lon lng long gps_longitude gps_lon gps_lng gps_long decimal_longitude lon_dd long_dd '
        'laenge laengengrad geogr_laenge geographische_laenge longitud lengde lengdegrad'
    ),
    'latitude_hemisphere': (
        'n_s ns n_or_s north_south lat_dir latitude_dir latitude_direction lat_hemisphere '
        'latitude_hemisphere hemisphere_lat lat_ref latitude_ref lat_ns latitude_ns'
    ),
    'latitude_minutes': '',
    'longitude_minutes': '',
    'latitude_seconds': '',
    'longitude_seconds': '',
    'longitude_hemisphere': (
        'e_w ew e_or_w o_w e_o east_west lon_dir long_dir longitude_dir longitude_direction '
        'lon_hemisphere longitude_hemisphere hemisphere_lon lon_ref longitude_ref lon_ew '
        'longitude_ew'
    ),
    'height': 'altitude alt ellipsoidal_height',
    'var_x': 'var_east xx cov_xx cov_x_x',
    'cov_xy': 'cov_east_north xy cov_x_y',
    'var_y': 'var_north yy cov_yy cov_y_y',
    'var_z': 'var_up var_height var_depth zz cov_zz cov_z_z',
    'cov_xz': 'cov_east_up xz cov_x_z',
    'cov_yz': 'cov_north_up yz cov_y_z',
    'std_x': 'std_east sigma_x sigma_east sd_x sx',
    'std_y': 'std_north sigma_y sigma_north sd_y sy',
    'std_z': 'std_up std_height std_depth sigma_z sigma_up sigma_depth sd_z sz',
    'std': (
        'sigma accuracy std_xy sigma_xy position_std standardabweichung genauigkeit ecart_type '
        'precision desviacion_estandar desvio_padrao precisao noyaktighet standardavvik'
    ),
    'range': (
        'distance dist rng alcance entfernung distanz abstand distancia avstand slant_range '
        'slant_distance schraegentfernung schraegdistanz distance_oblique distancia_inclinada '
        'skraavstand horizontal_range horizontal_distance ground_range'
    ),
    'std_range': 'sigma_range range_std',
    'forward': 'ahead fwd rel_forward voraus vorwaerts avant adelante frente forover foran forut',
    'starboard': 'stbd rel_starboard steuerbord tribord estribor estibordo boreste styrbord',
    'vessel_x': '',
    'vessel_y': '',
    'vessel_latitude': '',
    'vessel_longitude': '',
    'vessel_latitude_hemisphere': '',
    'vessel_longitude_hemisphere': '',
    'vessel_latitude_minutes': '',
    'vessel_longitude_minutes': '',
    'vessel_latitude_seconds': '',
    'vessel_longitude_seconds': '',
    'heading': 'hdg gyro true_heading heading_true steuerkurs cap cap_vrai rumbo rumo proa',
    'roll': 'roll_angle rollen roulis balanceo',
    'pitch': 'pitch_angle stampfen tangage cabeceo',
    'vx': 'v_east ve vel_x velocity_x',
    'vy': 'v_north vn vel_y velocity_y',
    'id': (
        'track_id target target_id target_name target_no target_number tag beacon beacon_id '
        'beacon_name transponder diver mmsi name taucher tauchername ziel zielnummer ziel_nr '
        'zielname cible nom balise objetivo nombre alvo nome navn maal dykker plongeur buzo '
        'buceador mergulhador'
    ),
    'valid': 'position_valid is_valid fix_valid validity gueltig valide valido gyldig',
    'status': 'fix_status position_status zustand etat statut estado',
    'quality': (
        'fix_quality position_quality quality_flag qualitaet qualite calidad qualidade kvalitet'
    ),
    'tag': (
        'tag_id transmitter transmitter_id tx tx_id full_id tagname tag_name acoustic_tag_id '
        'signal sender sender_id sendernummer emetteur transmisor transmissor marca marque merke'
    ),
    'code_space': 'codespace transmitter_codespace tag_code_space',
    'ping': 'ping_id ping_number',
    'receiver': (
        'rx rx_id receiver_id receiver_sn receiver_name hydro hydrophone serial_number station '
        'empfaenger recepteur receptor mottaker name id'
    ),
    'model': 'receiver_model',
    'transmitter': 'tx tx_id transmitter_id source name id',
    'arrival': 'arrival_time time_of_arrival detection_time',
    'toa': 'travel_time delay tof time_of_flight',
    'var_toa': 'toa_variance var_arrival',
    'std_toa': 'sigma_toa std_arrival sigma_arrival',
    'bearing': (
        'azimuth doa brg peilung azimut gisement relevement demora marcacion marcacao '
        'azimute peiling seitenpeilung true_bearing bearing_true relative_bearing '
        'bearing_relative rel_bearing bearing_rel'
    ),
    'amplitude': 'amp response value',
    'var_bearing': '',
    'std_bearing': 'sigma_bearing bearing_std',
    'elevation': 'elevation_angle',
    'var_elevation': '',
    'std_elevation': 'sigma_elevation',
    'var_depth': '',
    'std_depth': 'sigma_depth',
    'file': 'filename file_name image picture frame',
    'near_range': 'range_min min_range',
    'far_range': 'range_max max_range',
    'fov': 'field_of_view sector horizontal_fov',
}
ALIASES = {name: (name, *others.split()) for name, others in USUAL_NAMES.items()}
"""The names of the columns of all kinds of table: those by which each quantity is found."""
_NAMES = {name for names in ALIASES.values() for name in names}
VESSELS = (
    'vessel', 'ship', 'boat', 'own', 'schiff', 'boot', 'navire', 'bateau', 'buque', 'barco',
    'navio', 'skip', 'fartoy', 'baat',
)  # fmt: skip
"""Words that make a position or a heading that of the vessel."""
ZONES = ('utc', 'gmt', 'local', 'lokal')
"""Words beside the name of a time."""
_OFFSET = re.compile(r'_\d\d?(_\d\d)?$')
PARTS = {
    'minutes': ('min', 'mins', 'minute', 'minutes', 'minuten', 'minutos', 'minutter'),
    'seconds': ('sec', 'secs', 'second', 'seconds', 'sekunden', 'secondes', 'segundos'),
}
"""Last words of headers of the minutes and seconds of degrees in columns of their own."""
TARGETS = ('target', 'beacon', 'diver', 'rov', 'ziel', 'taucher', 'cible', 'objetivo', 'alvo')
"""Words that make a position that of the target."""
OF_TARGETS = ('x', 'y', 'z', 'depth', 'latitude', 'longitude')

UNRELATED = (
    'snr rssi power quality strength level confidence temperature temp temperatur salinity '
    'pressure doppler voltage battery index nr no number count row record ping channel frequency '
    'gain sats satellites hdop pdop'
).split()
"""Names of columns of numbers that are neither positions nor headings."""

FROM_NORTH = {'azimuth', 'azimut', 'azimute', 'relevement', 'demora', 'true', 'north'}
FROM_BOW = {'gisement', 'marcacao', 'relative', 'rel', 'bow', 'seitenpeilung'}
"""Words of headers of bearings that usually count from north and from the bow."""

SLANT = ('slant', 'schraeg', 'oblique', 'inclinada', 'skra')
LEVEL = ('horizontal', 'ground', 'level')
"""Begins of words of headers of ranges along the ray and in the plane."""

METRES = {
    'm': 1.0, 'meter': 1.0, 'meters': 1.0, 'metre': 1.0, 'metres': 1.0, 'metros': 1.0,
    'km': 1e3, 'dm': 0.1, 'cm': 1e-2, 'mm': 1e-3,
    'ft': 0.3048, 'feet': 0.3048, 'foot': 0.3048, 'fuss': 0.3048,
    'nm': 1852.0, 'nmi': 1852.0, 'fathom': 1.8288, 'fathoms': 1.8288,
    **dict.fromkeys(('pied', 'pieds', 'pie', 'pies', 'fot', 'ft_us'), 0.3048),
    **dict.fromkeys(('yd', 'yds', 'yard', 'yards'), 0.9144),
    **dict.fromkeys(('mi', 'mile', 'miles'), 1609.344),
    **dict.fromkeys(('inch', 'inches', 'zoll'), 0.0254),
}  # fmt: skip
SECONDS = {'s': 1.0, 'sec': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9}
RADIANS = {
    'rad': 1.0, 'radians': 1.0, 'mrad': 1e-3, 'gon': math.pi / 200.0,
    **dict.fromkeys(('deg', 'degree', 'degrees', 'grad', 'graus', 'grados'), math.pi / 180.0),
}  # fmt: skip
TIME_WORDS = {
    **dict.fromkeys(('s', 'sec', 'secs', 'second', 'seconds', 'sekunden', 'secondes'), 's'),
    **dict.fromkeys(('ms', 'msec', 'millis', 'milliseconds'), 'ms'),
    **dict.fromkeys(('us', 'usec', 'microseconds'), 'us'),
    **dict.fromkeys(('ns', 'nsec', 'nanoseconds'), 'ns'),
    **dict.fromkeys(PARTS['minutes'], 'min'),
    **dict.fromkeys(('h', 'hr', 'hrs', 'hour', 'hours', 'stunden', 'heures', 'horas'), 'h'),
    **dict.fromkeys(('d', 'day', 'days', 'tage', 'jours', 'dias', 'dager'), 'd'),
}
"""Units of times by their words in headers."""
_TIME_UNIT = re.compile(f'_({"|".join(sorted(TIME_WORDS, key=len, reverse=True))})$')
SPEEDS = {'m_s': 1.0, 'mps': 1.0, 'km_h': 1 / 3.6, 'kmh': 1 / 3.6}
SPEEDS |= dict.fromkeys(('kn', 'kt', 'kts', 'knots'), 1852.0 / 3600.0)
OTHER_UNITS = ('px', 'pixel', 'pixels', 'samples', 'bar', 'mbar', 'dbar', 'hpa', 'kpa', 'psi')
"""Units without a factor to the units of any quantity."""


def _squares(units: dict[str, float]) -> dict[str, float]:
    return {f'{name}2': factor**2 for name, factor in units.items()}


_DEGREES = {name: math.degrees(factor) for name, factor in RADIANS.items()}
_UNITS_OF = {
    'x y z depth height range std_x std_y std_z std std_range std_depth forward starboard '
    'vessel_x vessel_y near_range far_range': METRES,
    'var_x cov_xy var_y var_z cov_xz cov_yz var_depth': _squares(METRES),
    'latitude longitude vessel_latitude vessel_longitude heading roll pitch': _DEGREES,
    'bearing elevation std_bearing std_elevation': RADIANS,
    'var_bearing var_elevation': _squares(RADIANS),
    'std_toa': SECONDS,
    'var_toa': _squares(SECONDS),
    'vx vy': SPEEDS,
}
UNITS = {name: units for names, units in _UNITS_OF.items() for name in names.split()}
"""Factors of the units of each quantity: to m, m^2, s, s^2, m/s, degrees (positions and headings)
or rad (bearings and elevations)."""
_UNITS = sorted({unit for units in UNITS.values() for unit in units}, key=len, reverse=True)
_UNIT = re.compile(f'_({"|".join(_UNITS)})(?=_|$)')
_BRACKETS = re.compile(r'[\[(]([^\])]*)')

FRACTIONS = {'mil': 10**6, 'msec': 10**6, 'mi': 10**3, 'usec': 10**3, 'nan': 1, 'nsec': 1}
"""Nanoseconds of the unit of a column of parts of a second by the begin of its name, else s."""
DAY_NAMES = {
    'datenum': 'datenum', 'matlab_time': 'datenum', 'excel_time': 'excel', 'mjd': 'mjd',
    'jd': 'julian', 'julian_date': 'julian',
}  # fmt: skip
LOTEK = {'date', 'time', 'toa', 'tag_id'}
"""Columns of an export of Lotek, which writes the month before the day."""
THELMA = {'id', 'protocol', 'receiver'}
"""Columns of an export of Thelma."""
NOTHING = ('', '-', '--', 'nan', 'na', 'n/a', '#n/a', 'null', 'none', 'nil')
"""Cells without a value."""
YES = (
    '1 1.0 true t yes y valid ok good fix ja wahr gueltig gut oui vrai valide bon si sim '
    'verdadero verdadeiro valido bueno bom sann gyldig god'
).split()
NO = (
    '0 0.0 false f no n invalid bad error fail failed lost none nein falsch ungueltig fehler '
    'schlecht non faux invalide erreur mauvais nao falso invalido malo mau nei usann ugyldig feil'
).split()
SIGNS = {
    'latitude': {
        **dict.fromkeys('n north nord norte'.split(), 1.0),
        **dict.fromkeys('s south sued sud sur sul sor'.split(), -1.0),
    },
    'longitude': {
        **dict.fromkeys('e east ost est este leste ost'.split(), 1.0),
        **dict.fromkeys('w west ouest oeste vest'.split(), -1.0),
    },
}
"""Sign of a latitude and a longitude by the word for its hemisphere; ``o`` is east in German, west
in French, Spanish and Portuguese."""


_LETTERS = str.maketrans({'ä': 'ae', 'ö': 'oe', 'ü': 'ue', 'ß': 'ss', 'ø': 'o', 'å': 'a'})


def plain(text: str) -> str:
    """Reduce a text to lower-case letters without accents and single underscores."""
    text = unicodedata.normalize('NFC', text.lower())
    text = unicodedata.normalize('NFKD', text.translate(_LETTERS))
    return re.sub('[^a-z0-9]+', '_', text.encode('ascii', 'ignore').decode()).strip('_')


def name_of(header: str) -> str:
    """Reduce a header to its name: ``East [m]``, ``east_m`` and ``EAST`` are all ``east``.

    An axis in brackets behind a letter is the name: ``X (North)`` is ``north``.
    """
    name = plain(_BRACKETS.split(header)[0])
    if name in ('x', 'y') and (inner := _BRACKETS.search(header)):
        axis = plain(inner.group(1))
        return axis if axis in (*ALIASES['x'], *ALIASES['y']) else name
    if (timed := _TIME_UNIT.sub('', name)) in ALIASES['stamp']:
        return timed
    found = None if name in _NAMES else _UNIT.search(name)
    return name[: found.start()] if found and found.end() == len(name) else name


def time_unit_of(header: str) -> str:
    """Return the unit of times in a header, as in ``Time (min)`` or ``t_ms``; empty without."""
    found = _TIME_UNIT.search('_' + plain(header))
    return TIME_WORDS[found.group(1)] if found else ''


def unit_of(header: str) -> str:
    """Return the unit in a header, as in ``Range (km)`` or ``depth_ft``; empty without one."""
    if found := _BRACKETS.search(header):
        text = found.group(1).strip().lower().replace('°', 'deg ').replace('²', '2')
        words = re.split('[ ,;]', text.replace('/', '_').replace('^', ''))
        return words[0] if words[0] in (*_UNITS, *OTHER_UNITS) else ''
    name = plain(header.replace('°', ' deg '))
    found = None if name in _NAMES else _UNIT.search(name)
    return found.group(1) if found else ''


def factor_of(name: str, header: str) -> float:
    """Return the factor from the unit of a header to that of a quantity, 1 where the header has no
    unit. Raises `BagError` for a unit of another kind."""
    unit = unit_of(header)
    if not unit or name not in UNITS or unit == 's' and name.endswith('latitude'):
        return 1.0
    if unit not in UNITS[name]:
        raise BagError(
            f"the column '{header}' is in {unit}, and {name} can be in {', '.join(UNITS[name])}; "
            f'name another column with --column {name}=HEADER'
        )
    return UNITS[name][unit]


def quantities_of(header: str) -> list[str]:
    """Return the quantities that a header may stand for."""
    return [name for name in ALIASES if rank_of(name, header) < len(_NAMES)]


def is_of_vessel(header: str) -> bool:
    """Return whether a header is that of a heading, or has a word for a vessel."""
    return bool({'heading', *VESSELS} & {*quantities_of(header), *plain(header).split('_')})


def rank_of(quantity: str, header: str) -> int:
    """Return the place of a header among the usual names of a quantity, beyond all for another
    one. Names with a word for the target come first."""
    name = name_of(header)
    aliases = ALIASES[quantity]
    whole, _, part = quantity.rpartition('_')
    if part in PARTS:
        words = plain(header.replace('°', ' deg ')).split('_')
        of_part = len(words) > 1 and words[-1] in PARTS[part]
        return rank_of(whole, '_'.join(words[:-1])) if of_part else len(_NAMES)
    if name in aliases:
        return aliases.index(name)
    if (
        quantity in ('stamp', 'date')
        and (inner := _without(ZONES, _OFFSET.sub('', name))) in aliases
    ):
        return len(aliases)
    if quantity in OF_TARGETS and (inner := _without(TARGETS, name)) and inner in aliases:
        return -1
    of_vessel = quantity.removeprefix('vessel_')
    if (of_vessel != quantity or quantity == 'heading') and (inner := _without(VESSELS, name)):
        return len(aliases) if inner in ALIASES[of_vessel] else len(_NAMES)
    return len(_NAMES)


def _without(words: tuple[str, ...], name: str) -> str:
    """Remove one of `words` from the begin or the end of a name; empty where there is none."""
    for word in words:
        if name.startswith(f'{word}_') or name.endswith(f'_{word}'):
            return name.removeprefix(f'{word}_').removesuffix(f'_{word}')
    return ''


def sign_in(name: str, header: str) -> float | None:
    """Return the sign that the header of a latitude or longitude states for all its values, as in
    ``Longitude (°W)``; None for headers with no or several such words, or with words for signs."""
    words = {word for word in plain(header).split('_') if word != 'o'}
    signs = {sign_of(name, word) for word in words} - {None}
    told = any(word.startswith(('neg', 'pos', 'minus', 'plus')) for word in words)
    return signs.pop() if len(signs) == 1 and not told and not set('+-') & set(header) else None


def zone_in(header: str) -> str:
    """Return the zone that a header states, as in ``time_utc`` or ``Time (GMT+02:00)``; empty
    without one. Raises `BagError` for an offset that is none."""
    found = re.search(r'(?:utc|gmt)(?:[\s_]*([+-])\s*(\d\d?)(?::?(\d\d))?(?!\d))?', header.lower())
    if found is None:
        return ''
    sign, hours, minutes = found.groups()
    return f'{sign}{int(hours):02d}:{minutes or "00"}' if sign else 'UTC'


def sign_of(name: str, word: str) -> float | None:
    """Return the sign of a latitude or longitude by a word for its hemisphere, None for others."""
    return SIGNS[name].get(plain(word))
