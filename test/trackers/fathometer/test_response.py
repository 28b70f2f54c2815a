# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""From pressure to the response: snapshots, noise where no echo is, coherence or correlation."""

from collections import Counter

from attrs import evolve
from helpers.fathometer_runs import run, score_scene, sea_scene
from helpers.vector_files import load_vectors
import numpy as np
import pytest
from scipy.stats import median_abs_deviation

from sonar_imm.acoustics.fathometer import depth_response, printed_correlation, steering
from sonar_imm.acoustics.pulse import envelope_pulse
from sonar_imm.acoustics.spectra import effective_snapshots, window_of
from sonar_imm.measurements import ArrayDepth, Pressure, Rejection, Trace
from sonar_imm.trackers.fathometer import pressure as pressure_module
from sonar_imm.trackers.fathometer import response as responses
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.noise import mirror_sigma
from sonar_imm.trackers.fathometer.pressure import automatic_snapshot, MAX_BYTES, PressureStream
from sonar_imm_tools.simulation.fathometer import simulator
from sonar_imm_tools.simulation.fathometer.scenario import Drift

MIRROR = {'noise_depth_min': 0.0, 'noise_depth_max': 0.0}
LAYER, ARRAY = 130.0, 73.5
SHORT = {
    'phones': 6, 'frequency_max': 900.0, 'record_seconds': 4.0, 'depth_min': 85.0,
    'depth_max': 100.0, 'particles': 100,
}  # fmt: skip


def test_the_mirror_lies_at_negative_lags():
    """What lies above the array would be seen in the mirror window; what lies below is not."""
    below = 30.0 + 0.05 * np.arange(400)
    rng = np.random.default_rng(0)
    frequency = 100.0 + 2.0 * np.arange(1000)
    noise = 0.1 * (rng.standard_normal(1000) + 1j * rng.standard_normal(1000))
    echo = 0.3 * np.exp(-2j * np.pi * frequency * 2.0 * (60.0 - 20.0) / 1500.0)
    for heard in (noise, noise + echo):
        found = mirror_sigma(
            lambda *lattice, heard=heard: depth_response(heard, 100.0, 2.0, lattice, 20.0, 1500.0),
            below, 0.05, 20.0, 4.0,
        )  # fmt: skip
        assert len(found) == 400
        assert found[0] == pytest.approx(0.1 / np.sqrt(1000.0), rel=0.25)
    with pytest.raises(Rejection, match='mirrored'):
        mirror_sigma(lambda *a: np.ones(a[2]), 1e-3 * np.arange(100), 1e-3, 20.0, 4.0)


def test_the_noise_of_a_trace_is_what_its_reflectors_leave():
    scene = sea_scene('negative')
    traces = list(scene.traces(range(25), sigma=False))
    _, found = run(traces, particles=2000, polarity='both', **MIRROR)
    assert score_scene(found, scene.depth_at, after=5).right >= 0.9
    measured = np.mean([each.extras['sigma'][0] for each in found.values()])
    whole = [median_abs_deviation(each.amplitude, scale='normal') for each in traces]
    assert measured == pytest.approx(1.0, abs=0.15)
    assert abs(measured - 1.0) < 0.7 * abs(np.mean(whole) - 1.0)
    # Without noise beside its reflectors one is taken.
    depth = np.arange(40.0, 50.0, 0.05)
    tracker, found = run([Trace(stamp_ns=1, depth=depth, amplitude=np.sin(depth))], **MIRROR)
    assert len(found) == 1 and tracker.counts['used'] == 1
    assert not FathometerConfig().noise_from_mirror


def test_noise_near_an_array_that_hears_itself_is_louder_there_and_nowhere_else():
    below = 10.0 + 0.05 * np.arange(1200)
    rng = np.random.default_rng(1)

    def ringing(low, step, count):
        away = 20.0 - (low + step * np.arange(count))
        return rng.standard_normal(count) * (1.0 + 6.0 * np.exp(-away / 5.0))

    sigma = mirror_sigma(ringing, below, 0.05, 20.0, 2.5)
    assert sigma[0] > 1.6 and (np.diff(sigma) <= 0.0).all()
    assert (sigma[400:] == sigma[-1]).all() and sigma[-1] == pytest.approx(1.0, rel=0.1)
    flat = mirror_sigma(lambda *a: rng.standard_normal(a[2]), below, 0.05, 20.0, 2.5)
    assert (flat == flat[0]).all()
    # Of a window that ends within the aperture no depth is left that could be louder.
    short = mirror_sigma(ringing, 1.0 + 0.05 * np.arange(20), 0.05, 20.0, 2.5)
    assert len(short) == 20 and (short == short[0]).all()


