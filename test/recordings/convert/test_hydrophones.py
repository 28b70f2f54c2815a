# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Sound of an array becomes blocks of pressure that are its samples."""

import time

import numpy as np
import pytest

from sonar_imm_tools.recordings.convert import convert_hydrophones
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sniffing import sniff
from sonar_imm_tools.recordings.sources import BagError

soundfile = pytest.importorskip('soundfile')

RATE, BEGIN_NS = 4000, 1_717_149_600 * 10**9


def sound(path, rows=10_000, channels=4, subtype='PCM_16', seed=3):
    samples = 0.2 * np.random.default_rng(seed).standard_normal((rows, channels))
    soundfile.write(path, samples, RATE, subtype=subtype)
    return soundfile.read(path, dtype='float64', always_2d=True)[0]


def blocks_of(path):
    with BagReader(path) as bag:
        return [item.measurement for item in measurements_of(bag, 'fathometer')]


@pytest.mark.parametrize(
    'name, subtype',
    [('a.wav', 'PCM_16'), ('a.wav', 'FLOAT'), ('a.wav', 'PCM_24'), ('a.flac', 'PCM_16')],
)
def test_blocks_are_the_samples(tmp_path, name, subtype):
    samples = sound(tmp_path / name, subtype=subtype)
    report = convert_hydrophones(
        tmp_path / name, tmp_path / 'out', start='2024-05-31T10:00:00Z', channels=[3, 2, 0],
        full_scale=8.0, depth=100.0, block=0.7,
    )  # fmt: skip
    blocks = blocks_of(report.path)
    assert [block.stamp_ns for block in blocks] == [
        BEGIN_NS + 700_000_000 * k for k in range(len(blocks))
    ]
    found = np.concatenate([block.pressure for block in blocks])
    assert found == pytest.approx(8.0 * samples[:, [3, 2, 0]], abs=1e-6)
    assert {block.reference_depth for block in blocks} == {100.0}
    assert {block.sample_rate for block in blocks} == {RATE}


@pytest.mark.parametrize(
    'name', ['x_20240531_100000.wav', '5146.240531100000.wav', 'a-20240531T100000Z.wav']
)
def test_the_name_of_the_file_says_when_it_begins(tmp_path, name):
    sound(tmp_path / name)
    report = convert_hydrophones(tmp_path / name, tmp_path / 'out')
    assert blocks_of(report.path)[0].stamp_ns == BEGIN_NS
    assert report.notes['start'].startswith('2024-05-31T10:00:00Z by the name')
    report = convert_hydrophones(tmp_path / name, tmp_path / 'zone', time_zone='+02:00')
    assert blocks_of(report.path)[0].stamp_ns == BEGIN_NS - 7200 * 10**9


@pytest.mark.parametrize('start', ['0', 'now'])
def test_a_time_that_does_not_matter(tmp_path, start):
    sound(tmp_path / 'a.wav')
    before = time.time_ns() if start == 'now' else 10**9
    report = convert_hydrophones(tmp_path / 'a.wav', tmp_path / 'out', start=start)
    assert 0 <= blocks_of(report.path)[0].stamp_ns - before < 60 * 10**9


def test_wave_files_of_the_other_byte_order(tmp_path):
    samples = sound(tmp_path / 'a.wav')
    soundfile.write(tmp_path / 'b.wav', samples, RATE, endian='BIG')
    assert (tmp_path / 'b.wav').read_bytes()[:4] == b'RIFX'
    assert sniff(tmp_path / 'b.wav').kind == 'hydrophones'
    report = convert_hydrophones(tmp_path / 'b.wav', tmp_path / 'out', start='0')
    found = np.concatenate([block.pressure for block in blocks_of(report.path)])
    assert found == pytest.approx(samples, abs=1e-4)


def test_what_cannot_be_used_is_one_sentence(tmp_path):
    sound(tmp_path / 'a.wav')
    (tmp_path / 'b.wav').write_bytes(b'RIFF____WAVE' + bytes(50))
    sound(tmp_path / 'c.wav', channels=1)
    start = '2024-05-31T10:00:00Z'
    for name, options, wanted in (
        ('a.wav', {}, 'does not say when it begins'),
        ('a.wav', {'start': 'noon'}, 'is no time'),
        ('a.wav', {'start': start, 'channels': [0, 9]}, 'not 9'),
        ('a.wav', {'start': start, 'block': 600.0, 'channels': [0]}, 'at least two'),
        ('b.wav', {'start': start}, 'cannot be read as sound'),
        ('c.wav', {'start': start}, 'one channel'),
        ('none.wav', {'start': start}, 'cannot be read'),
    ):
        with pytest.raises(BagError, match=wanted):
            convert_hydrophones(tmp_path / name, tmp_path / 'out', **options)
        assert not (tmp_path / 'out').exists()


def test_a_file_that_was_cut_keeps_its_beginning(tmp_path):
    samples = sound(tmp_path / 'a.wav')
    content = (tmp_path / 'a.wav').read_bytes()
    (tmp_path / 'b.wav').write_bytes(content[: len(content) // 2])
    report = convert_hydrophones(
        tmp_path / 'b.wav', tmp_path / 'out', start='2024-05-31T10:00:00Z'
    )
    found = np.concatenate([block.pressure for block in blocks_of(report.path)])
    assert 4000 < len(found) <= 5000
    assert found == pytest.approx(samples[: len(found)], abs=1e-6)
