# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Files of sonars, made by the writers of the libraries that read them."""

from contextlib import suppress
from datetime import datetime, timedelta, timezone
import struct

import numpy as np

BEGIN = datetime(2024, 5, 31, 10, 0, 0, tzinfo=timezone.utc)
PLACE = 54.0, 10.0
DEGREE = 111_320.0


def place_of(x, y):
    """Latitude and longitude of metres east and north of `PLACE`."""
    return PLACE[0] + y / DEGREE, PLACE[1] + x / (DEGREE * np.cos(np.radians(PLACE[0])))


def xtf_head(channels):
    """The header of an XTF file. channels: (name, side, dtype) of each."""
    import pyxtf

    head = pyxtf.XTFFileHeader()
    head.NavUnits, head.NumberOfSonarChannels = 3, len(channels)
    head.SonarName = b'made by a test'
    formats = {'uint8': 8, 'uint16': 3, 'float32': 5}
    for info, (name, side, dtype) in zip(head.ChanInfo, channels):
        info.TypeOfChannel = {'port': 1, 'starboard': 2}[side]
        info.ChannelName = name.encode()
        info.BytesPerSample = np.dtype(dtype).itemsize
        info.SampleFormat = formats[dtype]
        info.Frequency = 450.0
    return head


def xtf_ping(seconds, samples, place=PLACE, slant_range=50.0, **more):
    """One ping; samples: of each channel, as they lie in the file."""
    import pyxtf

    moment = BEGIN + timedelta(seconds=seconds)
    ping = pyxtf.XTFPingHeader()
    ping.HeaderType = pyxtf.XTFHeaderType.sonar.value
    ping.NumChansToFollow = len(samples)
    ping.Year, ping.Month, ping.Day = moment.year, moment.month, moment.day
    ping.Hour, ping.Minute, ping.Second = moment.hour, moment.minute, moment.second
    ping.HSeconds = moment.microsecond // 10_000
    ping.SoundVelocity = 750.0
    ping.SensorYcoordinate, ping.SensorXcoordinate = place
    ping.SensorHeading, ping.SensorDepth, ping.SensorPrimaryAltitude = 90.0, 5.0, 12.0
    for name, value in more.items():
        setattr(ping, name, value)
    ping.ping_chan_headers, ping.data = [], []
    for number, row in enumerate(samples):
        channel = pyxtf.XTFPingChanHeader()
        channel.ChannelNumber, channel.NumSamples = number, len(row)
        channel.SlantRange, channel.TimeDuration = slant_range, slant_range / 750.0
        ping.ping_chan_headers.append(channel)
        ping.data.append(row)
    size = len(ping.to_bytes())
    ping.NumBytesThisRecord = pyxtf.xtf_io.xtf_padding(size)
    return ping.to_bytes().ljust(ping.NumBytesThisRecord, b'\0')


def xtf_soundings(seconds, beams, place=PLACE):
    """A ping of processed soundings; beams: (east, north, depth) in metres."""
    import pyxtf

    ping = pyxtf.XTFPingHeader.from_buffer_copy(xtf_ping(seconds, [], place))
    ping.HeaderType = pyxtf.XTFHeaderType.bathy_xyza.value
    ping.NumChansToFollow, content = len(beams), b''
    for east, north, depth in beams:
        beam = pyxtf.XTFBeamXYZA()
        beam.dPosOffsetTrX, beam.dPosOffsetTrY, beam.fDepth = east, north, depth
        content += bytes(beam)
    ping.NumBytesThisRecord = len(bytes(ping)) + len(content)
    return bytes(ping) + content


def line_east(pings, step=0.4):
    """(seconds, (latitude, longitude)) of 5 pings per second, `step` metres apart."""
    return [(0.2 * k, place_of(step * k, 0.0)) for k in range(pings)]


def side_scan(path, pings=60, bins=500, target=(3.0, 30.0), seed=1, spots=None):
    """A line east at half a metre per second, 5 pings per second, with one target to starboard;
    target: metres east along the line and away from it; spots: other times and places, as in
    `line_east`."""
    rng = np.random.default_rng(seed)
    channels = [('port', 'port', 'uint16'), ('stbd', 'starboard', 'uint16')]
    parts = [xtf_head(channels).to_bytes()]
    for k, (seconds, place) in enumerate(line_east(pings, 0.1) if spots is None else spots):
        x = 0.1 * k
        port, starboard = (np.round(200.0 * np.sqrt(rng.exponential(size=bins))) for _ in range(2))
        if abs(x - target[0]) < 0.5:
            starboard[round(target[1] / 50.0 * bins)] = 20_000.0
        samples = [port[::-1].astype('u2'), starboard.astype('u2')]
        parts.append(xtf_ping(seconds, samples, place))
    path.write_bytes(b''.join(parts))
    return path


