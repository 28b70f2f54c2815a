"""The fathometer tracker as its users see it: measurements in, estimates out."""

from pathlib import Path

from attrs import evolve
import numpy as np
import pytest

from sonar_imm.acoustics.spectra import BlockAverage, SnapshotStream
from sonar_imm.estimation.consistency import ospa
from sonar_imm.measurements import ArrayDepth, CrossSpectra, Fix, Pressure, Trace
from sonar_imm.parameters import ConfigError
from sonar_imm.simulation.fathometer import scenario, simulate
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.fathometer import FathometerConfig, FathometerTracker
from sonar_imm.trackers.fathometer_response import array_response, lattice_of_array

VECTORS = Path(__file__).parents[1] / 'vectors' / 'fathometer'
RECORD_NS = 90 * 10**9
SMALL = {'phones': 8, 'element_spacing': 0.36, 'frequency_max': 2000.0, 'particles': 2000}


@pytest.fixture(scope='module')
def vectors():
    with np.load(VECTORS / 'mvdr_traces.npz') as file:
        found = {name: file[name] for name in file}
    amplitude = found['reflector_amplitude']
    found['present'] = amplitude > 0.4 * amplitude.max(axis=0)
    return found


def traces(vectors, records, scale=1.0, given=True):
    for k in records:
        sigma = np.full(len(vectors['depth']), scale * vectors['sigma'][k])
        yield Trace(
            stamp_ns=(k + 1) * RECORD_NS,
            frame_id='array',
            depth=vectors['depth'],
            amplitude=vectors['amplitude'][k],
            sigma=sigma if given else None,
            reference_depth=float(vectors['reference_depth'][k]),
        )


def run(measurements, **parameters):
    tracker = FathometerTracker(FathometerConfig(**parameters))
    found = {}
    for one in measurements:
        found.update((each.stamp_ns, each) for each in tracker.process(one))
    return tracker, found


def score(found, vectors):
    """Share of records whose order is right, and mean OSPA."""
    right, distance = [], []
    for stamp, estimate in found.items():
        k = stamp // RECORD_NS - 1
        there = vectors['reflector_depth'][k][vectors['present'][k]].astype(float)
        order = int(estimate.model_names[estimate.probabilities[0].argmax()].split('_')[1])
        right.append(order == len(there))
        seen = estimate.state[np.isfinite(estimate.state[:, 0]), :1]
        distance.append(ospa(seen, there[:, None], cutoff=2.0, order=1.0))
    return np.mean(right), np.mean(distance)


@pytest.mark.parametrize('given', [True, False])
def test_the_simulated_drift_is_followed(vectors, given):
    tracker, found = run(traces(vectors, range(300), given=given), particles=5000)
    right, distance = score(found, vectors)
    assert right >= 0.94
    assert distance <= 0.07
    assert tracker.counts['used'] == 300 == len(found)
    ids = np.concatenate([one.extras['track_id'] for one in found.values()])
    names, lives = np.unique(ids, return_counts=True)
    # Ten reflectors; what else got an id was soon gone.
    assert np.count_nonzero(lives > 20) in (10, 11)
    assert np.count_nonzero(lives <= 20) <= 15


def test_what_came_later_corrects_an_estimate(vectors):
    options = {'particles': 3000, 'seed': 4}
    now = score(run(traces(vectors, range(80, 280)), **options)[1], vectors)
    later = score(run(traces(vectors, range(80, 280)), smoothing_lag=2, **options)[1], vectors)
    assert later[0] > now[0]
    assert later[1] <= now[1] + 0.003


def test_mistakes_of_print_cost_what_they_cost(vectors):
    records = range(0, 60)
    right, distance = score(run(traces(vectors, records), particles=3000)[1], vectors)
    low = score(run(traces(vectors, records, scale=0.7), particles=3000)[1], vectors)
    assert low[0] < right - 0.5
    blind = {'particles': 3000, 'proposal': 'prior'}
    assert score(run(traces(vectors, records), **blind)[1], vectors)[1] > 5.0 * distance
    fixed = {**blind, 'order_min': 7, 'order_max': 7}
    assert score(run(traces(vectors, records), **fixed)[1], vectors)[1] > 0.5


