# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""From a bag of sonar images to one the obstacle tracker hears."""

import json

from helpers import marine
from helpers.commands import run
from helpers.field_files import measured, pose_at
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from msg_adapters.snapshots import FIELDS, snapshot_of_phase, snapshot_of_staves
from msg_adapters.sonar_images import DTYPES
from sonar_imm.measurements import Detections, Navigation, Rejection, Snapshot
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

BEARINGS = np.radians(np.linspace(20.0, -20.0, 41))


def image(second, row, spoilt=False):
    """Beam-major, an echo at row / 2 + 2 m to port, none for row 0."""
    rng = np.random.default_rng(second)
    samples = np.round(3.0 * np.sqrt(rng.exponential(size=(41, 100))))
    if row:
        samples[5, row] = 200.0
    payload = marine.image_data(samples.astype('u1'), 0, 41)
    payload.data = payload.data[:-1] if spoilt else payload.data
    beams = np.column_stack([np.zeros(41), -np.sin(BEARINGS), np.cos(BEARINGS)])
    return marine.make(
        'ProjectedSonarImage', header=marine.header(sec=second), ping_info=marine.ping_info(),
        beam_directions=marine.vectors(beams), ranges=marine.floats(2.0 + 0.5 * np.arange(100)),
        image=payload,
    )  # fmt: skip


def converted(kind, *arguments, capsys):
    """The report of the command."""
    capsys.readouterr()
    assert run('convert', kind, *arguments, '--json') == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys, *arguments):
    """Its one sentence."""
    capsys.readouterr()
    assert run('convert', *arguments) in (1, 2)
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    return error


@pytest.fixture
def bag(tmp_path):
    seen = [(k, image(k, 0 if k == 4 else 60 - k, spoilt=k == 6)) for k in range(1, 7)]
    records = [(k * 10**9, '/fls/image', picture) for k, picture in seen]
    poses = [(k * 10**9 + 1, '/auv/odometry', pose_at(k * 10**9, 0.5 * k)) for k in range(1, 7)]
    return marine.write_bag(tmp_path / 'survey', [*records, *poses])


def test_images_become_pings_also_empty_ones_and_navigation_comes_along(bag, tmp_path, capsys):
    out = tmp_path / 'detections'
    content = converted('images', bag, out, '--set', 'image_order=beam_major', capsys=capsys)
    assert content['messages'] == {'/detections': 5, '/nav': 6} and content['bad_rows'] == 1
    assert '/fls/image #' in content['problems'][0]
    received = measured(out, 'obstacle')
    assert not any(isinstance(item, Rejection) for item in received)
    pings = [item for item in received if isinstance(item, Detections)]
    assert [len(ping) for ping in pings] == [1, 1, 1, 0, 1]
    assert [ping.range[0] for ping in pings if len(ping)] == [31.5, 31.0, 30.5, 29.5]
    assert pings[0].bearing[0] == pytest.approx(BEARINGS[5]) and BEARINGS[5] > 0.0
    assert sum(isinstance(item, Navigation) for item in received) == 6
    # A wrong setting and a bag without images are one sentence.
    order, other = ('--set', 'image_order=sideways'), tmp_path / 'other'
    assert 'image_order' in refused(capsys, 'images', bag, other, *order)
    assert 'has no topic with' in refused(capsys, 'images', out, other)


def oculus(second):
    rng = np.random.default_rng(second)
    samples = np.round(3.0 * np.sqrt(rng.exponential(size=(100, 41)))).astype('u1')
    samples[50, 30] = 200
    return marine.driver_message(
        'oculus_interfaces/msg/Ping', header=marine.header(sec=second), range_resolution=0.5,
        n_ranges=100, n_beams=41, step=41, sample_size=1, ping_data=samples.ravel(),
        bearings=np.linspace(-2000, 2000, 41).astype(np.int16),
    )  # fmt: skip


def ping360(angle, second):
    rng = np.random.default_rng([1, round(1000 * second)])
    seen = np.exp(-np.square((np.arange(200) - 100) / 2.0) - np.square((angle - 0.2) / 0.04))
    samples = 3.0 * np.sqrt(rng.exponential(size=200)) + 200.0 * seen
    return marine.driver_message(
        'ping360_sonar_msgs/msg/SonarEcho', header=marine.header(sec=int(second)), range=20,
        header__stamp__nanosec=round(second % 1.0 * 1e9), angle=float(angle % (2.0 * np.pi)),
        intensities=np.minimum(samples, 255).astype('u1'),
    )  # fmt: skip


