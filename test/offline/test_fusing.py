# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Covariance intersection, and the tracks of two nodes as those of one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from attrs import evolve
from helpers.dive_bags import write_dive
from helpers.dive_scenes import estimate_at, SECOND, START_NS
from helpers.estimates import same
import numpy as np
import pytest

from sonar_imm.estimates import Estimate
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline import fusing
from sonar_imm_tools.offline.fusing import (
    best_weight,
    covariance_intersection,
    fused,
    Fuser,
    LiveFusion,
    MANY_LATE,
)
from sonar_imm_tools.recordings.reader import BagError


def spd(rng: np.random.Generator, n: int) -> np.ndarray:
    """A covariance (n, n) with axes of very different length."""
    q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    return np.asarray(q @ np.diag(10.0 ** rng.uniform(-2, 2, n)) @ q.T)


@pytest.mark.parametrize('seed', [0, 1, 3, 11, 12])
def test_the_best_weight_is_that_of_a_grid(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    A, B = spd(rng, n), spd(rng, n)
    a, b = rng.normal(size=(2, n))
    found = covariance_intersection(a, A, b, B)
    grid = np.linspace(0.0, 1.0, 2001)
    size = [np.linalg.slogdet(covariance_intersection(a, A, b, B, w).P)[1] for w in grid]
    assert abs(found.weight - grid[int(np.argmin(size))]) <= 1.0 / 2000
    assert np.linalg.slogdet(found.P)[1] <= min(size) + 1e-9


def test_weights_at_the_ends_and_in_the_middle() -> None:
    same, wide = np.eye(2), 4.0 * np.eye(2)
    zero, unit = np.zeros(2), np.ones(2)
    assert covariance_intersection(zero, same, unit, wide).weight == 1.0
    assert covariance_intersection(zero, wide, unit, same).weight == 0.0
    twice = covariance_intersection(zero, same, unit, same)
    assert twice.weight == 0.5
    # Twice the same is not twice as sure.
    assert twice.P == pytest.approx(same) and twice.x == pytest.approx([0.5, 0.5])
    assert best_weight(np.array([4.0, 0.25])) == pytest.approx(0.5)
    with pytest.raises(np.linalg.LinAlgError):
        covariance_intersection(zero, same, unit, -same)


@pytest.mark.parametrize('correlation', [-1.0, -0.9, -0.5, 0.0, 0.5, 0.9, 1.0])
def test_the_fused_covariance_is_consistent_whatever_the_correlation(correlation: float) -> None:
    """The true covariance of the fused error never exceeds the stated one, for any joint
    covariance [[A, C], [C', B]] with C = A^1/2 U B^1/2 times the correlation, U a rotation; and
    the mean NEES is at most its due."""
    rng = np.random.default_rng(11)
    largest, nees = 0.0, []
    for _ in range(200):
        A, B = spd(rng, 4), spd(rng, 4)
        U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
        root_a, root_b = np.linalg.cholesky(A), np.linalg.cholesky(B)
        C = correlation * root_a @ U @ root_b.T
        zero = np.zeros(4)
        P, w = covariance_intersection(zero, A, zero, B)[1:]
        K, L = w * P @ np.linalg.inv(A), (1.0 - w) * P @ np.linalg.inv(B)
        true = K @ A @ K.T + L @ B @ L.T + K @ C @ L.T + L @ C.T @ K.T
        ratio = np.linalg.eigvals(np.linalg.solve(P, true)).real
        largest = max(largest, float(ratio.max()))
        nees.append(float(ratio.sum()))
    assert largest <= 1.0 + 1e-6
    assert np.mean(nees) <= 4.0
    # What takes the errors for independent is not, as soon as they are correlated.
    if correlation == 1.0:
        P = np.linalg.inv(np.linalg.inv(A) + np.linalg.inv(A))
        assert np.linalg.eigvals(np.linalg.solve(P, A)).real.max() == pytest.approx(2.0)


# -- tracks ---------------------------------------------------------------------------------------


def node(
    places: dict[int, tuple[float, float]], second: float, *, seed: int, **settings: Any
) -> Estimate:
    """What a node says of divers at `places` (by its own ids), .2 m wrong on each axis."""
    rng = np.random.default_rng([seed, round(second * 10)])
    states = [
        [*(np.array(place) + 0.2 * rng.normal(size=2)), 0.0, 0.0] for place in places.values()
    ]
    stated = np.diag([0.04, 0.04, 0.01, 0.01])
    stamp = START_NS + round(second * SECOND)
    return estimate_at(stamp, states, list(places), stated=stated, **settings)


def both(
    first: list[Estimate], second: list[Estimate], max_age: float = 5.0
) -> tuple[list[Estimate], Fuser]:
    fuser = Fuser(0.6)
    return list(fused(first, second, fuser, max_age)), fuser


def ids(estimate: Estimate) -> list[int]:
    return [int(number) for number in estimate.extras['track_id']]


def test_a_diver_whom_both_see_is_one_track() -> None:
    first = [node({7: (0.0, 0.0)}, k, seed=1) for k in range(20)]
    second = [node({3: (0.0, 0.0)}, k + 0.4, seed=2) for k in range(20)]
    made, fuser = both(first, second)
    assert [each.stamp_ns for each in made] == sorted(each.stamp_ns for each in first + second)
    assert {number for each in made for number in ids(each)} == {1}
    assert fuser.pairs == {(7, 3)}
    assert all(0.0 <= each.extras['first_weight'][0] <= 1.0 for each in made)


def test_divers_side_by_side_keep_their_partners() -> None:
    first = [node({1: (0.0, 0.0), 2: (0.0, 1.5)}, k, seed=3) for k in range(30)]
    second = [node({9: (0.0, 1.5), 8: (0.0, 0.0)}, k, seed=4) for k in range(30)]
    made, fuser = both(first, second)
    assert fuser.pairs == {(1, 8), (2, 9)}
    for each in made[1:]:
        upper = int(np.argmax(each.state[:, 1]))
        assert (
            len(each) == 2
            and ids(each)[upper] == ids(made[0])[int(np.argmax(made[0].state[:, 1]))]
        )


def test_a_diver_keeps_his_identity_when_he_leaves_one_view() -> None:
    first = [node({1: (0.0, 0.0)}, k, seed=5) for k in range(10)]
    second = [node({4: (0.0, 0.0)}, k, seed=6) for k in range(5, 30)]
    made, _ = both(first, second)
    assert {number for each in made for number in ids(each)} == {1}
    # And is called the same by a node that lost him and found him again.
    first += [node({2: (0.0, 0.0)}, k, seed=5) for k in range(20, 30)]
    made, _ = both(first, second)
    assert {number for each in made for number in ids(each)} == {1}


def test_tracks_of_years_are_forgotten_but_not_those_that_are_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fusing, 'REMEMBERED', 20)
    fuser = Fuser(0.6)
    for k in range(60):
        places = {1: (0.0, 0.0), 1000 + k: (500.0, 0.0), 2000 + k: (0.0, 900.0)}
        one, other = node(places, k, seed=9), node(places, k, seed=10)
        made = fuser.fuse(one, other, one.stamp_ns)
        assert ids(made)[0] == 1 and max(ids(made)) >= 2 * k + 3
    kept = [fuser._distance, fuser._partner, *fuser._ids, fuser.pairs]
    assert [len(each) for each in kept] == [20] * 5 and (1, 1) in fuser.pairs