def test_noise_alone_has_no_reflector():
    rng = np.random.default_rng(0)
    depth = np.arange(100.0, 150.0, 0.1)
    noise = [
        Trace(stamp_ns=k, depth=depth, amplitude=rng.standard_normal(len(depth)))
        for k in range(1, 30)
    ]
    _, found = run(noise, pulse='gaussian', pulse_width=0.05, order_min=0, particles=2000)
    nothing = [one for one in found.values() if np.isnan(one.state[0, 0])]
    assert len(nothing) > 24
    for one in nothing:
        assert len(one) == 1
        assert one.probabilities[0].argmax() == 0
        assert one.probabilities[0].sum() == pytest.approx(1.0)
        assert one.extras['track_id'][0] == 0 and np.isnan(one.xyz[0, 2])


def test_columns_are_those_of_the_contract(vectors):
    _, found = run(traces(vectors, range(3)), particles=500)
    columns = found[RECORD_NS].columns()
    names = list(columns)
    assert names[:3] == ['x', 'y', 'z']
    assert names[3:8] == [
        'depth', 'amplitude', 'cov_depth_depth', 'cov_depth_amplitude', 'cov_amplitude_amplitude',
    ]  # fmt: skip
    assert names[8:20] == [f'prob_order_{k}' for k in range(1, 13)]
    assert {'track_id', 'existence'} <= set(names[20:])
    assert columns['track_id'].dtype == np.uint32
    assert np.allclose(columns['z'], -columns['depth'])
    assert (np.diff(columns['depth']) > 0.0).all()
    assert np.ptp(columns['prob_order_8']) == 0.0
    assert (columns['cov_depth_depth'] > 0.0).all()
    assert ((columns['existence'] >= 0.5) & (columns['existence'] <= 1.0)).all()


def test_amplitudes_are_freed_of_spreading(vectors):
    """The truth's amplitudes differ from the response's by the way the echo goes, and one factor
    of the processor."""
    _, found = run(traces(vectors, range(60)), particles=1000)
    raw, freed = [], []
    for stamp, one in found.items():
        k = stamp // RECORD_NS - 1
        nearest = np.abs(one.state[:, :1] - vectors['reflector_depth'][k]).argmin(axis=1)
        true = vectors['reflector_amplitude'][k][nearest]
        strong = true > 0.09
        raw.append(one.state[strong, 1] / true[strong])
        freed.append(one.extras['relative_amplitude'][strong] / true[strong])
    spread = [np.std(one) / np.mean(one) for one in map(np.concatenate, (raw, freed))]
    assert spread[1] < 0.9 * spread[0]


def test_the_same_input_gives_the_same_bytes(vectors):
    def columns(**parameters):
        _, found = run(traces(vectors, range(12)), particles=1001, **parameters)
        return [c.tobytes() for one in found.values() for c in one.columns().values()]

    assert columns() == columns(threads=4)
    assert columns() != columns(seed=1)


def test_late_repeated_and_restarted_input(vectors):
    one = list(traces(vectors, range(8)))
    tracker = FathometerTracker(FathometerConfig(particles=200))
    for k in (3, 3, 1, 4):
        tracker.process(one[k])
    assert tracker.counts['duplicate'] == 1
    assert tracker.counts['too_late'] == 1
    assert tracker.counts['used'] == 2
    tracker = FathometerTracker(FathometerConfig(particles=200))
    estimates = [tracker.process(one[k]) for k in (7, 0, 1, 2, 3)]
    assert [len(each) for each in estimates] == [1, 0, 0, 3, 1]
    assert tracker.counts['restarts'] == 1


def test_reset_equals_a_fresh_tracker(vectors):
    tracker = FathometerTracker(FathometerConfig(particles=300))
    first, again = [], []
    for out in (first, again):
        for one in traces(vectors, range(5)):
            out += [c.tobytes() for e in tracker.process(one) for c in e.columns().values()]
        tracker.reset()
    assert first == again


