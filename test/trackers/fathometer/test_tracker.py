# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer tracker as its users see it: measurements in, estimates out; widths of echoes."""

from pathlib import Path

from attrs import evolve
from helpers.fathometer_runs import near_true, order_of, run, score_scene
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.estimation.consistency import nees
from sonar_imm.measurements import Rejection, Trace
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.fathometer.response import lattice_of_trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm.trackers.fathometer.width import EchoWidth, half_width
from sonar_imm_tools.simulation.fathometer.simulator import scenario, simulate

RECORD_NS = 90 * 10**9
SEVEN = {'order_min': 7, 'order_max': 8}
DEPTH = 50.0 + 1e-4 * np.arange(50_000)
FINE = Trace(stamp_ns=1, depth=DEPTH, amplitude=np.sin(DEPTH))
"""50,000 steps of a tenth of a millimetre: 400 kB."""
LAYERS, STRENGTH = np.array([14.0, 19.5, 27.0]), np.array([1.0, 0.5, 0.3])
BAND = band_pulse(50.0, 4000.0, 1500.0)


@pytest.fixture(scope='module')
def vectors():
    found = load_vectors('fathometer/mvdr_traces')
    amplitude = found['reflector_amplitude']
    found['present'] = amplitude > 0.4 * amplitude.max(axis=0)
    return found


def traces(vectors, records, given=True):
    for k in records:
        sigma = np.full(len(vectors['depth']), vectors['sigma'][k]) if given else None
        known = {'depth': vectors['depth'], 'amplitude': vectors['amplitude'][k], 'sigma': sigma}
        array = float(vectors['reference_depth'][k])
        stamp = (k + 1) * RECORD_NS
        yield Trace(stamp_ns=stamp, frame_id='array', reference_depth=array, **known)


def drift(seed=0, **changes):
    """Measurements of a scene of a hundred records, and what is true of each."""
    scene = simulate(scenario('drift_traces', {'records': 100, **changes}), seed)
    return [each.measurement for each in scene.measurements], scene.truth


def there(vectors):
    """What is in the record of a stamp."""

    def at(stamp):
        k = stamp // RECORD_NS - 1
        return vectors['reflector_depth'][k][vectors['present'][k]].astype(float)

    return at


@pytest.mark.statistics
def test_the_simulated_drift_is_followed_with_noise_that_is_measured(vectors):
    tracker, found = run(traces(vectors, range(300), given=False), particles=5000)
    score = score_scene(found, there(vectors))
    assert score.right >= 0.94 and score.ospa <= 0.07
    assert tracker.counts['used'] == 300 == len(found) and tracker.warnings() == []
    ids = np.concatenate([each.extras['track_id'] for each in found.values()])
    _, lives = np.unique(ids, return_counts=True)
    # Ten reflectors; what else got an id was soon gone.
    assert np.count_nonzero(lives > 20) in (10, 11)
    assert np.count_nonzero(lives <= 20) <= 15


def mean_nees(found, true, column=0, level=None):
    """Mean of error^2 / variance of depths, or amplitudes, of the reflectors near a true one; and
    the variances. true: depths of each stamp; level: amplitudes there."""
    error, variance = [], []
    for stamp, depths in true.items():
        nearest, distance = near_true(found[stamp], depths)
        near = distance < 0.3
        due = depths if level is None else level[stamp]
        error.append((found[stamp].state[:, column] - due[nearest])[near])
        variance.append(found[stamp].covariance[near, column, column])
    error, variance = np.concatenate(error), np.concatenate(variance)
    assert len(error) > 500
    return nees(error[:, None], variance[:, None, None]).mean(), variance


