# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The options of each kind of conversion, declared once for the converter and for the help page
of ``sonar-imm convert KIND``, as long as that is.

A converter is told its options as an attrs class. Every field is made with `option`, which keeps
what the command line needs beside the default, or is a group of options of its own, such as those
of a CSV file, made with `group`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, ClassVar

import attrs
from attrs import evolve, field, frozen, NOTHING

from sonar_imm.parameters import did_you_mean, Range

from .columns import ALIASES
from .sources import BagError
from .times import DAYS, GPS, HHMMSS, ORDERS, zone_of

BEARINGS = ('bow', 'north', 'east')
"""Where bearings count from: clockwise from the bow or from north, counter-clockwise from east."""
TIME_UNITS = {
    's': 10**9, 'ms': 10**6, 'us': 10**3, 'ns': 1,
    'min': 60 * 10**9, 'h': 3600 * 10**9, 'd': 86400 * 10**9,
}  # fmt: skip
_UNITS = (*TIME_UNITS, HHMMSS, *DAYS, GPS)
_KEY = 'sonar_imm.option'
KINDS = {'float': 'float', 'int': 'int', 'Path': 'file', 'Mapping': 'pairs'}
"""Kinds of options by the types of their fields; ``text`` for others."""


@frozen(kw_only=True)
class Option:
    """An option of the command line.

    metavar: what the help page shows for its value; empty for the name of the type. flag: its
    spelling where that is not the name of the field. kind: ``text``, ``float``, ``int``, ``file``,
    ``speed`` for that of sound, a number or a file with a profile, or ``pairs`` for NAME=VALUE,
    which may be repeated; by default as `KINDS` has it for the type of the field. range: of a
    number, inclusive; above: a limit it has to exceed. parse: from the text to the value; raises
    ValueError with a sentence. many: may be repeated.
    """

    help: str
    metavar: str = ''
    flag: str = ''
    kind: str = ''
    range: Range = (None, None)
    above: float | None = None
    choices: tuple[str, ...] = ()
    parse: Callable[[str], Any] | None = None
    many: bool = False


@frozen
class Group:
    """Options of an attrs class as a field of another one: their flags begin with `prefix`, and
    `what` takes the place of ``{what}`` in their help texts."""

    options: type
    prefix: str
    what: str


def option(default: Any, metavar: str, help: str, **more: Any) -> Any:
    """A field that is one option; `more` is as in `Option`. With the default attrs.NOTHING it has
    to be given."""
    default = attrs.Factory(dict) if default == {} else default
    spec = Option(help=help, metavar=metavar, **more)
    return field(default=default, metadata={_KEY: spec})


def group(options: type, prefix: str = '', what: str = 'the input') -> Any:
    return field(factory=options, metadata={_KEY: Group(options, prefix, what)})


def spec_of(attribute: attrs.Attribute[Any]) -> Option | Group:
    """What was declared of a field."""
    found: Option | Group = attribute.metadata[_KEY]
    if isinstance(found, Group) or found.kind:
        return found
    return evolve(found, kind=KINDS.get(str(attribute.type).split()[0].split('[')[0], 'text'))


def _nanoseconds(text: str) -> int:
    try:
        return int(Decimal(text) * 10**9)
    except (InvalidOperation, ValueError, OverflowError):
        raise ValueError(f"'{text}' is not a number of seconds") from None


def _origin(text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(','))
    except ValueError:
        numbers = ()
    if len(numbers) not in (2, 3):
        raise ValueError(f"'{text}' is not of the form LAT,LON or LAT,LON,HEIGHT")
    return numbers


def _whole_numbers(text: str) -> list[int]:
    try:
        return [int(number) for number in text.split(',')]
    except ValueError:
        raise ValueError(f"'{text}' is not of the form 3,2,1,0") from None


def _staves(text: str) -> list[list[int]]:
    try:
        return [[int(channel) for channel in stave.split('+')] for stave in text.split(',')]
    except ValueError:
        raise ValueError(f"'{text}' is not of the form 0+3,1+2") from None