def test_pings_of_an_oculus_become_detections_and_several_topics_have_to_be_chosen_from(
    tmp_path, capsys
):
    pings = [(k * 10**9, '/oculus/ping', oculus(k)) for k in range(1, 4)]
    bag, out = marine.write_bag(tmp_path / 'bag', pings), tmp_path / 'out'
    assert converted('images', bag, out, capsys=capsys)['messages'] == {'/detections': 3}
    for ping in measured(out, 'obstacle'):
        assert ping.range == pytest.approx([25.25], abs=0.1)
        assert ping.bearing == pytest.approx([-np.radians(10.0)], abs=0.01)
    pings = [(10**9, f'/{side}/ping', oculus(1)) for side in ('port', 'starboard')]
    bag, out = marine.write_bag(tmp_path / 'two', pings), tmp_path / 'one'
    assert '--topic /port/ping' in refused(capsys, 'images', bag, out)
    refused(capsys, 'images', bag, out, '--topic', '/nowhere')
    converted('images', bag, out, '--topic', '/starboard/ping', capsys=capsys)


def test_directions_of_a_ping360_in_a_bag_are_gathered_into_sweeps(tmp_path, capsys):
    angles = np.arange(-0.6, 0.6, np.radians(1.8))
    scan = np.concatenate([angles, angles[-2::-1], angles[1:]])
    echoes = [
        (int((10.0 + 0.1 * k) * 1e9), '/scan_echo', ping360(angle, 10.0 + 0.1 * k))
        for k, angle in enumerate(scan)
    ]
    bag, out = marine.write_bag(tmp_path / 'bag', echoes), tmp_path / 'out'
    settings = ['--set', 'beam_width_deg=2', '--set', 'range_resolution=0.4']
    content = converted('images', bag, out, *settings, capsys=capsys)
    assert content['messages'] == {'/detections': 2} and content['rows'] == len(scan)
    for ping in measured(out, 'obstacle'):
        assert ping.range == pytest.approx([10.1], abs=0.2)
        assert ping.bearing == pytest.approx([0.2], abs=0.02)


def test_what_the_sonar_says_beside_its_images_is_used_from_its_message_on(tmp_path, capsys):
    known = {'header': marine.header(), 'intensity_quantity': 3, 'intensity_scale': 1}
    none = dict.fromkeys(('pulse_lengths', 'bandwidths', 'tx_signal_types'), marine.floats([]))
    none['tx_signal_types'] = np.zeros(0, np.uint8)
    message = marine.driver_message('marine_interfaces/msg/SonarInfo', **known, **none)
    pings = [(k * 10**9, '/oculus/ping', oculus(k)) for k in range(1, 4)]
    bag = marine.write_bag(tmp_path / 'bag', [*pings, (25 * 10**8, '/oculus/sonar_info', message)])
    received = measured(bag, 'obstacle')
    strengths = [item.intensity[0] for item in received if isinstance(item, Detections)]
    assert strengths == pytest.approx([200.0, 200.0, np.sqrt(200.0)])
    done = converted('images', bag, tmp_path / 'out', capsys=capsys)
    assert done['messages'] == {'/detections': 3}


# -- arrays of few staves recorded as images: amplitude and phase, or one image a stave


RATE, FIRST = 15_000.0, 400  # 0.05 m a bin, from 20 m on
OF_TWO = {'pings': 2, 'staves': 2, 'spacing_wavelengths': 2.5}
SCENE = scenario('paper', {**OF_TWO, 'first_range': 20.0, 'last_range': 40.0})
SCENE_TRUTH = simulate(SCENE, 1)
PINGS = [item.measurement for item in SCENE_TRUTH.measurements]


def raw_image(ping, samples, dtype='f4', **raw):
    """RawSonarImage of samples (ranges, channels), range-major."""
    samples = np.atleast_2d(np.asarray(samples, '<' + dtype).T).T
    data = marine.image_data(np.ascontiguousarray(samples), DTYPES.index(dtype), samples.shape[1])
    second, rest = divmod(ping.stamp_ns, 10**9)
    stamp = {'header__stamp__sec': second, 'header__stamp__nanosec': rest}
    values = {'sample_rate': RATE, 'samples_per_beam': len(samples), 'sample0': FIRST, **stamp}
    values |= dict.fromkeys(('tx_delays', 'tx_angles', 'rx_angles'), marine.floats([]))
    values |= {'image': data, 'ping_info': marine.ping_info(), 'header__frame_id': 'sss', **raw}
    return marine.driver_message(marine.PACKAGE + 'RawSonarImage', **values)