@pytest.mark.statistics
def test_the_uncertainty_of_depths_covers_the_depth_sensor(vectors):
    """All reflectors of a record share the error of the array's depth, 0.03 m here."""
    options, at = {'particles': 3000, 'sound_speed_std': 0.0}, there(vectors)
    _, found = run(traces(vectors, range(300)), **options)
    assert 0.8 < mean_nees(found, {stamp: at(stamp) for stamp in found})[0] < 1.2
    measured, truth = drift()
    true = {each.stamp_ns: each.depth for each in truth}
    _, found = run(measured, **options)
    assert 0.7 < mean_nees(found, true)[0] < 1.3
    _, found = run(measured, array_depth_std=0.0, **options)
    assert mean_nees(found, true)[0] > 4.0


def test_a_perfect_depth_sensor_needs_no_allowance():
    measured, truth = drift(records=70, array_depth_std=0.0)
    _, found = run(measured, particles=3000, array_depth_std=0.0, sound_speed_std=0.0)
    assert 0.6 < mean_nees(found, {each.stamp_ns: each.depth for each in truth})[0] < 1.2


@pytest.mark.statistics
@pytest.mark.parametrize('memory, expected', [(0.0, 1.0), (0.98, 0.8)])
def test_the_uncertainty_of_amplitudes_is_that_of_their_errors(memory, expected):
    """A memory of amplitudes makes their variance smaller by a fourth."""
    measured, truth = drift(1)
    _, found = run(measured, particles=3000, amplitude_memory=memory)
    true, level = {}, {}
    for received, each in zip(measured, truth, strict=True):
        way = 2.0 * (each.depth - received.reference_depth) + 32 * 0.18
        true[each.stamp_ns], level[each.stamp_ns] = each.depth, 12.0 * each.amplitude / way
    mean, variance = mean_nees(found, true, 1, level)
    assert 0.85 < mean < 1.25
    assert np.median(variance) == pytest.approx(expected * 1.3e-3**2, rel=0.1)


def test_noise_alone_has_no_reflector():
    rng, depth = np.random.default_rng(0), np.arange(100.0, 150.0, 0.1)
    samples = rng.standard_normal((29, 500))
    noise = [Trace(stamp_ns=k, depth=depth, amplitude=row) for k, row in enumerate(samples, 1)]
    _, found = run(noise, pulse='gaussian', pulse_width=0.05, order_min=0, particles=2000)
    nothing = [each for each in found.values() if np.isnan(each.state[0, 0])]
    assert len(nothing) > 24
    for each in nothing:
        assert len(each) == 1 and each.probabilities[0].argmax() == 0
        assert each.probabilities[0].sum() == pytest.approx(1.0)
        assert each.extras['track_id'][0] == 0 and np.isnan(each.xyz[0, 2])


def test_columns_are_those_of_the_contract(vectors):
    _, found = run(traces(vectors, range(3)), particles=500)
    columns = found[RECORD_NS].columns()
    names = list(columns)
    assert names[:3] == ['x', 'y', 'z']
    covariance = ['cov_depth_depth', 'cov_depth_amplitude', 'cov_amplitude_amplitude']
    assert names[3:8] == ['depth', 'amplitude', *covariance]
    assert names[8:20] == [f'prob_order_{k}' for k in range(1, 13)]
    assert {'track_id', 'existence'} <= set(names[20:])
    assert columns['track_id'].dtype == np.uint32
    assert np.allclose(columns['z'], -columns['depth'])
    assert (np.diff(columns['depth']) > 0.0).all()
    assert np.ptp(columns['prob_order_8']) == 0.0
    assert (columns['cov_depth_depth'] > 0.0).all()
    assert ((columns['existence'] >= 0.5) & (columns['existence'] <= 1.0)).all()


def test_amplitudes_are_freed_of_spreading(vectors):
    """The truth's differ by the way the echo goes, and one factor of the processor."""
    _, found = run(traces(vectors, range(60)), particles=1000)
    raw, freed = [], []
    for stamp, each in found.items():
        k = stamp // RECORD_NS - 1
        nearest, _ = near_true(each, vectors['reflector_depth'][k])
        true = vectors['reflector_amplitude'][k][nearest]
        strong = true > 0.09
        raw.append(each.state[strong, 1] / true[strong])
        freed.append(each.extras['relative_amplitude'][strong] / true[strong])
    spread = [np.std(each) / np.mean(each) for each in map(np.concatenate, (raw, freed))]
    assert spread[1] < 0.9 * spread[0]


