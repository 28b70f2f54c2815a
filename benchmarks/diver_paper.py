# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The paper on divers: sixteen directions against one, and eq. (1) as it may have read.

    python -m benchmarks.diver_paper --runs 500 --out docs/results/diver_paper.json

All filters see the same measurements. Runs are processed side by side as if each were a target
of its own, every measurement assigned to its target and none gated, as in the science sheet.
The filters with one direction are tuned on scenes of their own (other seeds). RMSE is over all
stamps from the first fix on.

The model sets to compare with are registered as those of any package are (docs/howto/own_model.md,
`benchmarks/entry`), under the names `bench_cv`, `bench_cv_cv`, `bench_cv_ct` and
`bench_world_headings`; other studies run the whole tracker with them:

cv, cv_cv, cv_ct
    One direction: white-noise acceleration (`acceleration_noise`), quiet and lively, or with
    turns.
world_headings
    Closest to the paper: v is drawn afresh along the heading of each model, the speed given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from benchmarks.study import Parts, study, truths
from sonar_imm.estimation import imm, markov, motion
from sonar_imm.estimation.adaptation import AdaptiveChain
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.consistency import average_bounds, nees
from sonar_imm.estimation.motion import Model, Motion
from sonar_imm.estimation.smoothing import imm_smooth
from sonar_imm.trackers.diver.models import build_models, heading_vectors, ModelSet
from sonar_imm.trackers.diver.tracker import DiverConfig
from sonar_imm.truth import TrueTrack
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

COLUMNS = {
    'Table 1 legs': ['table1'],
    'five scenes': ['legs_slow', 'straight', 'circle', 'zigzag', 'stop_and_go'],
    'random heading': ['random_heading'],
}
NOISES: dict[str, list[tuple[float, ...]]] = {
    'bench_cv': [(q,) for q in (0.1, 0.15, 0.2, 0.25, 0.3, 0.4)],
    'bench_cv_cv': [(a, b) for a in (0.01, 0.03, 0.06, 0.1) for b in (0.45, 0.6, 0.8, 1.0)],
    'bench_cv_ct': [(a, b, b) for a in (0.05, 0.1, 0.2) for b in (0.2, 0.3, 0.5)],
}
STAYS: dict[str, tuple[float, ...]] = {
    'bench_cv': (1.0,),
    'bench_cv_cv': (0.7, 0.8, 0.85, 0.9, 0.95),
    'bench_cv_ct': (0.8, 0.9),
}
BASELINES = {
    'bench_cv': 'CV Kalman, tuned',
    'bench_cv_cv': 'IMM CV+CV, tuned',
    'bench_cv_ct': 'IMM CV+CT+-, tuned',
}
STAY, TURN_RATE = 0.85, np.deg2rad(20.0)
"""Probability of keeping a model of one direction over a reference step; rad/s of the turns."""

HEADINGS: dict[str, Any] = {'model_set': 'heading_speed'}
"""The set after the paper."""

LEAST = 1e-12
"""A model less probable than this before a step counts as this probable in a ratio."""


# -- the sets to compare with ---------------------------------------------------------------------


class OwnSet:
    """A `DiverModels`."""

    models: Sequence[Model]
    transition: FloatArray
    start: dict[str, tuple[float, float]]


class OneDirection(OwnSet):
    """Constant velocities (`turns` of 0) and turns, with the accelerations that suit the scene of
    Table 1 where none are stated."""

    def __init__(
        self, names: Sequence[str], noises: Sequence[float], turns: Sequence[float], c: DiverConfig
    ):
        noises = [q * c.reference_step**0.5 for q in c.acceleration_noise or noises]
        self.models = [
            motion.ct(noise, turn, name) for name, noise, turn in zip(names, noises, turns)
        ]
        self.transition = markov.persistent(len(names), STAY)
        self.start = velocities(c)


cv = partial(OneDirection, ('cv',), (0.25,), (0.0,))
cv_cv = partial(OneDirection, ('cv_quiet', 'cv_lively'), (0.05, 0.6), (0.0, 0.0))
cv_ct = partial(
    OneDirection,
    ('cv', 'ct_left', 'ct_right'),
    (0.1, 0.3, 0.3),
    (0.0, TURN_RATE, -TURN_RATE),
)


