# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Sets of reflectors are scored as they should be, and a whole run is told."""

import json

from attrs import evolve
from helpers import marine
import numpy as np
import pytest

from msg_adapters.array_records import write_trace
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.response import envelope_parameters
from sonar_imm_tools.cli import main
from sonar_imm_tools.evaluation.fathometer import crossing, figures, LIMIT
from sonar_imm_tools.evaluation.fathometer.predictive import for_tuning, Scored, tunables
from sonar_imm_tools.evaluation.fathometer.scoring import (
    pair,
    Record,
    records_of,
    Reflections,
    score,
)
from sonar_imm_tools.evaluation.judging import judge
from sonar_imm_tools.offline.run_folder import read_measurements, RunFolder
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.own_files import write_own_parameters
from sonar_imm_tools.recordings.positions import write_position
from sonar_imm_tools.recordings.sources import BagError

SECOND = 10**9


def reflections(depth, strength=None, track_id=None):
    n = len(depth)
    strength = np.ones(n) if strength is None else np.array(strength)
    track_id = np.arange(n) if track_id is None else np.array(track_id)
    return Reflections(np.array(depth, float), strength, track_id)


def record(found, true, stamp=1, order=None, preview=False):
    pmf = np.zeros(6)
    pmf[(len(found) if order is None else order) - 1] = 1.0
    return Record(
        stamp_ns=stamp * SECOND, preview=preview, found=found, pmf=pmf, order_min=1, sigma=1.0,
        depth_std=np.full(len(found), 0.05), existence=np.ones(len(found)), true=true,
    )  # fmt: skip


def test_ospa_in_closed_form_and_partners_are_near_and_as_many_as_can_be():
    z = np.array([130.0, 134.0, 138.0])
    assert pair(z, z[::-1], 2.0).ospa == pair(z[:0], z[:0], 2.0).ospa == 0.0
    assert pair(np.array([10.0]), np.array([10.3]), 2.0).ospa == pytest.approx(0.3)
    assert pair(np.array([10.0]), np.array([15.0]), 2.0).ospa == pytest.approx(2.0)
    assert pair(np.array([]), np.array([15.0, 16.0]), 2.0).ospa == pytest.approx(2.0)
    three = pair(np.array([10.0, 20.0, 30.0]), np.array([10.3, 20.0]), 2.0)
    assert three.ospa == pytest.approx(((0.3**2 + 2.0**2) / 3.0) ** 0.5)
    for paired in (three, pair(np.array([10.0, 10.3]), np.array([9.7, 10.2]), 2.0)):
        assert list(paired.found) == list(paired.true) == [0, 1]
    assert not len(pair(np.array([10.0]), np.array([10.41]), 2.0).found)


def test_false_missed_amplitudes_and_switches_are_counted():
    true = reflections([130.0, 134.0], [0.4, 0.2], [7, 9])
    records = [
        record(reflections([130.1, 134.1], [4.0, 2.0], [1, 2]), true, 1),
        record(reflections([130.1, 134.1, 150.0], [4.0, 2.2, 1.0], [1, 3, 4]), true, 2),
        record(reflections([129.9], [4.0], [1]), true, 3, order=2),
        record(reflections([]), true, 4, order=5, preview=True),
    ]
    silent = record(reflections([130.0], [4.0]), reflections([130.0], [0.0]))
    assert score([silent])['amplitude'] == {'n': 0}
    assert score([*records, silent])['amplitude']['n'] == 5
    metrics = score(records)
    assert 'scored_records' not in score([evolve(each, true=None) for each in records])
    assert metrics['records'] == 3 and metrics['previews'] == 1
    assert metrics['order_right'] == pytest.approx(2 / 3)
    assert metrics['false_per_record'] == pytest.approx(1 / 3)
    assert metrics['missed_per_record'] == pytest.approx(1 / 3)
    assert metrics['depth']['rmse_m'] == pytest.approx(0.1)
    assert metrics['depth']['inside_2_sigma'] == pytest.approx(1.0)
    assert metrics['amplitude']['factor'] == pytest.approx(10.0)
    assert metrics['amplitude']['p95_relative_error'] == pytest.approx(0.08, abs=1e-9)
    assert metrics['identity_switches'] == 1 and metrics['ids'] == 4


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp('fathometer')
    scene = '--scenario drift_traces --seed 4 --set records=12 --set layers=3 --set fading='
    scene += ' --set appearing= --set depth_step=0.0625'
    assert main(['simulate', 'fathometer', str(folder / 'bag'), *scene.split()]) == 0
    how = '--system fathometer --set particles=4000'.split()
    assert main(['track', str(folder / 'bag'), str(folder / 'out'), *how]) == 0
    return RunFolder(folder / 'out')


