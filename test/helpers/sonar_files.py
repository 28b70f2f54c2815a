# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Files of XTF, made by the writer of pyxtf, and of SEG-Y, by that of segyio."""

from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

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


def xtf_ping(seconds, samples, place=PLACE, slant_range=50.0, delay=0.0, **more):
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
    ping.ping_chan_headers, ping.data = [], list(samples)
    for number, row in enumerate(samples):
        channel = pyxtf.XTFPingChanHeader()
        channel.ChannelNumber, channel.NumSamples = number, len(row)
        channel.SlantRange, channel.TimeDuration = slant_range, slant_range / 750.0
        channel.TimeDelay = delay
        ping.ping_chan_headers.append(channel)
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


def write_segy(path, amplitude, fmt=1, **fields):
    """Traces (T, n) in the sample format `fmt`; fields: of their headers by the names of segyio,
    one value for all or (T,)."""
    segyio = pytest.importorskip('segyio')
    spec = segyio.spec()
    spec.format, spec.tracecount = fmt, len(amplitude)
    spec.samples = np.arange(amplitude.shape[1], dtype=float)
    fields = {'TRACE_SAMPLE_COUNT': amplitude.shape[1], **fields}
    columns = {
        getattr(segyio.TraceField, name): np.broadcast_to(value, len(amplitude)).tolist()
        for name, value in fields.items()
    }
    with segyio.create(str(path), spec) as file:
        for k, trace in enumerate(amplitude):
            file.trace[k] = trace.astype(file.dtype)
            file.header[k] = {field: values[k] for field, values in columns.items()}
    return path