# -- arrays ----------------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def pressure_scene():
    config = scenario(
        'pressure', {'phones': 12, 'sample_rate': 6000.0, 'frequency_max': 2000.0}
    )
    return simulate(evolve(config, snapshot_seconds=0.7), 1)


PRESSURE = {
    'phones': 12,
    'frequency_max': 2000.0,
    'snapshot_seconds': 0.7,
    'record_seconds': 9.8,
    'depth_min': 122.0,
    'depth_max': 172.0,
    'particles': 500,
}


def blocks(scene, size=None):
    """The scene's pressure, as it is or in blocks of `size` samples."""
    own = [one.measurement for one in scene.measurements]
    if size is None:
        return own
    p = np.concatenate([one.pressure for one in own])
    return [
        Pressure(
            stamp_ns=own[0].stamp_ns + round(first / own[0].sample_rate * 1e9),
            frame_id=own[0].frame_id,
            pressure=p[first : first + size],
            sample_rate=own[0].sample_rate,
            reference_depth=own[0].reference_depth,
        )
        for first in range(0, len(p) - 1, size)
    ]


def test_pressure_gives_what_its_cross_spectra_give(pressure_scene):
    own = blocks(pressure_scene)
    tracker, found = run(own, **PRESSURE)
    assert len(found) == 1 and tracker.counts['blocks'] == len(own)
    (estimate,) = found.values()

    p = np.concatenate([one.pressure for one in own]).astype(np.float64)
    n = 4200
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(n) / n)
    parts = [np.fft.rfft(p[k : k + n] * window[:, None], axis=0) for k in range(0, len(p) - n + 1, n // 2)]
    R = sum(part[:, :, None] * part[:, None, :].conj() for part in parts)
    frequency = np.arange(n // 2 + 1) / 0.7
    band = (frequency >= 50.0) & (frequency < 2000.001)
    spectra = CrossSpectra(
        stamp_ns=estimate.stamp_ns,
        frame_id='array',
        frequency=frequency[band].astype(np.float32),
        csdm=R[band].astype(np.complex64),
        reference_depth=own[0].reference_depth,
    )
    other, same = run([spectra], **PRESSURE)
    scale = tracker.response.sigma[0]
    assert np.abs(other.response.amplitude - tracker.response.amplitude).max() < 0.01 * scale
    assert other.response.sigma[0] == pytest.approx(scale, rel=1e-3)
    assert np.allclose(same[estimate.stamp_ns].probabilities, estimate.probabilities, atol=0.02)


@pytest.mark.parametrize('size', [977, 50_000])
def test_blocks_of_any_length_give_the_same(pressure_scene, size):
    own, _ = run(blocks(pressure_scene), **PRESSURE)
    other, _ = run(blocks(pressure_scene, size), **PRESSURE)
    assert np.allclose(own.response.amplitude, other.response.amplitude, atol=1e-7)


def test_a_lost_block_is_counted_and_a_long_gap_begins_anew(pressure_scene):
    own = blocks(pressure_scene)
    tracker, found = run(own[:3] + own[4:], **PRESSURE)
    assert tracker.counts['gaps'] == 1 and not found
    late = [evolve(one, stamp_ns=one.stamp_ns + 60 * 10**9) for one in own]
    tracker, found = run(own[:6] + late, **PRESSURE)
    assert tracker.counts['records_abandoned'] == 1
    assert len(found) == 1


def test_a_preview_is_not_committed(pressure_scene):
    own = blocks(pressure_scene)
    again = [
        evolve(one, stamp_ns=one.stamp_ns + k * round(9.8e9)) for k in range(3) for one in own
    ]
    plain, found = run(again, **PRESSURE)
    eager, more = run(again, preview_seconds=2.8, **PRESSURE)
    assert eager.counts['previews'] > 3
    assert set(found) < set(more)
    for stamp, one in more.items():
        assert one.extras['preview'].all() == (stamp not in found)
        if stamp in found:
            assert one.state.tobytes() == found[stamp].state.tobytes()


def test_the_small_drift_is_followed_from_cross_spectra_and_a_companion():
    scene = simulate(scenario('small'), 3)
    tracker, found = run([one.measurement for one in scene.measurements], **SMALL)
    assert tracker.counts['array_depths'] == 12 and not tracker.counts['array_depth_unknown']
    truth = {one.stamp_ns: one for one in scene.truth}
    near = [
        np.abs(one.state[0, 0] - truth[stamp].depth.min()) < 0.3 for stamp, one in found.items()
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
def test_a_dead_phone_is_left_out_and_changes_little(spectra, dead):
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
    assert found and tracker.counts['dead_phones_masked'] == 1


def test_hostile_cross_spectra_are_counted_and_stop_nothing(spectra):
    one = np.ones((len(spectra), 8, 8), np.complex64)
    cases = {
        'singular': ([changed(spectra, one)], {'loading': 0.0}),
        'wrong_phones': ([changed(spectra, spectra.csdm[:, :7, :7])], {}),
        'bad_band': ([spectra], {'frequency_min': 5000.0, 'frequency_max': 6000.0}),
        'bad_frequency': (
            [changed(spectra, frequency=spectra.frequency + 0.3 * np.sin(np.arange(len(spectra))))],
            {},
        ),
        'too_crowded': ([spectra], {'min_separation': 30.0}),
        'too_large': ([spectra], {'depth_step': 1e-4}),
    }
    for reason, (items, options) in cases.items():
        tracker, found = run(items, **{**SMALL, **options})
        assert tracker.counts[reason] == 1, (reason, tracker.counts)
        assert not found
    tracker, found = run([changed(spectra, one)], **SMALL)
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


def test_strange_input_is_counted():
    tracker = SYSTEMS['fathometer'].build(FathometerConfig(particles=100))
    assert tracker.process(Fix(stamp_ns=1, position=np.zeros(3))) == []
    flat = Trace(stamp_ns=2, depth=np.arange(100.0), amplitude=np.ones(100))
    assert tracker.process(flat) == []
    assert tracker.counts['unknown_type'] == 1 and tracker.counts['no_noise'] == 1


def test_a_trace_may_lie_elsewhere_later(vectors):
    tracker, found = run(
        [
            *traces(vectors, range(2)),
            Trace(stamp_ns=10**13, depth=np.arange(500.0, 600.0), amplitude=np.arange(100.0)),
            next(traces(vectors, [250])),
        ],
        particles=300,
    )
    assert tracker.counts['other_depths'] == 1


def test_a_running_tracker_takes_over_what_may_change():
    tracker = FathometerTracker(FathometerConfig())
    tracker.reconfigure(FathometerConfig(existence_min=0.7))
    assert tracker.config.existence_min == 0.7
    with pytest.raises(ValueError, match='particles'):
        tracker.reconfigure(FathometerConfig(particles=7))


def test_a_warm_tracker_is_as_new():
    tracker = FathometerTracker(FathometerConfig(particles=50, depth_min=100.0, depth_max=150.0))
    tracker.warm()
    assert not tracker.counts and tracker.response is None


@pytest.mark.parametrize(
    'parameters, word',
    [
        ({'order_min': 9, 'order_max': 7}, 'order_max'),
        ({'order_min': 7, 'order_max': 8, 'order_transition_matrix': [1.0]}, '2 x 2'),
        (
            {'order_min': 7, 'order_max': 8, 'order_transition_matrix': [0.5, 0.5, 0.5, 0.6]},
            'row 1',
        ),
        ({'pulse': 'file'}, 'pulse_file'),
        ({'frequency_min': 5000.0}, 'frequency_max'),
        ({'depth_min': 50.0}, 'depth_max'),
        ({'amplitude_prior': 'paper', 'amplitude_memory': 0.5}, 'marginal'),
        ({'particles': 0}, 'particles'),
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