def test_what_only_one_sees_stays_as_it_is() -> None:
    first = [node({1: (0.0, 0.0)}, k, seed=7) for k in range(5)]
    second = [node({1: (50.0, 0.0)}, k, seed=8) for k in range(5)]
    made, fuser = both(first, second)
    assert not fuser.pairs and all(len(each) == 2 for each in made)
    assert made[0].state[0] == pytest.approx(first[0].state[0])
    assert made[0].covariance[0] == pytest.approx(first[0].covariance[0])
    assert made[0].extras['first_weight'].tolist() == [1.0, 0.0]


def test_tentative_tracks_and_old_estimates_are_left_out() -> None:
    first = [node({1: (0.0, 0.0)}, 0, seed=9)]
    second = [node({1: (0.0, 0.0)}, k, seed=9, tentative=k < 3) for k in range(10)]
    made, _ = both(first, second, max_age=4.5)
    assert [len(each) for each in made] == [1] * 10
    assert [each.extras['first_weight'][0] for each in made[5:]] == [0.0] * 5
    # What is carried on becomes less certain.
    sizes = [np.linalg.det(each.covariance[0, :2, :2]) for each in made[:3]]
    assert sizes[0] < sizes[1] < sizes[2]


def test_names_settle_who_is_who() -> None:
    def named(estimate: Estimate, *names: int) -> Estimate:
        extras = {**estimate.extras, 'target_id': np.array(names, np.int32)}
        return Estimate(
            stamp_ns=estimate.stamp_ns,
            frame_id='map',
            xyz=estimate.xyz,
            state_names=estimate.state_names,
            state=estimate.state,
            covariance=estimate.covariance,
            extras=extras,
        )

    first = [named(node({1: (0.0, 0.0)}, k, seed=1), 5) for k in range(5)]
    other = [named(node({1: (0.0, 0.0)}, k, seed=2), 6) for k in range(5)]
    same = [named(node({1: (3.0, 0.0)}, k, seed=2), 5) for k in range(5)]
    nobody = [named(node({1: (0.0, 0.0)}, k, seed=2), -1) for k in range(5)]
    assert all(len(each) == 2 for each in both(first, other)[0])
    assert all(len(each) == 1 for each in both(first, same)[0])
    made = both(nobody, first)[0]
    assert all(each.extras['target_id'].tolist() == [5] for each in made)


