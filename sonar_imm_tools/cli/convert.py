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

"""``sonar-imm convert``: one subcommand per kind of input, because each has its own options."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

from sonar_imm.trackers import SYSTEMS

from .common import (
    BAG,
    example,
    json_option,
    load_detector,
    pairs_option,
    print_json,
    say,
    set_option,
    typed_overrides,
)
from .convert_options import (
    csv_options,
    FILE,
    frame_option,
    interferometer_options,
    options,
    place_options,
    sensor_offsets,
    staves,
    storage_option,
    truth_option,
)

BAG_OUT = click.Path(path_type=Path)


@click.group()
def command() -> None:
    """Turn recordings in other formats into a rosbag2 bag.

    Rows that cannot be used are left out, counted and listed by line.
    """


def _convert(kind: str, source: Path, out_bag: Path, as_json: bool, **options: Any) -> None:
    from ..recordings.convert import KINDS

    report = KINDS[kind](source, out_bag, **options)
    if as_json:
        print_json(
            {
                'bag': str(report.path),
                'messages': report.messages,
                'rows': report.rows,
                'bad_rows': report.bad_rows,
                'reasons': dict(report.reasons),
                'problems': report.problems,
                'notes': report.notes,
            }
        )
        return
    what = ', '.join(f'{count} on {topic}' for topic, count in sorted(report.messages.items()))
    say(f'{report.path}: {what}, from {report.rows} rows')
    _say_all('note', (f'{key}: {value}' for key, value in report.notes.items()))
    _say_all('left out', report.problems)
    if report.bad_rows:
        why = ', '.join(f'{count} {reason}' for reason, count in report.reasons.most_common())
        say(f'  {report.bad_rows} rows left out' + (f', of them {why}' if why else ''))


def _say_all(label: str, lines: Iterable[str]) -> None:
    for line in lines:
        say(f'  {label}: {line}')


@command.command(
    'fixes',
    epilog=example(
        'sonar-imm convert fixes fixes.csv dive.bag --truth gps.csv',
        'sonar-imm convert fixes usbl.csv dive.bag --column x=easting --column y=northing',
    ),
)
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@csv_options()
@truth_option
@place_options
@storage_option
@json_option
def fixes(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """CSV of position fixes to /fix, or to /fixes where a column says whose they are.

    Columns: stamp, or date and time of day, x and y [m] or latitude and longitude [deg]; optional
    var_x, cov_xy, var_y [m^2] or std_x, std_y or std [m], id and valid. Usual names are
    recognised; which columns were taken, and which not, is said. Times may count from 0; one that
    is written without a zone needs --time-zone. Rows flagged as invalid are left out and counted;
    repeated polls are counted, and left out by `track`.
    """
    _convert(
        'fixes',
        source,
        out_bag,
        as_json,
        options=options(values),
        truth_options=options(values, 'truth_'),
        **values,
    )


@command.command(
    'arrivals',
    epilog=example('sonar-imm convert arrivals arrivals.csv dive.bag --receivers hydrophones.csv'),
)
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@click.option('--receivers', type=FILE, required=True, help='CSV of receiver positions.')
@click.option('--transmitters', type=FILE, help='CSV of transmitter positions.')
@click.option(
    '--toa-std',
    type=click.FloatRange(min=0.0, min_open=True),
    metavar='SECONDS',
    help='Standard deviation of arrival times, for rows that state none.',
)
@csv_options()
@csv_options('receiver', 'the position files')
@truth_option
@place_options
@storage_option
@json_option
def arrivals(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """CSV of arrival times to /arrivals, one message per ping.

    Columns: receiver and arrival (or toa and transmitter); ping says which rows belong together.
    """
    _convert(
        'arrivals',
        source,
        out_bag,
        as_json,
        options=options(values),
        receiver_options=options(values, 'receiver_'),
        truth_options=options(values, 'truth_'),
        **values,
    )


@command.command('truth', epilog=example('sonar-imm convert truth gps.csv truth.bag'))
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@csv_options()
@place_options
@storage_option
@json_option
def truth(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """CSV of true positions to /truth/estimate, for `evaluate --truth`."""
    _convert('truth', source, out_bag, as_json, options=options(values), **values)


@command.command(
    'autoferry',
    epilog=example(
        'sonar-imm convert autoferry scenario13.json boats.bag --truth '
        'scenario13_groundTruth.json --sensor radar --std 5'
    ),
)
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@click.option('--truth', type=FILE, help='Ground truth of the scenario, JSON.')
@click.option(
    '--sensor',
    'sensors',
    multiple=True,
    default=['radar'],
    show_default=True,
    help='radar or lidar; may be given twice.',
)
@click.option(
    '--std',
    type=click.FloatRange(min=0.0, min_open=True),
    metavar='METRES',
    help='Standard deviation to state on each axis.',
)
@click.option(
    '--time-offset',
    'time_offset_ns',
    default='0',
    callback=sensor_offsets,
    metavar='SECONDS',
    help='Added to the stamps of the detections, of all sensors or as radar=-1.5,lidar=0.1.',
)
@frame_option
@storage_option
@json_option
def autoferry(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """Detections of the Autoferry data set (JSON) to /fixes: boats in clutter."""
    _convert('autoferry', source, out_bag, as_json, **values)


@command.command(
    'snapshots',
    epilog=example(
        'sonar-imm convert snapshots pings.npz survey.bag --name iq=data',
        'sonar-imm convert snapshots ping.npz ping.bag --staves 0+3,1+2',
    ),
)
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@pairs_option(
    '--name', 'names', metavar='WHAT=ARRAY', help='Name of an array in this archive, e.g. iq=data.'
)
@click.option(
    '--staves',
    callback=staves,
    metavar='CHANNELS',
    help='Channels, from 0, of each stave; those joined by + are summed.',
)
@click.option(
    '--ping-rate',
    type=click.FloatRange(min=0.001, max=1000.0),
    default=10.0,
    show_default=True,
    help='Pings per second, when there are no stamps.',
)
@click.option('--frame-id', default='sonar', show_default=True, help='Frame of the array.')
@storage_option
@json_option
def snapshots(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """Array snapshots in a numpy archive (npz) to /snapshot.

    Arrays: iq, complex, (bins, staves) or (pings, bins, staves), and range [m] or time [s];
    optional sound_speed, frequency, element_spacing or spacing_wavelengths, stamp, noise_variance,
    signal_variance. Usual names are recognised.
    """
    _convert('snapshots', source, out_bag, as_json, **values)


@command.command(
    'images',
    epilog=example(
        'sonar-imm convert images survey.bag detections.bag --set image_order=beam_major'
    ),
)
@click.argument('source', metavar='IN', type=BAG)
@click.argument('out_bag', type=BAG_OUT)
@click.option('--topic', help='Topic of the images, where several could be.')
@set_option
@storage_option
@json_option
def images(
    source: Path, out_bag: Path, overrides: dict[str, str], as_json: bool, **values: Any
) -> None:
    """Bag with images of a forward-looking sonar to /detections, for the obstacle tracker.

    Takes marine_acoustic_msgs ProjectedSonarImage and RawSonarImage, pings of the Oculus, echoes
    of the Ping360, SonoptixECHO and sensor_msgs/Image. Navigation and altitudes are copied. --set
    changes the detector, whose parameters docs/parameters/fls_detector.md lists; those beside the
    recording, in its parameters.yaml, are used.
    """
    from sonar_imm.trackers.obstacle.detector import DetectorConfig

    from ..recordings.own_parameters import own_parameters

    own = load_detector(SYSTEMS['obstacle'], own_parameters(source), {})
    _convert(
        'images',
        source,
        out_bag,
        as_json,
        parameters=own | typed_overrides(DetectorConfig, overrides),
        **values,
    )


@command.command(
    'interferometer',
    epilog=example(
        'sonar-imm convert interferometer survey.bag swath.bag --amplitude /sss/amplitude --phase '
        '/sss/phase --element-spacing 0.012',
        'sonar-imm convert interferometer survey.bag swath.bag --iq /stave_0 --iq /stave_1',
    ),
)
@click.argument('source', metavar='IN', type=BAG)
@click.argument('out_bag', type=BAG_OUT)
@interferometer_options
@storage_option
@json_option
def interferometer(
    source: Path, out_bag: Path, side: str | None, as_json: bool, **values: Any
) -> None:
    """Bag with images of amplitude and phase, or of each stave, to /snapshot.

    Takes RawSonarImage of marine_acoustic_msgs and messages like it: their fields are found by
    name. --field names others: amplitude, phase, iq, sample_rate, sample0, frequency, sound_speed.
    Navigation and altitudes are copied.
    """
    _convert('interferometer', source, out_bag, as_json, side=side or '', **values)


@command.command(
    'segy',
    epilog=example(
        'sonar-imm convert segy line.seg line.bag',
        'sonar-imm convert segy line.seg line.bag --sample-spacing 0.376 --first-sample 12',
    ),
)
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@click.option(
    '--sample-spacing',
    type=click.FloatRange(min=0.0, min_open=True),
    metavar='METRES',
    help='Depth from sample to sample; by default from the sample interval.',
)
@click.option(
    '--sound-speed',
    type=click.FloatRange(min=1300.0, max=1700.0),
    default=1500.0,
    show_default=True,
    help='Speed of sound in m/s, for the sample interval and the recording delay.',
)
@click.option(
    '--first-sample',
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help='Leave out samples before it, e.g. the transmit pulse.',
)
@click.option(
    '--samples', type=click.IntRange(min=2), help='How many samples to take; all by default.'
)
@click.option(
    '--stack',
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help='Number of successive traces averaged into one.',
)
@click.option(
    '--depth',
    'depth_offset',
    type=float,
    default=0.0,
    show_default=True,
    metavar='METRES',
    help='Depth of the transducer.',
)
@click.option('--frame-id', default='profiler', show_default=True, help='Frame of the traces.')
@storage_option
@json_option
def segy(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """Traces of a sub-bottom profiler in SEG-Y to /trace. Needs segyio.

    Stamps come from the trace headers; traces within one second are spread over it.
    """
    _convert('segy', source, out_bag, as_json, **values)


@command.command(
    'traces',
    epilog=example(
        'sonar-imm convert traces responses.npz drift.bag --rate 0.0112',
        'sonar-imm convert traces traces.csv line.bag --column depth=z',
    ),
)
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@csv_options()
@click.option(
    '--rate',
    type=click.FloatRange(min=1e-6, max=1e6),
    default=1.0,
    show_default=True,
    help='Traces per second, when an archive has no stamps.',
)
@click.option('--frame-id', default='array', show_default=True, help='Frame of the traces.')
@storage_option
@json_option
def traces(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """Traces in a numpy archive (npz) or CSV to /trace.

    Archive: depth (n,), amplitude (n,) or (traces, n); optional stamp, sigma, reference_depth, and
    as truth reflector_depth and reflector_amplitude (traces, K). CSV: stamp, depth, amplitude and
    optional std, one row per sample.
    """
    _convert('traces', source, out_bag, as_json, options=options(values), **values)
