# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A file of each format that goes in, made from one line: who was where and when."""

from collections.abc import Callable
from datetime import datetime, timedelta, timezone
import itertools
import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from helpers import marine, sonar_files
from helpers.dive_scenes import legs
from helpers.sonar_files import BEGIN, line_east, place_of
from msg_adapters.estimates import read_estimate
from msg_adapters.navigation import write_navigation
from sonar_imm.measurements import Navigation
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.reader import BagReader

BAGS = Path(__file__).resolve().parents[2] / 'bags'
FIRST = int(BEGIN.timestamp())
STATIONS = np.array([[0.0, 0.0], [900.0, 60.0], [930.0, 840.0], [-30.0, 900.0]])


class Spot(NamedTuple):
    """Whose position it is, seconds from the begin, metres east and north of `PLACE`; None for a
    receiver that had no fix, and says 0, 0."""

    seconds: float
    place: tuple[float, float] | None
    name: str = '1'

    @property
    def degrees(self):
        return (0.0, 0.0) if self.place is None else place_of(*self.place)

    @property
    def time(self):
        moment = np.datetime64(FIRST, 's') + np.timedelta64(round(1e3 * self.seconds), 'ms')
        return f'{moment}Z'


def text_of(t, digits=3, pattern='%Y-%m-%d %H:%M:%S'):
    """Seconds since 1970 as text, cut off after `digits` digits."""
    whole = datetime.fromtimestamp(math.floor(t), timezone.utc).strftime(pattern)
    return whole + (f'.{int(t % 1 * 10**digits + 1e-6):0{digits}d}' if digits else '')


MAKERS = {
    'otn': ('station,receiver,tagName,codeSpace,dateCollectedUTC',
            lambda t, r: f'S1,{r},A69-1602-7001,A69-1602,{text_of(t, 6)}'),
    'glatos': ('animal_id,detection_timestamp_utc,transmitter_codespace,transmitter_id,'
               'receiver_sn', lambda t, r: f'9,{text_of(t, 6)},A69-1602,7001,{r}'),
    'etn': ('date_time,tag_serial_number,acoustic_tag_id,receiver_id,station_name',
            lambda t, r: f'{text_of(t, 6)},1187,A69-1602-7001,{r},bh'),
    'actel': ('Timestamp,Receiver,CodeSpace,Signal,Valid',
              lambda t, r: f'{text_of(t, 6)},{r},A69-1602,7001,TRUE'),
    'lotek': ('Date,Time,TOA,Tag ID,Receiver,Power',
              lambda t, r: f'{text_of(t, 0, "%m/%d/%y,%H:%M:%S")},{t % 1:.6f},'
                           f'A69-1602-7001,{r},147'),
    'thelma': ('Date and Time (UTC),ID,Data,Protocol,SNR,Receiver,Microsecond',
               lambda t, r: f'{text_of(t, 0)},A69-1602-7001,0,S256,20,{r},{int(t % 1 * 1e6)}'),
    'fathom': ('VEMCO DATA LOG,2.0.0,vdat\nRECORD TYPE,FIELD\nDIAG_DESC,Device Time (UTC),Model\n'
               'DET_DESC,Device Time (UTC),Time,Model,Serial Number,Channel,Full ID,ID',
               lambda t, r: f'DIAG,{text_of(t, 6)},{r[:3]}\n'
               f'DET,{2 * (text_of(t, 6) + ",")}VR2,{r[4:]},69,A69-1602-7001,7001'),
    'serial_number': ('Date and Time (UTC),Receiver,Transmitter',
                      lambda t, r: f'{text_of(t, 6)},{r[4:]},A69-1602-7001'),
}  # fmt: skip
"""By maker or network: the head of an export, and a line of it, of the time and the receiver
`VR2-...`, whose number is what follows."""


def line(count=80, step=1.0):
    """A dive of ever new legs, with the noise of a USBL."""
    seconds = step * np.arange(count)
    noise = np.random.default_rng(1).normal(0.0, 1.2, (count, 2))
    places = legs(seconds)[:, :2] + noise
    return [Spot(float(t), (float(x), float(y))) for t, (x, y) in zip(seconds, places)]


def csv(path, head, rows):
    path.write_text('\n'.join([head, *rows]) + '\n')


