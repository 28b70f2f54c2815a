"""``sonar-imm convert``: one subcommand a kind of input, because each has its own options."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import click

from .common import (
    BAG,
    example,
    json_option,
    pairs_option,
    print_json,
    say,
    set_option,
    typed_overrides,
)

FILE = click.Path(path_type=Path, dir_okay=False)
BAG_OUT = click.Path(path_type=Path)


@click.group()
def command() -> None:
    """Turn recordings in other formats into a rosbag2 bag.

    Rows that cannot be used are left out, counted and named by line.
    """


def _origin(_ctx: click.Context, _param: click.Parameter,
            value: str | None) -> tuple[float, ...] | None:
    if value is None:
        return None
    try:
        numbers = tuple(float(part) for part in value.split(','))
    except ValueError:
        numbers = ()
    if len(numbers) not in (2, 3):
        raise click.BadParameter(f"'{value}' is not of the form LAT,LON or LAT,LON,HEIGHT")
    return numbers


def _nanoseconds(_ctx: click.Context, _param: click.Parameter, value: str) -> int:
    try:
        return int(Decimal(value) * 10**9)
    except (InvalidOperation, ValueError, OverflowError):
        raise click.BadParameter(f"'{value}' is not a number of seconds") from None


def _staves(_ctx: click.Context, _param: click.Parameter,
            value: str | None) -> list[list[int]] | None:
    if value is None:
        return None
    try:
        return [[int(channel) for channel in stave.split('+')] for stave in value.split(',')]
    except ValueError:
        raise click.BadParameter(f"'{value}' is not of the form 0+3,1+2") from None


def csv_options(prefix: str = '', what: str = 'the input') -> Callable[..., Any]:
    """The options that describe a CSV file; `prefix` tells several files apart."""
    dashed, name = (f'{prefix}-', f'{prefix}_') if prefix else ('', '')

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        for option in (
            click.option(f'--{dashed}delimiter', f'{name}delimiter', default='',
                         help=f'Between the columns of {what}; found by itself.'),
            click.option(f'--{dashed}time-offset', f'{name}time_offset', default='0',
                         callback=_nanoseconds, metavar='SECONDS',
                         help=f'Added to every time of {what}.'),
            click.option(f'--{dashed}time-unit', f'{name}time_unit', default='',
                         type=click.Choice(['', 's', 'ms', 'us', 'ns']), metavar='UNIT',
                         help=f'Of numeric times in {what}: s, ms, us or ns.'),
            pairs_option(f'--{dashed}column', f'{name}columns', metavar='NAME=HEADER',
                         help=f'Which column of {what} is what, e.g. x=easting.'),
        ):
            function = option(function)
        return function
    return decorate


def place_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Frame and origin, for all that has positions."""
    function = click.option('--origin', callback=_origin, metavar='LAT,LON[,HEIGHT]',
                            help='Of local metres; by default the first good row.')(function)
    return frame_option(function)


def frame_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """``--frame-id``."""
    return click.option('--frame-id', default='map', show_default=True,
                        help='Frame of the positions, east-north-up.')(function)


def storage_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """``--storage``."""
    return click.option('--storage', type=click.Choice(['mcap', 'sqlite3']), default='mcap',
                        show_default=True, help='Kind of bag.')(function)


def truth_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """``--truth``, with its own columns."""
    function = csv_options('truth', 'the truth')(function)
    return click.option('--truth', type=FILE,
                        help='CSV of true positions for the same bag.')(function)


def _options(values: dict[str, Any], prefix: str = '') -> Any:
    """Take the options of one CSV file out of `values`."""
    from ..recordings.csv_table import CsvOptions
    return CsvOptions(columns=values.pop(f'{prefix}columns'),
                      time_unit=values.pop(f'{prefix}time_unit'),
                      time_offset_ns=values.pop(f'{prefix}time_offset'),
                      delimiter=values.pop(f'{prefix}delimiter'))


def _convert(kind: str, source: Path, out_bag: Path, as_json: bool, **options: Any) -> None:
    from ..recordings.convert import KINDS
    report = KINDS[kind](source, out_bag, **options)
    if as_json:
        print_json({'bag': str(report.path), 'messages': report.messages, 'rows': report.rows,
                    'bad_rows': report.bad_rows, 'problems': report.problems,
                    'notes': report.notes})
        return
    what = ', '.join(f'{count} on {topic}' for topic, count in sorted(report.messages.items()))
    say(f'{report.path}: {what}, from {report.rows} rows')
    _say_all('note', (f'{key}: {value}' for key, value in report.notes.items()))
    _say_all('left out', report.problems)
    if report.bad_rows:
        say(f'  {report.bad_rows} rows left out')


def _say_all(label: str, lines: Iterable[str]) -> None:
    for line in lines:
        say(f'  {label}: {line}')


