# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The study of the paper on divers: its equation (1), its model sets, and that it runs."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import diver_paper
from benchmarks.diver_paper import PaperChain, Program, TRACKERS
from sonar_imm.estimation import imm
from sonar_imm.estimation.motion import Motion
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.tracker import DiverConfig
from sonar_imm.trackers.own_models import checked

PRIOR = np.array([[0.8, 0.15, 0.05], [0.3, 0.5, 0.2], [0.1, 0.2, 0.7]])
VECTORS = Path(__file__).parents[1] / 'vectors' / 'diver'


def learnt(chain, mu):
    """The matrix (3, 3) after the model probabilities mu (K, 1, 3) in turn."""
    P = chain.initial_counts(1)
    for before, after in zip(mu[:-1], mu[1:]):
        P = chain.learn(P, chain.transition(P, 1.0), before, after, 1.0)
    return chain.transition(P, 1.0)[0]


def constant(*mu):
    return np.tile(mu, (60, 1, 1))


@pytest.mark.parametrize('form', ['product', 'ratio'])
def test_a_guard_keeps_its_share_of_the_prior(form):
    found = [learnt(PaperChain(PRIOR, form), constant(0.98, 0.01, 0.01))]
    if form == 'ratio':  # models that were impossible
        mu = np.array([[[1.0, 0.0, 0.0]], [[0.5, 0.5, 0.0]]])
        found.append(learnt(PaperChain(PRIOR, form), mu))
        assert found[1][0, 1] > PRIOR[0, 1]
    for P in found:
        assert (P >= 0.7 * PRIOR - 1e-12).all()
        np.testing.assert_allclose(P.sum(axis=1), 1.0, atol=1e-12)


def test_the_product_without_a_guard_is_one_hot_within_five_steps():
    P = learnt(PaperChain(PRIOR, 'product', guard=0.0), constant(0.7, 0.2, 0.1)[:6])
    assert P.max(axis=1).min() > 0.97


def test_the_ratio_without_a_guard_telescopes():
    """Whatever the chain said, a column ends up weighed by mu(k) / mu(0)."""
    mu = np.random.default_rng(5).dirichlet(np.ones(3), (6, 1))
    P = PRIOR * mu[-1] / mu[0]
    found = learnt(PaperChain(PRIOR, 'ratio', guard=0.0), mu)
    np.testing.assert_allclose(found, P / P.sum(axis=1, keepdims=True), atol=1e-12)


@pytest.mark.parametrize('form', diver_paper.EQUATION)
def test_impossible_transitions_stay_impossible(form):
    prior = np.array([[0.9, 0.1, 0.0], [0.0, 0.9, 0.1], [0.1, 0.0, 0.9]])
    P = learnt(PaperChain(prior, form), np.random.default_rng(3).dirichlet(np.ones(3), (10, 1)))
    assert (P[prior == 0.0] == 0.0).all()
    np.testing.assert_allclose(P.sum(axis=-1), 1.0)


def test_the_guarded_product_in_a_filter_is_that_of_the_reference():
    with np.load(VECTORS / 'imm_reference.npz') as reference:
        names = (name for name in reference if name.startswith('A6_world16_adaptA_guard/'))
        given = {name.partition('/')[2]: reference[name] for name in names}
    models = SimpleNamespace(
        initial_states=lambda z, R: tuple(given[name][None, None] for name in ('x0', 'P0', 'mu0')),
        motion=lambda dt: Motion(given['F'], given['Q'], given['B']),
        E=given['E'],
    )
    chain = PaperChain(given['Pi'], 'product', json.loads(str(given['opts']))['eps'])
    # The first fix begins a track, which begins otherwise here.
    z, R = (np.concatenate([part[:1], part])[None] for part in (given['Z'], given['R']))
    steps = list(diver_paper.forward(models, chain, z, R))
    for name in ('x', 'P', 'mu'):
        ours = np.concatenate([getattr(step, name) for step in steps[1:]])
        wanted = given['out_mu' if name == 'mu' else f'out_{name}j']
        np.testing.assert_allclose(ours, wanted, rtol=0.0, atol=1e-9)
    used = np.concatenate([step.transition for step in steps[2:]])
    np.testing.assert_allclose(used, given['out_Pi'][:-1], rtol=0.0, atol=1e-9)


def test_world_headings_are_those_of_the_reference(monkeypatch):
    monkeypatch.setattr(diver_paper.WorldHeadings, 'noise', 0.15)
    config = DiverConfig(heading_concentration=1.0, stay_probability=0.88)
    own = checked(diver_paper.WorldHeadings(config))
    F, Q, B = own.motion(1.0)
    ours = {'F': F, 'Q': Q, 'B': B, 'E': own.joint.E, 'Pi': own.transition}
    with np.load(VECTORS / 'imm_reference.npz') as reference:
        for key, value in ours.items():
            np.testing.assert_allclose(value, reference[f'A4_world16/{key}'], atol=1e-12)


def test_world_headings_compose_in_position():
    """Their velocity is drawn afresh at each step; the law of the position composes."""
    models = build_models(DiverConfig(model_set='bench_world_headings'))
    (x,), (P,), _ = models.initial_states(
        np.array([[3.0, -2.0]]), np.array([[[2.0, 0.5], [0.5, 1.0]]])
    )
    long_x, long_P, _ = imm.predict(x, P, *models.motion(1.0))
    for _ in range(10):
        x, P, _ = imm.predict(x, P, *models.motion(0.1))
    np.testing.assert_allclose(x[..., :2], long_x[..., :2], atol=1e-12)
    np.testing.assert_allclose(P[..., :2, :2], long_P[..., :2, :2], atol=1e-12)


def test_sixteen_directions_beat_one():
    truth, z, R = diver_paper.load(['table1'], range(8))
    errors = {'fixes': diver_paper.rmse(z, truth)}
    one = Program({'model_set': 'bench_cv_cv'})
    for name, (values, chain) in {**TRACKERS, 'one': one}.items():
        estimate, _ = diver_paper.track(DiverConfig(**values), z, R, chain)
        errors[name] = diver_paper.rmse(estimate, truth)
    assert max(errors.values()) == errors['fixes']
    assert 1.15 * errors['heading_speed'] < errors['one'] < errors['fixes']
