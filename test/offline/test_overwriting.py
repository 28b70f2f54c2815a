# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Overwriting replaces only folders that this package made, as a whole, not through links."""

import json
import os
from pathlib import Path
import shutil
import signal

from helpers.dive_scenes import single_run
import pytest

from sonar_imm import files
from sonar_imm.files import MARKER, mount_points, remove_leftovers, UNFINISHED
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.sources import BagError

FIRST, SECOND = single_run(count=3)[0], single_run(count=5)[0]
RECORD = {'system': 'diver', 'bag': '', 'topics': {}, 'parameters': {}}
STEPS = ('rename', 'replace', 'fsync', 'mkdir', 'unlink', 'rmdir', 'open')


def make(path, estimates, *, overwrite=False, inputs=()):
    """A run of `estimates` at `path`."""
    with RunFolder(path).fresh(overwrite=overwrite, inputs=inputs) as folder:
        folder.write_estimates(estimates, 'diver')
        folder.write_json('run.json', {**RECORD, 'estimates': len(estimates)})


def contents(folder):
    """Texts of links and bytes of files by path."""
    return {
        path.relative_to(folder).as_posix(): os.readlink(path)
        if path.is_symlink()
        else path.read_bytes()
        for path in sorted(folder.rglob('*'))
        if path.is_symlink() or path.is_file()
    }


@pytest.fixture(scope='module')
def whole_runs(tmp_path_factory):
    """The contents of the old and of the new run."""
    folder = tmp_path_factory.mktemp('whole')
    for name, estimates in (('old', FIRST), ('new', SECOND)):
        make(folder / name / 'out', estimates)
    return contents(folder / 'old' / 'out'), contents(folder / 'new' / 'out')


@pytest.fixture
def out(tmp_path):
    """A folder with a run, a note of the user and a link of the user."""
    out = tmp_path / 'out'
    make(out, FIRST)
    (out / 'notes').mkdir()
    (out / 'notes' / 'mine.txt').write_text('mine')
    (out / 'elsewhere').symlink_to(tmp_path)
    return out


def is_whole(out, run):
    """Whether `out` holds a run and all that is the user's, and nothing else but markers of
    unfinished folders that could not be removed."""
    found = {k: v for k, v in contents(out).items() if not (UNFINISHED in k and MARKER in k)}
    return found == {**run, 'notes/mine.txt': b'mine', 'elsewhere': str(out.parent)}


def test_what_is_the_users_comes_along(out, whole_runs):
    make(out, SECOND, overwrite=True)
    assert is_whole(out, whole_runs[1])
    assert os.listdir(out.parent) == ['out']


def test_a_run_whose_estimate_is_a_link_is_replaced_and_its_target_stays(out, tmp_path):
    shutil.move(out / 'estimate', tmp_path / 'disk2')
    (out / 'estimate').symlink_to(tmp_path / 'disk2')
    kept = contents(tmp_path / 'disk2')
    make(out, SECOND, overwrite=True)
    assert len(RunFolder(out).read_estimates()) == 5 and not (out / 'estimate').is_symlink()
    assert contents(tmp_path / 'disk2') == kept


def failing(monkeypatch, number, act):
    """Have the `number`-th call that changes something on the disk end in `act()`."""
    left = [number]

    def wrapped(call, name):
        def changed(*arguments, **options):
            changes = name != 'open' or (
                len(arguments) > 1 and arguments[1] & (os.O_WRONLY | os.O_RDWR)
            )
            if changes:
                left[0] -= 1
                if left[0] == 0:
                    act()
            return call(*arguments, **options)

        return changed

    for name in STEPS:
        monkeypatch.setattr(os, name, wrapped(getattr(os, name), name))
    return left


