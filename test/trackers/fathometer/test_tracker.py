# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer tracker as its users see it: measurements in, estimates out; widths of echoes."""

from types import SimpleNamespace

from attrs import evolve
from helpers.fathometer_runs import run
from helpers.sea_scenes import score_scene
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


@pytest.fixture(scope='module')
def vectors():
    found = load_vectors('fathometer/mvdr_traces')
    amplitude = found['reflector_amplitude']
    found['present'] = amplitude > 0.4 * amplitude.max(axis=0)
    return found


def traces(vectors, records, given=True):
    for k in records:
        sigma = np.full(len(vectors['depth']), vectors['sigma'][k])
        yield Trace(
            stamp_ns=(k + 1) * RECORD_NS, frame_id='array', depth=vectors['depth'],
            amplitude=vectors['amplitude'][k], sigma=sigma if given else None,
            reference_depth=float(vectors['reference_depth'][k]),
        )  # fmt: skip


def drift(seed=0, **changes):
    """Measurements of a scene of a hundred records, and its truth by stamp."""
    scene = simulate(scenario('drift_traces', {'records': 100, **changes}), seed)
    return [each.measurement for each in scene.measurements], scene.truth


def truths(truth):
    return {each.stamp_ns: each.depth for each in truth}


def score(found, vectors):
    """Share of records whose order is right, and mean OSPA."""

    def there(stamp):
        k = stamp // RECORD_NS - 1
        return vectors['reflector_depth'][k][vectors['present'][k]].astype(float)

    return score_scene(found, SimpleNamespace(depth_at=there), after=0)


@pytest.mark.statistics
def test_the_simulated_drift_is_followed_with_noise_that_is_measured(vectors):
    tracker, found = run(traces(vectors, range(300), given=False), particles=5000)
    right, distance = score(found, vectors)
    assert right >= 0.94
    assert distance <= 0.07
    assert tracker.counts['used'] == 300 == len(found) and tracker.warnings() == []
    ids = np.concatenate([each.extras['track_id'] for each in found.values()])
    names, lives = np.unique(ids, return_counts=True)
    # Ten reflectors; what else got an id was soon gone.
    assert np.count_nonzero(lives > 20) in (10, 11)
    assert np.count_nonzero(lives <= 20) <= 15


def depth_nees(found, true_depths):
    """Mean of error^2 / variance over the reflectors that are near a true one."""
    error, variance = [], []
    for stamp, estimate in found.items():
        offset = estimate.state[:, :1] - true_depths[stamp]
        nearest = offset[np.arange(len(offset)), np.abs(offset).argmin(axis=1)]
        near = np.abs(nearest) < 0.3
        error.append(nearest[near])
        variance.append(estimate.covariance[near, 0, 0])
    error, variance = np.concatenate(error), np.concatenate(variance)
    assert len(error) > 500
    return nees(error[:, None], variance[:, None, None]).mean()


@pytest.mark.statistics
def test_the_uncertainty_of_depths_covers_the_depth_sensor(vectors):
    """All reflectors of a record share the error of the array's depth, 0.03 m here."""
    options = {'particles': 3000, 'sound_speed_std': 0.0}
    depth, present = vectors['reflector_depth'], vectors['present']
    true = {(k + 1) * RECORD_NS: depth[k][present[k]] for k in range(300)}
    _, found = run(traces(vectors, range(300)), **options)
    assert 0.8 < depth_nees(found, true) < 1.2
    measured, truth = drift()
    _, found = run(measured, **options)
    assert 0.7 < depth_nees(found, truths(truth)) < 1.3
    _, found = run(measured, array_depth_std=0.0, **options)
    assert depth_nees(found, truths(truth)) > 4.0


def test_a_perfect_depth_sensor_needs_no_allowance():
    measured, truth = drift(records=70, array_depth_std=0.0)
    exact = {'array_depth_std': 0.0, 'sound_speed_std': 0.0}
    _, found = run(measured, particles=3000, **exact)
    assert 0.6 < depth_nees(found, truths(truth)) < 1.2


@pytest.mark.statistics
@pytest.mark.parametrize('memory', [0.0, 0.98])
def test_the_uncertainty_of_amplitudes_is_that_of_their_errors(memory):
    """A memory of amplitudes makes their variance smaller by a fourth."""
    measured, truth = drift(1)
    _, found = run(measured, particles=3000, amplitude_memory=memory)
    error, variance = [], []
    for received, true in zip(measured, truth, strict=True):
        estimate = found[true.stamp_ns]
        way = 2.0 * (true.depth - received.reference_depth) + 32 * 0.18
        level = 12.0 * true.amplitude / way
        distance = np.abs(estimate.state[:, :1] - true.depth)
        near = distance.min(axis=1) < 0.3
        error.append((estimate.state[:, 1] - level[distance.argmin(axis=1)])[near])
        variance.append(estimate.covariance[near, 1, 1])
    error, variance = np.concatenate(error), np.concatenate(variance)
    assert len(error) > 700
    assert 0.85 < nees(error[:, None], variance[:, None, None]).mean() < 1.25
    expected = 0.8 if memory else 1.0
    assert np.median(variance) == pytest.approx(expected * 1.3e-3**2, rel=0.1)