def ek80_datagram(kind, seconds, content):
    """A datagram of a raw file: its length, type, time in 100 ns since 1601, content and length
    again, as Kongsberg's EK80 interface specification has it."""
    since = BEGIN - datetime(1601, 1, 1, tzinfo=timezone.utc) + timedelta(seconds=seconds)
    ticks = since // timedelta(microseconds=1) * 10
    body = kind.encode() + struct.pack('<Q', ticks) + content
    return struct.pack('<i', len(body)) + body + struct.pack('<i', len(body))


RATE = 1.5e6
"""Samples per second of the made-up receiver of `ek80` before its filters."""
BAND, PULSE, SLOPE = (55e3, 90e3), 512e-6, 0.1
"""Band in Hz, duration in s and slope of the edges of its chirps."""
FILTERS = [
    (np.hanning(49) * np.exp(2j * np.pi * 72.5e3 / RATE * np.arange(49)), 6),
    (np.array([1.0 + 0.0j]), 3),
]
"""Coefficients and decimation of its filters."""


def sentences(seconds, place=PLACE):
    """Datagrams that say where the ship is and that it looks east."""
    latitude, longitude = place
    moment = BEGIN + timedelta(seconds=seconds)
    fix = (
        f'GPGGA,{moment:%H%M%S}.{moment.microsecond // 10_000:02d},'
        f'{int(latitude):02d}{latitude % 1 * 60:08.5f},N,'
        f'{int(longitude):03d}{longitude % 1 * 60:08.5f},E,1,10,1.0,0.0,M,0.0,M,,'
    )
    parts = []
    for text in (fix, 'INHDT,90.0,T'):
        total = 0
        for letter in text:
            total ^= ord(letter)
        parts.append(ek80_datagram('NME0', seconds, f'${text}*{total:02X}'.encode()))
    return parts


def ek60(path, power, angles, spots=None):
    """A raw file of an EK60 with one channel, a ping and a position each 0.2 s, 0.4 m to the east;
    power (pings, bins), whole numbers of 3.0103/256 dB; angles (pings, bins, 2) as in `ek80`, or
    None. The datagrams with samples and the configuration are written by the library."""
    from ektools.simrad_parsers import SimradConfigParser, SimradRawParser

    zeros = dict.fromkeys(
        ['low_date', 'high_date', 'pulse_length', 'bandwidth', 'absorption_coefficient', 'heave']
        + ['roll', 'pitch', 'temperature', 'heading', 'transmit_mode', 'offset', 'transmit_power']
        + ['transducer_depth', 'gain', 'equivalent_beam_angle', 'beam_type']
        + [f'angle_offset_{way}' for way in ('alongship', 'athwartship')]
        + [f'beam_width_{way}' for way in ('alongship', 'athwartship')]
        + [f'{what}_{axis}' for what in ('pos', 'dir') for axis in 'xyz'],
        0,
    )
    texts = ['survey_name', 'transect_name', 'version', 'gpt_software_version']
    texts += [f'spare{k}' for k in range(5)]
    channel = {
        **zeros,
        **dict.fromkeys(texts, ''),
        **dict.fromkeys(['pulse_length_table', 'gain_table', 'sa_correction_table'], [0.0] * 5),
        'sounder_name': 'ER60',
        'channel_id': 'GPT 38 kHz ES38B',
        'frequency': 38e3,
        'angle_sensitivity_alongship': 21.9,
        'angle_sensitivity_athwartship': 21.9,
    }
    built = {**zeros, 'type': 'CON0', 'configuration': {channel['channel_id']: channel}}
    parts = [ek80_datagram('CON0', 0.0, SimradConfigParser().to_string(built)[16:-4])]
    where = line_east(len(power)) if spots is None else spots
    for k, (row, (seconds, place)) in enumerate(zip(power, where)):
        data = {
            **zeros,
            'type': 'RAW0',
            'channel': 1,
            'mode': 1 if angles is None else 3,
            'frequency': 38e3,
            'sample_interval': 2.56e-4,
            'sound_velocity': 1490.0,
            'spare0': '',
            'count': len(row),
            'power': row.astype(np.int16),
            'angle': None if angles is None else angles[k].astype(np.int8),
        }
        parts += sentences(seconds, place)
        content = SimradRawParser().to_string(data)[16:-4]
        parts.append(ek80_datagram('RAW0', seconds + 0.1, content))
    path.write_bytes(b''.join(parts))
    return path


