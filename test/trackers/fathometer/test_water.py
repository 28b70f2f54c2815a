# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The floor of profiler lines: labels, depth, the transmit pulse, and envelopes that scatter; and
real lines as two, of even and odd traces."""

from attrs import evolve
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from benchmarks.fathometer_field import real_lines
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.reflectors import Identities
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm.trackers.fathometer.water import SeenFloor, Water
from sonar_imm_tools.evaluation.fathometer.scoring import records_of
from sonar_imm_tools.recordings.segy_lines import read_segy
from sonar_imm_tools.simulation.fathometer.simulator import scenario, simulate

SECOND, STEP, SAMPLES, PULSE, SETTLED = 10**9, 0.05, 400, 0.15, 10
LINES = {
    'flat': {}, 'silent water': {'noise': 0.002, 'threshold': 0.02}, 'scatter': {'scatter': 0.3},
    'transmit pulse': {'ring': 1.5}, 'waves': {'waves': 2.5},
}  # fmt: skip
CUT = {'pulse': 'gaussian', 'noise_sigma': 0.05, 'min_separation': 1.5, 'depth_std': 0.1}


def line(
    seed, *, records=120, noise=0.02, threshold=0.0, scatter=0.0, ring=0.0, waves=0.0, fixed=0.0
):
    """Envelopes of a Gaussian pulse in complex noise, with a floor at about 10 m and two
    reflectors below it, and the depth of the floor (T,), m. threshold: below which nothing is
    written; scatter: rms below the floor, falling over 1.5 m; ring: m of transmit pulse; waves:
    amplitude, m, in 25 records; fixed: amplitude of an echo at 4 m."""
    rng, depth = np.random.default_rng(seed), STEP * np.arange(SAMPLES)
    record, traces = np.arange(records), []
    below = 10.0 + 0.3 * np.sin(record / 19.0) + waves * np.sin(2.0 * np.pi * record / 25.0)

    def echo(place, amplitude):
        phase = np.exp(2j * np.pi * rng.random())
        return amplitude * phase * np.exp(-0.5 * np.square((depth - place) / PULSE))

    def noise_of(rms):
        return rms * rng.standard_normal((SAMPLES, 2)) @ [1.0, 1j] / np.sqrt(2.0)

    for k, z in enumerate(below):
        field = noise_of(noise) + echo(z, 1.0) + echo(z + 3.0, 0.5) + echo(z + 6.0, 0.25)
        if scatter:
            under = np.maximum(depth - z, 0.0)
            field = field + noise_of(1.0) * scatter * np.exp(-under / 1.5) * (depth > z)
        if fixed:
            field = field + echo(4.0, fixed)
        if ring:
            field = field + 2.0 * np.exp(-np.maximum(depth - ring, 0.0) / 0.1)
        heard = np.abs(field)
        heard[heard < threshold] = 0.0
        traces.append(Trace(stamp_ns=(k + 1) * SECOND, depth=depth, amplitude=heard))
    return traces, below


def test_an_echo_at_a_fixed_depth_and_a_line_that_begins_below_its_floor_are_said():
    for fixed, said in ((0.2, True), (0.0, False)):
        warnings = run(line(4, records=75, waves=1.0, fixed=fixed)[0], particles=50)[0].warnings()
        assert any('it may belong to the instrument' in each for each in warnings) == said
        assert said or warnings == []
    traces, _ = line(5, records=30, scatter=0.5)
    cut = [evolve(each, depth=each.depth[210:], amplitude=each.amplitude[210:]) for each in traces]
    warnings = run(cut, particles=50)[0].warnings()
    assert any('no water is seen' in each or 'none of' in each for each in warnings)


def run(traces, **options):
    few = {'particles': 300, 'min_separation': 0.45, 'depth_std': 0.35, 'order_max': 6}
    tracker = FathometerTracker(FathometerConfig(**{**few, 'sound_speed_std': 0.0, **options}))
    return tracker, [each.columns() for trace in traces for each in tracker.process(trace)]


def test_noise_and_scatter_of_the_vectors(floor):
    """From four pulses below the onset on; nearer ours has the scatter of there."""
    v, water = floor, Water(FathometerConfig())
    step, count = float(v['step']), v['trace'].shape[1]
    depth = step * np.arange(count)
    water.begin(Trace(stamp_ns=1, depth=depth, amplitude=v['trace'][0]))
    water._noise, water._scatter = v['water_profile'], np.zeros(count)
    water._pulse = float(v['pulse']) / step
    water._lead = 2.4 * water._pulse
    expected = dict(zip(v['posterior_records'].tolist(), v['noise_and_scatter']))
    for k, (trace, onset) in enumerate(zip(v['trace'], v['onset'].tolist())):
        seen = water._update_scatter(trace, onset)
        if k in expected:
            near, begin = (onset + int(np.ceil(n * water._pulse)) for n in (3.4, 4.0))
            assert seen[begin:] == pytest.approx(expected[k][begin:], rel=1e-9)
            assert seen[:near] == pytest.approx(expected[k][:near], rel=1e-9)
            power = seen[near:begin] ** 2 - water._noise[near:begin] ** 2
            assert power == pytest.approx(seen[begin] ** 2 - water._noise[begin] ** 2, abs=1e-12)
            assert k == 0 or seen[begin] > 1.02 * water._noise[begin]
    # A short trace is no line.
    short = Water(FathometerConfig())
    short.begin(Trace(stamp_ns=1, depth=np.arange(10.0), amplitude=np.ones(10)))
    assert short.active is False


def test_labels_of_the_vectors(floor):
    v, known = floor, (0.45, 0.1, 1.0)
    for k, row in enumerate(v['posterior_records']):
        seen = SeenFloor(v['posterior'][k], 0.0, float(v['step']), float(v['pulse']), *known)
        bottom, above = seen.labels(v['reflector_depth'])
        assert bottom == pytest.approx(v['is_bottom'][row], abs=1e-6)
        assert above == pytest.approx(v['above_bottom'][row], abs=1e-6)
        depth, std = seen.depth
        assert abs(depth - v['floor'][row]) < 3.0 * std


@pytest.fixture(scope='module')
def floor():
    return load_vectors('fathometer_in_the_field/floor')


@pytest.mark.parametrize('kind', LINES)
def test_floor_is_the_floor(kind):
    """With nothing told but what converters write: ghosts more than 1 m above it, whether the
    greatest `is_bottom` is near it, and whether it is within two standard deviations."""
    traces, floor = line(7, records=60, **LINES[kind])
    rows = []
    for z, found in zip(floor[SETTLED:], run(traces, particles=1000)[1][SETTLED:]):
        depth, label = found['depth'], np.nan_to_num(found['is_bottom'])
        near, error = np.abs(depth - z) < 0.5, abs(found['bottom_depth'][0] - z)
        ghosts = np.sum((found['existence'] >= 0.5) & (depth < z - 1.0))
        inside = error <= 2.0 * found['bottom_depth_std'][0]
        rows.append([ghosts, near[np.argmax(label)], inside, label[near].max(initial=0.0)])
    ghosts, right, inside, said = np.mean(rows, axis=0)
    assert ghosts < 0.05 and right > 0.95 and inside > 0.95
    assert said > (0.7 if kind == 'waves' else 0.95)


def test_nothing_is_said_of_the_floor_before_ten_traces_unless_noise_is_stated():
    traces, floor = line(1, records=12)
    _, rows = run(traces)
    for each in rows[:9]:
        assert np.isnan(each['is_bottom']).all() and np.isnan(each['bottom_depth']).all()
    assert rows[9]['is_bottom'].max() > 0.7
    _, rows = run(traces, noise_sigma=0.02, pulse='gaussian', pulse_width=0.15)
    assert rows[0]['is_bottom'].max() > 0.7 and rows[0]['existence'].min() > 0.5
    for each, z in zip(rows, floor):
        assert abs(each['bottom_depth'][0] - z) < 2.0 * each['bottom_depth_std'][0]


def test_amplitudes_are_in_the_unit_of_the_trace():
    traces, _ = line(2, records=30, noise=0.01)
    loud = [evolve(each, amplitude=1000.0 * each.amplitude) for each in traces]
    _, rows = run(traces)
    _, other = run(loud)
    heard = [np.sort(each['amplitude'])[::-1][:3] for each in rows[10:]]
    assert np.median(heard, axis=0) == pytest.approx([1.0, 0.5, 0.25], rel=0.1)
    for one, two in zip(rows[10:], other[10:]):
        assert two['amplitude'] == pytest.approx(1000.0 * one['amplitude'], rel=1e-6)
        assert two['sigma'] == pytest.approx(1000.0 * one['sigma'], rel=1e-6)


def test_the_transmit_pulse_is_left_out_and_said():
    traces, floor = line(3, records=20, ring=1.5)
    tracker, rows = run(traces)
    assert rows[-1]['blanked'][0] == pytest.approx(1.75, abs=0.3)
    assert min(each['depth'].min() for each in rows[10:]) > 5.0
    sentence = tracker.warnings()[0]
    assert sentence.startswith('the first ') and 'transmit pulse' in sentence
    # A transmitter far below the surface has one too: depths are those below the surface.
    deep = [evolve(each, depth=each.depth + 100.0, reference_depth=100.0) for each in traces]
    lower = run(deep)[1][-1]
    assert lower['blanked'][0] == pytest.approx(rows[-1]['blanked'][0] + 100.0)
    assert lower['bottom_depth'][0] == pytest.approx(floor[-1] + 100.0, abs=0.5)
    tracker, rows = run(traces, blanking=3.0)
    assert tracker.warnings() == [] and rows[-1]['blanked'][0] == 0.0


def test_arrays_and_signed_traces_are_as_before():
    rng, depth = np.random.default_rng(6), 0.05 * np.arange(300)
    for options, sign in (({}, -1.0), ({'water': 'off'}, 1.0)):
        amplitude = np.abs(rng.standard_normal(300)) + 20.0 * np.exp(-np.square(depth - 8.0))
        amplitude[5] *= sign
        trace = Trace(stamp_ns=1, depth=depth, amplitude=amplitude)
        _, (row,) = run([trace], noise_sigma=1.0, pulse='gaussian', **options)
        for name in ('above_bottom', 'bottom_depth', 'bottom_depth_std', 'blanked'):
            assert np.isnan(row[name]).all()
        assert np.isfinite(row['is_bottom']).all()


def test_missing_samples_and_other_depths_are_taken():
    rng, odd = np.random.default_rng(0), []
    for k, each in enumerate(line(8, records=30)[0]):
        amplitude, first = each.amplitude.copy(), k % 3
        amplitude[rng.integers(0, len(amplitude), 20)] = np.nan
        odd.append(evolve(each, depth=each.depth[first:], amplitude=amplitude[first:]))
    tracker, rows = run(odd)
    assert tracker.counts['used'] == 30
    assert np.mean([each['is_bottom'].max() > 0.9 for each in rows[9:]]) > 0.9


def test_a_window_that_shifts_is_followed_under_the_same_ids():
    """The recording delay of a line that gets deeper is changed once: 8 m of 12 m are new."""
    traces, floor = line(9, records=60)
    floor, shifted = floor + 0.1 * np.arange(60), []
    for k, each in enumerate(traces):
        depth = np.arange(12.0 / STEP) * STEP + (6.0 if k < 30 else 9.0)
        amplitude = np.interp(depth, each.depth + 0.1 * k, each.amplitude, right=0.02)
        shifted.append(Trace(stamp_ns=each.stamp_ns, depth=depth, amplitude=amplitude))
    options = {'noise_sigma': 0.02, 'pulse': 'gaussian', 'pulse_width': 0.15, 'particles': 1000}
    tracker, rows = run(shifted, **options)
    assert tracker.counts['used'] == 60 and not tracker.counts['other_depths']
    named = set()
    for row, z in zip(rows, floor):
        near = np.abs(row['depth'] - z) < 0.5
        assert near.any() and row['is_bottom'][near].max() > 0.5
        named |= set(row['track_id'][near].tolist())
    assert len(named) == 1


@pytest.mark.parametrize('path', real_lines() or [None], ids=lambda p: p.stem[-20:] if p else '-')
def test_halves_of_real_lines_agree(path):
    """Each half stacked in pairs; floors differ by more than 0.75 m, or by less than two standard
    deviations."""
    if path is None:
        pytest.skip('no real recordings here; SONAR_IMM_DATA names their folder')
    amplitude, floors = read_segy(path).amplitude, []
    depth = 0.376 * np.arange(amplitude.shape[1])
    for half in (amplitude[::2], amplitude[1::2]):
        water, found = Water(FathometerConfig()), []
        stacked = half[: len(half) // 2 * 2].reshape(-1, 2, half.shape[1]).mean(axis=1)
        for k, row in enumerate(stacked):
            trace = Trace(stamp_ns=k + 1, depth=depth, amplitude=row)
            if water.active is None:
                water.begin(trace)
            found.append(water.take(trace)[2].depth)
        floors.append(np.array(found))
    count = min(map(len, floors))
    (z, std), (other, other_std) = (each[SETTLED:count].T for each in floors)
    apart = np.abs(z - other)
    assert np.mean(~(apart <= 0.75)) < 0.06
    assert np.mean(apart <= 2.0 * np.hypot(std, other_std)) > 0.95


def cut_line(first, top=12.0):
    """Two layers, the upper one with its middle at `top` m, in a window from `first` m on."""
    rng, depth = np.random.default_rng(3), 0.25 * np.arange(140)
    for k, lower in enumerate(np.linspace(18.0, 22.0, 41)):
        echo = 0.01 * np.abs(rng.standard_normal(len(depth)))
        echo += np.exp(-0.5 * np.square((depth[:, None] - [top, lower]) / 0.5)).sum(axis=1)
        seen = depth >= first
        yield Trace(stamp_ns=(k + 1) * 10**9, depth=depth[seen], amplitude=echo[seen])


def test_below_a_floor_that_the_window_cuts_nothing_is_the_floor():
    """Loud at the first depth is no transmit pulse here; how deep the floor is nobody can tell."""
    tracker, found = run(cut_line(12.0), **CUT)
    for columns in found[5:]:
        assert columns['depth'][0] == pytest.approx(12.0) and columns['is_bottom'][0] > 0.9
        assert (columns['is_bottom'][1:] < 0.1).all() and len(columns['depth']) == 2
        assert np.isnan(columns['bottom_depth']).all() and (columns['blanked'] == 0.0).all()
    assert any('below the floor' in each for each in tracker.warnings())


def test_the_tail_of_a_floor_above_the_window_is_said():
    tracker, _ = run(cut_line(12.5), **CUT)
    assert any('below the floor' in each for each in tracker.warnings())
    tracker, found = run(cut_line(11.0, top=13.5), **CUT)
    assert not tracker.warnings() and found[-1]['bottom_depth'][0] == pytest.approx(13.5, abs=0.4)


@pytest.fixture(scope='module')
def scene():
    return simulate(scenario('diffuse', {'records': 60}), 5)


def stated(**overrides):
    stated = {**scenario('diffuse').instruments(), 'particles': 1000, **overrides}
    return FathometerConfig.from_mapping(stated, ignore_unknown=True)


def track(scene, config):
    tracker = FathometerTracker(config)
    return tracker, [tracker.process(each.measurement)[0] for each in scene.measurements]


def test_the_scene_is_quiet_above_the_floor_and_scatters_below(scene):
    above, below = [], []
    for each, true in zip(scene.measurements, scene.truth):
        trace = each.measurement
        above.append(trace.amplitude[trace.depth < true.depth.min() - 2.0])
        inside = (trace.depth > true.depth.min() + 1.5) & (trace.depth < true.depth.min() + 3.5)
        below.append(trace.amplitude[inside])
    assert np.concatenate(above).max() == 0.0
    # Rayleigh of rms 0.25 at the top, falling to 1/e over 5 m, less the threshold of 0.06.
    expected = 0.886 * 0.25 * np.exp(-2.5 / 5.0) - 0.06
    assert np.concatenate(below).mean() == pytest.approx(expected, rel=0.15)


def test_the_floor_is_followed_under_one_identity(scene):
    _, estimates = track(scene, stated())
    away, names = [], set()
    for each, true in zip((each.columns() for each in estimates), scene.truth):
        k = int(np.argmax(each['is_bottom']))
        away.append(each['depth'][k] - true.depth.min())
        names.add(int(each['track_id'][k]))
    assert np.mean(np.abs(away) < 1.0) >= 0.95 and len(names) == 1
    right = [len(r.found) == len(t.depth) for r, t in zip(records_of(estimates), scene.truth)]
    assert np.mean(right) >= 0.9


def test_a_faint_floor_is_not_lost_to_what_scatters_below_it(scene):
    """A soft floor, a third of the loudest, 5 m above where the scatter begins."""
    tracker, right = FathometerTracker(stated()), []
    for each, true in zip(scene.measurements[:25], scene.truth):
        trace, floor = each.measurement, true.depth.min() - 5.0
        echo = np.exp(-0.5 * np.square((trace.depth - floor) / stated().pulse_width))
        amplitude = trace.amplitude + 0.35 * trace.amplitude.max() * echo
        columns = tracker.process(evolve(trace, amplitude=amplitude))[0].columns()
        right.append(abs(columns['depth'][np.argmax(columns['is_bottom'])] - floor) < 0.5)
    assert np.mean(right) >= 0.9


def test_the_first_return_keeps_its_name_on_a_wall():
    config = evolve(stated(), depth_std=0.3, min_separation=1.0)

    def name(known, depth, bottom, floor_known=True):
        return known.name(np.array(depth), np.array(bottom), config, floor_known=floor_known)

    first, ids = name(Identities(), [10.0, 14.0], [1.0, 0.0])
    assert list(ids) == [1, 2]
    # It rises by 2 m, and something below it is nearer to where it was.
    after, ids = name(first, [8.0, 9.9, 14.0], [1.0, 0.0, 0.0])
    assert list(ids) == [1, 3, 2] and after.bottom_id == 1
    # Ten metres are no slope.
    _, ids = name(after, [20.0], [1.0])
    assert ids[0] not in (1, 2, 3)
    # Where the floor is not known, the nearest counts.
    _, ids = name(first, [8.0, 9.9, 14.0], [1.0, 0.0, 0.0], floor_known=False)
    assert list(ids) == [3, 1, 2]


def test_a_wrong_pulse_and_a_full_set_are_said_with_their_remedy(scene):
    wrong = FathometerConfig(noise_sigma=0.02, particles=300, water='off', pulse='band')
    for config, *said in (
        (wrong, 'envelopes need water auto', 'no set of reflectors'),
        (stated(order_max=2, particles=300), 'against a limit of 2', 'order_max may not fit'),
    ):
        sentences = ' '.join(track(scene, config)[0].warnings())
        assert all(each in sentences for each in said)
    assert track(scene, stated(particles=300))[0].warnings() == []


def test_unexplained_records_are_said():
    impossible = {'order_min': 6, 'order_max': 6, 'pulse': 'gaussian', 'noise_sigma': 0.1}
    tracker = FathometerTracker(FathometerConfig(particles=50, **impossible))
    depth = 0.25 * np.arange(80)
    for second in range(1, 13):
        amplitude = -np.exp(-0.5 * np.square(depth - 10.0))
        tracker.process(Trace(stamp_ns=second * SECOND, depth=depth, amplitude=amplitude))
        assert tracker.counts['unexplained'] == second
        assert tracker._before is None  # the next one begins anew
        assert bool(tracker.warnings()) == (second >= 10)  # a few records are no evidence
    assert any('no set of reflectors explains 100 %' in each for each in tracker.warnings())