def test_the_same_input_gives_the_same_bytes(vectors):
    def columns(**parameters):
        _, found = run(traces(vectors, range(12)), particles=1001, **parameters)
        return [c.tobytes() for each in found.values() for c in each.columns().values()]

    assert columns() == columns(threads=4)
    assert columns() != columns(seed=1)


def test_strange_input_is_counted(vectors):
    flat = Trace(stamp_ns=2, depth=np.arange(100.0), amplitude=np.ones(100))
    tracker, found = run([flat], particles=100)
    assert not found and tracker.counts['no_noise'] == 1
    away = {'depth': np.arange(500.0, 600.0), 'amplitude': np.arange(100.0), 'frame_id': 'array'}
    given = *traces(vectors, range(2)), Trace(stamp_ns=10**13, **away), *traces(vectors, [250])
    assert run(given, particles=300)[0].counts['other_depths'] == 1


@pytest.mark.parametrize('parameters, word', [
    ({'order_min': 9, 'order_max': 7}, 'order_max'),
    ({**SEVEN, 'order_transition_matrix': [1.0]}, '2 x 2'),
    ({**SEVEN, 'order_transition_matrix': [0.5, 0.5, 0.5, 0.6]}, 'row 1'),
    ({'pulse': 'file'}, 'pulse_file'),
    ({'frequency_min': 5000.0}, 'frequency_max'), ({'depth_min': 50.0}, 'depth_max'),
    ({'particles': 0}, 'particles'),
    ({'particles': 10_000_000, 'order_max': 12}, 'memory'),
    ({'heave': 'memory', 'array_depth_std': 0.0}, 'array_depth_std'),
    ({'output': 'printed', 'processor': 'white_noise'}, 'printed'),
    ({'noise_depth_min': 10.0, 'noise_depth_max': 0.0}, 'noise_depth_max'),
    ({'negative_probability': 1.0}, 'negative_probability'),
    ({'snapshot_seconds': 1e-4}, '0.001'),
])  # fmt: skip
def test_configurations_that_cannot_be(parameters, word):
    with pytest.raises(ConfigError, match=word):
        FathometerConfig(**parameters)


def test_a_pulse_from_a_file(tmp_path):
    path = tmp_path / 'pulse.csv'
    path.write_text('distance,value\n0,2\n0.5,1\n1,0\n')
    tracker = FathometerTracker(FathometerConfig(pulse='file', pulse_file=str(path)))
    assert tracker.pulse(np.array([0.25, 0.5])) == pytest.approx([0.75, 0.5])
    names = [str(tmp_path / f'{k}.csv') for k in range(3)]
    for name, text in zip(names, ('', 'a,b\n', '1,2\n')):
        Path(name).write_text(text)
    reasons = dict.fromkeys(names, 'pulse_file') | {'/no': 'No such file', '/dev/zero': ''}
    for name, why in reasons.items():
        with pytest.raises(ConfigError, match=why) as raised:
            FathometerTracker(FathometerConfig(pulse='file', pulse_file=name))
        assert len(str(raised.value)) < 300


@pytest.mark.parametrize('parameters', [
    {}, {'depth_std': 100.0, 'depth_step': 1e-3},
    {'depth_step': 1e-9, 'depth_min': 50.0, 'depth_max': 50.0 + 1e-6}, {'depth_step': 1e-300},
    {'heave': 'independent', 'array_depth_std': 1000.0, 'depth_std': 1e-3},
])  # fmt: skip
def test_lattices_that_would_fill_the_memory_are_refused(parameters):
    """Tables of moves hold every cell times every distance a reflector can move by."""
    config = FathometerConfig(particles=100, **parameters)
    with pytest.raises(Rejection, match='at most') as refused:
        lattice_of_trace(FINE, config)
    assert refused.value.reason == 'too_large' and '\n' not in str(refused.value)
    tracker = FathometerTracker(config)
    assert tracker.process(FINE) == [] and tracker.counts['too_large'] == 1