def test_a_whole_run_is_judged_and_told(run, capsys):
    judgement = judge(run)
    assert judgement.metrics['scored_records'] == 12
    check = judgement.accuracy(None)
    assert check.good and not judgement.accuracy(1e-6).good
    assert check.name == f'{LIMIT.meaning} against truth'
    titles = [section.title for section in judgement.part([]).sections]
    first = ['Depth response and reflectors', 'How many there are']
    assert titles[:4] == [*first, 'Amplitudes', 'Distance from the truth']
    assert main(['evaluate', str(run.path), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['ospa_m'] == judgement.metrics['ospa_m']


def test_the_image_is_what_the_tracker_saw_and_a_thin_reflector_does_not_vanish_from_it(run):
    content = run.read_run()
    traces = [item for item in read_measurements(content) if isinstance(item, Trace)]
    image, fifth = figures.response_image(content), traces[5]
    assert image.value.shape == (len(fifth), len(traces)) and image.stamp_ns[5] == fifth.stamp_ns
    expected = fifth.amplitude / fifth.sigma
    assert np.allclose(image.value[:, 5], expected, rtol=1e-4, atol=1e-4)
    # Of an image with more depths and records than are drawn, the largest of a few is.
    value = np.zeros((2 * figures.MOST_DEPTHS, 3 * figures.MOST_RECORDS))
    value[301, 604] = 9.0
    depth, stamp_ns = 0.1 * np.arange(len(value)), 10**9 * np.arange(value.shape[1])
    (drawn,) = figures.response_figure(figures.Image(value, depth, stamp_ns), [], 0).data
    assert drawn.z.shape == (figures.MOST_DEPTHS, figures.MOST_RECORDS)
    [[row, column]] = np.argwhere(drawn.z)
    assert drawn.z[row, column] == 9.0
    assert drawn.y[row] == pytest.approx(30.1, abs=0.1)
    assert drawn.x[column] == pytest.approx(604.0, abs=3.0)


def test_truth_is_that_of_its_lag_later_within_the_gap_and_nothing_else(run):
    some = run.read_estimates()
    with pytest.raises(BagError, match='not estimates of reflectors'):
        records_of([evolve(item, extras={}) for item in some])
    with pytest.raises(BagError, match='truth is not that of reflectors'):
        records_of(some, [evolve(item, state_names=('px', 'py')) for item in some])
    early, late = (records_of(some[:1], some[1:], gap=gap)[0].true for gap in (60.0, 100.0))
    assert early is None and late is not None
    later = 1e-9 * (some[1].stamp_ns - some[0].stamp_ns)
    there = [np.sort(record.found.depth) for record in records_of(some)]
    shifted = records_of(some, some, lag=later, gap=0.1 * later)
    assert shifted[-1].true is None
    for record, depth in zip(shifted[:-1], there[1:], strict=True):
        np.testing.assert_array_equal(np.sort(record.true.depth), depth)


# -- two simulated lines over one floor, which they see along different courses -------------------

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
        seen = {'depth': DEPTH[first:], 'amplitude': echo[first:], 'reference_depth': 0.0}
        if positions:
            place = LON + east * METRE / np.cos(np.radians(LAT)), LAT + north * METRE
            records.append((stamp, '/position', write_position(stamp, *place)))
        trace = write_trace(Trace(stamp_ns=stamp, **seen), ros_message)
        records.append((stamp, '/trace', trace))
    bag = marine.write_bag(folder / f'{name}.bag', records)
    own = {**envelope_parameters(0.5, 0.05), 'particles': 400, 'depth_std': 0.1}
    write_own_parameters(bag, {'fathometer': own})
    assert main(['track', str(bag), str(folder / name)]) == 0
    return folder / name


@pytest.fixture(scope='module')
def lines(tmp_path_factory):
    folder = tmp_path_factory.mktemp('lines')
    way = np.linspace(-40.0, 40.0, 41)
    north = np.column_stack([np.full(41, -8.0), way])
    return {
        'we': line(folder, 'we', np.column_stack([way, np.full(41, 5.0)])),
        'sn': line(folder, 'sn', north),
        'deep': line(folder, 'deep', north, shift=0.6),
        'cut': line(folder, 'cut', north, first=48),
        'late': line(folder, 'late', north, lower=range(27, 41)),
        'far': line(folder, 'far', np.column_stack([np.full(8, 90.0), way[:8]])),
        'lost': line(folder, 'lost', np.column_stack([way, way])[:8], positions=False),
    }


def crossed(lines, a, b, position_std=3.0):
    return crossing.crossing_metrics(RunFolder(lines[a]), RunFolder(lines[b]), position_std)


def crossing_command(lines, a, b, *words):
    return main(['evaluate', str(lines[a]), str(lines[b]), '--crossing', *words])


def test_where_lines_cross_their_horizons_agree_and_misties_are_drawn(lines, tmp_path):
    metrics = crossed(lines, 'we', 'sn')
    [found] = metrics['crossings']
    there = LON - 8.0 * METRE / np.cos(np.radians(LAT)), LAT + 5.0 * METRE
    assert (found['longitude'], found['latitude']) == pytest.approx(there, abs=1e-7)
    assert found['angle_deg'] == pytest.approx(90.0, abs=0.1)
    assert found['stamp_a_ns'] == 1016 * SECOND and found['stamp_b_ns'] == 1022 * SECOND
    assert found['only_a'] == found['only_b'] == 0
    horizons = found['horizons']
    for horizon, true in zip(horizons, floor(-8.0, 5.0)):
        assert horizon['depth_a_m'] == pytest.approx(true, abs=0.25)
        assert abs(horizon['difference_m']) < 0.3 and abs(horizon['sigmas']) < 2.5
    assert [horizon['bottom'] for horizon in horizons] == [True, False]
    [drawn] = crossing.mistie_figure(metrics).data
    assert list(drawn.x) == [horizon['difference_m'] for horizon in horizons]
    assert list(drawn.error_x.array) == [2.0 * horizon['std_m'] for horizon in horizons]
    assert drawn.y[0].startswith('floor') and drawn.marker.symbol == 'circle'
    cut = crossing.mistie_figure(crossed(lines, 'we', 'cut')).data
    assert [each.marker.symbol for each in cut] == ['circle-open']
    page = tmp_path / 'misties.html'
    assert crossing_command(lines, 'we', 'sn', '--report', str(page)) == 0
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
    [found] = metrics['crossings']
    for horizon in found['horizons']:
        assert horizon['difference_m'] == pytest.approx(-0.6, abs=0.3)
    assert metrics['rms_sigmas'] > 2.0
    # All of it is common to both horizons.
    assert found['shift_m'] == pytest.approx(-0.6, abs=0.15) and found['residual_rms_m'] < 0.25
    assert metrics['between_lines_m'] == pytest.approx(0.6, abs=0.2)
    agreeing = crossed(lines, 'we', 'sn')
    assert agreeing['between_lines_m'] == 0.0
    for each, said in ((metrics, True), (agreeing, False)):
        assert ('more than is stated' in crossing.crossing_lines(each)[-1]) == said


def test_below_a_floor_that_is_cut_nothing_is_judged(lines, capsys):
    """The traces of one line begin at 12 m, below the floor there: what they show at their first
    depth is no depth of the floor."""
    metrics = crossed(lines, 'we', 'cut')
    [found] = metrics['crossings']
    assert found['floor_cut'] and [h['cut'] for h in found['horizons']] == [True, False]
    assert not any(h['judged'] for h in found['horizons'])
    assert metrics['matched'] == 2 and metrics['judged'] == 0
    assert np.isnan(metrics['rms_sigmas']) and 'shift_m' not in found
    assert crossing_command(lines, 'we', 'cut') == 0
    output = capsys.readouterr().out
    assert 'bottom, cut' in output and 'not judged' in output


def test_what_was_not_seen_at_the_crossing_is_not_compared(lines):
    """This line has the lower layer from 9 m beyond the crossing on; where places may be wrong by
    so much it is compared."""
    for std, bottoms in ((3.0, [True]), (10.0, [True, False])):
        [found] = crossed(lines, 'we', 'late', std)['crossings']
        assert [h['bottom'] for h in found['horizons']] == bottoms


@pytest.mark.parametrize('first, second, bottom', [(0.6, 0.9, True), (0.9, 0.5, False)])
def test_a_pair_is_the_floor_where_both_lines_rather_take_it_for_it(first, second, bottom):
    first, other = (
        crossing.Horizon(1, 20.0, 0.1, 0.0, is_bottom=share, multiple=0.0, cut=False)
        for share in (first, second)
    )
    for both in ([first], [other]), ([other], [first]):
        [horizon] = crossing.compared(*both, 1.0, np.eye(2), 0.0)['horizons']
        assert horizon['bottom'] == bottom
    # Of those a separation apart nobody knows that they are one.
    further = first._replace(depth=21.0)
    assert crossing.compared([first], [further], 1.0, np.eye(2), 0.0)['horizons'] == []


def test_shift_and_spread_of_differences_that_are_known():
    """Many made-up crossings: what comes out has the mean and the variances that went in."""
    rng, std = np.random.default_rng(3), np.array([0.1, 0.2, 0.3, 0.4])
    shifts, chi2, everything = [], [], []
    for _ in range(2000):
        off = 0.5 + std * rng.standard_normal(4)
        rows = [{'difference_m': d, 'std_m': s, 'sigmas': d / s} for d, s in zip(off, std)]
        shift = crossing.common_shift(rows)
        shifts.append((shift['shift_m'] - 0.5) / shift['shift_std_m'])
        chi2.append(shift['residual_rms_sigmas'] ** 2)
        everything += rows
    assert np.mean(shifts) == pytest.approx(0.0, abs=0.08)
    assert np.std(shifts) == pytest.approx(1.0, abs=0.06)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.07)
    assert crossing.summary(everything)['between_lines_m'] == pytest.approx(0.5, abs=0.02)
    assert crossing.common_shift(rows[:1]) == {} and crossing.summary([])['judged'] == 0


def test_the_command_says_it_and_what_is_missing(lines, capsys):
    assert crossing_command(lines, 'we', 'sn') == 0
    out = capsys.readouterr().out
    assert '2 horizons matched' in out and ', bottom' in out and 'stated sigma' in out
    assert crossing_command(lines, 'we', 'sn', '--json') == 0
    assert json.loads(capsys.readouterr().out)['matched'] == 2
    with pytest.raises(BagError, match='has no positions'):
        crossed(lines, 'we', 'lost')
    assert crossing_command(lines, 'we', 'far') == 0
    assert 'do not cross' in capsys.readouterr().out
    assert main(['evaluate', str(lines['we']), '--crossing']) == 2
    assert main(['evaluate', str(lines['we']), str(lines['sn'])]) == 2


# -- what of the fathometer is tuned --------------------------------------------------------------


def test_what_is_tuned_of_pulses_and_of_noise_that_is_not_stated():
    for sigma, values, more in (
        (np.ones(3), {'pulse': 'gaussian'}, ['pulse_width']),
        (np.ones(3), {'pulse': 'auto'}, []),
        (None, {'pulse': 'auto', 'noise_sigma': 0.5}, ['noise_sigma']),
    ):
        trace = Trace(stamp_ns=1, depth=np.arange(3.0), amplitude=np.ones(3), sigma=sigma)
        names = [found.name for found in tunables(FathometerConfig(**values), [trace])]
        assert sorted(names) == sorted(['depth_std', 'amplitude_std_sigmas', *more])


def total(depth_std, stated=0.3):
    """Log evidence of five traces of noise alone, of 0.3."""
    rng, depth = np.random.default_rng(4), np.arange(100.0, 160.0, 0.1)
    amplitudes, sigma = 0.3 * rng.normal(size=(5, len(depth))), np.full(len(depth), stated)
    traces = [
        Trace(stamp_ns=(k + 1) * SECOND, depth=depth, amplitude=each, sigma=sigma)
        for k, each in enumerate(amplitudes)
    ]
    tracker = Scored(for_tuning(FathometerConfig(depth_std=depth_std, particles=500)), traces)
    for trace in traces:
        tracker.process(trace)
    return sum(score for score, _ in tracker.scores.values())


def test_depths_between_the_samples_of_a_trace_are_no_data_and_noise_is_what_it_is():
    """A small `depth_std` needs a finer grid: noise alone stays as probable as it was."""
    assert total(0.01) == pytest.approx(total(0.2), abs=15.0)
    assert total(0.2) > max(total(0.2, 0.25), total(0.2, 0.36))
