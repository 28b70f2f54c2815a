# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The estimates of the shipped recordings on another processor: the promise of
docs/architecture.md.

The other processor is played by this one: the oldest OpenBLAS kernels that it can run (the newest,
where the oldest are in effect), and numpy without the loops it has for newer instruction sets,
against what this process runs with.
"""

import csv
import os
import subprocess
import sys

from helpers.kernel_types import in_effect, left_out, runnable
from helpers.source import ROOT
import numpy as np
import pytest

from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli import main

PROMISE = {
    'bathymetry': 1e-10, 'bathymetry_ledge': 1e-6, 'diver': 1e-10, 'obstacle': 1e-7,
    'fathometer': 1e-9, 'fathometer_drift': 2e-5, 'fathometer_pressure': 0.05,
}  # fmt: skip
"""By recording, else by system: largest difference of any number, as a share of the largest
magnitude in its column. Measured between Prescott and SkylakeX, with numpy's AVX2 and AVX-512
loops off and on: bathymetry 2e-12 (a ship that moves; at rest 4e-16), diver 3e-13, obstacle 2e-9,
fathometer 8e-12; between Prescott and Haswell two surfaces in a bin 1e-7. In a drift of traces a
draw falls on the other side of its edge once: one particle of one record goes to another cell,
which moves a depth by 1e-5 m, an amplitude by 7e-6; else it is 7e-9. Spectra of pressure are
computed in single precision, which the inverse of their matrix makes 6e-6: that moves some
particles to other cells, a depth by 1e-5, a probability by .025."""

SPREAD = {'fathometer_pressure': 1.0, 'fathometer_drift': 0.01}
"""The same of covariances and standard deviations, where it is another: by that one particle .003
of the largest covariance of a drift; in the second record of raw pressure few particles have a
reflector that is not there; .57 of the largest covariance of depth with amplitude, .09 of the
largest standard deviation."""

EXACT = {'stamp_ns', 'track_id', 'track_state', 'valid', 'label', 'nis_dof', 'told', 'surfaces'}
"""Columns of counts and names: equal everywhere."""

PROGRAM = """
import sys
from helpers.kernel_types import in_effect
from sonar_imm_tools.cli import main
for number, bag in enumerate(sys.argv[2:]):
    assert main(['track', bag, f'{sys.argv[1]}/{number}']) == 0
print(' '.join(sorted(in_effect())))
"""


def newer_loops():
    """The instruction sets above the baseline that numpy uses here."""
    try:
        from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
    except ImportError:  # numpy 1
        from numpy.core._multiarray_umath import __cpu_dispatch__, __cpu_features__
    return [name for name in __cpu_dispatch__ if __cpu_features__.get(name)]


def track(bags, out, kernel_type, disabled=()):
    """For each recording the columns of its estimates, by name, from one process of that type."""
    environment = {
        **os.environ,
        'OPENBLAS_CORETYPE': kernel_type,
        'NPY_DISABLE_CPU_FEATURES': ' '.join(disabled),
        'PYTHONPATH': os.pathsep.join(filter(None, sys.path)),
    }
    done = subprocess.run(
        [sys.executable, '-c', PROGRAM, str(out), *map(str, bags)], env=environment,
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == kernel_type
    return [columns(out / str(number)) for number in range(len(bags))]


def columns(run):
    """The columns of the estimates of a run, by name."""
    with (run / 'estimate.csv').open(newline='') as file:
        table = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or 'nan') for row in table]) for name in table[0]}


def apart(first, other, least=0.0):
    """Largest difference of two columns as a share of their largest magnitude, or of `least`."""
    known = np.isfinite(first)
    assert np.array_equal(known, np.isfinite(other))
    difference = np.abs(first - other)[known].max(initial=0.0)
    return difference / np.abs(first[known]).max(initial=least) if difference else 0.0


@pytest.mark.statistics  # not by chance, but 30 s of work
@pytest.mark.parametrize('system', SYSTEMS)
def test_another_processor_gives_the_same_estimates_to_the_promised_digits(tmp_path, system):
    here = ' '.join(sorted(in_effect()))
    others = [name for name in runnable() if name != here]
    if not others:
        pytest.skip(f'no two kernel types to compare: {left_out()}')
    there = others[0] if here != runnable()[0] else others[-1]
    wrong, bags = {}, sorted((ROOT / 'bags').glob(f'{system}_*'))
    assert bags
    for bag, old in zip(bags, track(bags, tmp_path, there, newer_loops())):
        # as `info` recommends: test_pipeline.py
        assert main(['track', str(bag), str(tmp_path / bag.name), '--system', system]) == 0
        new = columns(tmp_path / bag.name)
        assert list(old) == list(new) and len(old['stamp_ns']) == len(new['stamp_ns']) > 20
        promise = PROMISE.get(bag.name, PROMISE[system])
        for name in old:
            # What is left of a probability of nothing is rounding alone.
            difference = apart(old[name], new[name], 1.0 if name.startswith('prob_') else 0.0)
            spread = name.startswith('cov_') or name.endswith('_std')
            most = SPREAD.get(bag.name, promise) if spread else promise
            if difference > (0.0 if name in EXACT else most):
                wrong[bag.name, name] = difference
    assert not wrong, f'{there} and {here} differ by more than is promised: {wrong}'


def test_a_difference_is_measured_against_its_column():
    column = np.array([np.nan, 100.0, -400.0, 1e-9])
    assert apart(column, column.copy()) == 0.0
    assert apart(column, column + [0.0, 0.0, 0.4, 2e-9]) == pytest.approx(1e-3)
    assert apart(column, column + [0.0, 0.0, 0.0, 2e-9]) == pytest.approx(5e-12)