def ek80(
    path,
    samples,
    chirp=False,
    filters=FILTERS,
    angles=None,
    channel='WBT 1-15 ES70',
    spots=None,
):
    """A raw file with one channel, 5 pings per second; samples: (pings, bins, sectors), complex,
    or where there are angles, (pings, bins, 2) of -128 to 127, athwartships and alongships, whole
    numbers of power, 3.0103/256 dB each. The datagrams with samples and filters are written by the
    library."""
    from themachinethatgoesping.echosounders import simradraw

    def xml(seconds, text):
        return ek80_datagram('XML0', seconds, text.encode())

    chirp_text = f'FrequencyStart="{BAND[0]}" FrequencyEnd="{BAND[1]}"'
    pulse, duration, interval = 'Frequency="70000"', 0.000256, 4e-5
    if chirp:
        pulse, duration = chirp_text, PULSE
        interval = np.prod([step for _, step in FILTERS]) / RATE
    parts = [
        xml(
            0.0,
            '<?xml version="1.0" encoding="utf-8"?><Configuration><Header ApplicationName="EK80" '
            'Version="2.0.1.0" FileFormatVersion="1.23" TimeBias="0"/><Transceivers>'
            '<Transceiver TransceiverName="WBT 1" SerialNumber="1" Impedance="5400" '
            f'RxSampleFrequency="{RATE:.0f}" TransceiverNumber="1" TransceiverType="WBT">'
            f'<Channels><Channel ChannelID="{channel}" ChannelIdShort="ES70" '
            'MaxTxPowerTransceiver="750" PulseDuration="0.000256" PulseDurationFM="0.000512">'
            '<Transducer TransducerName="ES70" SerialNumber="1" Frequency="70000" '
            'FrequencyMinimum="45000" FrequencyMaximum="90000" Gain="27" SaCorrection="0" '
            'EquivalentBeamAngle="-20.7" AngleSensitivityAlongship="23" '
            'AngleSensitivityAthwartship="23" BeamWidthAlongship="7" BeamWidthAthwartship="7" '
            'BeamType="1"/></Channel></Channels></Transceiver></Transceivers><Transducers>'
            '<Transducer TransducerName="ES70" TransducerMounting="HullMounted" '
            'TransducerOffsetX="0" TransducerOffsetY="0" TransducerOffsetZ="0"/></Transducers>'
            '</Configuration>',
        ),
        xml(
            0.0,
            '<?xml version="1.0" encoding="utf-8"?><Environment Depth="28" Acidity="8" '
            'Salinity="35" SoundSpeed="1490" Temperature="10" Latitude="54" '
            'WaterLevelDraft="1"/>',
        ),
    ]
    for stage, (coefficients, step) in enumerate(filters if chirp else [], start=1):
        content = simradraw.datagrams.FIL1()
        content.set_channel_id(channel.ljust(128, '\0'))
        content.set_stage(stage)
        content.set_decimation_factor(step)
        content.set_no_of_coefficients(len(coefficients))
        content.set_coefficients(coefficients.astype(np.complex64))
        parts.append(ek80_datagram('FIL1', 0.0, content.to_binary()[16:-4]))
    where = [(0.2 * k, PLACE) for k in range(len(samples))] if spots is None else spots
    for k, (rows, (seconds, place)) in enumerate(zip(samples, where)):
        parts += sentences(seconds, place)
        parts.append(
            xml(
                seconds,
                '<?xml version="1.0" encoding="utf-8"?><Parameter><Channel '
                f'ChannelID="{channel}" ChannelMode="0" PulseForm="{int(chirp)}" {pulse} '
                f'PulseDuration="{duration}" SampleInterval="{interval}" TransmitPower="750" '
                f'Slope="{SLOPE}" SoundVelocity="1490"/></Parameter>',
            )
        )
        data, kinds = simradraw.datagrams.RAW3(), simradraw.datagrams.raw3datatypes
        data.set_channel_id(channel.ljust(128, '\0'))
        data.set_timestamp(BEGIN.timestamp() + seconds)
        data.set_count(len(rows))
        data.set_offset(0)
        if angles is None:
            pairs = np.stack([rows.real, rows.imag], axis=-1).astype(np.float32)
            data.set_data_type(kinds.t_RAW3DataType.ComplexFloat32)
            data.set_number_of_complex_samples(rows.shape[1])
            data.set_sample_data(kinds.RAW3DataComplexFloat32(np.ascontiguousarray(pairs)))
        else:
            turns = angles[k].astype(np.int8).view(np.uint8)
            data.set_data_type(kinds.t_RAW3DataType.PowerAndAngle)
            data.set_sample_data(kinds.RAW3DataPowerAndAngle(rows.astype(np.int16), turns))
        parts.append(ek80_datagram('RAW3', seconds, data.to_binary()[16:-4]))
    path.write_bytes(b''.join(parts))
    return path