@pytest.mark.parametrize(
    ('linked', 'error'),
    [
        (False, OSError(28, 'No space left on device')),
        (True, OSError(30, 'Read-only file system')),
    ],
)
def test_a_failure_at_each_step_leaves_the_old_or_the_new_whole(
    out, tmp_path, whole_runs, monkeypatch, linked, error
):
    old, new = whole_runs
    if linked:
        shutil.move(out / 'estimate', tmp_path / 'disk2')
        (out / 'estimate').symlink_to(tmp_path / 'disk2')
        old = {k: v for k, v in old.items() if not k.startswith('estimate/')}
        old['estimate'] = str(tmp_path / 'disk2')
    shutil.copytree(out, tmp_path / 'kept', symlinks=True)

    def fail():
        raise error

    number, ends, left = 0, set(), [0]
    while left[0] <= 0:
        number += 1
        with monkeypatch.context() as patches:
            left = failing(patches, number, fail)
            try:
                make(out, SECOND, overwrite=True)
            except (OSError, BagError) as caught:
                assert error.strerror in str(caught)
        # What is the user's may wait in the folder of an unfinished command for the next one.
        remove_leftovers(out)
        ends.add(is_whole(out, new))
        assert is_whole(out, new) or is_whole(out, old), number
        if is_whole(out, new):
            shutil.rmtree(out)
            shutil.copytree(tmp_path / 'kept', out, symlinks=True)
    assert number > 20 and ends == {True, False}
    if linked:
        assert contents(tmp_path / 'disk2')


def test_a_kill_at_each_step_leaves_the_old_or_the_new_whole(
    out, tmp_path, whole_runs, monkeypatch
):
    old, new = whole_runs
    shutil.copytree(out, tmp_path / 'kept', symlinks=True)
    number, ends, killed = 0, set(), True
    while killed:
        number += 1
        if not (child := os.fork()):
            failing(monkeypatch, number, lambda: os.kill(os.getpid(), signal.SIGKILL))
            make(out, SECOND, overwrite=True)
            os._exit(0)
        killed = os.waitpid(child, 0)[1] != 0
        # Any command that reads or writes the run finds it.
        assert RunFolder(out).read_run()['estimates'] in (3, 5), number
        remove_leftovers(out)
        ends.add(is_whole(out, new))
        assert is_whole(out, new) or is_whole(out, old), number
        left = [path.name for path in tmp_path.iterdir() if UNFINISHED in path.name]
        assert all(not os.listdir(tmp_path / name) for name in left), (number, left)
        for name in left:  # one that was killed before its marker; it is empty
            (tmp_path / name).rmdir()
        if is_whole(out, new):
            shutil.rmtree(out)
            shutil.copytree(tmp_path / 'kept', out, symlinks=True)
    assert number > 20 and ends == {True, False}


def test_a_kill_while_a_run_moves_into_a_folder_of_the_user_is_repaired(tmp_path, whole_runs):
    out = tmp_path / 'out'
    number, killed = 0, True
    while killed:
        number += 1
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        (out / 'mine.txt').write_text('mine')
        if not (child := os.fork()):
            failing(pytest.MonkeyPatch(), number, lambda: os.kill(os.getpid(), signal.SIGKILL))
            make(out, SECOND)
            os._exit(0)
        killed = os.waitpid(child, 0)[1] != 0
        try:
            make(out, SECOND)
        except BagError as error:  # what is there counts as ours
            assert '--overwrite' in str(error)
            make(out, SECOND, overwrite=True)
        found = {k: v for k, v in contents(out).items() if UNFINISHED not in k}
        assert found == {**whole_runs[1], 'mine.txt': b'mine'}, number
    assert number > 20


def test_a_folder_that_others_made_is_not_replaced(tmp_path):
    out = tmp_path / 'out'
    out.mkdir()
    for name in ('estimate.csv', 'report.html', 'metrics.json'):
        (out / name).write_text('mine')
    (out / 'estimate').mkdir()
    (out / 'estimate' / 'thesis.tex').write_text('mine')
    before = contents(out)
    with pytest.raises(BagError, match=r'no results folder that sonar-imm made .*\.sonar_imm'):
        make(out, SECOND, overwrite=True)
    (out / MARKER).symlink_to(tmp_path)
    with pytest.raises(BagError, match='no results folder'):
        make(out, SECOND, overwrite=True)
    (out / MARKER).unlink()
    (out / MARKER).write_text(json.dumps({'made_by': 'sonar_imm', 'kind': 'survey'}))
    with pytest.raises(BagError, match='holds a survey, not a results'):
        make(out, SECOND, overwrite=True)
    (out / MARKER).unlink()
    assert contents(out) == before and os.listdir(tmp_path) == ['out']


