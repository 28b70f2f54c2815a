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


def side_scan(path, pings=60, bins=500, target=(3.0, 30.0), seed=1):
    """A line east at half a metre per second, 5 pings per second, with one target to starboard;
    target: metres east along the line and away from it."""
    rng = np.random.default_rng(seed)
    channels = [('port', 'port', 'uint16'), ('stbd', 'starboard', 'uint16')]
    parts = [xtf_head(channels).to_bytes()]
    for k in range(pings):
        seconds = 0.2 * k
        x = 0.5 * seconds
        port, starboard = (np.round(200.0 * np.sqrt(rng.exponential(size=bins))) for _ in range(2))
        if abs(x - target[0]) < 0.5:
            starboard[round(target[1] / 50.0 * bins)] = 20_000.0
        samples = [port[::-1].astype('u2'), starboard.astype('u2')]
        parts.append(xtf_ping(seconds, samples, place_of(x, 0.0)))
    path.write_bytes(b''.join(parts))
    return path


def ek80_datagram(kind, seconds, content):
    """A datagram of a raw file: its length, type, time in 100 ns since 1601, content and length
    again, as Kongsberg's EK80 interface specification has it."""
    since = BEGIN - datetime(1601, 1, 1, tzinfo=timezone.utc) + timedelta(seconds=seconds)
    ticks = since // timedelta(microseconds=1) * 10
    body = kind.encode() + struct.pack('<Q', ticks) + content
    return struct.pack('<i', len(body)) + body + struct.pack('<i', len(body))


def ek80(path, samples, chirp=False, channel='WBT 1-15 ES70', place=PLACE):
    """A raw file with one channel; samples: (pings, bins, sectors), complex, 5 pings per second.
    The datagrams with samples are written by the library."""
    from themachinethatgoesping.echosounders import simradraw

    def xml(seconds, text):
        return ek80_datagram('XML0', seconds, text.encode())

    pulse = 'FrequencyStart="55000" FrequencyEnd="90000"' if chirp else 'Frequency="70000"'
    parts = [
        xml(
            0.0,
            '<?xml version="1.0" encoding="utf-8"?><Configuration><Header ApplicationName="EK80" '
            'Version="2.0.1.0" FileFormatVersion="1.23" TimeBias="0"/><Transceivers>'
            '<Transceiver TransceiverName="WBT 1" SerialNumber="1" Impedance="5400" '
            'RxSampleFrequency="1500000" TransceiverNumber="1" TransceiverType="WBT"><Channels>'
            f'<Channel ChannelID="{channel}" ChannelIdShort="ES70" MaxTxPowerTransceiver="750" '
            'PulseDuration="0.000256" PulseDurationFM="0.000512"><Transducer '
            'TransducerName="ES70" SerialNumber="1" Frequency="70000" FrequencyMinimum="45000" '
            'FrequencyMaximum="90000" Gain="27" SaCorrection="0" EquivalentBeamAngle="-20.7" '
            'AngleSensitivityAlongship="23" AngleSensitivityAthwartship="23" '
            'BeamWidthAlongship="7" BeamWidthAthwartship="7" BeamType="1"/></Channel></Channels>'
            '</Transceiver></Transceivers><Transducers><Transducer TransducerName="ES70" '
            'TransducerMounting="HullMounted" TransducerOffsetX="0" TransducerOffsetY="0" '
            'TransducerOffsetZ="0"/></Transducers></Configuration>',
        ),
        xml(
            0.0,
            '<?xml version="1.0" encoding="utf-8"?><Environment Depth="28" Acidity="8" '
            'Salinity="35" SoundSpeed="1490" Temperature="10" Latitude="54" '
            'WaterLevelDraft="1"/>',
        ),
    ]
    for k, iq in enumerate(samples):
        seconds = 0.2 * k
        latitude, longitude = place
        moment = BEGIN + timedelta(seconds=seconds)
        fix = (
            f'GPGGA,{moment:%H%M%S}.{moment.microsecond // 10_000:02d},'
            f'{int(latitude):02d}{latitude % 1 * 60:08.5f},N,'
            f'{int(longitude):03d}{longitude % 1 * 60:08.5f},E,1,10,1.0,0.0,M,0.0,M,,'
        )
        for text in (fix, 'INHDT,90.0,T'):
            total = 0
            for letter in text:
                total ^= ord(letter)
            parts.append(ek80_datagram('NME0', seconds, f'${text}*{total:02X}'.encode()))
        mode = 1 if chirp else 0
        parts.append(
            xml(
                seconds,
                '<?xml version="1.0" encoding="utf-8"?><Parameter><Channel '
                f'ChannelID="{channel}" ChannelMode="0" PulseForm="{mode}" {pulse} '
                'PulseDuration="0.000256" SampleInterval="4e-05" TransmitPower="750" '
                'Slope="0.1" SoundVelocity="1490"/></Parameter>',
            )
        )
        data, kinds = simradraw.datagrams.RAW3(), simradraw.datagrams.raw3datatypes
        pairs = np.stack([iq.real, iq.imag], axis=-1).astype(np.float32)
        data.set_channel_id(channel.ljust(128, '\0'))
        data.set_timestamp(BEGIN.timestamp() + seconds)
        data.set_data_type(kinds.t_RAW3DataType.ComplexFloat32)
        data.set_number_of_complex_samples(iq.shape[1])
        data.set_count(len(iq))
        data.set_offset(0)
        data.set_sample_data(kinds.RAW3DataComplexFloat32(np.ascontiguousarray(pairs)))
        parts.append(ek80_datagram('RAW3', seconds, data.to_binary()[16:-4]))
    path.write_bytes(b''.join(parts))
    return path
