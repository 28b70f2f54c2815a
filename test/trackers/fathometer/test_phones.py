# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Faulty hydrophones in the tracker: what it finds, what it says, what it leaves out."""

from attrs import evolve
from helpers.fathometer_runs import run
import numpy as np
import pytest

from sonar_imm.acoustics.ambient import sample_csdm
from sonar_imm_tools.simulation.fathometer.simulator import scenario, simulate

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
    orders = {
        stamp: int(each.model_names[each.probabilities[0].argmax()].split('_')[1])
        for stamp, each in found.items()
    }
    late = sorted(orders)[2:]
    return np.mean([orders[stamp] == there[stamp] for stamp in late])


def test_gain_sign_and_delay_are_taken_out_and_said(scene):
    records, truth, instruments = scene
    response = np.ones((len(records[0]), 16), np.complex128)
    response[:, 2] *= 0.5
    response[:, 4] *= -1.0
    response[:, 9] *= np.exp(-2j * np.pi * records[0].frequency * 80e-6)
    faulty = list(with_responses(records, response))
    tracker, found = run(faulty, **instruments, **FOUND)
    assert share_right(found, truth) == 1.0
    sentences = tracker.warnings()
    assert sentences[:2] == [
        'hydrophone 2 is 6.0 dB below the others; its signal was levelled',
        'hydrophone 4 is turned; it was turned back',
    ]
    assert sentences[2] in [
        f'hydrophone 9 is {late} us late; it was shifted' for late in range(74, 87)
    ]
    assert len(sentences) == 3
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
    assert tracker.warnings() == [
        "hydrophone 12 has 0 % of its neighbours' sound; it was left out"
    ]
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
