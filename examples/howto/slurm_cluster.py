# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A dask cluster on Slurm, until Enter is pressed. Prints the address of its scheduler.

Run with dask-jobqueue 0.9 and a stand-in for sbatch, as in test/offline/test_tracking.py: the
scripts of four jobs are handed in, and cancelled at the end. Not run on a Slurm of its own.
"""

from dask_jobqueue import SLURMCluster

cluster = SLURMCluster(
    cores=16,
    processes=16,  # a process per core: a run is a single thread
    memory='32GB',
    walltime='04:00:00',
    job_script_prologue=['. /data/venv/bin/activate', 'export OMP_NUM_THREADS=1'],
)
cluster.scale(jobs=4)
print(cluster.scheduler_address)
input('Enter ends the cluster')
