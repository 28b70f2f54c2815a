# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer tracker with arrays: lost blocks, faulty hydrophones, echoes of either sign."""

import re

from attrs import evolve
from helpers.fathometer_runs import near_true, order_of, run, score_scene, sea_scene
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.acoustics.ambient import sample_csdm, surface_noise_csdm
from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.estimation.set_filter import SetFilter, Weighted
from sonar_imm.estimation.set_model import SetModel, Sets
from sonar_imm.measurements import ArrayDepth, CrossSpectra
from sonar_imm.trackers.fathometer import pressure
from sonar_imm.trackers.fathometer.pressure import CompanionDepths
from sonar_imm.trackers.fathometer.response import array_response, lattice_of_array
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.simulation.fathometer.scenario import Drift
from sonar_imm_tools.simulation.fathometer.simulator import cross_spectra, scenario, simulate

SMALL = {**scenario('small').instruments(), 'particles': 2000}


@pytest.fixture(scope='module')
def blocks():
    changes = {
        'records': 1, 'record_seconds': 9.8, 'phones': 12, 'element_spacing': 0.18,
        'frequency_max': 2000.0, 'steps_per_sigma': 0.0, 'block_seconds': 0.7, 'array_depth': 73.5,
        'first_depth': 130.0,
    }  # fmt: skip
    scene = simulate(scenario('pressure', changes), 1)
    return [each.measurement for each in scene.measurements]


PRESSURE = {
    'phones': 12, 'frequency_max': 2000.0, 'snapshot_seconds': 0.7, 'record_seconds': 9.8,
    'depth_min': 122.0, 'depth_max': 172.0, 'particles': 500,
}  # fmt: skip


def test_a_lost_block_is_counted_and_a_long_gap_begins_anew(blocks):
    tracker, found = run(blocks[:3] + blocks[4:], **PRESSURE)
    assert tracker.counts['gaps'] == 1 and not found
    late = [evolve(each, stamp_ns=each.stamp_ns + 60 * 10**9) for each in blocks]
    tracker, found = run(blocks[:6] + late, **PRESSURE)
    assert tracker.counts['records_abandoned'] == 1
    assert len(found) == 1


def test_a_preview_is_not_committed(blocks):
    later = [k * round(9.8e9) for k in range(3)]
    again = [evolve(each, stamp_ns=each.stamp_ns + by) for by in later for each in blocks]
    plain, found = run(again, **PRESSURE)
    eager, more = run(again, preview_seconds=2.8, **PRESSURE)
    assert eager.counts['previews'] > 3
    assert set(found) < set(more)
    for stamp, each in more.items():
        assert each.extras['preview'].all() == (stamp not in found)
        if stamp in found:
            assert each.state.tobytes() == found[stamp].state.tobytes()


@pytest.fixture(scope='module')
def spectra():
    scene = simulate(scenario('small', {'records': 1, 'depth_companion': False}), 5)
    return scene.measurements[0].measurement


def test_a_dead_hydrophone_or_a_missing_frequency_changes_little(spectra):
    csdm, config = spectra.csdm.copy(), FathometerConfig(**SMALL, depth_min=122.0, depth_max=172.0)
    csdm[:, 0], csdm[:, :, 0] = np.nan, np.nan
    depth, dead = spectra.reference_depth, evolve(spectra, csdm=csdm)
    lattice = lattice_of_array(depth, config)
    whole, masked = (array_response(each, lattice, config, depth) for each in (spectra, dead))
    peak = whole.amplitude.argmax()
    assert masked.amplitude[peak] > 0.5 * whole.amplitude[peak]
    assert np.corrcoef(whole.amplitude, masked.amplitude)[0, 1] > 0.5
    tracker, found = run([dead], **SMALL)
    assert found and tracker.counts['dead_hydrophones_masked'] == 1
    assert tracker.health()['dead_hydrophones'] == 1.0
    keep = np.delete(np.arange(len(spectra)), np.s_[50:60])
    holed = evolve(spectra, csdm=spectra.csdm[keep], frequency=spectra.frequency[keep])
    a, b = (run([each], **SMALL)[0].response.amplitude for each in (spectra, holed))
    assert np.corrcoef(a, b)[0, 1] > 0.9