class WorldHeadings(OwnSet):
    """Every heading has the same speed, m/s, but for a noise, m/s, drawn afresh at each step."""

    speed, noise = 1.0, 0.19

    def __init__(self, config: DiverConfig):
        u, _, names = heading_vectors(config)
        T, variance = config.reference_step, self.noise**2

        def step(along: FloatArray, x: FloatArray, dt: float) -> Motion:
            F, Q = np.diag([1.0, 1.0, 0.0, 0.0]), variance * np.eye(4)
            Q[:2, :2] *= T * dt
            Q[:2, 2:] = Q[2:, :2] = variance * min(T, dt) * np.eye(2)
            return Motion(F, Q, self.speed * np.append(dt * along, along))

        self.models = [moving(name, partial(step, along)) for name, along in zip(names, u)]
        self.transition = persistent(config)
        self.start = velocities(config)


def moving(name: str, step: Callable[[FloatArray, float], Motion]) -> Model:
    """A model whose state is position and velocity."""
    return Model(name, ('px', 'py', 'vx', 'vy'), step)


def velocities(config: DiverConfig) -> dict[str, tuple[float, float]]:
    """How a model whose state is position and velocity begins: at rest."""
    return {'vx': (0.0, config.velocity_std), 'vy': (0.0, config.velocity_std)}


def persistent(config: DiverConfig) -> FloatArray:
    """The chain (M, M) of headings that persist."""
    return markov.persistent_headings(
        config.directions, config.stay_probability, config.heading_concentration
    )


# -- eq. (1) --------------------------------------------------------------------------------------


class PaperChain:
    """Eq. (1) of the paper, which is lost in the source, in a form of `EQUATION`; the interface is
    that of `AdaptiveChain`.

    P <- (1 - guard) P + guard P0 after each step. Without a guard the exponent of the product
    doubles at each step, and rows become one-hot within five; ratios telescope to mu(k) / mu(0),
    whatever the chain.
    """

    def __init__(self, prior: FloatArray, form: str, guard: float = 0.7):
        self.prior, self.factor, self.guard = prior, EQUATION[form], guard

    def initial_counts(self, targets: int) -> FloatArray:
        """Transition matrices (targets, M, M)."""
        return np.tile(self.prior, (targets, 1, 1))

    def transition(self, learnt: FloatArray, dt: float) -> FloatArray:
        return learnt

    def learn(
        self,
        learnt: FloatArray,
        used: FloatArray,
        before: FloatArray,
        after: FloatArray,
        dt: float,
    ) -> FloatArray:
        P = learnt * self.factor(before, after)[:, None, :]
        total = P.sum(axis=-1, keepdims=True)
        P = np.where(total > 0.0, P / np.where(total > 0.0, total, 1.0), self.prior)
        return np.asarray((1.0 - self.guard) * P + self.guard * self.prior)


EQUATION: dict[str, Callable[[FloatArray, FloatArray], FloatArray]] = {
    'product': lambda before, after: after,
    'ratio': lambda before, after: after / np.maximum(before, LEAST),
    'not adapted': lambda before, after: np.ones_like(after),
}
"""How eq. (1) may have read, P_ij <- P_ij f_j / sum with f = mu(k) or mu(k) / mu(k-1), and what it
is compared with."""


def by_parameters(models: ModelSet, config: DiverConfig) -> AdaptiveChain:
    """The chain as the tracker has it."""
    return AdaptiveChain(
        models.chain,
        weight=config.adaptation_prior,
        learns=config.adaptation == 'counts',
    )


def guarded(form: str, models: ModelSet, config: DiverConfig) -> PaperChain:
    return PaperChain(models.chain.matrix, form)


def literal(form: str, matrix: FloatArray, models: ModelSet, config: DiverConfig) -> PaperChain:
    """Unguarded, from transition probabilities `matrix` (M, M)."""
    return PaperChain(matrix / matrix.sum(axis=1, keepdims=True), form, guard=0.0)


