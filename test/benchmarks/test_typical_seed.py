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

from benchmarks.study import Outcome
from benchmarks.typical_seed import readme, typical
from sonar_imm_tools.evaluation.judging import Limit


def outcomes(**metrics):
    columns = [np.asarray(values, float) for values in metrics.values()]
    return [
        Outcome(seed, dict(zip(metrics, row))) for seed, row in enumerate(zip(*columns), start=1)
    ]


def test_the_seed_is_that_of_the_median_and_nine_in_ten_are_within_the_limit():
    error = np.random.default_rng(0).permutation(np.arange(1.0, 32.0))
    found = typical(outcomes(rmse=error), ['rmse'])
    assert error[found.seed - 1] == 16.0 and found.spread['rmse']['of the seed'] == 16.0
    assert found.limit == 28.0 and (error <= found.limit).sum() == 28


def test_a_run_without_the_error_is_worse_than_any_and_most_must_have_it():
    runs = outcomes(rmse=[1.0, 2.0, 3.0]) + [Outcome(9, failure='no track')]
    assert typical(runs, ['rmse']).seed == 2
    with pytest.raises(ValueError, match='most runs have no nees; there are: rmse'):
        typical(runs, ['nees'])


def test_the_text_names_the_command_the_seeds_and_the_limit():
    given = Namespace(
        system='diver', scene='table1', runs=5, seed=1, set=['speed=2'],
        metric=['position.rmse_m'], compress=[], keep=None, write='somewhere/diver_table1',
    )  # fmt: skip
    found = typical(outcomes(**{'position.rmse_m': [5.0, 1.0, 3.0, 2.0, 4.0]}), given.metric)
    text = readme(given, found, Limit(1.0, 'm', 'position RMSE', 'position.rmse_m'), 0)
    assert 'simulate diver bags/diver_table1 --scenario table1 --seed 3 --set speed=2' in text
    assert (
        'Number 3 of seeds 1 to 5' in text and 'allows 4.6 m' in text and 'somewhere' not in text
    )
    kept = typical(outcomes(**{'position.rmse_m': [5.0, 1.0, 3.0, 2.0, 4.0]}), given.metric, 5)
    assert (kept.seed, kept.rank, kept.limit) == (5, 4, found.limit)