def test_hostile_cross_spectra_are_counted_and_stop_nothing(spectra):
    each = np.ones((len(spectra), 8, 8), np.complex64)
    uneven = 0.3 * np.sin(np.arange(len(spectra)))
    cases = {
        'singular': ([evolve(spectra, csdm=each)], {'loading': 0.0}),
        'wrong_hydrophones': ([evolve(spectra, csdm=spectra.csdm[:, :7, :7])], {}),
        'bad_band': ([spectra], {'frequency_min': 5000.0, 'frequency_max': 6000.0}),
        'bad_frequency': ([evolve(spectra, frequency=spectra.frequency + uneven)], {}),
        'too_crowded': ([spectra], {'min_separation': 30.0}),
        'too_large': ([spectra], {'depth_step': 1e-4}),
    }
    for reason, (items, options) in cases.items():
        tracker, found = run(items, **{**SMALL, **options})
        assert tracker.counts[reason] == 1, (reason, tracker.counts)
        assert not found
    tracker, found = run([evolve(spectra, csdm=each)], **SMALL)
    assert tracker.counts['rank_deficient'] == 1


def test_where_the_array_is(spectra):
    bare = evolve(spectra, reference_depth=None)
    for companion, options, expected in (
        ([ArrayDepth(stamp_ns=bare.stamp_ns - 10**9, depth=70.0)], {}, 70.0),
        ([ArrayDepth(stamp_ns=bare.stamp_ns - 10**12, depth=70.0)], {'array_depth': 60.0}, 60.0),
        ([], {}, 0.0),
    ):
        tracker, _ = run([*companion, bare], **{**SMALL, **options})
        assert tracker.response.reference_depth == expected
        assert tracker.counts['array_depth_unknown'] == (expected == 0.0)
        assert tracker.counts['array_depths'] == len(companion)


def test_the_nearest_depth_counts_before_or_after(monkeypatch):
    second = 10**9
    config = FathometerConfig(array_depth_age=5.0)
    depths = CompanionDepths()
    assert depths.nearest(0, config) is None and depths.spread(0, second) == 0.0
    for seconds, depth in ((30, 73.0), (10, 71.0), (20, 72.0)):  # in the order of arrival
        depths.add(ArrayDepth(stamp_ns=seconds * second, depth=depth))
    for seconds, depth in ((4, None), (5, 71.0), (14, 71.0), (16, 72.0), (35, 73.0), (36, None)):
        assert depths.nearest(seconds * second, config) == depth, seconds
    assert depths.over(25 * second, 15 * second, config) == 71.5
    assert depths.spread(25 * second, 15 * second) == 0.5
    assert depths.over(29 * second, second, config) == 73.0  # nothing within: the nearest
    monkeypatch.setattr(pressure, '_KEPT', 2)
    depths.add(ArrayDepth(stamp_ns=40 * second, depth=74.0))
    assert depths.nearest(20 * second, config) is None
    assert depths.nearest(30 * second, config) == 73.0


def test_an_echo_of_the_processor_is_even_about_its_layer():
    """A tail above a strong layer, and its opposite below it, were taken for reflectors."""
    frequency, layer = np.arange(100.0, 2800.0, 4.0), 52.0
    R = surface_noise_csdm(frequency, 16, 0.25, [layer - 30.0], [0.35], 1500.0) + 0.01 * np.eye(16)
    record = CrossSpectra(stamp_ns=1, frequency=frequency, csdm=R)
    settings = {'phones': 16, 'element_spacing': 0.25, 'depth_min': 47.0, 'depth_max': 57.0}
    band = {'frequency_min': 100.0, 'frequency_max': 2800.0, 'noise_sigma': 1.0}
    odd = {}
    for pulse in ('processor', 'band'):
        config = FathometerConfig(**settings, **band, pulse=pulse, depth_step=0.05)
        response = array_response(record, lattice_of_array(30.0, config), config, 30.0)
        b, middle = response.amplitude, len(response.amplitude) // 2
        assert response.depth[middle] == pytest.approx(layer)
        near = np.arange(4, 25)
        odd[pulse] = np.abs(b[middle + near] - b[middle - near]).max() / b[middle]
    # The band leaves the phase in: its response is the same as ever.
    assert odd['processor'] < 0.02 < 0.04 < odd['band']


SCENE = {
    'level': 'csdm', 'records': 6, 'snapshots': 100, 'snapshot_seconds': 0.2,
    'first_amplitude': 0.35,
}  # fmt: skip
FOUND = {'particles': 2000, 'depth_min': 42.0, 'depth_max': 74.0}