# fmt: off
@frozen(kw_only=True)
class CsvOptions:
    """How to read a CSV file.

    columns: what is not listed is found by its usual names (`ALIASES`); case and units are
    ignored. time_zone, empty: UTC where the header says so (``utc_time``), else times without a
    zone are refused. time_unit, empty: from the header (``time_ms``), else s; ISO 8601 texts are
    recognised, also as a date and a time of day in two columns.
    """

    columns: Mapping[str, str] = option({}, 'NAME=HEADER',
        'Header of a column of {what}, e.g. x=easting.', flag='column')
    time_zone: str = option('', 'ZONE',
        'Zone of times in {what} that do not say it: UTC, +02:00 or Europe/Berlin.')
    time_unit: str = option('', 'UNIT',
        'Unit of numeric times in {what}: s, ms, us, ns, min, h or d; HHMMSS for a time of day '
        'in one number; days of MATLAB (datenum), a spreadsheet (excel), or the Julian calendar '
        '(julian, mjd); seconds of GPS time (gps).', choices=('', *_UNITS))
    date_order: str = option('', 'ORDER',
        'Order of day, month and year in dates such as 05/06/24 in {what}.', choices=('', *ORDERS))
    time_offset_ns: int = option(0, 'SECONDS',
        'Added to every time of {what}.', flag='time-offset', kind='text', parse=_nanoseconds)
    delimiter: str = option('', '',
        'Delimiter between the columns of {what}; found automatically by default.')
    ignore: Sequence[str] = option((), 'NAME',
        'Quantity of {what} to leave out though a column has its name, e.g. id.', many=True)

    def __attrs_post_init__(self) -> None:
        if self.time_unit not in ('', *_UNITS):
            raise BagError(
                f"the time unit must be one of {', '.join(_UNITS)}, got '{self.time_unit}'"
            )
        if self.time_zone:
            zone_of(self.time_zone)
        for name in (*self.columns, *self.ignore):
            if name not in ALIASES:
                raise BagError(
                    f"there is no quantity '{name}' to map a column to"
                    f'{did_you_mean(name, ALIASES)}'
                )


@frozen(kw_only=True)
class _Options:
    storage: str = option('mcap', '', 'Storage of the bag.', choices=('mcap', 'sqlite3'))


@frozen(kw_only=True)
class _Places(_Options):
    frame_id: str = option('map', '', 'Frame of the positions, east-north-up.')
    origin: tuple[float, ...] | None = option(None, 'LAT,LON[,HEIGHT]',
        'Origin of local metres; by default the first good row.', parse=_origin)


@frozen(kw_only=True)
class _WithTruth(_Places):
    truth: Path | str | None = option(None, '', 'CSV of true positions for the same bag.')
    truth_options: CsvOptions = group(CsvOptions, 'truth', 'the truth')


@frozen(kw_only=True)
class _Navigated(_Options):
    nav: Path | str | None = option(None, '',
        'CSV of where the instrument was: stamp, x and y [m] or latitude and longitude [deg], '
        'heading [deg, clockwise from north], z or depth, roll, pitch [deg].')
    nav_options: CsvOptions = group(CsvOptions, 'nav', 'the navigation')


@frozen(kw_only=True)
class _OfSonar(_Options):
    frame_id: str = option('sonar', '', 'Frame of the sonar.')


@frozen(kw_only=True)
class _Detecting(_OfSonar):
    parameters: Mapping[str, Any] = option({}, 'NAME=VALUE',
        'Change one parameter of the detector; may be given several times.', flag='set')


def _bearings(usual: str) -> Any:
    help = (
        'Where bearings count from: bow or north, clockwise, or east, counter-clockwise. By '
        f'default {usual}, where no column says otherwise.'
    )
    return option(None, '', help, choices=BEARINGS)


def _element_spacing() -> Any:
    help = 'Distance between staves, to be stated in the snapshots.'
    return option(None, 'METRES', help, kind='float', range=(1e-5, 10.0))


def _phase_scale() -> Any:
    help = (
        'Radians of one count of the phase; by default 1 for floats, and for whole numbers the '
        'full circle over their range.'
    )
    return option(None, 'RAD', help, flag='phase-scale', kind='float')


