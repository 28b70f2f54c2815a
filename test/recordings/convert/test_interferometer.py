# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Arrays of few staves recorded as images: amplitude and phase, or one image a stave."""

import json

from helpers import marine
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg

from msg_adapters.navigation import write_navigation
from msg_adapters.snapshots import FIELDS, snapshot_of_phase, snapshot_of_staves
from msg_adapters.sonar_images import DTYPES
from sonar_imm.measurements import Navigation, Rejection, Snapshot
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

RATE, FIRST = 15_000.0, 400  # 0.05 m a bin, from 20 m on
SCENE = scenario(
    'paper',
    {'pings': 2, 'staves': 2, 'spacing_wavelengths': 2.5, 'first_range': 20.0, 'last_range': 40.0},
)
SCENE_TRUTH = simulate(SCENE, 1)
PINGS = [item.measurement for item in SCENE_TRUTH.measurements]


def image(ping, samples, dtype='f4', **raw):
    """RawSonarImage of samples (ranges, channels), range-major."""
    samples = np.atleast_2d(np.asarray(samples, '<' + dtype).T).T
    data = np.frombuffer(np.ascontiguousarray(samples).tobytes(), np.uint8)
    stamp = ping.stamp_ns
    head = marine.make(
        'std_msgs/msg/Header',
        frame_id='sss',
        stamp=marine.make(
            'builtin_interfaces/msg/Time', sec=stamp // 10**9, nanosec=stamp % 10**9
        ),
    )
    values = {
        'sample_rate': RATE, 'samples_per_beam': len(samples), 'sample0': FIRST,
        'tx_delays': marine.floats([]), 'tx_angles': marine.floats([]),
        'rx_angles': marine.floats([]),
    }  # fmt: skip
    return marine.make(
        'RawSonarImage',
        header=head,
        ping_info=marine.ping_info(),
        image=marine.make(
            'SonarImageData', is_bigendian=False, dtype=DTYPES.index(dtype),
            beam_count=samples.shape[1], data=data,
        ),
        **{**values, **raw},
    )  # fmt: skip


def phase_of(iq):
    return np.angle(iq[:, 1] * iq[:, 0].conj())


def in_two(stave):
    return np.column_stack([stave.real, stave.imag])


def test_complex_samples_come_back():
    ping = PINGS[0]
    made = snapshot_of_staves([image(ping, in_two(ping.iq[:, p])) for p in range(2)])
    assert np.array_equal(made.iq, ping.iq) and made.stamp_ns == ping.stamp_ns
    assert made.range == pytest.approx(ping.range) and made.sample_rate == RATE
    assert made.frequency == 450e3 and made.sound_speed == 1500.0 and made.frame_id == 'sss'
    turns = [np.ascontiguousarray(ping.iq[:, p]).view(np.float32) for p in range(2)]
    assert np.array_equal(snapshot_of_staves([image(ping, turn) for turn in turns]).iq, ping.iq)


@pytest.mark.parametrize('dtype, counts', [('f4', None), ('i2', 65536), ('u1', 256)])
def test_amplitude_and_phase_of_two_staves(dtype, counts):
    ping = PINGS[0]
    phase = phase_of(ping.iq)
    if counts:
        phase = np.round(phase * counts / (2.0 * np.pi)) % counts
        phase = np.where(phase >= counts / 2, phase - counts, phase) if dtype == 'i2' else phase
    made = snapshot_of_phase(image(ping, np.abs(ping.iq[:, 0])), image(ping, phase, dtype))
    step = 2.0 * np.pi / (counts or 1e6)
    apart = np.angle(np.exp(1j * (phase_of(made.iq) - phase_of(ping.iq))))
    assert np.abs(apart).max() < 0.51 * step + 1e-5
    assert np.abs(made.iq[:, 0]) == pytest.approx(np.abs(ping.iq[:, 0]), rel=1e-6)
    half = snapshot_of_phase(
        image(ping, np.abs(ping.iq[:, 0])), image(ping, phase, dtype), radians_per_count=0.25
    )
    assert np.angle(half.iq[5, 1]) == pytest.approx(
        np.angle(np.exp(0.25j * float(phase[5]))), abs=1e-5
    )


def test_amplitude_and_phase_of_every_stave():
    ping = PINGS[0]
    made = snapshot_of_phase(image(ping, np.abs(ping.iq)), image(ping, np.angle(ping.iq)))
    assert made.iq == pytest.approx(ping.iq, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize(
    'make, word',
    [
        (lambda p: (image(p, np.ones(9)), image(p, np.ones(8))), 'do not fit'),
        (lambda p: (image(p, np.ones(9), sample_rate=0.0), image(p, np.ones(9))), 'sample rate'),
        (lambda p: (image(p, np.ones((9, 3))), image(p, np.ones((9, 65)))), 'too_large|channels'),
        (lambda p: (object(), image(p, np.ones(9))), "no field 'image'"),
    ],
)
def test_what_cannot_be_is_refused_with_a_sentence(make, word):
    with pytest.raises(Rejection, match=word):
        snapshot_of_phase(*make(PINGS[0]))


def test_images_of_unknown_types_and_odd_sizes_are_refused():
    ping, good = PINGS[0], image(PINGS[0], np.ones(8))
    bad = image(ping, np.ones(8))
    bad.image.dtype = 77
    with pytest.raises(Rejection, match='datatype 77'):
        snapshot_of_phase(bad, good)
    short = image(ping, np.ones(8))
    short.image.data = short.image.data[:-1]
    with pytest.raises(Rejection):
        snapshot_of_phase(short, good)
    with pytest.raises(Rejection, match='two channels'):
        snapshot_of_staves([image(ping, np.ones((8, 3))), good])
    with pytest.raises(Rejection, match='ranges'):
        snapshot_of_staves([image(ping, np.ones((8, 2))), image(ping, np.ones((7, 2)))])


# -- from bag to bag, and through the tracker -----------------------------------------------------


def write(path, topics):
    """A bag with messages (stamp, message) by topic."""
    types = marine.typestore()
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, messages in topics.items():
            kind = messages[0].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=types)
            for number, message in enumerate(messages):
                writer.write(connection, number + 1, types.serialize_cdr(message, kind))
    return path