def test_a_fine_trace_is_tracked_where_reflectors_move_little():
    assert len(run([FINE], particles=100, depth_std=1e-3)[1]) == 1


def test_conventional_amplitudes_are_a_third_unless_they_are_remembered():
    """As its echoes stand out by a third; phantoms that are remembered would be too cheap."""
    assert FathometerConfig().amplitude_std == 7.5
    conventional = FathometerConfig(processor='conventional')
    assert conventional.amplitude_std == 2.5
    assert evolve(conventional, amplitude_memory=0.9).amplitude_std == 7.5


def made(width, records=12, noise=0.05, seed=5):
    """Traces (T,) of three Gaussian echoes that wander."""
    rng, depth, layers = np.random.default_rng(seed), 0.1 * np.arange(400), LAYERS
    known = {'depth': depth, 'sigma': np.full(400, noise)}
    for k in range(records):
        layers = layers + 0.05 * rng.standard_normal(3)
        echoes = np.exp(-0.5 * np.square((depth[:, None] - layers) / width)) @ STRENGTH
        amplitude = echoes + noise * rng.standard_normal(400)
        yield Trace(stamp_ns=(k + 1) * 10**9, amplitude=amplitude, **known)


def test_half_width_is_that_of_the_narrowest_loud_echo():
    z = np.arange(400, dtype=np.float64)
    b = 40.0 * np.exp(-0.5 * np.square((z - 100.3) / 4.0))
    b += 60.0 * np.exp(-0.5 * np.square((z - 200.0) / 9.0))
    b += 9.0 * np.exp(-0.5 * np.square((z - 300.0) / 2.0))  # not loud
    assert half_width(b) == pytest.approx(4.0 * np.sqrt(2.0 * np.log(2.0)), rel=0.02)
    assert np.isnan(half_width(0.1 * b)) and np.isnan(half_width(np.zeros(5)))
    # It has to end within the trace on both sides.
    assert np.isnan(half_width(40.0 * np.exp(-z / 50.0)))


@pytest.mark.parametrize('width', [0.15, 1.0])
def test_width_of_the_echoes_is_found_and_used_from_the_first_trace_on(width):
    tracker, found = run(made(width), particles=1000)
    assert tracker.health()['pulse_width'] == pytest.approx(width, rel=0.15)
    assert [order_of(each) for each in found.values()] == [3] * 12 and tracker.warnings() == []
    assert len(set(np.concatenate([e.extras['track_id'] for e in found.values()]))) == 3


def test_pulse_of_the_band_is_left_alone(vectors):
    config, found = FathometerConfig(), EchoWidth()
    assert not any(found.take(trace, config, BAND) for trace in traces(vectors, range(60)))
    assert found.effective(config) == config
    # What is told is used, and echoes narrower than the samples say nothing.
    assert not EchoWidth().take(next(made(0.5)), FathometerConfig(pulse='band'), BAND)
    assert not EchoWidth().take(next(made(0.03)), config, BAND)


def test_pulse_is_judged_anew_until_many_traces_have_shown_it():
    found, config = EchoWidth(), FathometerConfig()
    widths = np.repeat([0.3, 0.5, 0.8, 1.3, 2.0], [1, 4, 10, 45, 20])
    taken = [found.take(next(made(width)), config, BAND) for width in widths]
    assert (np.flatnonzero(taken) + 1).tolist() == [1, 5, 15, 60]


def test_room_for_all_reflectors_is_left():
    found, config = EchoWidth(), FathometerConfig(order_max=12)
    assert found.take(next(made(2.0)), config, BAND)
    own = found.effective(config)
    assert own.pulse == 'gaussian' and own.pulse_width == pytest.approx(2.0, rel=0.2)
    assert 12.0 * own.min_separation < 40.0
    FathometerTracker(config).process(next(made(2.0)))
    found._seen = np.array([np.nan])
    with pytest.raises(ValueError, match='no echo is as wide'):
        found.require()