@frozen(kw_only=True)
class _Polar(_WithTruth):
    options: CsvOptions = group(CsvOptions)
    range_std: float | None = option(None, 'METRES',
        'Standard deviation of ranges, for rows that state none.', above=0.0)
    bearing_std_deg: float | None = option(None, 'DEGREES',
        'Standard deviation of bearings, for rows that state none.', flag='bearing-std', above=0.0)
    ranges: str = option('', '',
        'Whether ranges are along the ray (slant) or in the plane (horizontal). By default as '
        'their header says, else horizontal where the depth hardly matters.',
        choices=('', 'slant', 'horizontal'))


@frozen(kw_only=True)
class _Receivers(_WithTruth):
    receivers: Path | str = option(NOTHING, '', 'CSV of receiver positions.')
    options: CsvOptions = group(CsvOptions)
    receiver_options: CsvOptions = group(CsvOptions, 'receiver', 'the position files')


@frozen(kw_only=True)
class FixesOptions(_Polar):
    """CSV of position fixes to /fix, or with names to /fixes.

    Columns: stamp, or date and time of day, x and y [m] or latitude and longitude [deg]; optional
    var_x, cov_xy, var_y [m^2] or std_x, std_y or std [m], id and valid. In place of x and y: range
    [m] and bearing from a sensor at the origin, with std_range and std_bearing;
    degrees unless the header says rad. Usual names are recognised; which columns were taken, and
    which not, is said. Times may count from 0; one that is written without a zone needs
    --time-zone. A row with a time and no position is a scan in which nobody was seen. Rows flagged
    as invalid are left out and counted; repeated polls are counted, and left out by `track`.
    """

    EXAMPLES: ClassVar = (
        'fixes.csv dive.bag --truth gps.csv',
        'usbl.csv dive.bag --column x=easting --column y=northing',
        'radar.csv dive.bag --bearings north --range-std 2 --bearing-std 0.5',
    )
    bearings: str | None = _bearings('north')
    depth_std: float | None = option(None, 'METRES',
        'Standard deviation of z or depth, for rows that state none.', above=0.0)


@frozen(kw_only=True)
class RelativeOptions(_Polar):
    """CSV of positions seen from a vessel to /relative and /nav.

    Columns: stamp; forward and starboard [m], or range [m] and bearing, with std_range and
    std_bearing, degrees unless the header says rad; vessel_x and vessel_y [m], or
    vessel_latitude and vessel_longitude [deg]; heading [deg, clockwise from north], which only
    bearings from north or east can do without; optional depth of the target below the vessel, std
    [m], id and valid. A row with the pose and no position is a scan in which nobody was seen.
    """

    EXAMPLES: ClassVar = (
        'usbl.csv dive.bag',
        'usbl.csv dive.bag --bearings north --column vessel_x=ship_e --column vessel_y=ship_n',
    )
    bearings: str | None = _bearings('bow')


@frozen(kw_only=True)
class NmeaOptions(_WithTruth):
    """Log of NMEA 0183 and AIS to /fixes, /nav_fix and /heading. Needs pyais and pynmea2.

    Fixes are the targets of AIS (by MMSI), TLL and TTM, and of a USBL (USRTH, PSIMSSB); the
    vessel's own GGA, RMC, GLL, GNS, HDT and THS are its navigation, or the fixes where there are
    no targets. Times stand before a
    sentence, in its tag block, or are the vessel's clock with the date of ZDA or RMC.
    """

    EXAMPLES: ClassVar = ('harbour.nmea harbour.bag', 'gps.log buoy.bag --date 2024-05-31')
    date: str = option('', 'DATE', 'Date of the first line (UTC), where no sentence says it.')
    time_zone: str = option('', 'ZONE',
        'Zone of times before the sentences that do not say it; UTC by default.')
    own: str = option('auto', '',
        'What the positions of the receiver itself are; auto: of the vessel, where there are '
        'targets, else the fixes.', choices=('auto', 'vessel', 'fixes'))
    talker: str = option('', 'GP|GN|...',
        'Whose positions of the receiver itself are used, where several talkers say them; by '
        'default of the one that says most.')


@frozen(kw_only=True)
class ArrivalsOptions(_Receivers):
    """CSV of arrival times to /arrivals, one message per ping.

    Columns: receiver and arrival (or toa and transmitter); ping says which rows belong together.
    """

    EXAMPLES: ClassVar = ('arrivals.csv dive.bag --receivers hydrophones.csv',)
    transmitters: Path | str | None = option(None, '', 'CSV of transmitter positions.')
    toa_std: float | None = option(None, 'SECONDS',
        'Standard deviation of arrival times, for rows that state none.', above=0.0)


