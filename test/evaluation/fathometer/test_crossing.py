# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two simulated lines over one floor, which they see along different courses."""

import json

import numpy as np
import pytest

from msg_adapters.array_records import write_trace
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.response import envelope_parameters
from sonar_imm_tools.cli import main
from sonar_imm_tools.evaluation.fathometer.crossing import (
    common_shift,
    compared,
    crossing_lines,
    crossing_metrics,
    Horizon,
    mistie_figure,
    summary,
)
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.conversion import ConversionReport, write_bag
from sonar_imm_tools.recordings.convert_options import TracesOptions
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.own_files import write_own_parameters
from sonar_imm_tools.recordings.positions import write_position
from sonar_imm_tools.recordings.sources import BagError

SECOND = 10**9
LON, LAT, METRE = -91.64, 17.13, 180.0 / (np.pi * 6_371_008.8)
DEPTH = 0.25 * np.arange(140)


def floor(east, north):
    """Depths of two layers there: the lower one slopes to the north."""
    return 12.0 + 0.01 * east, 20.0 + 0.05 * north


def line(folder, name, places, shift=0.0, positions=True, first=0, lower=None):
    """A tracked line past `places` (T, 2) m, of traces that are too deep by `shift` and begin with
    sample `first`; lower: which of the places see the lower layer."""
    rng, records = np.random.default_rng(len(name)), []
    for k, (east, north) in enumerate(places):
        stamp = (1000 + k) * SECOND
        echo = 0.01 * np.abs(rng.standard_normal(len(DEPTH)))
        for depth in floor(east, north)[: 1 if lower is not None and k not in lower else 2]:
            echo += np.exp(-0.5 * np.square((DEPTH - depth - shift) / 0.5))
        trace = Trace(
            stamp_ns=stamp, depth=DEPTH[first:], amplitude=echo[first:], reference_depth=0.0
        )
        if positions:
            place = LON + east * METRE / np.cos(np.radians(LAT)), LAT + north * METRE
            records.append((stamp, '/position', write_position(stamp, *place)))
        records.append((stamp, '/trace', write_trace(trace, ros_message)))
    bag = folder / f'{name}.bag'
    write_bag(ConversionReport(bag), records, folder / name, TracesOptions())
    own = {**envelope_parameters(0.5, 0.05), 'particles': 400, 'depth_std': 0.1}
    write_own_parameters(bag, {'fathometer': own})
    assert main(['track', str(bag), str(folder / name)]) == 0
    return folder / name


@pytest.fixture(scope='module')
def lines(tmp_path_factory):
    folder = tmp_path_factory.mktemp('lines')
    way = np.linspace(-40.0, 40.0, 41)
    return {
        'we': line(folder, 'we', np.column_stack([way, np.full(41, 5.0)])),
        'sn': line(folder, 'sn', np.column_stack([np.full(41, -8.0), way])),
        'deep': line(folder, 'deep', np.column_stack([np.full(41, -8.0), way]), shift=0.6),
        'cut': line(folder, 'cut', np.column_stack([np.full(41, -8.0), way]), first=48),
        'late': line(
            folder, 'late', np.column_stack([np.full(41, -8.0), way]), lower=range(27, 41)
        ),
        'far': line(folder, 'far', np.column_stack([np.full(8, 90.0), way[:8]])),
        'lost': line(folder, 'lost', np.column_stack([way, way])[:8], positions=False),
    }


def crossed(lines, a, b, position_std=3.0):
    return crossing_metrics(RunFolder(lines[a]), RunFolder(lines[b]), position_std)


def test_where_lines_cross_their_horizons_agree(lines):
    metrics = crossed(lines, 'we', 'sn')
    [crossing] = metrics['crossings']
    assert crossing['longitude'] == pytest.approx(
        LON - 8.0 * METRE / np.cos(np.radians(LAT)), abs=1e-7
    )
    assert crossing['latitude'] == pytest.approx(LAT + 5.0 * METRE, abs=1e-7)
    assert crossing['angle_deg'] == pytest.approx(90.0, abs=0.1)
    assert crossing['stamp_a_ns'] == 1016 * SECOND and crossing['stamp_b_ns'] == 1022 * SECOND
    assert crossing['only_a'] == crossing['only_b'] == 0
    for horizon, true in zip(crossing['horizons'], floor(-8.0, 5.0)):
        assert horizon['depth_a_m'] == pytest.approx(true, abs=0.25)
        assert abs(horizon['difference_m']) < 0.3 and abs(horizon['sigmas']) < 2.5
    assert [horizon['bottom'] for horizon in crossing['horizons']] == [True, False]


def test_misties_are_drawn_by_horizon(lines, tmp_path):
    metrics = crossed(lines, 'we', 'sn')
    horizons = metrics['crossings'][0]['horizons']
    [drawn] = mistie_figure(metrics).data
    assert list(drawn.x) == [horizon['difference_m'] for horizon in horizons]
    assert list(drawn.error_x.array) == [2.0 * horizon['std_m'] for horizon in horizons]
    assert drawn.y[0].startswith('floor') and drawn.marker.symbol == 'circle'
    cut = mistie_figure(crossed(lines, 'we', 'cut')).data
    assert [each.marker.symbol for each in cut] == ['circle-open']
    page = tmp_path / 'misties.html'
    runs = [str(lines[name]) for name in ('we', 'sn')]
    assert main(['evaluate', *runs, '--crossing', '--report', str(page)]) == 0
    assert 'with two standard deviations' in page.read_text()


