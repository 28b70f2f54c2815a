# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Which seed is typical, and what limit follows from the runs of a scene."""

from argparse import Namespace

import numpy as np
import pytest

from benchmarks.typical_seed import readme, scored, typical
from sonar_imm_tools.evaluation.judging import Limit


def runs_of(values):
    return {seed: {'rmse': value} for seed, value in enumerate(values, start=1)}


def test_the_seed_is_that_of_the_median_and_nine_in_ten_are_within_the_limit():
    error = np.random.default_rng(0).permutation(np.arange(1.0, 32.0))
    found = typical(runs_of(error), ['rmse'])
    assert error[found.seed - 1] == 16.0 and found.spread['rmse']['of the seed'] == 16.0
    assert found.limit == 28.0 and (error <= found.limit).sum() == 28


def test_a_run_without_the_error_is_worse_than_any_and_most_must_have_it():
    runs = runs_of([1.0, 2.0, 3.0]) | {9: {}}
    assert typical(runs, ['rmse']).seed == 2
    with pytest.raises(ValueError, match='most runs have no nees; there are: rmse'):
        typical(runs, ['nees'])


def test_the_text_names_the_command_the_seeds_and_the_limit():
    given = Namespace(
        system='diver', scene='table1', runs=5, seed=1, set=['speed=2'],
        metric=['position.rmse_m'], compress=[], keep=None, write='somewhere/diver_table1',
    )  # fmt: skip
    runs = {k: {'position.rmse_m': v} for k, v in enumerate([5.0, 1.0, 3.0, 2.0, 4.0], start=1)}
    found = typical(runs, given.metric)
    text = readme(given, found, Limit(1.0, 'm', 'position RMSE', 'position.rmse_m'), 0)
    assert 'simulate diver bags/diver_table1 --scenario table1 --seed 3 --set speed=2' in text
    assert 'Number 3 of seeds 1 to 5' in text and 'allows 4.6 m' in text
    assert 'somewhere' not in text
    kept = typical(runs, given.metric, 5)
    assert (kept.seed, kept.rank, kept.limit) == (5, 4, found.limit)


def test_a_seed_is_simulated_tracked_and_scored_with_what_its_scene_has(capsys):
    scene = ('--scenario', 'approach', '--seed', '7')
    short = ('--set', 'first_range=30', '--set', 'last_range=20')
    found = scored('obstacle', [*scene, *short])
    assert found['gospa.mean_m'] > 0.0 and found['tracks.true_obstacles'] == 1.0
    assert scored('obstacle', [*scene, '--set', 'nothing=1']) == {}
    assert 'nothing' in capsys.readouterr().err
