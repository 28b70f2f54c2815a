# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What SEG-Y traces tell of their instrument: pulse, noise, spacing and place."""

from helpers.segy_files import write_segy
import numpy as np
import pytest
import yaml

from msg_adapters.array_records import read_trace
from sonar_imm.trackers.fathometer.response import envelope_parameters
from sonar_imm_tools.recordings.convert import convert_segy
from sonar_imm_tools.recordings.convert.segy import (
    doubted_spacing,
    measured_instrument,
)
from sonar_imm_tools.recordings.positions import read_positions
from sonar_imm_tools.recordings.reader import BagReader

pytest.importorskip('segyio')
T, N = 40, 90
ARRIVAL = 30 + np.arange(T) // 8
LAG = np.arange(N) - ARRIVAL[:, None]
ECHO = 1000.0 * np.exp(-0.5 * np.square(LAG / 1.5)) + np.where(LAG > 6, 200.0, 0.0)


def profile(path, amplitude, *, depth_m=0.0, arcsec=True):
    second = np.arange(len(amplitude)) // 4
    return write_segy(
        path,
        amplitude,
        TRACE_SAMPLE_INTERVAL=66,
        YearDataRecorded=2018,
        DayOfYear=72,
        HourOfDay=10,
        SecondOfMinute=second,
        ElevationScalar=-10,
        SourceWaterDepth=round(10.0 * depth_m),
        SourceGroupScalar=-1000,
        CoordinateUnits=2 if arcsec else 1,
        SourceX=round(-91.64 * 3.6e6) + 40 * second,
        SourceY=round(17.13 * 3.6e6),
    )


def test_the_pulse_and_the_noise_are_measured():
    pulse, noise = measured_instrument(ECHO, 0.4)
    # A Gaussian of 1.5 samples: half of its width at half height, linear between samples.
    assert pulse == pytest.approx(0.4 * 1.5, rel=0.1)
    assert noise[:28] == pytest.approx(np.full(28, 1.0))
    coarse = 100.0 * np.round(ECHO / 100.0)
    assert measured_instrument(coarse, 0.4)[1][:28] == pytest.approx(np.full(28, 50.0))
    assert measured_instrument(ECHO[:, 40:], 0.4) is None


def test_an_impossible_spacing_is_said():
    stated = np.full(T, 12.8)
    assert doubted_spacing(ECHO, 0.4, 0.0, stated) is None
    message = doubted_spacing(ECHO, 0.05, 0.0, stated)
    assert '0.4 m a sample would fit' in message and '12.8 m of water' in message
    # Samples that were left out before count as way.
    assert doubted_spacing(ECHO[:, 10:], 0.4, 4.0, stated) is None
    assert doubted_spacing(ECHO, 0.05, 0.0, np.zeros(T)) is None
    assert 'end at 0.09 m' in doubted_spacing(ECHO, 0.001, 0.0, np.zeros(T))


def test_an_envelope_brings_its_parameters_and_places(tmp_path):
    path = profile(tmp_path / 'line.seg', ECHO, depth_m=12.8)
    report = convert_segy(path, tmp_path / 'bag', stack=2)
    assert 'would fit' in report.notes['sample_interval']
    report = convert_segy(path, tmp_path / 'good', stack=2, sample_spacing=0.4)
    assert 'sample_interval' not in report.notes
    assert report.messages == {'/position': 10, '/trace': 20}
    own = yaml.safe_load((tmp_path / 'good' / 'parameters.yaml').read_text())
    own = own['fathometer']['ros__parameters']
    assert own['pulse'] == 'gaussian' and own['pulse_width'] == pytest.approx(0.6, rel=0.05)
    assert own['min_separation'] == pytest.approx(3 * own['pulse_width'])
    with BagReader(tmp_path / 'good') as bag:
        places = read_positions(bag)
    assert places.latitude == pytest.approx(np.full(10, 17.13), abs=1e-6)
    east, north = places.at(places.stamp_ns[:2] + np.array([500_000_000, -60 * 10**9]))
    assert east[0] == pytest.approx(places.longitude[:2].mean(), abs=1e-9)
    assert np.isnan(east[1]) and np.isnan(north[1])


def test_what_is_no_envelope_is_left_alone(tmp_path):
    path = profile(tmp_path / 'line.seg', ECHO - 100.0, arcsec=False)
    report = convert_segy(path, tmp_path / 'bag', sample_spacing=0.4)
    assert report.messages == {'/trace': 40} and 'pulse' not in report.notes
    assert not (tmp_path / 'bag' / 'parameters.yaml').exists()
    path = profile(tmp_path / 'deaf.seg', ECHO[:, 40:])
    report = convert_segy(path, tmp_path / 'deaf', sample_spacing=0.4)
    assert 'no floor stands free' in report.notes['pulse']