@pytest.mark.statistics
def test_what_came_later_corrects_an_estimate(vectors):
    options = {'particles': 3000, 'seed': 4}
    now = score(run(traces(vectors, range(80, 280)), **options)[1], vectors)
    later = score(run(traces(vectors, range(80, 280)), smoothing_lag=2, **options)[1], vectors)
    assert later[0] > now[0]
    assert later[1] <= now[1] + 0.003


def test_noise_alone_has_no_reflector():
    rng = np.random.default_rng(0)
    depth = np.arange(100.0, 150.0, 0.1)
    noise = [
        Trace(stamp_ns=k, depth=depth, amplitude=rng.standard_normal(len(depth)))
        for k in range(1, 30)
    ]
    _, found = run(noise, pulse='gaussian', pulse_width=0.05, order_min=0, particles=2000)
    nothing = [each for each in found.values() if np.isnan(each.state[0, 0])]
    assert len(nothing) > 24
    for each in nothing:
        assert len(each) == 1
        assert each.probabilities[0].argmax() == 0
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
        nearest = np.abs(each.state[:, :1] - vectors['reflector_depth'][k]).argmin(axis=1)
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
    """A trace without noise, one that lies elsewhere later."""
    tracker = FathometerTracker(FathometerConfig(particles=100))
    flat = Trace(stamp_ns=2, depth=np.arange(100.0), amplitude=np.ones(100))
    assert tracker.process(flat) == [] and tracker.counts['no_noise'] == 1
    away = {'depth': np.arange(500.0, 600.0), 'amplitude': np.arange(100.0), 'frame_id': 'array'}
    given = *traces(vectors, range(2)), Trace(stamp_ns=10**13, **away)
    tracker, found = run([*given, next(traces(vectors, [250]))], particles=300)
    assert tracker.counts['other_depths'] == 1


@pytest.mark.parametrize(
    'parameters, word',
    [
        ({'order_min': 9, 'order_max': 7}, 'order_max'),
        ({**SEVEN, 'order_transition_matrix': [1.0]}, '2 x 2'),
        ({**SEVEN, 'order_transition_matrix': [0.5, 0.5, 0.5, 0.6]}, 'row 1'),
        ({'pulse': 'file'}, 'pulse_file'),
        ({'frequency_min': 5000.0}, 'frequency_max'),
        ({'depth_min': 50.0}, 'depth_max'),
        ({'particles': 0}, 'particles'),
        ({'particles': 10_000_000, 'order_max': 12}, 'memory'),
        ({'heave': 'memory', 'array_depth_std': 0.0}, 'array_depth_std'),
        ({'output': 'printed', 'processor': 'white_noise'}, 'printed'),
        ({'noise_depth_min': 10.0, 'noise_depth_max': 0.0}, 'noise_depth_max'),
        ({'negative_probability': 1.0}, 'negative_probability'),
        ({'snapshot_seconds': 1e-4}, '0.001'),
    ],
)
def test_configurations_that_cannot_be(parameters, word):
    with pytest.raises(ConfigError, match=word):
        FathometerConfig(**parameters)


def test_a_pulse_from_a_file(tmp_path):
    path = tmp_path / 'pulse.csv'
    path.write_text('distance,value\n0,2\n0.5,1\n1,0\n')
    tracker = FathometerTracker(FathometerConfig(pulse='file', pulse_file=str(path)))
    assert tracker.pulse(np.array([0.25, 0.5])) == pytest.approx([0.75, 0.5])
    for text in ('', 'a,b\n', '1,2\n'):
        path.write_text(text)
        with pytest.raises(ConfigError, match='pulse_file'):
            FathometerTracker(FathometerConfig(pulse='file', pulse_file=str(path)))
    with pytest.raises(ConfigError, match='No such file'):
        FathometerTracker(FathometerConfig(pulse='file', pulse_file=str(tmp_path / 'no')))
    with pytest.raises(ConfigError) as endless:
        FathometerTracker(FathometerConfig(pulse='file', pulse_file='/dev/zero'))
    assert len(str(endless.value)) < 300


def fine_trace():
    """50,000 steps of a tenth of a millimetre: 400 kB."""
    depth = 50.0 + 1e-4 * np.arange(50_000)
    return Trace(stamp_ns=1, depth=depth, amplitude=np.sin(depth))


@pytest.mark.parametrize(
    'parameters',
    [
        {},
        {'depth_std': 100.0, 'depth_step': 1e-3},
        {'depth_step': 1e-9, 'depth_min': 50.0, 'depth_max': 50.0 + 1e-6},
        {'depth_step': 1e-300},
    ],
)
def test_lattices_that_would_fill_the_memory_are_refused(parameters):
    """Tables of moves hold every cell times every distance a reflector can move by."""
    config = FathometerConfig(particles=100, **parameters)
    with pytest.raises(Rejection, match='at most') as refused:
        lattice_of_trace(fine_trace(), config)
    assert refused.value.reason == 'too_large' and '\n' not in str(refused.value)
    tracker = FathometerTracker(config)
    assert tracker.process(fine_trace()) == [] and tracker.counts['too_large'] == 1


