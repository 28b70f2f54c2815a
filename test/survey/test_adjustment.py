# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The crossing adjustment beside dense least squares and the reference vectors."""

from attrs import evolve
from helpers import survey_vectors as vectors
import numpy as np
import pytest

from sonar_imm_tools.simulation.survey import budget
from sonar_imm_tools.survey import adjustment as module
from sonar_imm_tools.survey import looks as looks_module
from sonar_imm_tools.survey.adjustment import (
    adjust,
    Crossing,
    described,
    misties,
    Priors,
    robust_rms,
)
from sonar_imm_tools.survey.line import BASIS
from sonar_imm_tools.survey.looks import Looks, looks_of, strips

BUDGET = budget()


def small(seed=1, lines=3, cells=60):
    """Looks of lines over the same cells, all partials known: depth 10 to 14 m, gradient zero."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(lines):
        side = rng.choice([-1.0, 1.0], cells)
        D, Y = rng.uniform(10.0, 14.0, cells), rng.uniform(3.0, 30.0, cells)
        basis = np.zeros((cells, BASIS))
        basis[:, 0], basis[:, 1] = side * Y, (Y * Y / D - D) / 1500.0
        basis[:, 8] = 0.5 * Y * Y / D
        z = -12.0 + basis[:, 0] * 0.01 + 0.2 * k + basis[:, 1] * 2.0 + rng.normal(0, 0.03, cells)
        n = np.zeros(cells, np.int64)
        looks = Looks(
            cell=2.0,
            ix=np.arange(cells) * 40,  # far apart: nothing tells a gradient
            iy=n,
            line=n + k,
            side=(side < 0.0).astype(np.int64),
            count=np.full(cells, 9.0),
            time=1e9 + 1000.0 * k + rng.uniform(0.0, 60.0, cells),
            z=z,
            place=np.zeros((cells, 2)),
            noise=np.full(cells, 0.03**2),
            moments=np.zeros((cells, 6)),
            basis=basis,
        )
        made.append(looks)
    return made


def dense(made, priors):
    """Partials (m, P), heights (m,), variances and blocks of ten seconds, and the incidence of
    cells, written down row by row."""
    looks = Looks.joined(made)
    looks = looks.chosen(np.lexsort((looks.side, looks.line, looks.iy, looks.ix)))
    L, m = len(made), len(looks)
    J = np.zeros((m, 3 + 3 * L))
    for row in range(m):
        b, k = looks.basis[row], looks.line[row]
        J[row, 0] = b[0]
        J[row, 3 + 3 * k : 6 + 3 * k] = 1.0, b[1], b[0]
    line = (priors.line_offset, priors.line_sound_speed, priors.line_roll)
    prior = np.array([priors.roll, priors.pitch, priors.heading, *line * L])
    cell = np.unique(looks.ix, return_inverse=True)[1]
    G = np.zeros((m, cell.max() + 1))
    G[np.arange(m), cell] = 1.0
    v = 0.03**2 / 5.0 + 0.02**2
    times = np.floor(looks.time / 10.0)
    blocks = np.array(
        [(k, t) == (a, b) for k, t in zip(looks.line, times) for a, b in zip(looks.line, times)]
    ).reshape(m, m)
    depth = 2.0 * looks.basis[:, 8] - 1500.0 * looks.basis[:, 1]
    layers = looks.basis[:, 1] * (depth / np.median(depth) - 1.0)
    U = {'roll': np.outer(J[:, 0], J[:, 0]) * blocks, 'heave': 1.0 * blocks}
    U['layers'] = np.outer(layers, layers)
    return J, looks.z, v, U, G, prior


def corrected(made):
    """Statistics of `made` at corrected places: where all is linear, heights and partials."""

    def statistics(corrections):
        level = [np.zeros((len(looks), 2)) for looks in made]
        moves = [module.partials(looks.basis, g, 1500.0) for looks, g in zip(made, level)]
        return [
            evolve(looks, z=looks.z + a @ corrections[k])
            for k, (looks, a) in enumerate(zip(made, moves))
        ]

    return statistics


@pytest.fixture
def plain(monkeypatch):
    """One round, no Student weights: what is left is linear."""
    monkeypatch.setattr(module, 'REWEIGHTINGS', 1)
    monkeypatch.setattr(module, 'ROUNDS', 1)
    monkeypatch.setattr(module, 'NU', 1e12)
    monkeypatch.setattr(module, 'SECOND_ORDER', 0.0)


def test_states_are_generalized_least_squares(plain):
    """Unknown blocks with a prior are errors with a covariance."""
    made, priors = small(), Priors()
    J, z, v, U, G, prior = dense(made, priors)
    V = v * np.eye(len(z)) + BUDGET.attitude**2 * U['roll'] + BUDGET.heave**2 * U['heave']
    V += module.LAYERS_STD**2 * U['layers']
    A = np.hstack([J, -G])  # z + J beta = h
    W = np.linalg.inv(V)
    N = A.T @ W @ A
    N[: len(prior), : len(prior)] += np.diag(prior**-2)
    wanted = np.linalg.solve(N, -A.T @ W @ z)[: len(prior)]
    found = adjust(lambda corrections: made, 3, BUDGET, priors)
    assert found.value == pytest.approx(wanted, rel=1e-6, abs=1e-9)
    # The published standard deviation is the larger of this and the consider one.
    assert (found.std >= np.sqrt(np.diag(np.linalg.inv(N))[: len(prior)]) * (1 - 1e-6)).all()


def test_the_consider_covariance_is_that_of_the_plain_estimate(plain):
    made, priors = small(), Priors()
    J, z, v, U, G, prior = dense(made, priors)
    A = np.hstack([J, -G])
    P = np.zeros(A.shape[1])
    P[: len(prior)] = prior**-2
    N = A.T @ A / v + np.diag(P)
    V = v * np.eye(len(z)) + BUDGET.attitude**2 * U['roll'] + BUDGET.heave**2 * U['heave']
    inverse = np.linalg.inv(N)
    C = (inverse @ (A.T @ V @ A / v**2 + np.diag(P)) @ inverse)[: len(prior), : len(prior)]
    found = adjust(lambda corrections: made, 3, BUDGET, priors, states=False)
    assert found.value == pytest.approx(
        (inverse @ (-A.T @ z / v))[: len(prior)], rel=1e-6, abs=1e-9
    )
    assert found.covariance == pytest.approx(C, rel=1e-6, abs=1e-12)


def test_layers_at_a_depth_are_not_taken_for_the_speed_of_all():
    """Where the mean speed grows with the depth, that at the median depth is found."""
    made = small(lines=4, cells=400)
    depth = np.where(np.arange(400) % 10 < 6, 10.0, 18.0)
    for looks in made:
        side = looks.basis[:, 0]
        looks.z[:] -= 2.0 * looks.basis[:, 1]
        looks.basis[:, 1] = (side**2 / depth - depth) / 1500.0
        looks.basis[:, 8] = 0.5 * side**2 / depth
        looks.z[:] += looks.basis[:, 1] * (2.0 + 10.0 * (depth / 10.0 - 1.0))
    plain = adjust(corrected(made), 4, BUDGET, states=False)
    found = adjust(corrected(made), 4, BUDGET)
    speeds = found.kind == 4
    assert np.abs(plain.value[speeds].mean() + 2.0) > 0.6
    assert np.abs(found.value[speeds].mean() + 2.0) < 0.3


def test_the_level_is_that_of_the_priors():
    made = small()
    found = adjust(corrected(made), 3, BUDGET)
    offsets = found.kind == 3
    mean = offsets / offsets.sum()
    assert np.sqrt(mean @ found.covariance @ mean) == pytest.approx(0.5 / np.sqrt(3), rel=0.02)
    ((lines, std),) = found.levels()
    assert lines.tolist() == [0, 1, 2] and std == pytest.approx(0.5 / np.sqrt(3), rel=0.02)
    assert found.value[offsets].sum() == pytest.approx(0.0, abs=1e-3)
    # Lines 0.2 m apart come together, whatever their level.
    assert np.diff(found.value[offsets]) == pytest.approx(-0.2, abs=0.06)
    given = described(found, ['a', 'b', 'c'])
    level = given['not_told'][0]
    assert level['share'] > 0.99
    assert {row['line'] for row in given['parameters']} == {'', 'a', 'b', 'c'}
    pitch = next(row for row in given['parameters'] if row['name'] == 'pitch_deg')
    assert pitch['told'] == pytest.approx(0.0, abs=1e-6)  # the floor is level: nothing tells it


def test_a_line_whose_tide_is_known_holds_the_level():
    made = small()
    found = adjust(corrected(made), 3, BUDGET, fixed=[1])
    offsets = found.value[found.kind == 3]
    assert offsets[1] == pytest.approx(0.0, abs=2e-3)
    assert offsets == pytest.approx([0.2, 0.0, -0.2], abs=0.06)
    assert found.std[found.kind == 3].max() < 0.1
    assert found.levels()[0][1] == pytest.approx(module.FIXED, rel=0.1)


def test_rounds_hold_the_totals(monkeypatch):
    """Statistics at corrected places: three rounds end where one does, not at three times it."""
    made = small()
    monkeypatch.setattr(module, 'CLOSE', 1e-6)
    thrice = adjust(corrected(made), 3, BUDGET)
    monkeypatch.setattr(module, 'ROUNDS', 1)
    once = adjust(corrected(made), 3, BUDGET)
    assert thrice.value == pytest.approx(once.value, abs=2e-3)
    assert thrice.rms[-1] < 0.3 * thrice.rms[0] and len(thrice.rms) == 4


def test_lines_that_do_not_overlap():
    near, far = small(lines=2), small(lines=2)
    moved = [evolve(looks, ix=looks.ix + 10**6, line=looks.line + 2) for looks in far]
    apart = adjust(lambda corrections: near + moved, 4, BUDGET)
    levels = [(lines.tolist(), round(std / 0.5, 2)) for lines, std in apart.levels()]
    assert levels == [([0, 1], 0.71), ([2, 3], 0.71)]
    with pytest.raises(ValueError, match='no two lines'):
        adjust(lambda corrections: [near[0], near[0].chosen(np.zeros(0, np.int64))], 2, BUDGET)


def test_misties_are_differences_of_lines():
    pairs, cells = misties(small())
    assert set(pairs) == {(0, 1), (0, 2), (1, 2)} and cells == 60
    assert pairs[0, 2].median == pytest.approx(-0.4, abs=0.2) and pairs[0, 2].cells == 60
    assert robust_rms(np.array([-1.0, 1.0, 1.0])) == pytest.approx(1.4826)


@pytest.fixture(scope='module')
def of_the_vectors():
    lines = vectors.lines(vectors.scene())
    return [looks_of(line, 2.0).numbered(k) for k, line in enumerate(lines)]


def test_strips_of_the_floor_are_the_floor(of_the_vectors, monkeypatch):
    """What a survey needs at once does not grow with it, and no bit on where strips end."""
    whole, pairs = Crossing.of(of_the_vectors), misties(of_the_vectors)
    monkeypatch.setattr(looks_module, 'LOOKS_AT_ONCE', 6000)
    most = [len(looks) for looks, _ in strips(of_the_vectors)]
    assert len(most) == 4 and max(most) < 10_000
    parts = Crossing.of(of_the_vectors)
    assert parts.cells == whole.cells and misties(of_the_vectors) == pairs
    for name in ('z', 'variance', 'g', 'partials', 'depth'):
        here, there = (
            getattr(each, name)[np.lexsort((each.z, each.time, each.line))]
            for each in (parts, whole)
        )
        assert np.array_equal(here, there), name


def test_a_part_of_the_cells_tells_the_same(of_the_vectors, monkeypatch):
    """Equations of more looks than are wanted are those of every fourth cell."""
    whole = Crossing.of(of_the_vectors)
    monkeypatch.setattr(module, 'MOST_LOOKS', len(whole.z) // 3)
    part = Crossing.of(of_the_vectors)
    assert len(part.z) < 0.3 * len(whole.z) and part.cells == -(-whole.cells // 4)
    assert np.array_equal(np.unique(part.cell), np.arange(part.cells))
    assert part.rms() == pytest.approx(whole.rms(), rel=0.05)


@pytest.mark.parametrize('states', [True, False])
def test_the_vectors(states):
    data = vectors.scene()
    lines = vectors.lines(data)

    def statistics(corrections):
        return [
            looks_of(line.corrected(c), 2.0).numbered(k)
            for k, (line, c) in enumerate(zip(lines, corrections))
        ]

    found = adjust(statistics, 7, BUDGET, states=states)
    truth, prototype = data['corrections'], data['estimate']
    roll = np.degrees(found.corrections[:, 0])
    assert roll == pytest.approx(np.degrees(truth[:, 0]), abs=0.05)
    off = np.degrees(found.corrections[:, 0] - prototype[:, 0])
    assert np.sqrt(np.mean(off**2)) < 0.02
    offset = found.corrections[:, 3] - found.corrections[:, 3].mean()
    for other in (truth, prototype):
        assert np.sqrt(np.mean((offset - other[:, 3] + other[:, 3].mean()) ** 2)) < 0.025
    speed = found.corrections[:, 4] - 4.0
    assert np.sqrt(np.mean(speed**2)) < (0.5 if states else 1.0)
    assert abs(np.degrees(found.corrections[0, 1])) < 0.35
    assert abs(np.degrees(found.corrections[0, 2])) < 0.11
    # The level is not told: the true one lies inside two stated standard deviations.
    offsets = found.kind == 3
    mean = offsets / 7.0
    level = np.sqrt(mean @ found.covariance @ mean)
    assert level == pytest.approx(0.5 / np.sqrt(7.0), rel=0.02)
    assert found.rms[-1] < 0.2 * found.rms[0]
    normalized = np.concatenate([(speed / found.std[found.kind == 4])])
    assert np.sqrt(np.mean(normalized**2)) < 1.5
