# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer tracker with arrays: pressure, cross-spectra, dead hydrophones, lost blocks."""

from attrs import evolve
from helpers.fathometer_runs import run
import numpy as np
import pytest

from sonar_imm.acoustics.ambient import surface_noise_csdm
from sonar_imm.measurements import ArrayDepth, CrossSpectra, Pressure
from sonar_imm.trackers.fathometer import pressure
from sonar_imm.trackers.fathometer.pressure import CompanionDepths
from sonar_imm.trackers.fathometer.response import array_response, lattice_of_array
from sonar_imm.trackers.fathometer.tracker import FathometerConfig
from sonar_imm_tools.simulation.fathometer.simulator import scenario, simulate

SMALL = {**scenario('small').instruments(), 'particles': 2000}


@pytest.fixture(scope='module')
def pressure_scene():
    changes = {
        'records': 1, 'record_seconds': 9.8, 'phones': 12, 'element_spacing': 0.18,
        'frequency_max': 2000.0, 'steps_per_sigma': 0.0, 'block_seconds': 0.7, 'array_depth': 73.5,
        'first_depth': 130.0,
    }  # fmt: skip
    return simulate(scenario('pressure', changes), 1)


PRESSURE = {
    'phones': 12, 'frequency_max': 2000.0, 'snapshot_seconds': 0.7, 'record_seconds': 9.8,
    'depth_min': 122.0, 'depth_max': 172.0, 'particles': 500,
}  # fmt: skip


def blocks(scene):
    return [each.measurement for each in scene.measurements]