@frozen(kw_only=True)
class DetectionsOptions(_Receivers):
    """Detections of tags by telemetry receivers to /arrivals.

    Columns: stamp (or date and time), receiver and tag; the usual names of exports are recognised.
    Detections of one tag within --window are one ping. With --sync, tags that lie at known places,
    the clocks of the receivers are compared first: offset and drift of each against the first
    receiver, by least squares, linear between knots --clock-interval apart; what is left is said.
    """

    EXAMPLES: ClassVar = (
        'vue.csv fish.bag --receivers stations.csv --sync synctags.csv',
        'detections.csv fish.bag --receivers stations.csv --toa-std 0.001',
    )
    sync: Path | str | None = option(None, '',
        'CSV of the positions of fixed tags, with the column tag.')
    window: float | None = option(None, 'SECONDS',
        'Longest time between the first and the last detection of a ping; by default 1, or half '
        'of the time between the pings of a tag.', range=(1e-3, 600.0))
    clock_interval: float = option(12.0, 'HOURS',
        'Time over which the clock of a receiver drifts evenly.', range=(0.1, 1e4))
    sound_speed: float = option(1500.0, '',
        'Speed of sound in m/s, or a file with its profile, for the travel times from fixed tags.',
        kind='speed', range=(1300.0, 1700.0))
    toa_std: float | None = option(None, 'SECONDS',
        'Standard deviation of arrival times; by default that of the clocks after --sync.',
        above=0.0)


@frozen(kw_only=True)
class TruthOptions(_Places):
    """CSV of true positions to /truth/estimate, for `evaluate`."""

    EXAMPLES: ClassVar = ('gps.csv truth.bag',)
    options: CsvOptions = group(CsvOptions)


@frozen(kw_only=True)
class SnapshotsOptions(_Navigated):
    """Array snapshots in a numpy archive (npz) to /snapshot.

    Arrays: iq, complex, (bins, staves) or (pings, bins, staves), and range [m] or time [s];
    optional sound_speed, frequency, element_spacing or spacing_wavelengths, stamp, noise_variance,
    signal_variance. With latitude and longitude, or x and y [m], and heading [deg] or yaw [rad],
    one value per ping, /nav is written; z or sonar_depth, roll, pitch and altitude are optional.
    Usual names are recognised; arrays that are not used are listed.
    """

    EXAMPLES: ClassVar = (
        'pings.npz survey.bag --name iq=data', 'ping.npz ping.bag --staves 0+3,1+2',
    )
    names: Mapping[str, str] = option({}, 'WHAT=ARRAY',
        'Name of an array in this archive, e.g. iq=data.', flag='name')
    staves: Sequence[Sequence[int]] | None = option(None, 'CHANNELS',
        'Channels, from 0, of each stave; those joined by + are summed.', parse=_staves)
    ping_rate: float = option(10.0, '',
        'Pings per second, when there are no stamps.', range=(0.001, 1000.0))
    frame_id: str = option('sonar', '', 'Frame of the sonar.')


@frozen(kw_only=True)
class ImagesOptions(_Options):
    """Bag with images of a forward-looking sonar to /detections.

    Takes marine_acoustic_msgs ProjectedSonarImage and RawSonarImage, pings of the Oculus, echoes
    of the Ping360, SonoptixECHO and sensor_msgs/Image. Navigation and altitudes are copied. --set
    changes the detector, whose parameters docs/parameters/fls_detector.md lists; those beside the
    recording, in its parameters.yaml, are used.
    """

    EXAMPLES: ClassVar = ('survey.bag detections.bag --set image_order=beam_major',)
    topic: str | None = option(None, '', 'Topic of the images, where several could be.')
    parameters: Mapping[str, Any] = option({}, 'NAME=VALUE',
        'Change one parameter; may be given several times.', flag='set')


