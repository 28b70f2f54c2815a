# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Reflectors of either sign: the likelihood, the filter and the scene of the vectors."""

from pathlib import Path

from helpers.fathometer_runs import run
from helpers.fathometer_vectors import signed_sets
from helpers.sea_scenes import score_scene, sea_scene
from helpers.set_cycle import cycle
import numpy as np
from oracles.set_particles import weigh
import pytest

from sonar_imm.estimation.set_filter import SetFilter, Weighted
from sonar_imm.estimation.set_model import SetModel
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.simulation.fathometer.scenario import Drift
from sonar_imm_tools.simulation.fathometer.simulator import cross_spectra, scenario

VECTORS = Path(__file__).parents[2] / 'vectors'


@pytest.mark.parametrize('compiled', [False, True])
def test_a_set_with_a_wrong_sign_is_impossible(compiled):
    impossible = 0
    for case in signed_sets(VECTORS):
        if compiled:
            filter_ = SetFilter(case.model, 1)
            record = filter_.record(case.response, (0, 0))
            step = filter_.weigh(Weighted(case.sets, np.zeros(1)), record)
            found, amplitude = step.after.log_weight, step.amplitude
        else:
            found, amplitude = weigh(case.model, case.response, case.sets)
        assert found[0] == pytest.approx(case.log_likelihood, abs=1e-9)
        impossible += np.isinf(case.log_likelihood)
        if np.isfinite(case.log_likelihood):
            assert amplitude[0] == pytest.approx(case.amplitude, abs=1e-9)
    assert impossible == 24


def test_the_filter_agrees_with_the_sum_over_all_sets_of_one():
    """One member or none, on 12 cells: the posterior of place and sign by enumeration."""
    n, prior, std = 12, 0.2, 3.0
    switch = np.array([[0.7, 0.3], [0.2, 0.8]])
    walk = np.array([0.25, 0.5, 0.25])
    model = SetModel(
        cells=n, separation=2, order_min=0, transition=switch, walk=walk,
        gram=np.exp(-0.5 * np.arange(n) ** 2.0), amplitude_std=std, negative_probability=prior,
    )  # fmt: skip
    rng = np.random.default_rng(3)
    b = rng.standard_normal((3, n))
    b[:, 4] -= 3.5
    none, single = 0.5, 0.5 * np.outer([1.0 - prior, prior], np.full(n, 1.0 / n))
    K = sum(w * np.eye(n, k=shift) for w, shift in zip(walk, (-1, 0, 1)))
    tracker, before = SetFilter(model, 200_000), None
    for name, record in enumerate(b):
        born = none * switch[0, 1] * np.outer([1.0 - prior, prior], np.full(n, 1.0 / n))
        none = none * switch[0, 0] + single.sum() * switch[1, 0]
        single = single @ K * switch[1, 1] + born
        variance = 1.0 / (1.0 + std**-2)
        likelihood = np.exp(0.5 * variance * record**2) / np.sqrt(1.0 + std**2)
        single = single * np.where(np.array([[1.0], [-1.0]]) * record > 0.0, likelihood, 0.0)
        total = none + single.sum()
        none, single = none / total, single / total
        step = cycle(tracker, before, record, (5, name))
        before = step.after
        there = step.sets.order == 1
        found = np.zeros((2, n))
        row = (step.sets.sign[there, 0] < 0).astype(int)
        np.add.at(found, (row, step.sets.cell[there, 0]), step.w[there])
        assert step.log_evidence == pytest.approx(np.log(total), abs=0.02)
        assert np.abs(found - single).sum() < 0.03
    assert single[1].sum() > 0.3


def test_negative_layers_are_found_where_they_are_looked_for():
    scene = sea_scene('negative')
    tracker, found = run(scene.traces(), particles=3000, polarity='both')
    assert tracker.warnings() == []
    score = score_scene(found, scene, after=5)
    assert score.right >= 0.95 and score.ospa <= 0.03
    for stamp, estimate in found.items():
        if stamp > 5 * 10**9:
            near = np.abs(estimate.state[:, :1] - scene.depth_at(stamp)).argmin(axis=1)
            expected = np.sign(scene.amplitude[near])
            assert np.array_equal(estimate.extras['polarity'], expected)
            assert np.array_equal(np.sign(estimate.state[:, 1]), expected)
            assert estimate.extras['polarity'].dtype == np.int8
    tracker, found = run(scene.traces(range(30)), particles=2000, polarity='positive')
    assert 'negative echoes' in ' '.join(tracker.warnings())
    assert score_scene(found, scene, after=5).right == 0.0
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
        (5, {'pulse': 'processor'}, ('processor', 'both')),
        (0, {'pulse': 'processor'}, ('processor', 'positive')),
    ],
)
def test_what_auto_stands_for(hydrophones, changes, expected):
    """Five hydrophones .25 m apart are a fifteenth of the wave of 100 Hz."""
    config = FathometerConfig(element_spacing=0.25, frequency_min=100.0, **changes)
    settled = config.settled(hydrophones)
    assert (settled.pulse, settled.polarity) == expected
    assert settled.settled(0) is settled


def test_reflectors_are_negative_where_both_signs_are_asked_for():
    assert FathometerConfig(polarity='both').negative_share == 0.05
    assert FathometerConfig(polarity='positive').negative_share == 0.0
    with pytest.raises(ConfigError, match='negative_probability'):
        FathometerConfig(negative_probability=1.0)