class Program(NamedTuple):
    """Parameters, and how transitions are learnt."""

    values: dict[str, Any]
    chain: Callable[[ModelSet, DiverConfig], Any] = by_parameters


TRACKERS = {
    'world_headings, 1 m/s given': Program(
        {
            'model_set': 'bench_world_headings',
            'stay_probability': 0.88,
            'heading_concentration': 2.5,
        }
    ),
    'heading_speed': Program(HEADINGS),
    'heading_speed, fixed transitions': Program({**HEADINGS, 'adaptation': 'fixed'}),
    'heading_speed, paper (guarded)': Program(HEADINGS, partial(guarded, 'product')),
    'heading_speed, ratio (guarded)': Program(HEADINGS, partial(guarded, 'ratio')),
}


# -- the filter -----------------------------------------------------------------------------------


def load(names: list[str], seeds: range) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """truth (N, K, 4), fixes (N, K, 2) and their covariances (N, K, 2, 2) of scenes in turn."""
    truth, z, R = [], [], []
    for seed in seeds:
        scene = simulate(scenario(names[seed % len(names)]), seed)
        track = truths(scene, TrueTrack)[0]
        truth.append(np.column_stack([track.position[:, :2], track.velocity]))
        z.append([item.measurement.position[:2] for item in scene.measurements])
        R.append([item.measurement.covariance[:2, :2] for item in scene.measurements])
    return np.array(truth), np.array(z), np.array(R)


class Step(NamedTuple):
    """After a fix: mean (N, 4), covariance (N, 4, 4); x, P, mu of the models; the transition
    matrices that led there, at first those of the next step."""

    mean: np.ndarray
    covariance: np.ndarray
    x: np.ndarray
    P: np.ndarray
    mu: np.ndarray
    transition: np.ndarray


def forward(
    models: ModelSet, chain: AdaptiveChain | PaperChain, z: np.ndarray, R: np.ndarray
) -> Iterator[Step]:
    """Filter N runs of K fixes, one a second, at once."""
    x, P, mu = (part[:, 0] for part in models.initial_states(z[:, 0], R[:, 0]))
    F, Q, B = models.motion(1.0)
    H = models.E[:, :2]
    learnt = chain.initial_counts(len(z))
    yield Step(*imm.combine(x, P, mu, models.E), x, P, mu, chain.transition(learnt, 1.0))
    for k in range(1, z.shape[1]):
        transition, before = chain.transition(learnt, 1.0), mu
        x, P, c = imm.mix(x, P, mu, transition)
        x, P, _ = imm.predict(x, P, F, Q, B)
        innovation = z[:, k, None] - np.einsum('jma,tja->tjm', H, x)
        x, P, mu, *_ = imm.update(x, P, c, innovation, H[None], R[:, k])
        learnt = chain.learn(learnt, transition, before, mu, 1.0)
        yield Step(*imm.combine(x, P, mu, models.E), x, P, mu, transition)


def track(
    config: DiverConfig,
    z: np.ndarray,
    R: np.ndarray,
    chain: Callable[[ModelSet, DiverConfig], Any] = by_parameters,
) -> tuple[np.ndarray, np.ndarray]:
    """Estimates (N, K, 4) and covariances (N, K, 4, 4)."""
    models = build_models(config)
    steps = [step[:2] for step in forward(models, chain(models, config), z, R)]
    mean, covariance = zip(*steps)
    return np.stack(mean, axis=1), np.stack(covariance, axis=1)


def rmse(estimate: np.ndarray, truth: np.ndarray, columns: slice = slice(0, 2)) -> float:
    error = estimate[..., columns] - truth[..., columns]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=-1))))


def tuned(model_set: str, names: list[str], scenes: int = 100) -> DiverConfig:
    """The filter with one direction that does best on so many scenes of other seeds."""
    truth, z, R = load(names, range(10_000, 10_000 + scenes))
    candidates = [
        DiverConfig(
            model_set=model_set,
            acceleration_noise=noise,
            transition_matrix=tuple(markov.persistent(len(noise), stay).ravel().tolist()),
            adaptation='fixed',
        )
        for noise in NOISES[model_set]
        for stay in STAYS[model_set]
    ]
    return min(candidates, key=lambda config: rmse(track(config, z, R)[0], truth))