@pytest.fixture(scope='module')
def scene():
    config = scenario('pressure', SCENE)
    made = simulate(config, 2)
    return [each.measurement for each in made.measurements], made.truth, config.instruments()


def with_responses(records, response):
    """response (F, M) or (M,)."""
    for each in records:
        c = np.broadcast_to(response, (len(each), each.hydrophones)).astype(np.complex64)
        yield evolve(each, csdm=each.csdm * c[:, :, None] * c.conj()[:, None, :])


def share_right(found, truth):
    there = {each.stamp_ns: len(each.depth) for each in truth}
    return np.mean([order_of(found[stamp]) == there[stamp] for stamp in sorted(found)[2:]])


def test_gain_sign_and_delay_are_taken_out_and_said(scene):
    records, truth, instruments = scene
    response = np.ones((len(records[0]), 16), np.complex128)
    response[:, 2] *= 0.5
    response[:, 4] *= -1.0
    response[:, 9] *= np.exp(-2j * np.pi * records[0].frequency * 80e-6)
    faulty = list(with_responses(records, response))
    tracker, found = run(faulty, **instruments, **FOUND)
    assert share_right(found, truth) == 1.0
    said = tracker.warnings()
    assert said[0] == 'hydrophone 2 is 6.0 dB below the others; its signal was levelled'
    assert said[1] == 'hydrophone 4 is turned; it was turned back'
    late = re.fullmatch('hydrophone 9 is ([0-9]+) us late; it was shifted', said[2])
    assert 74 <= int(late[1]) <= 86 and len(said) == 3
    health = tracker.health()
    assert health['phone_gain_db_2'] == pytest.approx(-6.0, abs=0.1)
    assert health['phone_sign_4'] == -1.0
    assert health['phone_delay_9'] == pytest.approx(80e-6, abs=6e-6)
    assert not [name for name in health if name.endswith('_3')]

    plain, lost = run(faulty, **instruments, **FOUND, phone_correction='off')
    assert share_right(lost, truth) < 0.5 and plain.warnings() == []


def test_a_foreign_hydrophone_is_left_out_and_said(scene):
    records, truth, instruments = scene
    rng = np.random.default_rng(6)
    faulty = []
    for each in records:
        csdm = each.csdm.copy()
        alone = sample_csdm(np.repeat(np.eye(16)[None], len(each), axis=0), 100, rng)
        alone = alone * csdm[:, 0, 0].real[:, None, None]
        csdm[:, 12], csdm[:, :, 12] = alone[:, 12], alone[:, :, 12]
        faulty.append(evolve(each, csdm=csdm))
    tracker, found = run(faulty, **instruments, **FOUND)
    assert share_right(found, truth) == 1.0
    (said,) = tracker.warnings()
    assert said == "hydrophone 12 has 0 % of its neighbours' sound; it was left out"
    assert tracker.counts['foreign_hydrophones_left_out'] == 6


def test_equal_hydrophones_say_nothing_and_keep_the_score(scene):
    records, truth, instruments = scene
    tracker, found = run(records, **instruments, **FOUND)
    assert tracker.warnings() == [] and share_right(found, truth) == 1.0
    assert not tracker.counts['foreign_hydrophones_left_out']
    assert not [name for name in tracker.health() if name.startswith('phone_')]


def test_many_that_differ_are_in_one_sentence(scene):
    records, _, instruments = scene
    gain = np.ones(16)
    gain[::2] = 2.0 ** np.arange(1, 9)
    tracker, _ = run(with_responses(records[:1], gain), **instruments, **FOUND)
    (sentence,) = tracker.warnings()
    assert sentence.count(' dB ') == 6
    assert sentence.endswith('more; their signals were levelled')


def test_a_set_with_a_wrong_sign_is_impossible():
    """Each row of the vectors is one set under its model."""
    v = load_vectors('fathometer_sea/signed_likelihood')
    n, impossible = v['response'].shape[1], 0
    edges = float(v['frequency_min']), float(v['frequency_max'])
    gram = band_pulse(*edges, float(v['sound_speed']))(float(v['depth_step']) * np.arange(n))
    for k, (order, due) in enumerate(zip(v['order'].tolist(), v['log_likelihood'])):
        model = SetModel(
            cells=n, separation=1, order_min=order, transition=np.eye(1), walk=np.ones(1),
            gram=gram, amplitude_std=float(v['amplitude_std_sigmas']), negative_probability=0.05,
        )  # fmt: skip
        sets, filter_ = Sets.empty(model, 1), SetFilter(model, 1)
        sets.order[:] = order
        sets.cell[0], sets.sign[0] = v['cell'][k, :order], v['sign'][k, :order]
        record = filter_.record(v['response'][k], (0, 0))
        step = filter_.weigh(Weighted(sets, np.zeros(1)), record)
        assert step.after.log_weight[0] == pytest.approx(due, abs=1e-9)
        impossible += np.isinf(due)
        if np.isfinite(due):
            assert step.amplitude[0] == pytest.approx(v['amplitude_mean'][k, :order], abs=1e-9)
    assert impossible == 24