@pytest.mark.parametrize('half, expected', [(np.inf, 3.3), (40.0, 1.0), (9.0, 1.0)])
def test_the_mirror_window_ends_at_half_a_snapshot(half, expected):
    """Further away are the lags of the other side, here five times as loud."""
    rng = np.random.default_rng(2)

    def other_side(low, step, count):
        away = 20.0 - (low + step * np.arange(count))
        return rng.standard_normal(count) * np.where(away > 40.0, 5.0, 1.0)

    sigma = mirror_sigma(other_side, 20.0 + 0.05 * np.arange(1600), 0.05, 20.0, 2.5, half)
    assert np.median(sigma) == pytest.approx(expected, rel=0.3)


def test_noise_depths_that_a_snapshot_cannot_hold_are_mirrored_and_said():
    """With 0.2 s the lags of 180 m to 300 m are those of the array itself, and its depths."""
    small = simulator.scenario('small', {'records': 1, 'depth_companion': False})
    scene = simulator.simulate(small, 5)
    spectra = scene.measurements[0].measurement
    base = {**simulator.scenario('small').instruments(), 'particles': 200}
    lattice = responses.Lattice(125.0, 0.05, 500)
    depth = spectra.reference_depth

    def response(**options):
        config = FathometerConfig(**base, **options)
        return responses.array_response(spectra, lattice, config, depth)

    wrapped, mirror = response(), response(**MIRROR)
    assert wrapped.noise_wraps and not mirror.noise_wraps
    assert wrapped.sigma.tobytes() == mirror.sigma.tobytes()
    fits = response(noise_depth_min=85.0, noise_depth_max=125.0)
    assert not fits.noise_wraps and fits.sigma[0] != mirror.sigma[0]
    assert not any('half a' in each for each in run([spectra], **base)[0].warnings())
    told = run([spectra], **base, noise_depth_max=310.0)[0].warnings()
    (said,) = (each for each in told if 'half a snapshot' in each)
    assert '75 m below the array with 0.2 s' in said


@pytest.fixture(scope='module')
def spectra():
    config = simulator.scenario('small', {'ship_noise': 0.0, 'snapshots': 4000})
    layer = np.array([[LAYER]])
    floor = Drift(layer, 0.5 * np.ones((1, 1)), layer > 0.0, np.array([ARRAY]), np.array([ARRAY]))
    return simulator.cross_spectra(config, floor, 0, ARRAY, np.random.default_rng(0))


def received(spectra, low, high, **options):
    """Depth and response between `low` and `high`, and the noise at the layer."""
    stated = simulator.scenario('small').instruments()
    config = FathometerConfig(**stated, **MIRROR, **options)
    lattice = responses.Lattice(low, 0.03, int((high - low) / 0.03))
    found = responses.array_response(spectra, lattice, config, ARRAY)
    return found.depth, found.amplitude, np.interp(LAYER, found.depth, found.sigma)


def test_echoes_are_positive_and_where_they_should_be(spectra):
    for output in ('coherence', 'correlation'):
        depth, b, sigma = received(spectra, 100.0, 140.0, output=output)
        assert depth[np.argmax(b)] == pytest.approx(LAYER, abs=0.15) and b.max() > 2.5 * sigma
        depth, e, _ = received(spectra, 100.0, 140.0, output=output, envelope=True)
        assert (e >= np.abs(b) - 1e-12).all()
        assert depth[np.argmax(e)] == pytest.approx(LAYER, abs=0.2)
    # The conventional one is printed right.
    options = {'envelope': True, 'processor': 'conventional'}
    known, names = (spectra, 110.0, 140.0), ('printed', 'correlation')
    e, c = (received(*known, output=name, **options)[1] for name in names)
    assert e == pytest.approx(c, rel=1e-5)


def test_equation_4_as_printed_has_its_echo_above_the_array(spectra):
    w = steering(spectra.frequency, 0.36 * np.arange(8), 1500.0)
    C = printed_correlation(spectra.csdm, w, 'mvdr', loading=1e-3)
    z = np.arange(110.0, 140.0, 0.03)
    way = 4.0j * np.pi * spectra.frequency[:, None] * (z - ARRAY) / 1500.0
    at_depth, above = (np.abs((C[:, None] * np.exp(s * way)).mean(axis=0)) for s in (1.0, -1.0))
    assert z[np.argmax(above)] == pytest.approx(LAYER, abs=0.2)
    assert above.max() > 2.0 * at_depth.max()
    # The tracker, which looks below the array, is told so and finds less there.
    _, e, _ = received(spectra, 110.0, 140.0, output='printed', envelope=True, loading=1e-3)
    assert e.max() == pytest.approx(at_depth.max(), rel=0.1)


