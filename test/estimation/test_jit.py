"""Compiling: the cache is used when it can be, and is no condition."""

import os
from pathlib import Path
import subprocess
import sys

import numba

from sonar_imm.estimation import imm_kernels, jit

ROOT = Path(__file__).parents[2]


def test_without_any_place_for_a_cache_a_kernel_still_works(monkeypatch):
    """What numba does in a container with a read-only installation and no home."""
    plain = numba.njit

    def refuses_to_cache(*args, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function 'doubled': no locator available for file")
        return plain(*args, **options)

    monkeypatch.setattr(jit.numba, 'njit', refuses_to_cache)

    @jit.kernel
    def doubled(x):
        return 2.0 * x

    assert doubled(2.0) == 4.0


def test_kernels_of_a_read_only_installation_are_cached_elsewhere(tmp_path):
    """`NUMBA_CACHE_DIR` takes what the installation cannot, and a second process loads it."""
    code = (
        'from sonar_imm.estimation.imm_kernels import combine; import numpy as np;'
        'o = np.ones; combine(o((1, 1, 1)), o((1, 1, 1, 1)), o((1, 1)), o((1, 1, 1)));'
        'print(sum(combine.stats.cache_hits.values()))'
    )
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path), 'PYTHONPATH': str(ROOT)}
    hits = [
        subprocess.run(
            [sys.executable, '-c', code],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for _ in range(2)
    ]
    assert hits == ['0', '1']
    assert list(tmp_path.rglob('*.nbi'))


def test_warm_leaves_nothing_to_compile():
    imm_kernels.warm()
    verbs = ('mix', 'predict', 'update', 'gate', 'combine')
    assert all(getattr(imm_kernels, verb).signatures for verb in verbs)