# -- live -----------------------------------------------------------------------------------------


def seconds(estimate: Estimate) -> float:
    return (estimate.stamp_ns - START_NS) / SECOND


def test_what_comes_within_the_wait_is_fused_live_as_afterwards() -> None:
    """Each node in the order of its stamps, one of them late by up to the wait."""
    first = [node({1: (0.0, 0.0), 2: (9.0, 0.0)}, k, seed=1) for k in range(20)]
    second = [node({4: (9.0, 0.0)}, k + 0.4, seed=2) for k in range(20)]
    rng = np.random.default_rng(3)
    heard = [(seconds(each), 0, each) for each in first]
    came = np.maximum.accumulate([seconds(each) + rng.uniform(0.0, 1.9) for each in second])
    heard += [(float(now), 1, each) for now, each in zip(came, second)]
    live, made = LiveFusion(0.6, 5.0, wait=2.0), []
    for now, side, each in sorted(heard, key=lambda item: item[0]):
        live.take(side, each, now)
        made += live.ready(now)
    made += live.ready(30.0)
    afterwards, fuser = both(first, second)
    assert live.late == 0 and live.pairs == fuser.pairs == {(2, 4)}
    assert len(made) == len(afterwards) and all(map(same, made, afterwards))


def test_a_node_that_stays_silent_is_not_waited_for_long() -> None:
    live = LiveFusion(0.6, 5.0, wait=1.0)
    live.take(0, node({1: (0.0, 0.0)}, 3.0, seed=1), 10.0)
    assert not list(live.ready(10.9)) and len(list(live.ready(11.0))) == 1
    live.take(1, node({1: (0.0, 0.0)}, 2.5, seed=1), 11.1)
    assert live.late == 1 and not list(live.ready(20.0))


def test_clocks_that_were_set_back_begin_anew() -> None:
    live = LiveFusion(0.6, 5.0, wait=0.0)
    live.take(0, node({1: (0.0, 0.0)}, 100.0, seed=1), 0.0)
    assert len(list(live.ready(0.0))) == 1
    for k in range(MANY_LATE + 1):
        live.take(0, node({1: (0.0, 0.0)}, k, seed=1), 1.0)
    assert [seconds(each) for each in live.ready(1.0)] == [MANY_LATE - 1.0, MANY_LATE]