def phase_of(iq):
    return np.angle(iq[:, 1] * iq[:, 0].conj())


def same_angle(found, wanted, most):
    apart = np.exp(1j * (np.asarray(found, float) - wanted))
    assert np.abs(np.angle(apart)).max() < most


def in_two(stave):
    return np.column_stack([stave.real, stave.imag])


def test_complex_samples_come_back():
    ping = PINGS[0]
    made = snapshot_of_staves([raw_image(ping, in_two(ping.iq[:, p])) for p in range(2)])
    assert np.array_equal(made.iq, ping.iq) and made.stamp_ns == ping.stamp_ns
    assert made.range == pytest.approx(ping.range) and made.sample_rate == RATE
    assert made.frequency == 450e3 and made.sound_speed == 1500.0 and made.frame_id == 'sss'
    turns = [np.ascontiguousarray(ping.iq[:, p]).view(np.float32) for p in range(2)]
    again = snapshot_of_staves([raw_image(ping, turn) for turn in turns])
    assert np.array_equal(again.iq, ping.iq)


@pytest.mark.parametrize('dtype, counts', [('f4', None), ('i2', 65536), ('u1', 256)])
def test_amplitude_and_phase_of_two_staves(dtype, counts):
    ping = PINGS[0]
    phase = phase_of(ping.iq)
    if counts:
        phase = np.round(phase * counts / (2.0 * np.pi)) % counts
        phase = np.where(phase >= counts / 2, phase - counts, phase) if dtype == 'i2' else phase
    size, turn = raw_image(ping, np.abs(ping.iq[:, 0])), raw_image(ping, phase, dtype)
    made = snapshot_of_phase(size, turn)
    step = 2.0 * np.pi / (counts or 1e6)
    same_angle(phase_of(made.iq), phase_of(ping.iq), 0.51 * step + 1e-5)
    assert np.abs(made.iq[:, 0]) == pytest.approx(np.abs(ping.iq[:, 0]), rel=1e-6)
    half = snapshot_of_phase(size, turn, radians_per_count=0.25)
    same_angle(np.angle(half.iq[5, 1]), 0.25 * float(phase[5]), 1e-5)
    # Of every stave.
    made = snapshot_of_phase(raw_image(ping, np.abs(ping.iq)), raw_image(ping, np.angle(ping.iq)))
    assert made.iq == pytest.approx(ping.iq, rel=1e-5, abs=1e-5)


def ones(*shape, **raw):
    return raw_image(PINGS[0], np.ones(shape), **raw)


def test_what_cannot_be_is_refused_with_a_sentence():
    cut = {'image__data': ones(8).image.data[:-1]}
    for make, images, word in (
        (snapshot_of_phase, (ones(9), ones(8)), 'do not fit'),
        (snapshot_of_phase, (ones(9, sample_rate=0.0), ones(9)), 'sample rate'),
        (snapshot_of_phase, (ones(9, 3), ones(9, 65)), 'too_large|channels'),
        (snapshot_of_phase, (object(), ones(9)), "no field 'image'"),
        (snapshot_of_phase, (ones(8, image__dtype=77), ones(8)), 'datatype 77'),
        (snapshot_of_phase, (ones(8, **cut), ones(8)), None),
        (snapshot_of_staves, ([ones(8, 3), ones(8)],), 'two channels'),
        (snapshot_of_staves, ([ones(8, 2), ones(7, 2)],), 'ranges'),
    ):
        with pytest.raises(Rejection, match=word):
            make(*images)


# -- from bag to bag, and through the tracker -----------------------------------------------------


def write(path, topics):
    """A bag with messages by topic."""
    records = [(k + 1, topic, each) for topic in topics for k, each in enumerate(topics[topic])]
    return marine.write_bag(path, records)


def snapshots_in(bag):
    return [item for item in measured(bag, 'bathymetry') if isinstance(item, Snapshot)]