def test_pressure_gives_what_its_cross_spectra_give(pressure_scene):
    own = blocks(pressure_scene)
    tracker, found = run(own, **PRESSURE)
    assert len(found) == 1 and tracker.counts['blocks'] == len(own)
    (estimate,) = found.values()

    p = np.concatenate([each.pressure for each in own]).astype(np.float64)
    n = 4200
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(n) / n)
    parts = [
        np.fft.rfft(p[k : k + n] * window[:, None], axis=0)
        for k in range(0, len(p) - n + 1, n // 2)
    ]
    R = sum(part[:, :, None] * part[:, None, :].conj() for part in parts)
    frequency = np.arange(n // 2 + 1) / 0.7
    band = (frequency >= 50.0) & (frequency < 2000.001)
    spectra = CrossSpectra(
        stamp_ns=estimate.stamp_ns, frame_id='array', frequency=frequency[band].astype(np.float32),
        csdm=R[band].astype(np.complex64), reference_depth=own[0].reference_depth,
    )  # fmt: skip
    other, same = run([spectra], **PRESSURE)
    scale = tracker.response.sigma[0]
    assert np.abs(other.response.amplitude - tracker.response.amplitude).max() < 0.01 * scale
    assert other.response.sigma[0] == pytest.approx(scale, rel=1e-3)
    assert np.allclose(same[estimate.stamp_ns].probabilities, estimate.probabilities, atol=0.02)


@pytest.mark.statistics
def test_the_noise_is_measured_right_though_it_fades_with_depth():
    """What windows do to noise: between 180 m and 300 m there is an eighth less of it."""
    options = {'phones': 8, 'frequency_max': 2900.0, 'depth_min': 122.0, 'depth_max': 172.0}
    options['snapshot_seconds'] = 1.4
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(4):
        noise = [
            Pressure(
                stamp_ns=10**18 + round(k * 1.4e9),
                frame_id='array',
                pressure=rng.standard_normal((8400, 8), np.float32),
                sample_rate=6000.0,
                reference_depth=73.5,
            )
            for k in range(64)
        ]
        tracker, _ = run(noise, particles=50, **options)
        seen.append(tracker.response.amplitude / tracker.response.sigma)
    assert np.sqrt(np.mean(np.square(seen))) == pytest.approx(1.0, abs=0.06)


def test_a_lost_block_is_counted_and_a_long_gap_begins_anew(pressure_scene):
    own = blocks(pressure_scene)
    tracker, found = run(own[:3] + own[4:], **PRESSURE)
    assert tracker.counts['gaps'] == 1 and not found
    late = [evolve(each, stamp_ns=each.stamp_ns + 60 * 10**9) for each in own]
    tracker, found = run(own[:6] + late, **PRESSURE)
    assert tracker.counts['records_abandoned'] == 1
    assert len(found) == 1


def test_a_preview_is_not_committed(pressure_scene):
    own = blocks(pressure_scene)
    again = [
        evolve(each, stamp_ns=each.stamp_ns + k * round(9.8e9)) for k in range(3) for each in own
    ]
    plain, found = run(again, **PRESSURE)
    eager, more = run(again, preview_seconds=2.8, **PRESSURE)
    assert eager.counts['previews'] > 3
    assert set(found) < set(more)
    for stamp, each in more.items():
        assert each.extras['preview'].all() == (stamp not in found)
        if stamp in found:
            assert each.state.tobytes() == found[stamp].state.tobytes()


def test_the_small_drift_is_followed_from_cross_spectra_and_a_companion():
    scene = simulate(scenario('small'), 3)
    tracker, found = run([each.measurement for each in scene.measurements], **SMALL)
    assert tracker.counts['array_depths'] == 12 and not tracker.counts['array_depth_unknown']
    truth = {each.stamp_ns: each for each in scene.truth}
    near = [
        np.abs(each.state[0, 0] - truth[stamp].depth.min()) < 0.3 for stamp, each in found.items()
    ]
    assert len(near) == 12 and np.mean(near) > 0.9


@pytest.fixture(scope='module')
def spectra():
    scene = simulate(scenario('small', {'records': 1, 'depth_companion': False}), 5)
    return scene.measurements[0].measurement


def changed(spectra, csdm=None, **fields):
    return CrossSpectra(
        stamp_ns=spectra.stamp_ns,
        frequency=fields.pop('frequency', spectra.frequency),
        csdm=spectra.csdm if csdm is None else csdm,
        reference_depth=fields.pop('reference_depth', spectra.reference_depth),
        **fields,
    )


@pytest.mark.parametrize('dead', [0, 3, 7])
def test_a_dead_hydrophone_is_left_out_and_changes_little(spectra, dead):
    csdm = spectra.csdm.copy()
    csdm[:, dead], csdm[:, :, dead] = np.nan, np.nan
    config = FathometerConfig(**SMALL, depth_min=122.0, depth_max=172.0)
    depth = spectra.reference_depth
    lattice = lattice_of_array(depth, config)
    whole = array_response(spectra, lattice, config, depth)
    masked = array_response(changed(spectra, csdm), lattice, config, depth)
    peak = whole.amplitude.argmax()
    assert masked.amplitude[peak] > 0.5 * whole.amplitude[peak]
    assert np.corrcoef(whole.amplitude, masked.amplitude)[0, 1] > 0.5
    tracker, found = run([changed(spectra, csdm)], **SMALL)
    assert found and tracker.counts['dead_hydrophones_masked'] == 1
    assert tracker.health()['dead_hydrophones'] == 1.0


def test_hostile_cross_spectra_are_counted_and_stop_nothing(spectra):
    each = np.ones((len(spectra), 8, 8), np.complex64)
    cases = {
        'singular': ([changed(spectra, each)], {'loading': 0.0}),
        'wrong_hydrophones': ([changed(spectra, spectra.csdm[:, :7, :7])], {}),
        'bad_band': ([spectra], {'frequency_min': 5000.0, 'frequency_max': 6000.0}),
        'bad_frequency': (
            [
                changed(
                    spectra, frequency=spectra.frequency + 0.3 * np.sin(np.arange(len(spectra)))
                )
            ],
            {},
        ),
        'too_crowded': ([spectra], {'min_separation': 30.0}),
        'too_large': ([spectra], {'depth_step': 1e-4}),
    }
    for reason, (items, options) in cases.items():
        tracker, found = run(items, **{**SMALL, **options})
        assert tracker.counts[reason] == 1, (reason, tracker.counts)
        assert not found
    tracker, found = run([changed(spectra, each)], **SMALL)
    assert tracker.counts['rank_deficient'] == 1


def test_missing_frequencies_do_no_harm(spectra):
    keep = np.ones(len(spectra), bool)
    keep[50:60] = False
    tracker, _ = run([spectra], **SMALL)
    other, _ = run(
        [changed(spectra, spectra.csdm[keep], frequency=spectra.frequency[keep])], **SMALL
    )
    a, b = tracker.response.amplitude, other.response.amplitude
    assert np.corrcoef(a, b)[0, 1] > 0.9


def test_where_the_array_is(spectra):
    bare = changed(spectra, reference_depth=None)
    for companion, options, expected in (
        ([ArrayDepth(stamp_ns=bare.stamp_ns - 10**9, depth=70.0)], {}, 70.0),
        ([ArrayDepth(stamp_ns=bare.stamp_ns - 10**12, depth=70.0)], {'array_depth': 60.0}, 60.0),
        ([], {}, 0.0),
    ):
        tracker, _ = run([*companion, bare], **{**SMALL, **options})
        assert tracker.response.reference_depth == expected
        assert tracker.counts['array_depth_unknown'] == (expected == 0.0)


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