# -- the tables -----------------------------------------------------------------------------------


def main_table(runs: int) -> dict[str, dict[str, float]]:
    table: dict[str, dict[str, float]] = {}
    for column, names in COLUMNS.items():
        truth, z, R = load(names, range(runs))
        first = {
            'random': np.random.default_rng(1).uniform(size=(16, 16)),
            'flat': np.ones((16, 16)),
        }
        estimates = {'raw fix': z}
        for model_set, label in BASELINES.items():
            estimates[label] = track(tuned(model_set, names), z, R)[0]
        for label, (values, chain) in TRACKERS.items():
            estimates[label] = track(DiverConfig(**values), z, R, chain)[0]
        world = DiverConfig(model_set='bench_world_headings')
        for kind, matrix in first.items():
            for form in EQUATION:
                estimates[f'eq. (1) literal, {form}, {kind} P0'] = track(
                    world, z, R, partial(literal, form, matrix)
                )[0]
        for label, estimate in estimates.items():
            table.setdefault(label, {})[column] = rmse(estimate, truth)
    return table


def losses(runs: int) -> dict[str, dict[str, float]]:
    """Scenes on which a multi-direction set does worse, and standing still."""
    table: dict[str, dict[str, float]] = {}
    programs = {**TRACKERS, 'IMM CV+CV': Program({'model_set': 'bench_cv_cv'})}
    for name in ('straight', 'legs_slow', 'still'):
        truth, z, R = load([name], range(runs))
        for label, (values, chain) in programs.items():
            estimate, _ = track(DiverConfig(**values), z, R, chain)
            row = table.setdefault(label, {})
            row[f'{name}, position'] = rmse(estimate, truth)
            row[f'{name}, velocity'] = rmse(estimate[:, 20:], truth[:, 20:], slice(2, 4))
    return table


def consistency(runs: int) -> dict[str, dict[str, float]]:
    """Mean NEES of the position, 2 degrees of freedom, and coverage of the 95 % ellipse."""
    table = {}
    for name in (
        'table1',
        'random_heading',
        'straight',
        'circle',
        'zigzag',
        'stop_and_go',
        'still',
    ):
        truth, z, R = load([name], range(runs))
        estimate, covariance = track(DiverConfig(**HEADINGS), z, R)
        squared = nees((estimate - truth)[..., :2], covariance[..., :2, :2])[:, 5:]
        low, high = average_bounds(squared.size // 10, 2)
        table[name] = {
            'NEES': float(squared.mean()),
            'low': low,
            'high': high,
            'coverage 95 %': float(np.mean(squared < 5.991)),
        }
    return table


def smoothing(runs: int) -> dict[str, dict[str, float]]:
    """Filter beside smoother."""
    truth, z, R = load(['table1'], range(runs))
    table = {}
    for label, model_set in (('CV RTS', 'bench_cv'), ('heading_speed', 'heading_speed')):
        config = DiverConfig(model_set=model_set)
        models = build_models(config)
        steps = list(forward(models, by_parameters(models, config), z, R))
        K = len(steps)
        F, Q, B = (np.broadcast_to(part, (K, *part.shape)) for part in models.motion(1.0))
        smooth = np.empty((runs, K, 4))
        for run in range(runs):
            x, P, mu = (
                np.stack([getattr(s, name)[run] for s in steps]) for name in ('x', 'P', 'mu')
            )
            into = np.stack([s.transition[run % len(s.transition)] for s in steps])
            smooth[run] = imm_smooth(x, P, mu, into, F, Q, B).combine(models.E)[0]
        table[label] = {
            'filter': rmse(np.stack([step.mean for step in steps], axis=1), truth),
            'smoother': rmse(smooth, truth),
        }
    return table


def main(runs: int = 500) -> Parts:
    yield {'runs': runs}
    yield {'RMSE of position, m': main_table(runs)}
    yield {'where it loses': losses(min(runs, 200))}
    yield {'consistency of heading_speed': consistency(min(runs, 200))}
    yield {'smoothing, Table 1 legs, RMSE m': smoothing(min(runs, 60))}


if __name__ == '__main__':
    study(main)
