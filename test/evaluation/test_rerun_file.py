# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is drawn in a Rerun file, as far as it needs no Rerun."""

from importlib import import_module
from pathlib import Path
import sys
from types import ModuleType, SimpleNamespace

from attrs import evolve
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_imm.estimates import Estimate

NAME = 'sonar_imm_tools.evaluation.rerun_file'


@pytest.fixture
def drawn(monkeypatch):
    """The module, in which Rerun is only called to write."""
    try:
        import rerun  # noqa: F401
    except ImportError:
        empty = ModuleType('rerun')
        empty.blueprint = None
        monkeypatch.setitem(sys.modules, 'rerun', empty)
    yield import_module(NAME)
    if getattr(sys.modules.get('rerun'), 'blueprint', 0) is None:
        del sys.modules[NAME]


def estimate(state_names, covariance, **extras):
    n, d = covariance.shape[:2]
    return Estimate(
        stamp_ns=1, frame_id='map', xyz=np.zeros((n, 3), np.float32), state_names=state_names,
        state=np.zeros((n, d)), covariance=covariance, model_names=(),
        probabilities=np.empty((n, 0)), extras=extras,
    )  # fmt: skip


def test_ellipsoids_are_those_of_the_covariances_of_places(drawn):
    rng = np.random.default_rng(1)
    A = rng.normal(size=(4, 3, 3))
    full = A @ A.swapaxes(1, 2)
    flat = drawn._place_covariances(estimate(('px', 'py'), full[:, :2, :2]))
    assert (flat[:, :2, :2] == full[:, :2, :2]).all() and not flat[:, 2].any()
    upper = {f'place_cov_{a}_{b}': full[:, 'xyz'.index(a), 'xyz'.index(b)] for a, b in (
        ('x', 'x'), ('x', 'y'), ('x', 'z'), ('y', 'y'), ('y', 'z'), ('z', 'z')
    )}  # fmt: skip
    places = drawn._place_covariances(estimate(('range',), full[:, :1, :1], **upper))
    assert places == pytest.approx(full)
    assert drawn._place_covariances(estimate(('range',), full[:, :1, :1])) is None
    half, turns = drawn._ellipsoids(full)
    R = Rotation.from_quat(turns).as_matrix()
    assert np.einsum('nij,nj,nkj->nik', R, (half / 2.0) ** 2, R) == pytest.approx(full)
    assert drawn._ellipsoids(np.zeros((1, 3, 3)))[0] == pytest.approx(0.005)


class Stream:
    """A recording that keeps what is logged: (path, time, what)."""

    def __init__(self, name):
        self.name, self.logged = name, []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def save(self, file, default_blueprint):
        self.file, self.picture = file, default_blueprint

    def set_time(self, timeline, timestamp):
        self.now = timestamp.astype(int)

    def log(self, path, what):
        self.logged.append((path, self.now, what))


def noted(*arguments, **values):
    """In place of what Rerun draws."""
    return SimpleNamespace(arguments=arguments, **values)


@pytest.fixture
def written(drawn, monkeypatch):
    """The module, and what it writes of a run of `estimates` with `truth`."""
    stream = Stream('none yet')

    def write(estimates, truth):
        folder = SimpleNamespace(
            read_run=lambda: {'system': 'diver'}, read_estimates=lambda: estimates
        )
        monkeypatch.setattr(drawn, 'RunFolder', lambda run: folder)
        monkeypatch.setattr(drawn, 'read_truth', lambda facts: truth)
        count = drawn.write_rerun(Path('run'), Path('.') / 'run.rrd')
        return count, stream

    views = 'Spatial3DView', 'TimeSeriesView', 'Blueprint', 'Horizontal', 'Vertical'
    kinds = 'Points3D', 'Ellipsoids3D', 'Scalars'
    monkeypatch.setattr(drawn, 'blueprint', SimpleNamespace(**dict.fromkeys(views, noted)))
    monkeypatch.setattr(
        drawn,
        'rerun',
        SimpleNamespace(RecordingStream=lambda name: stream, **dict.fromkeys(kinds, noted)),
    )
    return write


def scan(stamp_ns, ids, states):
    n = len(ids)
    return evolve(
        estimate(
            ('px', 'py'), np.tile(np.diag([4.0, 9.0]), (n, 1, 1)),
            track_id=np.array(ids, np.uint32), track_state=np.array(states, np.uint8),
        ),
        stamp_ns=stamp_ns,
        state=np.tile([10.0, np.nan], (n, 1)),
        model_names=('still', 'east'),
        probabilities=np.tile([0.25, 0.75], (n, 1)),
    )  # fmt: skip


def test_tracks_that_were_ever_confirmed_have_curves_of_what_is_known(written):
    """Track 7 is confirmed at its second scan, 8 for longer, and 9 never."""
    run = [scan(5, [7, 8, 9], [0, 1, 0]), scan(6, [7, 8], [1, 2]), scan(7, [8, 9], [1, 0])]
    count, stream = written(run, [estimate((), np.empty((2, 0, 0)))])
    assert count == 3
    curves = [entry for entry in stream.logged if '/track_' in entry[0]]
    assert {(path.split('/')[1], stamp) for path, stamp, _ in curves} == {
        ('track_7', 5), ('track_7', 6), ('track_8', 5), ('track_8', 6), ('track_8', 7)
    }  # fmt: skip
    first = {path: what.arguments for path, stamp, what in curves if stamp == 5}
    assert {path: value for path, (value,) in first.items() if 'track_7' in path} == {
        'diver/track_7/state/px': 10.0, 'diver/track_7/std/px': 2.0, 'diver/track_7/std/py': 3.0,
        'diver/track_7/probability/still': 0.25, 'diver/track_7/probability/east': 0.75,
    }  # fmt: skip
    places = [(stamp, len(what.arguments[0])) for path, stamp, what in stream.logged
              if path == 'diver/points']  # fmt: skip
    assert places == [(5, 3), (6, 2), (7, 2)]
    truth = [(stamp, what.colors) for path, stamp, what in stream.logged if path == 'truth']
    assert truth == [(1, (255, 255, 255))]  # white


def test_the_first_picture_has_the_curves_of_the_track_that_lasted_longest(written):
    run = [scan(5, [7, 8, 9], [0, 1, 0]), scan(6, [7, 8, 9], [1, 2, 0]), scan(7, [8, 9], [1, 0])]
    _, stream = written([*run, scan(8, [9], [0])], None)
    (split,) = stream.picture.arguments
    scene, curves = split.arguments
    assert scene.origin == '/'
    assert [view.origin.rpartition('/')[0] for view in curves.arguments] == ['/diver/track_8'] * 3
    _, alone = written([scan(5, [9], [0])], None)
    assert [view.origin for view in alone.picture.arguments] == ['/']