def usbl_csv(path, spots):
    rows = ('{},{:.8f},{:.8f},1.2,{}'.format(e.time, *e.degrees, e.name) for e in spots)
    csv(path, 'time,lat,lon,std,id', rows)


def vessel_csv(path, spots):
    row = '{},{:.8f},{:.8f},90,{:.2f},45,{}'
    rows = [row.format(e.time, *e.degrees, 30 + 0.2 * k, e.name) for k, e in enumerate(spots)]
    csv(path, 'time,vessel_latitude,vessel_longitude,heading,range,bearing_deg,id', rows)


def of_each(spots):
    names = dict.fromkeys(each.name for each in spots)
    return [(name, [each for each in spots if each.name == name]) for name in names]


def gpx(path, spots):
    tracks, point = '', '<trkpt lat="{:.8f}" lon="{:.8f}"><time>{}</time></trkpt>\n'
    for name, own in of_each(spots):
        points = ''.join(point.format(*each.degrees, each.time) for each in own)
        tracks += f'<trk><name>{name}</name><trkseg>{points}</trkseg></trk>'
    path.write_text(f'<gpx xmlns="http://www.topografix.com/GPX/1/1">{tracks}</gpx>')


def kml(path, spots):
    marks, coord = '', '<gx:coord>{1:.8f} {0:.8f} 0</gx:coord>\n'
    for name, own in of_each(spots):
        whens = ''.join(f'<when>{each.time}</when>\n' for each in own)
        coords = ''.join(coord.format(*each.degrees) for each in own)
        marks += f'<Placemark><name>{name}</name><gx:Track>{whens}{coords}</gx:Track></Placemark>'
    path.write_text(
        '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">'
        f'<Document>{marks}</Document></kml>'
    )


def geojson(path, spots):
    features = [
        {
            'type': 'Feature', 'properties': {'time': each.time, 'id': each.name},
            'geometry': {'type': 'Point', 'coordinates': list(each.degrees[::-1])},
        }
        for each in spots
    ]  # fmt: skip
    path.write_text(json.dumps({'type': 'FeatureCollection', 'features': features}, indent=1))


def checked(text):
    total = 0
    for letter in text:
        total ^= ord(letter)
    return f'${text}*{total:02X}'


def minutes(value, width):
    return f'{int(value):0{width}d}{value % 1 * 60:08.5f}'


def position(kind, moment, place=sonar_files.PLACE, talker='GP'):
    """A sentence RMC or GGA."""
    where, clock = f'{minutes(place[0], 2)},N,{minutes(place[1], 3)},E', f'{moment:%H%M%S}.00'
    if kind == 'GGA':
        return checked(f'{talker}GGA,{clock},{where},4,08,0.9,2.0,M,40.0,M,,')
    return checked(f'{talker}RMC,{clock},A,{where},1.0,90.0,{moment:%d%m%y},,')


def nmea(path, spots):
    pytest.importorskip('pynmea2')
    pytest.importorskip('pyais')
    moments = [(BEGIN + timedelta(seconds=each.seconds), each.degrees) for each in spots]
    lines = [position(kind, *each) for each in moments for kind in ('RMC', 'GGA')]
    path.write_text('\r\n'.join(lines) + '\r\n')


def ais(path, spots):
    pyais = pytest.importorskip('pyais')
    lines = []
    for each in spots:
        lat, lon = each.degrees if each.place is None else place_of(*(5.0 * v for v in each.place))
        content = {'type': 1, 'mmsi': 211_000_000 + int(each.name), 'lat': lat, 'lon': lon}
        content |= {'second': int(FIRST + each.seconds) % 60, 'accuracy': 1}
        sentence = pyais.encode_dict(content, talker_id='AI', sentence_type='VDM')[0]
        lines.append(f'{FIRST + each.seconds:.0f} {sentence}')
    path.write_text('\r\n'.join(lines) + '\r\n')