def test_the_pulse_of_an_envelope():
    pulse = envelope_pulse(50.0, 4000.0, 1500.0)
    zero = 1500.0 / (2.0 * 3950.0)
    assert pulse(np.array([0.0, zero])) == pytest.approx([1.0, 0.0], abs=1e-12)
    assert (pulse(np.linspace(-3.0, 3.0, 999)) >= 0.0).all()
    with pytest.raises(ValueError):
        envelope_pulse(10.0, 5.0, 1500.0)


def noise(seconds, *, rate=2000.0, phones=6, depths=None, block=0.5, seed=0):
    """Blocks of white noise; depths: told of the array, one for each block."""
    rng, blocks = np.random.default_rng(seed), []
    for k in range(round(seconds / block)):
        blocks.append(
            Pressure(
                stamp_ns=10**18 + round(k * block * 1e9), frame_id='array', sample_rate=rate,
                pressure=rng.standard_normal((round(block * rate), phones)),
                reference_depth=80.0 if depths is None else depths[k],
            )
        )  # fmt: skip
    return blocks


@pytest.mark.statistics
def test_the_noise_is_measured_right_though_it_fades_with_depth():
    """What windows do to noise: between 180 m and 300 m there is an eighth less of it."""
    options = {'phones': 8, 'frequency_max': 2900.0, 'depth_min': 122.0, 'depth_max': 172.0}
    seen = []
    for seed in range(4):
        blocks = noise(89.6, rate=6000.0, phones=8, block=1.4, seed=seed)
        tracker, _ = run(blocks, particles=50, snapshot_seconds=1.4, **options)
        seen.append(tracker.response.amplitude / tracker.response.sigma)
    assert np.sqrt(np.mean(np.square(seen))) == pytest.approx(1.0, abs=0.06)


def test_a_snapshot_is_as_long_as_the_depths_need_and_the_array_allows():
    config = FathometerConfig(record_seconds=89.6)
    way = 2.0 * 30.0 / 1500.0
    assert automatic_snapshot(config, 16, 30.0) == pytest.approx(7.0 * way)
    # In 10 s, 2.5 snapshots for each hydrophone make it shorter, but not below five ways.
    short = evolve(config, record_seconds=10.0)
    seconds = automatic_snapshot(short, 30, 30.0)
    assert 5.0 * way < seconds < 7.0 * way
    count = 2.0 * 10.0 / seconds - 1.0
    assert 0.947 * count == pytest.approx(2.5 * 30, rel=0.01)
    assert automatic_snapshot(short, 40, 30.0) == pytest.approx(5.0 * way)
    assert automatic_snapshot(evolve(config, record_seconds=0.1), 32, 30.0) == 0.1
    # Whatever depth is told: 10 m to 12 km.
    assert automatic_snapshot(config, 3, -1e9) == automatic_snapshot(config, 3, 10.0)
    assert automatic_snapshot(evolve(config, record_seconds=1e4), 3, 1e9) < 113.0


def test_what_overlapping_snapshots_are_worth():
    assert effective_snapshots('rectangular', 0.0, 40) == 40.0
    assert effective_snapshots('hann', 0.5, 1000) == pytest.approx(947.0, abs=1.0)
    # Drawn: the variance of a mean power against that of one.
    rng = np.random.default_rng(0)
    x = rng.standard_normal((4000, 64 * 6)) + 1j * rng.standard_normal((4000, 64 * 6))
    window = window_of('hann', 64)
    power = [np.abs(x[:, k : k + 64] @ window) ** 2 for k in range(0, 64 * 5 + 1, 16)]
    worth = np.var(power[0]) / np.var(np.mean(power, axis=0))
    assert effective_snapshots('hann', 0.75, len(power)) == pytest.approx(worth, rel=0.12)