def test_nodes_in_two_frames_are_not_fused() -> None:
    live = LiveFusion(0.6, 5.0, wait=0.0)
    live.take(0, node({1: (0.0, 0.0)}, 0.0, seed=1), 0.0)
    list(live.ready(0.0))
    with pytest.raises(BagError, match='different frames'):
        live.take(1, evolve(node({1: (0.0, 0.0)}, 1.0, seed=1), frame_id='odom'), 0.0)


# -- the command ----------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('fuse')
    for name, seed in (('a', 4), ('b', 5)):
        bag = write_dive(folder / f'{name}.bag', seed=seed, count=60)
        assert main(['track', str(bag), str(folder / name), '--set', 'model_set=linear']) == 0
    return folder


def test_two_runs_are_one_that_can_be_scored(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = runs / 'both'
    assert main(['fuse', str(runs / 'a'), str(runs / 'b'), str(out), '--json']) == 0
    content = json.loads(capsys.readouterr().out)
    assert content['pairs'] == [[1, 1]] and content['fused_rows'] > 50
    scores = {}
    for name in ('a', 'b', 'both'):
        assert main(['evaluate', str(runs / name), '--no-report']) in (0, 1)
        scores[name] = json.loads((runs / name / 'metrics.json').read_text())
    rmse = {name: each['position']['rmse_m'] for name, each in scores.items()}
    assert rmse['both'] < max(rmse['a'], rmse['b'])
    assert scores['both']['tracks']['identity_switches'] == 0


def test_the_same_command_writes_the_same_bytes(runs: Path) -> None:
    for name in ('one', 'two'):
        assert main(['fuse', str(runs / 'a'), str(runs / 'b'), str(runs / name)]) == 0
    item, two = ((runs / name / 'estimate.csv').read_bytes() for name in ('one', 'two'))
    assert item == two


def test_what_does_not_fit_is_said(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = str(runs / 'a'), str(runs / 'b')
    assert main(['fuse', a, a, str(runs / 'x')]) == 2
    assert 'the same folder' in capsys.readouterr().err
    assert main(['fuse', a, b]) == 2 and main(['fuse', a, b, a, '--live']) == 2
    assert 'OUT is for two runs' in capsys.readouterr().err
    assert main(['fuse', a, b, a, '--overwrite']) == 2
    assert 'OUT is one of the runs' in capsys.readouterr().err
    assert main(['fuse', a, str(runs / 'nothing'), str(runs / 'x')]) == 2
    assert 'holds no finished run' in capsys.readouterr().err
    record = json.loads((runs / 'b' / 'run.json').read_text())
    other = runs / 'other'
    other.mkdir()
    (other / 'run.json').write_text(json.dumps({**record, 'system': 'obstacle'}))
    assert main(['fuse', a, str(other), str(runs / 'x')]) == 2
    assert 'not of divers' in capsys.readouterr().err
    assert not (runs / 'x').exists()


def test_a_run_with_a_place_on_earth_keeps_it(tmp_path: Path) -> None:
    for name, seed in (('a', 1), ('b', 2)):
        bag = tmp_path / f'{name}.bag'
        wanted = ['--scenario', 'geodetic', '--seed', str(seed), '--set', 'duration=15']
        assert main(['simulate', 'diver', str(bag), *wanted]) == 0
        place = ['--set', 'origin_latitude=43.3', '--set', 'origin_longitude=5.35']
        assert (
            main(
                [
                    'track',
                    str(bag),
                    str(tmp_path / name),
                    '--set',
                    'model_set=linear',
                    *place,
                ]
            )
            == 0
        )
    a, b, out = (str(tmp_path / name) for name in ('a', 'b', 'out'))
    assert main(['fuse', a, b, out]) == 0
    header = (tmp_path / 'out' / 'estimate.csv').read_text().splitlines()[0]
    assert header.endswith('first_weight,latitude,longitude')
    record = json.loads((tmp_path / 'b' / 'run.json').read_text())
    record['origin']['latitude'] += 0.1
    (tmp_path / 'b' / 'run.json').write_text(json.dumps(record))
    assert main(['fuse', a, b, str(tmp_path / 'x')]) == 2