def heard(path, spots, head, row):
    """Receptions, and beside the file where the stations are."""
    rows = ['{},{:.9f},{:.9f}'.format(k, *place_of(*place)) for k, place in enumerate(STATIONS)]
    csv(path.with_name('stations.csv'), 'receiver,latitude,longitude', rows)
    rows = []
    for k, each in enumerate(spots):
        apart = np.linalg.norm(STATIONS - (each.place or (0.0, 0.0)), axis=1)
        times = FIRST + each.seconds + apart / 1500.0
        rows += [row.format(k, number, t, each.name) for number, t in enumerate(times)]
    csv(path, head, rows)


def telemetry(path, spots):
    heard(path, spots, 'time_utc,receiver,tag', '{2:.6f},{1},{3}')


def arrivals(path, spots):
    heard(path, spots, 'ping,receiver,arrival_s,tag', '{0},{1},{2:.6f},{3}')


def shipped_sound(most=None):
    """Blocks of what the 16 hydrophones of a shipped recording heard."""
    with BagReader(BAGS / 'fathometer_pressure') as bag:
        first = itertools.islice(measurements_of(bag, 'fathometer'), most)
        return [item.measurement for item in first if hasattr(item.measurement, 'pressure')]


def sound(path, spots):
    soundfile = pytest.importorskip('soundfile')
    blocks = shipped_sound() if spots else []
    steps = np.concatenate([np.zeros((0, 16)), *[each.pressure / each.scale for each in blocks]])
    soundfile.write(path, np.round(steps).astype(np.int16), 6000, subtype='PCM_16')


def echoes(count, bins=120):
    """Envelopes (count, bins) of a floor and a layer below it."""
    at = np.arange(bins)
    row = 1000.0 * np.exp(-0.5 * ((at - 30) / 1.5) ** 2)
    row = row + 300.0 * np.exp(-0.5 * ((at - 70) / 1.5) ** 2)
    noise = np.random.default_rng(6).rayleigh(5.0, (count, bins))
    return row + noise


def segy(path, spots):
    moments = [BEGIN + timedelta(seconds=each.seconds) for each in spots]
    degrees = np.array([each.degrees for each in spots]).reshape(-1, 2)
    sonar_files.write_segy(
        path, echoes(max(len(spots), 1))[: len(spots)], TRACE_SAMPLE_INTERVAL=266,
        YearDataRecorded=[moment.year for moment in moments],
        DayOfYear=[moment.timetuple().tm_yday for moment in moments],
        HourOfDay=[moment.hour for moment in moments],
        MinuteOfHour=[moment.minute for moment in moments],
        SecondOfMinute=[moment.second for moment in moments], SourceGroupScalar=-1000,
        CoordinateUnits=2, SourceX=np.round(3.6e6 * degrees[:, 1]).astype(int),
        SourceY=np.round(3.6e6 * degrees[:, 0]).astype(int),
    )  # fmt: skip


def traces_csv(path, spots):
    rows = [
        f'{FIRST + each.seconds:.3f},{20 + 0.2 * n:.1f},{value:.3f}'
        for each, row in zip(spots, echoes(len(spots)))
        for n, value in enumerate(row)
    ]
    csv(path, 'time_utc,depth,amplitude', rows)


def traces_npz(path, spots):
    stamp, depth = np.array([FIRST + each.seconds for each in spots]), 20.0 + 0.2 * np.arange(120)
    np.savez(path, depth=depth, amplitude=echoes(len(spots)), stamp=stamp)