@command.command('fixes', epilog=example(
    'sonar-imm convert fixes fixes.csv dive.bag --truth gps.csv',
    'sonar-imm convert fixes usbl.csv dive.bag --column x=easting --column y=northing'))
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@csv_options()
@truth_option
@place_options
@storage_option
@json_option
def fixes(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """CSV of position fixes to /fix.

    Columns: stamp, x and y [m] or latitude and longitude [deg]; optional var_x, cov_xy, var_y
    [m^2] or std_x, std_y or std [m]. Usual names are recognised.
    """
    _convert('fixes', source, out_bag, as_json, options=_options(values),
             truth_options=_options(values, 'truth_'), **values)


@command.command('arrivals', epilog=example(
    'sonar-imm convert arrivals arrivals.csv dive.bag --receivers hydrophones.csv'))
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@click.option('--receivers', type=FILE, required=True, help='CSV of receiver positions.')
@click.option('--transmitters', type=FILE, help='CSV of transmitter positions.')
@click.option('--toa-std', type=click.FloatRange(min=0.0, min_open=True), metavar='SECONDS',
              help='Standard deviation of arrival times that state none.')
@csv_options()
@csv_options('receiver', 'the position files')
@truth_option
@place_options
@storage_option
@json_option
def arrivals(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """CSV of arrival times to /arrivals, one message a ping.

    Columns: receiver and arrival (or toa, with transmitter); ping tells pings apart.
    """
    _convert('arrivals', source, out_bag, as_json, options=_options(values),
             receiver_options=_options(values, 'receiver_'),
             truth_options=_options(values, 'truth_'), **values)


@command.command('truth', epilog=example('sonar-imm convert truth gps.csv truth.bag'))
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@csv_options()
@place_options
@storage_option
@json_option
def truth(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """CSV of true positions to /truth/estimate, for `evaluate --truth`."""
    _convert('truth', source, out_bag, as_json, options=_options(values), **values)


@command.command('autoferry', epilog=example(
    'sonar-imm convert autoferry scenario13.json boats.bag --truth '
    'scenario13_groundTruth.json --sensor radar --std 5'))
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@click.option('--truth', type=FILE, help='Ground truth of the scenario, JSON.')
@click.option('--sensor', 'sensors', multiple=True, default=['radar'], show_default=True,
              help='radar or lidar; may be given twice.')
@click.option('--std', type=click.FloatRange(min=0.0, min_open=True), metavar='METRES',
              help='Standard deviation to state on each axis.')
@frame_option
@storage_option
@json_option
def autoferry(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """Detections of the Autoferry data set (JSON) to /fix: boats in clutter."""
    _convert('autoferry', source, out_bag, as_json, **values)


@command.command('snapshots', epilog=example(
    'sonar-imm convert snapshots pings.npz survey.bag --name iq=data',
    'sonar-imm convert snapshots ping.npz ping.bag --staves 0+3,1+2'))
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@pairs_option('--name', 'names', metavar='WHAT=ARRAY',
              help='What an array is called here, e.g. iq=data.')
@click.option('--staves', callback=_staves, metavar='CHANNELS',
              help='Channels, from 0, that make each stave; those joined by + are added up.')
@click.option('--ping-rate', type=click.FloatRange(min=0.001, max=1000.0), default=10.0,
              show_default=True, help='Pings a second, where there are no stamps.')
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


@command.command('images', epilog=example(
    'sonar-imm convert images survey.bag detections.bag --set image_order=beam_major'))
@click.argument('source', metavar='IN', type=BAG)
@click.argument('out_bag', type=BAG_OUT)
@set_option
@storage_option
@json_option
def images(source: Path, out_bag: Path, overrides: dict[str, str], as_json: bool,
           **values: Any) -> None:
    """Bag with images of a forward-looking sonar to /detections, for the obstacle tracker.

    Takes marine_acoustic_msgs ProjectedSonarImage and RawSonarImage; navigation and altitudes come
    along. --set changes the detector: image_order, beam_axes, sound_speed, guard, training,
    false_alarm, min_range, max_detections.
    """
    from msg_adapters.sonar_images import DetectorConfig
    _convert('images', source, out_bag, as_json,
             parameters=typed_overrides(DetectorConfig, overrides), **values)


@command.command('segy', epilog=example(
    'sonar-imm convert segy line.seg line.bag',
    'sonar-imm convert segy line.seg line.bag --sample-spacing 0.376 --first-sample 12'))
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@click.option('--sample-spacing', type=click.FloatRange(min=0.0, min_open=True), metavar='METRES',
              help='Depth from sample to sample; by default from the sample interval.')
@click.option('--sound-speed', type=click.FloatRange(min=1300.0, max=1700.0), default=1500.0,
              show_default=True, help='For the sample interval and the recording delay.')
@click.option('--first-sample', type=click.IntRange(min=0), default=0, show_default=True,
              help='Leave out what comes before, such as the transmit pulse.')
@click.option('--samples', type=click.IntRange(min=2), help='How many to take; all by default.')
@click.option('--stack', type=click.IntRange(min=1), default=1, show_default=True,
              help='Traces averaged to one.')
@click.option('--depth', 'depth_offset', type=float, default=0.0, show_default=True,
              metavar='METRES', help='Depth of the transducer.')
@click.option('--frame-id', default='profiler', show_default=True, help='Frame of the traces.')
@storage_option
@json_option
def segy(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """Traces of a sub-bottom profiler in SEG-Y to /trace. Needs segyio.

    Stamps come from the trace headers; traces within one second are spread over it.
    """
    _convert('segy', source, out_bag, as_json, **values)


@command.command('traces', epilog=example(
    'sonar-imm convert traces responses.npz drift.bag --rate 0.0112',
    'sonar-imm convert traces traces.csv line.bag --column depth=z'))
@click.argument('source', metavar='IN', type=FILE)
@click.argument('out_bag', type=BAG_OUT)
@csv_options()
@click.option('--rate', type=click.FloatRange(min=1e-6, max=1e6), default=1.0, show_default=True,
              help='Traces a second, where an archive has no stamps.')
@click.option('--frame-id', default='array', show_default=True, help='Frame of the traces.')
@storage_option
@json_option
def traces(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
    """Traces in a numpy archive (npz) or CSV to /trace.

    Archive: depth (n,), amplitude (n,) or (traces, n); optional stamp, sigma, reference_depth, and
    as truth reflector_depth and reflector_amplitude (traces, K). CSV: stamp, depth, amplitude and
    optional std, one row a sample.
    """
    _convert('traces', source, out_bag, as_json, options=_options(values), **values)