def test_from_images_to_a_floor(tmp_path, capsys):
    amplitudes = [raw_image(p, np.abs(p.iq[:, 0])) for p in PINGS]
    phases = [raw_image(p, phase_of(p.iq)) for p in reversed(PINGS)]
    wide = write(tmp_path / 'phase', {'/sss/a': amplitudes, '/sss/p': phases})
    topics = ('--amplitude', '/sss/a', '--phase', '/sss/p', '--side', 'port')
    report = converted('interferometer', wide, tmp_path / 'out', *topics, capsys=capsys)
    assert report['messages'] == {'/port/snapshot': 2} and report['bad_rows'] == 0
    found = sorted(snapshots_in(tmp_path / 'out'), key=lambda item: item.stamp_ns)
    assert found[0].side == 'port'
    known = {'element_spacing_wavelengths': SCENE.spacing_wavelengths, 'noise_variance': 1.0}
    tracker = BathymetryTracker(BathymetryConfig(**known))
    heights = np.array([tracker.process(snapshot)[0].state[:, 0] for snapshot in found])
    error = heights - [item.height for item in SCENE_TRUTH.truth]
    assert np.sqrt(np.mean(error**2)) < 0.15
    assert tracker.counts['bins_silent'] < 0.1 * tracker.counts['bins']
    staves = {
        f'/stave_{p}': [raw_image(ping, in_two(ping.iq[:, p])) for ping in PINGS] for p in range(2)
    }
    bag, topics = write(tmp_path / 'iq', staves), ('--iq', '/stave_0', '--iq', '/stave_1')
    converted('interferometer', bag, tmp_path / 'out2', *topics, capsys=capsys)
    for found, ping in zip(snapshots_in(tmp_path / 'out2'), PINGS, strict=True):
        assert np.array_equal(found.iq, ping.iq) and found.range == pytest.approx(ping.range)


def test_navigation_comes_along_and_lonely_images_are_counted(tmp_path, capsys):
    pings = [raw_image(p, np.ones(8)) for p in PINGS]
    bag = write(tmp_path / 'bag', {'/a': pings, '/p': [ones(8)], '/odom': [pose_at(5, 0.0)]})
    topics = ('--amplitude', '/a', '--phase', '/p')
    report = converted('interferometer', bag, tmp_path / 'out', *topics, capsys=capsys)
    assert report['messages'] == {'/snapshot': 1, '/nav': 1}
    assert report['bad_rows'] == 1 and 'stamps have to be equal' in report['problems'][0]


def test_fields_are_found_by_the_names_that_are_told(tmp_path, capsys):
    """One message with both, of a type that nobody knows."""
    types, name, ping = marine.typestore(), 'my_msgs/msg/Sidescan', PINGS[0]
    fields = 'std_msgs/Header header\nfloat32[] strength\nint16[] turn\nfloat32 fs\nfloat32 c'
    types.register(get_types_from_msg(fields, name))
    message = types.types[name](
        header=raw_image(ping, [1.0]).header, strength=np.abs(ping.iq[:, 0]).astype(np.float32),
        turn=np.round(phase_of(ping.iq) / (2.0 * np.pi) * 65536).astype(np.int16), fs=RATE,
        c=1480.0,
    )  # fmt: skip
    bag = write(tmp_path / 'bag', {'/sss': [message]})
    names = {'amplitude': 'strength', 'phase': 'turn', 'sample_rate': 'fs', 'sound_speed': 'c'}
    given = [part for pair in names.items() for part in ('--field', '='.join(pair))]
    topics = ('--amplitude', '/sss', '--phase', '/sss')
    converted('interferometer', bag, tmp_path / 'out', *topics, *given, capsys=capsys)
    found = snapshots_in(tmp_path / 'out')[0]
    assert phase_of(found.iq) == pytest.approx(phase_of(ping.iq), abs=2e-4)
    assert found.sound_speed == 1480.0 and found.frequency is None and found.range[0] == 0.0
    assert set(names) < set(FIELDS)


def test_mistakes_of_the_user_are_one_sentence(tmp_path, capsys):
    bag = write(tmp_path / 'bag', {'/a': [ones(8)], '/p': [ones(8)]})
    for words, said in (
        ('--amplitude /a', 'name the topics'), ('', 'name the topics'),
        ('--iq /a', 'at least two staves'), ('--iq /a --iq /nowhere', "no topic '/nowhere'"),
        ('--iq /a --iq /p --field colour=x', "unknown field 'colour'"),
    ):  # fmt: skip
        assert said in refused(capsys, 'interferometer', bag, tmp_path / 'out', *words.split())