def test_negative_layers_are_found_where_they_are_looked_for():
    scene = sea_scene('negative')
    tracker, found = run(scene.traces(), particles=3000, polarity='both')
    assert tracker.warnings() == []
    score = score_scene(found, scene.depth_at, after=5)
    assert score.right >= 0.95 and score.ospa <= 0.03
    for stamp, estimate in found.items():
        if stamp > 5 * 10**9:
            expected = np.sign(scene.amplitude[near_true(estimate, scene.depth_at(stamp))[0]])
            assert np.array_equal(estimate.extras['polarity'], expected)
            assert np.array_equal(np.sign(estimate.state[:, 1]), expected)
            assert estimate.extras['polarity'].dtype == np.int8
    tracker, found = run(scene.traces(range(30)), particles=2000, polarity='positive')
    assert 'negative echoes' in ' '.join(tracker.warnings())
    assert all((each.extras['polarity'] >= 0).all() for each in found.values())


def test_negative_layers_under_an_array_are_found_at_the_defaults():
    """Six layers, of which two are negative, as cross-spectra; traces keep the plain defaults."""
    rng, changes = np.random.default_rng(7), {'records': 10, 'snapshots': 100}
    config = scenario('pressure', {'level': 'csdm', 'snapshot_seconds': 0.35, **changes})
    depth = np.array([52.0, 55.2, 58.5, 61.7, 66.0, 69.3])
    depth = depth + np.cumsum(0.05 * rng.standard_normal((10, 6)), axis=0)
    array = config.array_depth + rng.uniform(-0.5, 0.5, 10)
    stated = array + config.array_depth_std * rng.standard_normal(10)
    amplitude = np.tile([0.35, 0.3, -0.25, 0.22, -0.2, 0.15], (10, 1))
    floor = Drift(depth, amplitude, amplitude != 0.0, array, stated)
    settings = {k: v for k, v in config.instruments().items() if k not in ('window', 'overlap')}
    settings |= {'depth_min': config.depth_min, 'depth_max': config.depth_max, 'particles': 3000}
    settings |= {'noise_depth_min': 0.0, 'noise_depth_max': 0.0}
    tracker = FathometerTracker(FathometerConfig(**settings, window='rectangular', overlap=0.0))
    for record, told in enumerate(stated.tolist()):
        (found,) = tracker.process(cross_spectra(config, floor, record, told, rng))
    assert found.state[:, 0] == pytest.approx(depth[-1], abs=0.2)
    assert np.array_equal(found.extras['polarity'], np.sign(amplitude[-1]))
    assert tracker.warnings() == []


@pytest.mark.parametrize(
    ('hydrophones', 'changes', 'expected'),
    [
        (16, {}, ('processor', 'both')),
        (0, {}, ('band', 'positive')),
        (5, {}, ('band', 'positive')),
        (16, {'processor': 'conventional'}, ('band', 'positive')),
        (16, {'envelope': True}, ('band', 'positive')),
        (16, {'pulse': 'band'}, ('band', 'positive')),
        (16, {'polarity': 'positive'}, ('processor', 'positive')),
        (0, {'pulse': 'processor'}, ('processor', 'positive')),
        (5, {'pulse': 'processor'}, ('processor', 'both')),
    ],
)
def test_what_auto_stands_for(hydrophones, changes, expected):
    """Five hydrophones .25 m apart are a fifteenth of the wave of 100 Hz."""
    config = FathometerConfig(element_spacing=0.25, frequency_min=100.0, **changes)
    settled = config.settled(hydrophones)
    assert (settled.pulse, settled.polarity) == expected
    assert settled.settled(0) is settled
    assert settled.negative_share == (0.05 if settled.polarity == 'both' else 0.0)
