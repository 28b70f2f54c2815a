# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Noise measured where no echo is, and what is made of both beams: coherence or correlation."""

from helpers.fathometer_runs import run
from helpers.sea_scenes import score_scene, sea_scene
import numpy as np
import pytest

from sonar_imm.acoustics.fathometer import depth_response, printed_correlation, steering
from sonar_imm.acoustics.pulse import envelope_pulse
from sonar_imm.measurements import Rejection, Trace
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.noise import mirror_sigma
from sonar_imm.trackers.fathometer.response import array_response, Lattice
from sonar_imm_tools.simulation.fathometer.scenario import Drift
from sonar_imm_tools.simulation.fathometer.simulator import cross_spectra, scenario, simulate

MIRROR = {'noise_depth_min': 0.0, 'noise_depth_max': 0.0}


def test_the_mirror_lies_at_negative_lags():
    """What lies above the array would be seen in the mirror window; what lies below is not."""
    below = 30.0 + 0.05 * np.arange(400)
    rng = np.random.default_rng(0)
    frequency = 100.0 + 2.0 * np.arange(1000)
    noise = 0.1 * (rng.standard_normal(1000) + 1j * rng.standard_normal(1000))

    def sigma(depth, strength):
        echo = strength * np.exp(-2j * np.pi * frequency * 2.0 * (depth - 20.0) / 1500.0)
        found = mirror_sigma(
            lambda low, step, count: depth_response(
                noise + echo, 100.0, 2.0, (low, step, count), 20.0, 1500.0
            ),
            below,
            0.05,
            20.0,
            4.0,
        )
        assert len(found) == 400
        return found[0]

    quiet = sigma(60.0, 0.0)
    assert quiet == pytest.approx(0.1 / np.sqrt(1000.0), rel=0.2)
    assert sigma(60.0, 0.3) == pytest.approx(quiet, rel=0.2)
    with pytest.raises(Rejection, match='mirrored'):
        mirror_sigma(lambda *a: np.ones(a[2]), 1e-3 * np.arange(100), 1e-3, 20.0, 4.0)


def test_the_noise_of_a_trace_is_what_its_reflectors_leave():
    scene = sea_scene('negative')
    traces = list(scene.traces(range(25), sigma=False))
    options = {'particles': 2000, 'polarity': 'both', **MIRROR}
    _, found = run(traces, **options)
    assert score_scene(found, scene, after=5).right >= 0.9
    measured = np.mean([each.extras['sigma'][0] for each in found.values()])
    whole = np.mean([_mad(each.amplitude) for each in traces])
    assert measured == pytest.approx(1.0, abs=0.15)
    assert abs(measured - 1.0) < 0.7 * abs(whole - 1.0)


def _mad(x):
    return np.median(np.abs(x - np.median(x))) / 0.6744897501960817


def test_a_trace_without_noise_beside_its_reflectors_is_still_taken():
    depth = np.arange(40.0, 50.0, 0.05)
    trace = Trace(stamp_ns=1, depth=depth, amplitude=np.sin(depth))
    tracker, found = run([trace], particles=100, **MIRROR)
    assert len(found) == 1 and tracker.counts['used'] == 1


def test_only_both_depths_at_zero_ask_for_the_mirror():
    assert FathometerConfig(**MIRROR).noise_from_mirror
    assert not FathometerConfig().noise_from_mirror
    with pytest.raises(ConfigError, match='noise_depth_max'):
        FathometerConfig(noise_depth_min=10.0, noise_depth_max=0.0)


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
    scene = simulate(scenario('small', {'records': 1, 'depth_companion': False}), 5)
    spectra = scene.measurements[0].measurement
    base = {**scenario('small').instruments(), 'particles': 200}
    lattice = Lattice(125.0, 0.05, 500)
    depth = spectra.reference_depth

    def response(**options):
        return array_response(spectra, lattice, FathometerConfig(**base, **options), depth)

    wrapped, mirror = response(), response(**MIRROR)
    assert wrapped.noise_wraps and not mirror.noise_wraps
    assert wrapped.sigma.tobytes() == mirror.sigma.tobytes()
    fits = response(noise_depth_min=85.0, noise_depth_max=125.0)
    assert not fits.noise_wraps and fits.sigma[0] != mirror.sigma[0]
    for told, sentences in (({}, 0), ({'noise_depth_max': 310.0}, 1)):
        tracker, _ = run([spectra], **base, **told)
        said = [each for each in tracker.warnings() if 'half a snapshot' in each]
        assert len(said) == sentences
    assert '75 m below the array with 0.2 s' in said[0]


LAYER, ARRAY = 130.0, 73.5


@pytest.fixture(scope='module')
def spectra():
    config = scenario('small', {'ship_noise': 0.0, 'snapshots': 4000})
    layer = np.array([[LAYER]])
    floor = Drift(layer, 0.5 * np.ones((1, 1)), layer > 0.0, np.array([ARRAY]), np.array([ARRAY]))
    return cross_spectra(config, floor, 0, ARRAY, np.random.default_rng(0))


def received(spectra, low, high, **options):
    """Depth and response between `low` and `high`, and the noise at the layer."""
    stated = scenario('small').instruments()
    config = FathometerConfig(**stated, noise_depth_min=0.0, noise_depth_max=0.0, **options)
    lattice = Lattice(low, 0.03, int((high - low) / 0.03))
    found = array_response(spectra, lattice, config, ARRAY)
    return found.depth, found.amplitude, np.interp(LAYER, found.depth, found.sigma)


@pytest.mark.parametrize('output', ['coherence', 'correlation'])
def test_echoes_are_positive_and_where_they_should_be(spectra, output):
    depth, b, sigma = received(spectra, 100.0, 140.0, output=output)
    assert depth[np.argmax(b)] == pytest.approx(LAYER, abs=0.15)
    assert b.max() > 2.5 * sigma
    depth, e, _ = received(spectra, 100.0, 140.0, output=output, envelope=True)
    assert (e >= np.abs(b) - 1e-12).all()
    assert depth[np.argmax(e)] == pytest.approx(LAYER, abs=0.2)


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


def test_the_conventional_one_is_printed_right(spectra):
    _, e, _ = received(
        spectra, 110.0, 140.0, output='printed', envelope=True, processor='conventional'
    )
    _, c, _ = received(
        spectra, 110.0, 140.0, output='correlation', envelope=True, processor='conventional'
    )
    assert e == pytest.approx(c, rel=1e-5)


def test_the_pulse_of_an_envelope():
    pulse = envelope_pulse(50.0, 4000.0, 1500.0)
    assert pulse(np.array([0.0]))[0] == 1.0
    first_zero = 1500.0 / (2.0 * 3950.0)
    assert pulse(np.array([first_zero]))[0] == pytest.approx(0.0, abs=1e-12)
    assert (pulse(np.linspace(-3.0, 3.0, 999)) >= 0.0).all()
    with pytest.raises(ValueError):
        envelope_pulse(10.0, 5.0, 1500.0)


def test_what_cannot_be_printed_is_refused():
    with pytest.raises(ConfigError, match='printed'):
        FathometerConfig(output='printed', processor='white_noise')