def test_a_fine_trace_is_tracked_where_reflectors_move_little():
    tracker = FathometerTracker(FathometerConfig(particles=100, depth_std=1e-3))
    assert len(tracker.process(fine_trace())) == 1


def test_conventional_amplitudes_are_a_third_unless_they_are_remembered():
    """As its echoes stand out by a third; phantoms that are remembered would be too cheap."""
    assert FathometerConfig().amplitude_std == 7.5
    conventional = FathometerConfig(processor='conventional')
    assert conventional.amplitude_std == 2.5
    assert evolve(conventional, amplitude_memory=0.9).amplitude_std == 7.5


LAYERS, STRENGTH = np.array([14.0, 19.5, 27.0]), np.array([1.0, 0.5, 0.3])


def made(width, records=12, noise=0.05, seed=5):
    """Traces (T,) of three Gaussian echoes that wander."""
    rng, depth, layers = np.random.default_rng(seed), 0.1 * np.arange(400), LAYERS
    for k in range(records):
        layers = layers + 0.05 * rng.standard_normal(3)
        echoes = np.exp(-0.5 * np.square((depth[:, None] - layers) / width)) @ STRENGTH
        yield Trace(
            stamp_ns=(k + 1) * 10**9,
            depth=depth,
            amplitude=echoes + noise * rng.standard_normal(400),
            sigma=np.full(400, noise),
        )


def test_half_width_is_that_of_the_narrowest_loud_echo():
    z = np.arange(400, dtype=np.float64)
    b = 40.0 * np.exp(-0.5 * np.square((z - 100.3) / 4.0))
    b += 60.0 * np.exp(-0.5 * np.square((z - 200.0) / 9.0))
    b += 9.0 * np.exp(-0.5 * np.square((z - 300.0) / 2.0))  # not loud
    assert half_width(b) == pytest.approx(4.0 * np.sqrt(2.0 * np.log(2.0)), rel=0.02)
    assert np.isnan(half_width(0.1 * b)) and np.isnan(half_width(np.zeros(5)))
    # It has to end within the trace on both sides.
    assert np.isnan(half_width(40.0 * np.exp(-z / 50.0)))


@pytest.mark.parametrize('width', [0.15, 0.25, 0.5, 1.0])
def test_width_of_the_echoes_is_found_and_used_from_the_first_trace_on(width):
    tracker, found = run(made(width), particles=1000)
    assert tracker.health()['pulse_width'] == pytest.approx(width, rel=0.15)
    orders = [int(np.argmax(each.probabilities[0])) + 1 for each in found.values()]
    assert orders == [3] * 12 and tracker.warnings() == []
    assert len(set(np.concatenate([e.extras['track_id'] for e in found.values()]))) == 3


def test_pulse_of_the_band_is_left_alone():
    config, band = FathometerConfig(), band_pulse(50.0, 4000.0, 1500.0)
    traces = load_vectors('fathometer/mvdr_traces')
    found = EchoWidth()
    for amplitude, sigma in zip(traces['amplitude'][:60], traces['sigma']):
        trace = Trace(
            stamp_ns=1,
            depth=traces['depth'],
            amplitude=amplitude,
            sigma=np.full(len(amplitude), sigma),
        )
        assert not found.take(trace, config, band)
    assert found.effective(config) == config
    # What is told is used, and echoes narrower than the samples say nothing.
    wide = next(made(0.5))
    assert not EchoWidth().take(wide, FathometerConfig(pulse='band'), band)
    assert not EchoWidth().take(next(made(0.03)), config, band)


def test_pulse_is_judged_anew_until_many_traces_have_shown_it():
    found, config, band = EchoWidth(), FathometerConfig(), band_pulse(50.0, 4000.0, 1500.0)
    widths = np.repeat([0.3, 0.5, 0.8, 1.3, 2.0], [1, 4, 10, 45, 20])
    taken = [found.take(next(made(width)), config, band) for width in widths]
    assert (np.flatnonzero(taken) + 1).tolist() == [1, 5, 15, 60]


def test_room_for_all_reflectors_is_left():
    found, config = EchoWidth(), FathometerConfig(order_max=12)
    assert found.take(next(made(2.0)), config, band_pulse(50.0, 4000.0, 1500.0))
    own = found.effective(config)
    assert own.pulse == 'gaussian' and own.pulse_width == pytest.approx(2.0, rel=0.2)
    assert 12.0 * own.min_separation < 40.0
    FathometerTracker(config).process(next(made(2.0)))
    found._seen = np.array([np.nan])
    with pytest.raises(ValueError, match='no echo is as wide'):
        found.require()