def line(*, gas=0.0, steep=0.0, growth=0.0, seed=1):
    """Envelopes (400, 200), .1 m apart, of a pulse of .3 m on a floor that rises by `steep` m from
    trace to trace, and falls; `gas`: share of arrivals that are up to six times as broad; noise of
    .02 that grows by exp(growth)."""
    rng, rows, z = np.random.default_rng(seed), np.arange(400), 0.1 * np.arange(200)
    floor = 6.0 + 2.0 * np.sin(rows / 40.0) + steep * np.abs(rows % 20 - 10)
    width = 0.3 * (1.0 + (rng.random(400) < gas) * rng.uniform(1.0, 5.0, 400))
    away = z - floor[:, None]

    def complex_noise(rms):
        return rms * np.sqrt(0.5) * (rng.standard_normal((2, 400, 200)).T @ [1.0, 1j]).T

    field = (
        np.exp(-0.5 * np.square(away / width[:, None]))
        * np.exp(2j * np.pi * rng.random(400))[:, None]
    )
    field = field + complex_noise(0.15) * np.where(away > 0.0, np.exp(-away / 3.0), 0.0)
    return np.abs(field + complex_noise(0.02) * np.exp(growth * z / z[-1]))


@pytest.mark.parametrize('field', [{}, {'gas': 0.8}, {'steep': 0.3}, {'gas': 0.5, 'steep': 0.3}])
def test_scatter_and_slopes_do_not_widen_the_pulse(field):
    """Gas makes most arrivals up to six times as broad: so is their median."""
    pulse, _ = measured_instrument(line(**field), 0.1)
    gas = field.get('gas', 0.0)
    assert 0.75 * 0.3 < pulse < (1.25 if not gas else 4.5) * 0.3


def with_transmit_pulse(traces, samples=25):
    """The first samples of each trace as an instrument has them, louder than any floor."""
    ring = 3.0 * np.exp(-np.maximum(np.arange(traces.shape[1]) - samples, 0.0) / 2.0)
    return traces + ring


@pytest.mark.parametrize('ring', [False, True])
def test_the_same_pulse_from_few_and_many_traces(ring):
    """Not from what is loudest, which is the transmit pulse, whose end is much steeper or not."""
    few, some = line(seed=3)[:60], line(seed=3)
    many = np.concatenate([line(seed=seed) for seed in range(3, 8)])
    if ring:
        few, some, many = map(with_transmit_pulse, (few, some, many))
    pulses = [measured_instrument(each, 0.1)[0] for each in (few, some, many)]
    assert pulses == pytest.approx([0.3] * 3, rel=0.2)
    assert max(pulses) < 1.12 * min(pulses)


def test_noise_that_grows_with_the_depth_is_measured():
    true = 0.02 * np.exp(3.0 * np.linspace(0.0, 1.0, 200))
    _, found = measured_instrument(line(growth=3.0), 0.1)
    # Just below the floor what scatters there cannot be told from it.
    ratio = found / true
    assert ratio.min() > 0.7 and np.delete(ratio, np.arange(40, 110)).max() < 1.45


def test_traces_state_noise_that_grows(tmp_path):
    profile(tmp_path / 'in.sgy', line(growth=3.0))
    report = convert_segy(tmp_path / 'in.sgy', tmp_path / 'out', sample_spacing=0.1)
    assert 'growing with the depth' in report.notes['pulse']
    own = yaml.safe_load((tmp_path / 'out' / 'parameters.yaml').read_text())
    own = own['fathometer']['ros__parameters']
    assert own['noise_sigma'] == 0.0
    with BagReader(tmp_path / 'out') as bag:
        trace = read_trace(next(iter(bag.messages(['/trace']))).message)
    assert trace.sigma[-1] > 10.0 * trace.sigma[0]


def test_as_many_reflectors_as_the_window_holds():
    """A pulse too broad for six reflectors in the window: fewer, and no run refused for that."""
    broad = envelope_parameters(2.6, 0.1, 27.8)
    assert broad['order_max'] == 3 and broad['order_max'] * broad['min_separation'] <= 27.8
    assert envelope_parameters(0.5, 0.1, 27.8) == envelope_parameters(0.5, 0.1)
    assert envelope_parameters(50.0, 0.1, 27.8)['order_max'] == 1