def test_the_error_of_a_position_counts_by_the_slope(lines):
    without, with_it = (crossed(lines, 'we', 'sn', std)['crossings'][0] for std in (0.0, 20.0))
    level, steep = (
        np.sqrt(b['std_m'] ** 2 - a['std_m'] ** 2)
        for a, b in zip(without['horizons'], with_it['horizons'])
    )
    # The lower layer slopes by 0.05 to the north, the upper one by 0.01 to the east, whatever line
    # sees it; the place of either line can be wrong.
    assert steep == pytest.approx(np.sqrt(2.0) * 20.0 * 0.05, abs=0.3) and level < 0.5


def test_a_line_that_is_too_deep_shows(lines):
    metrics = crossed(lines, 'we', 'deep')
    for horizon in metrics['crossings'][0]['horizons']:
        assert horizon['difference_m'] == pytest.approx(-0.6, abs=0.3)
    assert metrics['rms_sigmas'] > 2.0
    # All of it is common to both horizons.
    assert metrics['crossings'][0]['shift_m'] == pytest.approx(-0.6, abs=0.15)
    assert metrics['crossings'][0]['residual_rms_m'] < 0.25
    assert metrics['between_lines_m'] == pytest.approx(0.6, abs=0.2)
    assert 'more than is stated' in crossing_lines(metrics)[-1]
    agreeing = crossed(lines, 'we', 'sn')
    assert agreeing['between_lines_m'] == 0.0
    assert 'more than is stated' not in crossing_lines(agreeing)[-1]


def test_below_a_floor_that_is_cut_nothing_is_judged(lines, capsys):
    """The traces of one line begin at 12 m, below the floor there: what they show at their first
    depth is no depth of the floor."""
    metrics = crossed(lines, 'we', 'cut')
    [crossing] = metrics['crossings']
    assert crossing['floor_cut'] and len(crossing['horizons']) == 2
    assert [h['cut'] for h in crossing['horizons']] == [True, False]
    assert not any(h['judged'] for h in crossing['horizons'])
    assert metrics['matched'] == 2 and metrics['judged'] == 0
    assert np.isnan(metrics['rms_sigmas']) and 'shift_m' not in crossing
    assert main(['evaluate', str(lines['we']), str(lines['cut']), '--crossing']) == 0
    output = capsys.readouterr().out
    assert 'bottom, cut' in output and 'not judged' in output


def test_what_was_not_seen_at_the_crossing_is_not_compared(lines):
    """This line has the lower layer from 9 m beyond the crossing on."""
    [crossing] = crossed(lines, 'we', 'late')['crossings']
    assert [h['bottom'] for h in crossing['horizons']] == [True]
    # Where places may be wrong by so much it is.
    assert len(crossed(lines, 'we', 'late', 10.0)['crossings'][0]['horizons']) == 2


@pytest.mark.parametrize('first, second, bottom', [(0.6, 0.9, True), (0.9, 0.5, False)])
def test_a_pair_is_the_floor_where_both_lines_rather_take_it_for_it(first, second, bottom):
    first, other = (
        Horizon(1, 20.0, 0.1, 0.0, is_bottom=share, multiple=0.0, cut=False)
        for share in (first, second)
    )
    further = first._replace(depth=21.0)
    for pair in ([first], [other]), ([other], [first]):
        [horizon] = compared(*pair, 1.0, np.eye(2), 0.0)['horizons']
        assert horizon['bottom'] == bottom
    # Of those a separation apart nobody knows that they are one.
    assert compared([first], [further], 1.0, np.eye(2), 0.0)['horizons'] == []


def test_shift_and_spread_of_differences_that_are_known():
    """Many made-up crossings: what comes out has the mean and the variances that went in."""
    rng = np.random.default_rng(3)
    shifts, chi2, missing = [], [], []
    std = np.array([0.1, 0.2, 0.3, 0.4])
    for _ in range(2000):
        off = 0.5 + std * rng.standard_normal(4)
        rows = [{'difference_m': d, 'std_m': s, 'sigmas': d / s} for d, s in zip(off, std)]
        shift = common_shift(rows)
        shifts.append((shift['shift_m'] - 0.5) / shift['shift_std_m'])
        chi2.append(shift['residual_rms_sigmas'] ** 2)
        missing.append(off)
    assert np.mean(shifts) == pytest.approx(0.0, abs=0.08)
    assert np.std(shifts) == pytest.approx(1.0, abs=0.06)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.07)
    everything = [
        {'difference_m': d, 'std_m': s, 'sigmas': d / s}
        for off in missing
        for d, s in zip(off, std)
    ]
    assert summary(everything)['between_lines_m'] == pytest.approx(0.5, abs=0.02)
    assert common_shift(rows[:1]) == {} and summary([])['judged'] == 0


def test_no_crossing_and_no_places_are_said(lines, capsys):
    assert crossed(lines, 'we', 'far')['crossings'] == []
    with pytest.raises(BagError, match='has no positions'):
        crossed(lines, 'we', 'lost')
    assert main(['evaluate', str(lines['we']), str(lines['far']), '--crossing']) == 0
    assert 'do not cross' in capsys.readouterr().out
    assert main(['evaluate', str(lines['we']), '--crossing']) == 2
    assert main(['evaluate', str(lines['we']), str(lines['sn'])]) == 2


def test_the_command_says_it(lines, capsys):
    assert main(['evaluate', str(lines['we']), str(lines['sn']), '--crossing']) == 0
    out = capsys.readouterr().out
    assert '2 horizons matched' in out and ', bottom' in out and 'stated sigma' in out
    assert main(['evaluate', str(lines['we']), str(lines['sn']), '--crossing', '--json']) == 0
    assert json.loads(capsys.readouterr().out)['matched'] == 2