def zero(part, **values):
    """A part of a datagram: what the library leaves undefined is 0."""
    for name in dir(part):
        if name.startswith('set_') and 'identifier' not in name:
            with suppress(TypeError):  # texts and lists
                getattr(part, name)(0)
    for name, value in values.items():
        getattr(part, f'set_{name}')(value)
    return part


INSTALLATION = (
    'OSCV:Empty,EMXV:EM2042,PU_0,SN=25002,IP=157.237.20.40:0xffff0000,UDP=1997,TYPE=CON_TECH,'
    'VERSIONS:,CPU:6.3.0,VXW:7,FILTER:1,CBMF:1,TX:1.02,RX:3.3.0,VERSIONS-END,SERIALno:,TX:1,RX:2,'
    'SERIALno-END,DCL:2.0.3,KMALL:Rev J,SYSTEM:EM 2042 - Single Tx single Rx,TRAI_TX1:N=1;X=0;Y=0;'
    'Z=0;R=0;P=0;H=0;S=0.7,TRAI_RX1:N=2;X=0;Y=0;Z=0;R=0;P=0;H=0;G=0,POSI_1:X=0;Y=0;Z=0;D=0;'
    'G=WGS84;T=Datagram;C=On;F=GGA;Q=Off;I=Net port 1;U=ACTIVE,POSI_2:U=NOT_SET,POSI_3:U=NOT_SET,'
    'ATTI_1:X=0;Y=0;Z=0;R=0;P=0;H=0;D=0;M=Rotation;F=KM Binary;I=Net port 2;U=ACTIVE,ATTI_2:U='
    'NOT_SET,EMXI:SWLZ=0,'
)