def test_the_tracker_takes_the_depths_it_tracks_and_the_mirror_window():
    tracker, found = run(noise(8.0), **SHORT)
    assert len(found) == 2
    seconds = 7.0 * 2.0 * 20.0 / 1500.0
    assert 0.95 * seconds < tracker.response.snapshot_seconds <= seconds
    # 180 m to 300 m would lie beyond half a snapshot.
    mirrored, _ = run(noise(8.0), **SHORT, **MIRROR)
    assert tracker.response.sigma[0] == mirrored.response.sigma[0]
    given, _ = run(noise(8.0), **SHORT, snapshot_seconds=0.2)
    assert given.response.sigma[0] != tracker.response.sigma[0]
    # A companion tells how far down snapshots must reach.
    blocks = [evolve(each, reference_depth=None) for each in noise(4.0)]
    stated = ArrayDepth(stamp_ns=blocks[0].stamp_ns - 10**9, depth=70.0)
    tracker, found = run([stated, *blocks], **SHORT)
    assert len(found) == 1 and tracker.response.reference_depth == 70.0
    seconds = 7.0 * 2.0 * 30.0 / 1500.0
    assert 0.95 * seconds < tracker.response.snapshot_seconds <= seconds


def test_too_few_snapshots_are_said():
    tracker, _ = run(noise(2.0), **{**SHORT, 'record_seconds': 0.3})
    assert tracker.counts['few_snapshots'] == tracker.counts['used'] > 1
    (said,) = tracker.warnings()
    assert 'hydrophones' in said
    tracker, _ = run(noise(8.0), **SHORT)
    assert not tracker.counts['few_snapshots'] and tracker.warnings() == []


def test_an_array_that_heaves_within_a_record_is_said_and_its_mean_is_taken():
    depths = 80.0 + 0.2 * np.sin(np.arange(8))
    tracker, _ = run(noise(4.0, depths=depths), **SHORT)
    assert tracker.counts['heave_within_record'] == 1
    assert tracker.response.reference_depth == pytest.approx(depths.mean())
    assert 'heaves' in tracker.warnings()[0]
    # A little it may, and from record to record.
    for depths in (80.0 + 0.02 * np.sin(np.arange(8)), np.repeat([80.0, 81.0], 8)):
        tracker, _ = run(noise(len(depths) / 2.0, depths=depths), **SHORT)
        assert not tracker.counts['heave_within_record'] and tracker.warnings() == []
        assert tracker.counts['used'] == len(depths) // 8
    # What a companion tells counts as well.
    told = []
    for k, each in enumerate(noise(4.0)):
        told.append(ArrayDepth(stamp_ns=each.stamp_ns, depth=80.0 + 0.2 * (k % 2)))
        told.append(evolve(each, reference_depth=None))
    assert run(told, **SHORT)[0].counts['heave_within_record'] == 1


@pytest.mark.parametrize('rate, phones, options', [
    (1e7, 250, {'snapshot_seconds': 4.0}),  # 10^10 samples would wait for the first snapshot
    (12e3, 250, {'snapshot_seconds': 3.0}),  # the cross-spectra
    (12e3, 100, {'snapshot_seconds': 0.2, 'preview_seconds': 1.0, 'record_seconds': 86400.0}),
    (1e6, 3, {'snapshot_seconds': 1.0, 'frequency_max': 4e5}),  # frequencies
    (1.0, 6, {}),  # no frequency at all
])  # fmt: skip
def test_arrays_that_would_take_too_much_are_refused_and_others_go_on(rate, phones, options):
    pressure = np.random.default_rng(0).standard_normal((100, phones))
    hostile = Pressure(stamp_ns=10**17, pressure=pressure, sample_rate=rate)
    stream = PressureStream(FathometerConfig(**{**SHORT, 'phones': 0, **options}), Counter())
    with pytest.raises(Rejection) as refused:
        stream.push(hostile, 20.0)
    assert refused.value.reason in ('too_large', 'bad_band')
    assert stream.waiting == 0


def test_an_array_that_is_refused_between_good_blocks_costs_nothing():
    good = noise(4.0)
    first, wrong = (
        evolve(good[k], sample_rate=1.0, stamp_ns=good[k].stamp_ns + by)
        for k, by in ((0, -(10**9)), (3, 1))
    )
    tracker, found = run([first, *good[:4], wrong, *good[4:]], **SHORT)
    assert tracker.counts['bad_band'] == 2 and len(found) == 1
    assert not tracker.counts['restarted_array'] and not tracker.counts['gaps']
    _, plain = run(good, **SHORT)
    (one,), (other,) = found.values(), plain.values()
    assert one.state.tobytes() == other.state.tobytes()


