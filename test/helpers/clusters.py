# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A dask cluster inside the process of a test, and work that ends the process that does it."""

import os

import pytest


def small_cluster(**options):
    """A scheduler and one worker as threads, without pages for browsers; a context. Skips the test
    where dask is missing."""
    distributed = pytest.importorskip('distributed')
    return distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None,
        scheduler_kwargs={'dashboard_address': '127.0.0.1:0'}, **options,
    )  # fmt: skip


def dying(folder, k):
    """Ends its process the first time that 2 is done, always with 3, and fails with 4."""
    (folder / f'{k}-{os.getpid()}').touch()
    if k == 3 or (k == 2 and len(list(folder.glob('2-*'))) == 1):
        os._exit(9)
    if k == 4:
        raise ValueError('not this one')
    return k * k