@frozen(kw_only=True)
class InterferometerOptions(_Options):
    """Bag with amplitude and phase, or staves, to /snapshot.

    Takes RawSonarImage of marine_acoustic_msgs and messages like it: their fields are found by
    name. --field names others: amplitude, phase, iq, sample_rate, sample0, frequency, sound_speed.
    Navigation and altitudes are copied.
    """

    EXAMPLES: ClassVar = (
        'survey.bag swath.bag --amplitude /sss/amplitude --phase /sss/phase --element-spacing '
        '0.012',
        'survey.bag swath.bag --iq /stave_0 --iq /stave_1',
    )
    amplitude: str = option('', 'TOPIC', 'Topic with the amplitudes.')
    phase: str = option('', 'TOPIC',
        'Topic with the phases, of stave 1 against stave 0, or one of each stave.')
    iq: Sequence[str] = option((), 'TOPIC',
        'Topic with the complex samples of a stave, the uppermost first; once for each.',
        many=True)
    fields: Mapping[str, str] = option({}, 'WHAT=PATH',
        'Where something stands in the messages, e.g. phase=sidescan.phase.', flag='field')
    side: str = option('', '', 'Of the array.', choices=('port', 'starboard'))
    radians_per_count: float | None = _phase_scale()
    element_spacing: float | None = _element_spacing()
    sound_speed: float = option(1500.0, '',
        'Speed of sound in m/s, or a file with its profile, where a message states none.',
        kind='speed', range=(1300.0, 1700.0))
    order: str = option('range_major', '',
        'Order of the samples in an image with several channels.',
        choices=('range_major', 'beam_major'))


@frozen(kw_only=True)
class HydrophonesOptions(_Navigated):
    """Sound of a vertical array to /pressure. Needs soundfile.

    WAV or FLAC with a channel for each hydrophone, the deepest first; --channels says another
    order. The first sample is taken at --start, or when the name of the file says, as in
    20240531_100000.wav.
    """

    EXAMPLES: ClassVar = (
        '20240531_100000.wav drift.bag', 'array.wav drift.bag --channels 3,2,1,0 --depth 120',
    )
    start: str = option('', 'TIME',
        'Time of the first sample, e.g. 2024-05-31T10:00:00Z, now, or 0 if it does not matter.')
    time_zone: str = option('UTC', 'ZONE', 'Zone of a time that does not say it.')
    channels: Sequence[int] | None = option(None, 'CHANNELS',
        'Channels of the hydrophones, from 0, the deepest first; all in their order by default.',
        parse=_whole_numbers)
    full_scale: float = option(1.0, 'PASCALS',
        'Pressure of the full scale. The tracker needs ratios only.', above=0.0)
    depth: float | None = option(None, 'METRES',
        'Depth of the deepest hydrophone, to be stated with each block.')
    block: float = option(1.0, 'SECONDS', 'Length of a message.', range=(0.01, 600.0))
    frame_id: str = option('array', '', 'Frame of the array.')


@frozen(kw_only=True)
class SegyOptions(_Navigated):
    """Traces of a sub-bottom profiler in SEG-Y or SU to /trace. Needs segyio.

    Stamps, recording delay, sample interval and places come from the headers of each trace; traces
    within one second are spread over it.
    """

    EXAMPLES: ClassVar = (
        'line.seg line.bag', 'line.seg line.bag --sample-spacing 0.376 --first-sample 12',
        'line.sgy line.bag --time-zone +02:00 --crs 32631',
    )
    time_zone: str = option('', 'ZONE', 'Zone of times whose headers say they are local.')
    start: str = option('', 'TIME',
        'Time of the first trace, e.g. 2024-05-31T10:00:00Z, where the headers hold no date.')
    rate: float = option(1.0, '',
        'Traces per second, where the headers hold no times.', range=(1e-6, 1e6))
    crs: int | None = option(None, 'EPSG',
        'Coordinate system of places in metres or feet. Needs rasterio.', range=(1, None))
    sample_spacing: float | None = option(None, 'METRES',
        'Depth from sample to sample; by default from the sample interval.', above=0.0)
    sound_speed: float = option(1500.0, '',
        'Speed of sound in m/s, or a file with its profile, for the sample interval and the '
        'recording delay.', kind='speed', range=(1300.0, 1700.0))
    first_sample: int = option(0, '',
        'Leave out samples before it, e.g. the transmit pulse.', range=(0, None))
    samples: int | None = option(None, '',
        'How many samples to take; all by default.', range=(2, None))
    stack: int = option(1, '', 'Number of successive traces averaged into one.', range=(1, None))
    depth_offset: float = option(0.0, 'METRES', 'Depth of the transducer.', flag='depth')
    frame_id: str = option('profiler', '', 'Frame of the traces.')