def test_a_long_block_is_taken_in_pieces_with_the_same_result(monkeypatch):
    config = FathometerConfig(**SHORT)
    (block,) = noise(8.0, block=8.0)
    (whole, *_), _ = PressureStream(config, Counter()).push(block, 20.0)
    monkeypatch.setattr(pressure_module, '_SAMPLES_AT_ONCE', 6 * 900)
    (pieces, *_), _ = PressureStream(config, Counter()).push(block, 20.0)
    assert pieces.spectra.snapshots == whole.spectra.snapshots
    scale = np.abs(whole.spectra.csdm).max()
    assert np.abs(pieces.spectra.csdm - whole.spectra.csdm).max() < 1e-5 * scale
    assert MAX_BYTES <= 1 << 30


@pytest.fixture(scope='module')
def vectors():
    return load_vectors('fathometer_sea/pressure')


def collected(vectors, record):
    names = 'element_spacing snapshot_seconds record_seconds frequency_min frequency_max'
    config = FathometerConfig(phones=16, **{name: float(vectors[name]) for name in names.split()})
    known = {'pressure': vectors['p'][record] * vectors['scale'][record]}
    block = Pressure(stamp_ns=1, sample_rate=float(vectors['sample_rate']), **known)
    (found,), _ = PressureStream(config, Counter()).push(block, 40.0)
    return config, found


def levelled(values):
    """Of any level: only ratios of cross-spectra count."""
    return values / np.abs(values).max()


def test_what_is_made_of_pressure_is_what_the_vectors_have(vectors):
    """Cross-spectra, coherence, spectrum and pulse of the processor, response, mirror noise."""
    record, v, (config, found) = 0, vectors, collected(vectors, 0)
    config, spectra = evolve(config, phone_correction='off', **MIRROR), found.spectra
    first, second = (float(z) for z in v['depth'][:2])
    lattice = responses.Lattice(first, second - first, len(v['depth']))
    coherent = responses.array_coherence(spectra, config)
    response = responses.array_response(spectra, lattice, config, float(v['array_depth'][record]))
    near = responses.Lattice(40.0, lattice.step, 320)
    pulse = responses.processor_pulse(coherent, near, config.sound_speed)
    rows = np.searchsorted(spectra.frequency, v['csdm_frequency'] - 0.1)
    lag = lattice.step * np.arange(320)
    for ours, theirs in (
        (levelled(spectra.csdm[rows]), levelled(v['csdm'][record])),
        (coherent.gamma, v['gamma_mvdr'][record]),
        (levelled(coherent.weight), levelled(v['weight'][record])),
        (response.amplitude, v['response'][record]),
        (response.sigma[:1], v['sigma_mirror'][record]),
        (pulse(lag), v['pulse_processor'][record]),
    ):
        assert np.abs(ours - theirs).max() < 1e-4 * np.abs(theirs).max()
    # It is not that of the band.
    assert spectra.snapshots == v['snapshots']
    assert pulse(np.array([0.14]))[0] > 0.0 > responses.pulse_of(config)(np.array([0.14]))[0]


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('processor', ['conventional', 'mvdr', 'white_noise'])
def test_the_unit_of_the_pressure_changes_no_digit_of_an_echo(vectors, processor):
    """Products of two powers of beams would leave single precision at both ends."""
    config, found = collected(vectors, 0)
    for output, gain in (('coherence', 0), ('correlation', 1)):
        config = evolve(config, processor=processor, output=output)
        plain = responses.array_coherence(found.spectra, config)
        for exponent in (-70, 60):
            spectra = evolve(found.spectra, csdm=found.spectra.csdm * np.float32(2.0**exponent))
            other = responses.array_coherence(spectra, config)
            scaled = plain.gamma * 2.0 ** (gain * exponent)
            assert np.array_equal(other.gamma, scaled, equal_nan=True)
            assert np.array_equal(other.weight, plain.weight, equal_nan=True)


@pytest.mark.filterwarnings('error')
def test_a_hydrophone_that_is_too_loud_for_any_unit_is_dead():
    rng = np.random.default_rng(0)
    samples = rng.standard_normal((600, 5)).astype(np.float32)
    samples[7, 2] = 1e30
    block = Pressure(stamp_ns=1, pressure=samples, sample_rate=6000.0)
    assert np.flatnonzero(~block.alive).tolist() == [2]
    loudest = np.float32(9e11) * np.sign(samples)
    loudest[7, 2] = 0.0
    config = FathometerConfig(phones=5, record_seconds=0.1, snapshot_seconds=0.02, particles=40)
    (found, *_), _ = PressureStream(config, Counter()).push(evolve(block, pressure=loudest), 40.0)
    assert found.spectra.alive.all() and np.isfinite(found.spectra.csdm).all()