def test_what_lies_in_the_bag_of_a_run_is_not_deleted(out):
    (out / 'estimate' / 'thesis.tex').write_text('mine')
    with pytest.raises(BagError, match='estimate holds thesis.tex, which is of no run'):
        make(out, SECOND, overwrite=True)
    assert (out / 'estimate' / 'thesis.tex').read_text() == 'mine'


def test_runs_of_versions_without_markers_are_known_by_their_run_json(out, whole_runs):
    (out / MARKER).unlink()
    RunFolder(out).write_json('run.json', {**RECORD, 'versions': {'sonar_imm': '0.9'}})
    make(out, SECOND, overwrite=True)
    assert is_whole(out, whole_runs[1])


@pytest.mark.parametrize(
    ('name', 'words'),
    [
        ('link', 'is a link to'),
        ('file', 'is a file'),
        ('fifo', 'is a file'),
        ('.', 'the current folder'),
        ('around', 'the current folder'),
        ('home', 'your home folder'),
        ('bag', 'is a recording'),
        ('parent', 'which is being read'),
        ('mount', 'is a mount point'),
        ('root', 'is the root of all folders'),
    ],
)
def test_odd_places_are_one_sentence_and_stay(out, tmp_path, monkeypatch, name, words):
    target, inputs = out, []
    if name == 'link':
        target = tmp_path / 'link'
        target.symlink_to(out)
    elif name == 'file':
        target = tmp_path / 'file'
        target.write_text('mine')
    elif name == 'fifo':
        target = tmp_path / 'fifo'
        os.mkfifo(target)
    elif name in ('.', 'around'):
        monkeypatch.chdir(out if name == '.' else out / 'notes')
        target = Path('.') if name == '.' else Path('..')
    elif name == 'home':
        monkeypatch.setenv('HOME', str(out))
    elif name == 'bag':
        target = out / 'estimate'
        inputs = [target]
    elif name == 'parent':
        inputs = [out / 'estimate']
    elif name == 'mount':
        monkeypatch.setattr(files, 'mount_points', lambda place: [place / 'estimate'])
    elif name == 'root':
        assert words in files.hindrance(Path('/'), 'results')
        return
    before = contents(out)
    with pytest.raises(BagError, match=words):
        make(target, SECOND, overwrite=True, inputs=inputs)
    assert contents(out) == before


def test_mount_points_are_those_of_the_system():
    assert Path('/') in mount_points(Path('/')) and Path('/proc') in mount_points(Path('/proc'))
    assert mount_points(Path(__file__)) == []


@pytest.mark.parametrize('made', ['nothing', 'marker of a run', 'marker of another folder'])
def test_folders_of_the_user_that_look_unfinished_are_never_removed(out, made):
    mine = out.parent / f'out{UNFINISHED}2024'
    if made == 'nothing':
        mine.mkdir()
    elif made == 'marker of a run':
        shutil.copytree(out, mine, symlinks=True)
    else:
        with files.beside(out.parent / 'out') as place:
            shutil.copytree(place, mine)
    (mine / 'thesis.tex').write_text('mine')
    before = contents(mine)
    inside = out / f'run{UNFINISHED}2024'
    inside.mkdir()
    (inside / 'thesis.tex').write_text('mine')
    make(out, SECOND, overwrite=True)
    assert contents(mine) == before and (inside / 'thesis.tex').exists()


def test_a_link_that_looks_unfinished_is_not_followed(out, tmp_path):
    with files.beside(out) as place:
        shutil.copytree(place, tmp_path / 'target')
    (tmp_path / place.name).symlink_to(tmp_path / 'target')
    remove_leftovers(out)
    assert (tmp_path / 'target' / MARKER).exists() and (tmp_path / place.name).is_symlink()


def test_metrics_are_not_written_through_a_link(out, tmp_path):
    """A folder from others may hold links to files of the user."""
    (tmp_path / 'mine.txt').write_text('mine')
    (out / 'metrics.json').symlink_to(tmp_path / 'mine.txt')
    RunFolder(out).write_json('metrics.json', {'a': 1})
    assert (tmp_path / 'mine.txt').read_text() == 'mine'
    assert json.loads((out / 'metrics.json').read_text()) == {'a': 1}
    assert not (out / 'metrics.json').is_symlink()