def kmall(path, pings=5, across=(-10.0, 0.0, 10.0), down=20.0, spots=None):
    """A KMALL file, written by the library: an EM 2042 that goes east, 5 pings per second; across,
    down: m from the reference point, of the soundings."""
    from themachinethatgoesping.echosounders.kmall import datagrams as made

    def packed(datagram, seconds):
        nanoseconds = round((BEGIN.timestamp() + seconds) * 1e9)
        datagram.set_time_sec(nanoseconds // 10**9)
        datagram.set_time_nanosec(nanoseconds % 10**9)
        size = len(datagram.to_binary())
        datagram.set_bytes_datagram(size)
        if hasattr(datagram, 'set_bytes_datagram_check'):
            datagram.set_bytes_datagram_check(size)
        return datagram.to_binary()

    installation, runtime = made.IInstallationParam(), made.IOpRuntime()
    installation.set_install_txt(INSTALLATION)
    runtime.set_runtime_txt('Sector coverage\nMax angle Port:      60.0\n')
    parts = [packed(installation, 0.0), packed(runtime, 0.0)]
    for k, (seconds, (latitude, longitude)) in enumerate(
        line_east(pings) if spots is None else spots
    ):
        place = made.SPosition()
        place.set_corrected_lat_deg(latitude)
        place.set_corrected_lon_deg(longitude)
        place.set_course_over_ground_deg(90.0)
        place.set_pos_data_from_sensor('$GPGGA')
        parts.append(packed(place, seconds))
        soundings = []
        for number, y in enumerate(across):
            where = {'x_re_ref_point_m': 0.5, 'y_re_ref_point_m': y, 'z_re_ref_point_m': down}
            soundings.append(zero(made.MRZSoundings(), sounding_index=number, **where))
        ping, holder = made.MRangeAndDepth(), made.MRZSoundingsContainer()
        holder.soundings = made.MRZSoundingsVector(soundings)
        ping.soundings = holder
        ping.set_ping_count(k)
        for name in ('number_of_datagrams', 'datagram_number', 'swaths_per_ping'):
            getattr(ping, f'set_{name}')(1)
        ping.set_rx_fans_per_ping(1)
        ping.ping_info = zero(made.MRZPingInfo())
        ping.rx_info = zero(
            made.MRZRxInfo(),
            number_of_soundings_max_main=len(across),
            number_of_soundings_valid_main=len(across),
            number_of_bytes_per_sounding=120,
        )
        parts.append(packed(ping, seconds))
    path.write_bytes(b''.join(parts))
    return path


OFFSETS = [f'S{k}{axis}' for k in (1, 2) for axis in 'ZYXHRP'] + [f'P1{axis}' for axis in 'ZYX']
OFFSETS += [f'MS{axis}' for axis in 'XYZRPG'] + [f'DS{axis}' for axis in 'OXYZ']
INSTALLATION_ALL = (
    'WLZ=0,SMH=101,HUN=0,S1S=0,GO1=0,GO2=0,FGD=0,TSV=1,RSV=1,BSV=1,PSV=1,DSV=1,OSV=SIS,DSF=1,'
    'APS=0,P1M=0,P1T=1,P1D=0,P1G=WGS84,MRP=RP,MSD=0,VSN=1,ARO=2,AHE=2,AHS=2,STC=1,'
    + ''.join(f'{name}=0,' for name in OFFSETS)
)


def kongsberg_all(path, pings=5, across=(-10.0, 0.0, 10.0), down=20.0, spots=None):
    """The same line as `kmall` in an .all file of an EM 2040, with a compass and a profile."""
    from themachinethatgoesping.echosounders.kongsbergall import datagrams as made

    parts = made.substructures

    def packed(datagram, seconds):
        midnight = BEGIN.replace(hour=0, minute=0, second=0)
        datagram.set_date(int(f'{BEGIN:%Y%m%d}'))
        clock = (BEGIN - midnight).total_seconds() + seconds
        datagram.set_time_since_midnight(round(1e3 * clock))
        datagram.set_model_number(2040)
        datagram.set_system_serial_number(101)
        datagram.set_stx(2)
        datagram.set_etx(3)
        if isinstance(datagram, made.InstallationParameters):
            datagram.set_bytes(21 + len(INSTALLATION_ALL))
        else:
            datagram.set_bytes(len(datagram.to_binary()) - 4)
        return datagram.to_binary()

    installation = zero(made.InstallationParameters())
    installation.set_installation_parameters(INSTALLATION_ALL)
    cast = zero(made.SoundSpeedProfileDatagram(), depth_resolution=100, number_of_entries=2)
    cast.set_profile_date(int(f'{BEGIN:%Y%m%d}'))
    cast.set_depths_and_sound_speeds(np.array([[0, 14800], [30, 14900]], np.uint32))
    written = [packed(installation, 0.0), packed(zero(made.RuntimeParameters()), 0.0)]
    written.append(packed(cast, 0.0))
    for k, (seconds, (latitude, longitude)) in enumerate(
        line_east(pings) if spots is None else spots
    ):
        place = zero(
            made.PositionDatagram(),
            latitude=round(2e7 * latitude),
            longitude=round(1e7 * longitude),
            heading=9000,
            course=9000,
            position_system_descriptor=1,
            size_of_input_datagram=6,
        )
        place.set_input_datagram('$GPGGA')
        attitude = zero(made.AttitudeDatagram(), number_of_entries=1)
        entries = parts.AttitudeDatagramAttitudesContainer()
        entries.set_attitudes([zero(parts.AttitudeDatagramAttitude(), heading=9000)])
        attitude.set_attitudes(entries)
        count = len(across)
        ping = zero(
            made.XYZDatagram(),
            heading=9000,
            ping_counter=k,
            number_of_beams=count,
            number_of_valid_detections=count,
        )
        beams = parts.XYZDatagramBeamsContainer()
        beams.set_beams(
            [
                zero(
                    parts.XYZDatagramBeam(),
                    depth=down,
                    acrosstrack_distance=y,
                    alongtrack_distance=0.5,
                )
                for y in across
            ]
        )
        ping.beams = beams
        written += [packed(part, seconds) for part in (place, attitude, ping)]
    path.write_bytes(b''.join(written))
    return path