def floor(count, staves):
    """Samples (count, bins, staves) of an array 15 m above a level floor, half a wavelength from
    stave to stave, and their ranges."""
    rng = np.random.default_rng(4)
    distance = 0.06 * np.arange(833)
    shape = (count, len(distance))
    noise = 0.05 * (rng.normal(size=(*shape, staves)) + 1j * rng.normal(size=(*shape, staves)))
    echo = (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * (distance > 15.0)
    angle = np.arccos(np.clip(15.0 / np.maximum(distance, 15.0), 0.0, 1.0))
    place = 0.5 * (np.arange(staves) - 0.5 * (staves - 1))
    turn = np.exp(2j * np.pi * np.outer(np.sin(angle), place))
    return (noise + echo[..., None] * turn).astype(np.complex64), distance


def snapshots_npz(path, spots):
    iq, distance = floor(len(spots), 4)
    stamp = np.array([FIRST + each.seconds for each in spots])
    facts = {'sound_speed': 1500.0, 'frequency': 300e3, 'spacing_wavelengths': 0.5}
    np.savez(path, iq=iq[:, 140:], range=distance[140:], stamp=stamp, **facts)


def measured(path, system='diver', topics=None):
    """What a tracker hears of a recording."""
    with BagReader(path) as bag:
        return [item.measurement for item in measurements_of(bag, system, topics)]


def truth_of(path):
    """The true estimates of a recording."""
    with BagReader(path) as bag:
        return [read_estimate(item.message) for item in bag.messages(['/truth/estimate'])]


def bag_of(path, spots, messages, types=None):
    """A recording; messages: of a spot, (topic, message) each."""
    stamps = [round((FIRST + each.seconds) * 1e9) for each in spots]
    records = ((at, *both) for each, at in zip(spots, stamps) for both in messages(each, at))
    marine.write_bag(path, records, types)


def pose_at(stamp, x):
    pose = Navigation(
        stamp_ns=stamp, position=[x, 0.0, -20.0], orientation=[0, 0, 0, 1.0], frame_id='odom'
    )
    return write_navigation(pose, ros_message)


def images_bag(path, spots):
    bearings = np.radians(np.linspace(20.0, -20.0, 41))
    rng = np.random.default_rng(7)

    def messages(each, stamp):
        samples = np.round(3.0 * np.sqrt(rng.exponential(size=(100, 41))))
        samples[max(round(70 - each.seconds), 1), 20] = 200.0
        yield '/auv/odometry', pose_at(stamp, 0.5 * each.seconds)
        directions = np.column_stack([np.zeros(41), -np.sin(bearings), np.cos(bearings)])
        yield '/fls/image', marine.make(
            'ProjectedSonarImage', header=marine.header(sec=stamp // 10**9),
            ping_info=marine.ping_info(), beam_directions=marine.vectors(directions),
            ranges=marine.floats(2.0 + 0.5 * np.arange(100)),
            image=marine.image_data(samples.astype('u1'), 0, 41),
        )  # fmt: skip

    bag_of(path, spots, messages)


def phases_bag(path, spots):
    iq, _ = floor(max(len(spots), 1), 2)
    count = iter(range(len(spots)))

    def image(stamp, row):
        row, none = np.asarray(row, np.float32), marine.floats([])
        return marine.make(
            'RawSonarImage', header=marine.header(sec=stamp // 10**9),
            ping_info=marine.ping_info(), sample_rate=0.5 * 1500.0 / 0.06,
            samples_per_beam=len(row), sample0=140, tx_delays=none, tx_angles=none,
            rx_angles=none, image=marine.image_data(row, 8),
        )  # fmt: skip

    def messages(each, stamp):
        ping = iq[next(count), 140:]
        yield '/sss/amplitude', image(stamp, np.abs(ping).mean(axis=1))
        yield '/sss/phase', image(stamp, np.angle(ping[:, 1] * ping[:, 0].conj()))

    bag_of(path, spots, messages)


POINT, CLOUD = 'geometry_msgs/msg/Point32', 'sensor_msgs/msg/PointCloud'


def cloud_bag(path, spots):
    def messages(each, stamp):
        yield '/auv/odometry', pose_at(stamp, 0.5 * each.seconds)
        seen = [marine.make(POINT, x=60.0 - 0.5 * each.seconds, y=0.0, z=0.0)]
        header = marine.header(sec=stamp // 10**9)
        yield '/micron/points', marine.make(CLOUD, header=header, points=seen, channels=[])

    bag_of(path, spots, messages)


def side_scan_xtf(path, spots):
    """Towed straight, but for spots that are nowhere near: a jump from ping to ping is no tow."""
    pytest.importorskip('pyxtf')
    towed = [
        (each.seconds, place if np.allclose(each.degrees, place, atol=0.01) else each.degrees)
        for each, (_, place) in zip(spots, line_east(len(spots), 0.1))
    ]
    sonar_files.side_scan(path, spots=towed)


def soundings_xtf(path, spots):
    pytest.importorskip('pyxtf')
    beams = [(0.0, y, 20.0) for y in (-10.0, 0.0, 10.0)]
    parts = [sonar_files.xtf_head([('port', 'port', 'uint16')]).to_bytes()]
    parts += [sonar_files.xtf_soundings(each.seconds, beams, each.degrees) for each in spots]
    path.write_bytes(b''.join(parts))


def pictures(path, spots):
    """An echo on the bow that comes nearer as the vehicle goes east."""
    image = pytest.importorskip('PIL.Image')
    rng, rows = np.random.default_rng(2), ['file,time_utc,latitude,longitude,heading,depth']
    path.mkdir(exist_ok=True)
    for k, each in enumerate(spots):
        pixels = np.round(3.0 * np.sqrt(rng.exponential(size=(200, 41))))
        pixels[150 - k, 20] = 200.0
        image.fromarray(pixels.astype('u1')).save(path / f'{k:02d}.png')
        latitude, longitude = each.degrees if each.place is None else place_of(0.2 * k, 0.0)
        rows.append(f'{k:02d}.png,{each.time},{latitude:.9f},{longitude:.9f},90,3')
    (path / 'stamps.csv').write_text('\n'.join(rows))


class Format(NamedTuple):
    """row: first column of the table in docs/reference/formats.md; make: (path, spots); options:
    words of ``convert``, {} is the folder of the file; system: whose input it becomes; kind: where
    its content does not say it; step: seconds from ping to ping."""

    row: str
    name: str
    make: Callable
    system: str
    options: tuple[str, ...] = ()
    kind: str = ''
    step: float = 1.0


FORMATS = [
    Format('CSV of positions, also range and bearing', 'usbl.csv', usbl_csv, 'diver'),
    Format('CSV of positions from a vessel', 'vessel.csv', vessel_csv, 'diver'),
    Format('GPX 1.0, 1.1: tracks, routes, waypoints', 'dive.gpx', gpx, 'diver'),
    Format('KML: `gx:Track`, points with a time', 'dive.kml', kml, 'diver'),
    Format(
        'GeoJSON: points, lines with `coordTimes` or `times`', 'dive.geojson', geojson, 'diver'
    ),
    Format(
        'NMEA 0183: GGA, RMC, GLL, GNS, GST, HDT, THS, ZDA, TLL, TTM; USRTH, PSIMSSB (C, H), '
        'PSIMSNS of a USBL', 'gps.log', nmea, 'diver',
    ),
    Format('AIS: messages 1, 2, 3, 18, 19, 27', 'harbour.nmea', ais, 'diver'),
    Format(
        'receivers of telemetry: rows of receiver, tag, time', 'vue.csv', telemetry, 'diver',
        ('--receivers', '{}/stations.csv', '--toa-std', '0.001'), step=5.0,
    ),
    Format(
        'CSV of arrival times', 'arrivals.csv', arrivals, 'diver',
        ('--receivers', '{}/stations.csv', '--toa-std', '0.001'), step=5.0,
    ),
    Format('WAV, FLAC of an array', 'array_20240531_100000.wav', sound, 'fathometer'),
    Format('SEG-Y', 'line.seg', segy, 'fathometer'),
    Format('numpy archive', 'pings.npz', snapshots_npz, 'bathymetry'),
    Format('numpy archive', 'traces.npz', traces_npz, 'fathometer'),
    Format('CSV of traces', 'traces.csv', traces_csv, 'fathometer'),
    Format('bag with sonar images, or amplitude and phase', 'survey.bag', images_bag, 'obstacle'),
    Format(
        'bag with sonar images, or amplitude and phase', 'swath.bag', phases_bag, 'bathymetry',
        ('--amplitude', '/sss/amplitude', '--phase', '/sss/phase', '--element-spacing', '0.0025'),
        'interferometer',
    ),
    Format('bag with `sensor_msgs/PointCloud`', 'micron.bag', cloud_bag, 'obstacle', kind='none'),
    Format('XTF: side scan, processed soundings', 'line.xtf', side_scan_xtf, 'obstacle', step=0.2),
    Format('XTF: side scan, processed soundings', 'swath.xtf', soundings_xtf, '', step=0.2),
    Format(
        'folder of PNG, JPEG with a CSV of stamps', 'frames', pictures, 'obstacle',
        ('--far-range', '40', '--fov', '60'), step=0.2,
    ),
]  # fmt: skip