def converted(*arguments, capsys):
    capsys.readouterr()
    assert main(['convert', 'interferometer', *map(str, arguments), '--json']) == 0
    return json.loads(capsys.readouterr().out)


def snapshots_in(bag):
    with BagReader(bag) as reader:
        found = measurements_of(reader, 'bathymetry')
        return [item.measurement for item in found if isinstance(item.measurement, Snapshot)]


def height_error(snapshots, **values):
    spacing = SCENE.spacing_wavelengths
    tracker = BathymetryTracker(
        BathymetryConfig(element_spacing_wavelengths=spacing, noise_variance=1.0, **values)
    )
    found = [tracker.process(snapshot)[0].state[:, 0] for snapshot in snapshots]
    truth = [item.height for item in SCENE_TRUTH.truth]
    return float(np.sqrt(np.mean(np.square(np.array(found) - truth)))), tracker


def test_from_images_to_a_floor(tmp_path, capsys):
    wide = write(
        tmp_path / 'phase',
        {
            '/sss/a': [image(p, np.abs(p.iq[:, 0])) for p in PINGS],
            '/sss/p': [image(p, phase_of(p.iq)) for p in reversed(PINGS)],
        },
    )
    report = converted(
        wide,
        tmp_path / 'out',
        *('--amplitude', '/sss/a', '--phase', '/sss/p', '--side', 'port'),
        capsys=capsys,
    )
    assert report['messages'] == {'/port/snapshot': 2} and report['bad_rows'] == 0
    found = sorted(snapshots_in(tmp_path / 'out'), key=lambda item: item.stamp_ns)
    assert found[0].side == 'port'
    error, tracker = height_error(found)
    assert error < 0.15 and tracker.counts['bins_silent'] < 0.1 * tracker.counts['bins']
    staves = {
        f'/stave_{p}': [image(ping, in_two(ping.iq[:, p])) for ping in PINGS] for p in range(2)
    }
    converted(
        write(tmp_path / 'iq', staves), tmp_path / 'out2',
        *('--iq', '/stave_0', '--iq', '/stave_1'), capsys=capsys,
    )  # fmt: skip
    assert height_error(snapshots_in(tmp_path / 'out2'))[0] < 0.15


def test_navigation_comes_along_and_lonely_images_are_counted(tmp_path, capsys):
    pose = Navigation(stamp_ns=5, position=np.zeros(3), orientation=[0.0, 0.0, 0.0, 1.0])
    bag = write(
        tmp_path / 'bag',
        {
            '/a': [image(p, np.ones(8)) for p in PINGS],
            '/p': [image(PINGS[0], np.ones(8))],
            '/odom': [write_navigation(pose, ros_message)],
        },
    )
    report = converted(bag, tmp_path / 'out', '--amplitude', '/a', '--phase', '/p', capsys=capsys)
    assert report['messages'] == {'/snapshot': 1, '/nav': 1}
    assert report['bad_rows'] == 1 and 'stamps have to be equal' in report['problems'][0]


def test_fields_are_found_by_the_names_that_are_told(tmp_path, capsys):
    """One message with both, of a type that nobody knows."""
    types = marine.typestore()
    name = 'my_msgs/msg/Sidescan'
    types.register(
        get_types_from_msg(
            'std_msgs/Header header\nfloat32[] strength\nint16[] turn\nfloat32 fs\nfloat32 c', name
        )
    )
    ping = PINGS[0]
    counts = np.round(phase_of(ping.iq) / (2.0 * np.pi) * 65536).astype(np.int16)
    message = types.types[name](
        header=image(ping, [1.0]).header, strength=np.abs(ping.iq[:, 0]).astype(np.float32),
        turn=counts, fs=RATE, c=1480.0,
    )  # fmt: skip
    bag = write(tmp_path / 'bag', {'/sss': [message]})
    names = {'amplitude': 'strength', 'phase': 'turn', 'sample_rate': 'fs', 'sound_speed': 'c'}
    given = [part for pair in names.items() for part in ('--field', '='.join(pair))]
    converted(
        bag, tmp_path / 'out', '--amplitude', '/sss', '--phase', '/sss', *given, capsys=capsys
    )
    found = snapshots_in(tmp_path / 'out')[0]
    assert phase_of(found.iq) == pytest.approx(phase_of(ping.iq), abs=2e-4)
    assert found.sound_speed == 1480.0 and found.frequency is None and found.range[0] == 0.0
    assert set(names) < set(FIELDS)


@pytest.mark.parametrize(
    'arguments, word',
    [
        (['--amplitude', '/a'], 'name the topics'),
        ([], 'name the topics'),
        (['--iq', '/a'], 'at least two staves'),
        (['--iq', '/a', '--iq', '/nowhere'], "no topic '/nowhere'"),
        (['--iq', '/a', '--iq', '/p', '--field', 'colour=x'], "unknown field 'colour'"),
    ],
)
def test_mistakes_of_the_user_are_one_sentence(tmp_path, capsys, arguments, word):
    bag = write(tmp_path / 'bag', {name: [image(PINGS[0], np.ones(8))] for name in ('/a', '/p')})
    command = ['convert', 'interferometer', str(bag), str(tmp_path / 'out'), *arguments]
    assert main(command) == 2
    errors = capsys.readouterr().err
    assert word in errors and errors.count('\n') == 1