@frozen(kw_only=True)
class TracesOptions(_Navigated):
    """Traces in a numpy archive (npz) or CSV to /trace.

    Archive: depth (n,), amplitude (n,) or (traces, n); optional stamp, sigma, reference_depth, and
    as truth reflector_depth and reflector_amplitude (traces, K). CSV: stamp, depth, amplitude and
    optional std, one row per sample.
    """

    EXAMPLES: ClassVar = (
        'responses.npz drift.bag --rate 0.0112', 'traces.csv line.bag --column depth=z',
    )
    options: CsvOptions = group(CsvOptions)
    rate: float = option(1.0, '',
        'Traces per second, when an archive has no stamps.', range=(1e-6, 1e6))
    frame_id: str = option('array', '', 'Frame of the traces.')

@frozen(kw_only=True)
class XtfOptions(_Detecting):
    """Side scan in an XTF file to /detections and /nav. Needs pyxtf.

    Each ping of --side is an image of one beam abeam, in which echoes are found; --set changes the
    detector (docs/parameters/fls_detector.md). Where a side has a channel whose name says phase,
    it becomes /port/snapshot or /starboard/snapshot too: one channel of stave 1 against stave 0,
    or one for each stave. Processed soundings of a multibeam become /ground.
    """

    EXAMPLES: ClassVar = ('line.xtf line.bag', 'line.xtf line.bag --side port')
    side: str = option('starboard', '',
        'Side whose echoes are found.', choices=('starboard', 'port'))
    units: str = option('auto', '',
        'Units of the places; auto: what the file says.', choices=('auto', 'degrees', 'metres'))
    frequency: float | None = option(None, 'HZ',
        'Which channel of a side, of several frequencies; by default the first one.', above=0.0)
    port_samples: str = option('far', '',
        'Which sample of a port channel comes first: most programs write the farthest.',
        choices=('far', 'near'))
    radians_per_count: float | None = _phase_scale()
    element_spacing: float | None = _element_spacing()


@frozen(kw_only=True)
class PicturesOptions(_Detecting):
    """Folder of pictures of a sonar to /detections. Needs Pillow.

    PNG or JPEG of a forward-looking sonar. A CSV in the folder says file and stamp of each, and
    where the vehicle was: x, y or latitude, longitude [deg], heading [deg, clockwise from north],
    optional depth. near_range, far_range [m] and fov [deg] stand there too, or are options. Rows
    of a picture are ranges from near to far, columns beams from port to starboard; fans drawn on
    paper are none. --set changes the detector (docs/parameters/fls_detector.md).
    """

    EXAMPLES: ClassVar = ('frames dive.bag --far-range 40 --fov 90',)
    table: Path | str | None = option(None, '', 'The CSV, where there are several.')
    near_range: float = option(0.0, 'METRES',
        'Range of the first row, for rows that state none.', range=(0.0, 1e4))
    far_range: float | None = option(None, 'METRES',
        'Range of the last row, for rows that state none.', range=(0.1, 1e4))
    fov: float | None = option(None, 'DEGREES',
        'Width of the sector, for rows that state none.', range=(0.1, 360.0))
    options: CsvOptions = group(CsvOptions)
# fmt: on


OPTIONS: dict[str, type] = {
    options.__name__.removesuffix('Options').lower(): options
    for options in (
        *(FixesOptions, RelativeOptions, NmeaOptions, ArrivalsOptions, DetectionsOptions),
        *(TruthOptions, SnapshotsOptions, ImagesOptions, InterferometerOptions),
        *(SegyOptions, XtfOptions, PicturesOptions, HydrophonesOptions, TracesOptions),
    )
}
"""The options by the kind of conversion."""
FROM_BAGS = ('images', 'interferometer')
"""The kinds that read a bag; the others read a file, or a folder of pictures."""
DETECTING = ('images', 'xtf', 'pictures')
"""The kinds that find echoes in images."""
