# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Files and folders are whole or not there; shared ones are found, those of this installation."""

import os
from pathlib import Path
import shutil
import subprocess
import sys
import time

import pytest

from sonar_imm import files
from sonar_imm.files import beside, fcntl, hold, UNFINISHED, whole
from sonar_imm_tools.resources import share_folder, shared_file

locks = pytest.mark.skipif(fcntl is None, reason='there are no locks')


def test_a_file_is_there_at_the_end_only_and_replaces_an_older_one(tmp_path):
    target = tmp_path / 'new' / 'file.txt'
    for text in ('first', 'second'):
        with whole(target) as path:
            assert path.name == 'file.txt' and path != target
            path.write_text(text)
            assert not target.exists() or target.read_text() == 'first'
        assert target.read_text() == text
    with pytest.raises(KeyError), whole(target) as path:
        path.write_text('third')
        raise KeyError
    assert target.read_text() == 'second' and len(list(target.parent.iterdir())) == 1


def test_a_folder_is_there_at_the_end_and_no_other_is_replaced(tmp_path):
    for _ in range(2):
        try:
            with whole(tmp_path / 'folder') as path:
                path.mkdir()
                (path / 'file').touch()
        except OSError as error:
            assert error.filename == str(tmp_path / 'folder')
    assert [path.name for path in tmp_path.rglob('*')] == ['folder', 'file']


def test_links_and_devices_stay_what_they_are(tmp_path):
    (tmp_path / 'link').symlink_to(tmp_path / 'file')
    with whole(tmp_path / 'link') as path:
        path.write_text('text')
    assert (tmp_path / 'link').is_symlink() and (tmp_path / 'file').read_text() == 'text'
    with whole('/dev/null') as path:
        path.write_text('text')
    assert Path('/dev/null').is_char_device()


def test_errors_name_what_the_user_named(tmp_path):
    (tmp_path / 'file').touch()
    for path in (tmp_path / 'file' / 'below', tmp_path / 'none'):
        with pytest.raises(OSError) as caught, whole(path) as unfinished:
            unfinished.open('r')
        assert str(caught.value.filename) in (str(path), str(path.parent))


@locks
def test_what_a_killed_process_left_is_removed_and_that_of_a_living_one_is_not(tmp_path):
    text = (
        'import sys\nfrom pathlib import Path\nfrom sonar_imm.files import beside\n'
        'with beside(Path(sys.argv[1])) as place:\n'
        "    (place / 'file').touch()\n    print(flush=True)\n    sys.stdin.read()\n"
    )
    target = tmp_path / 'out'
    with subprocess.Popen(
        [sys.executable, '-c', text, str(target)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        other.stdout.readline()
        with beside(target) as place:
            assert len(list(tmp_path.iterdir())) == 2
        assert not place.exists()
        other.kill()
        other.wait()
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(f'out{UNFINISHED}') and (left / 'file').exists()
    with beside(target) as place:
        assert list(tmp_path.iterdir()) == [place]


@locks
def test_file_systems_without_locks_keep_leftovers(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(38, 'no locks')

    (tmp_path / f'out{UNFINISHED}abc').mkdir()
    monkeypatch.setattr(fcntl, 'flock', no_locks)
    with whole(tmp_path / 'out') as path:
        path.touch()
    assert sorted(path.name for path in tmp_path.iterdir()) == ['out', f'out{UNFINISHED}abc']


@locks
def test_where_there_are_neither_locks_nor_open_folders(tmp_path, monkeypatch):
    """As on Windows: no fcntl, folders cannot be opened, files not synced that are read only."""
    opened, synced = os.open, os.fsync

    def open_files_only(path, *arguments, **options):
        if 'dir_fd' not in options and os.path.isdir(path):  # shutil.rmtree names it
            raise PermissionError(13, 'a folder')
        return opened(path, *arguments, **options)

    def sync_written_only(handle):
        if handle < 0 or fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(9, 'bad handle')
        synced(handle)

    monkeypatch.setattr(files, 'fcntl', None)
    monkeypatch.setattr(shutil, '_use_fd_functions', False)  # that of Python 3.10 does not
    monkeypatch.setattr(os, 'open', open_files_only)
    monkeypatch.setattr(os, 'fsync', sync_written_only)
    with whole(tmp_path / 'run') as path:
        path.mkdir()
        (path / 'a').write_text('a')
    with whole(tmp_path / 'file') as path:
        path.write_text('b')
    assert (tmp_path / 'run' / 'a').read_text() == 'a'
    assert (tmp_path / 'file').read_text() == 'b'
    assert {place.name for place in tmp_path.iterdir()} == {'run', 'file'}
    release = hold(tmp_path / 'state')
    release()
    assert not (tmp_path / 'state.lock').exists()


def test_the_command_runs_without_the_modules_of_unix_and_with_backslashes(tmp_path):
    run, report = tmp_path / 'a\\new\\run', tmp_path / 'a\\report.html'
    blocked = ('fcntl', 'grp', 'pwd', 'resource', 'termios')
    program = (
        'import os, signal, sys\n'
        f'sys.modules.update(dict.fromkeys({blocked!r}))\n'
        'del signal.SIGHUP, signal.SIGKILL, os.sched_getaffinity, os.fork, os.nice\n'
        'from sonar_imm_tools.cli import main\n'
        f"main(['track', 'bags/diver_table1', {str(run)!r}])\n"
        f"sys.exit(main(['evaluate', {str(run)!r}, '--report', {str(report)!r}]))"
    )
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run(
        [sys.executable, '-c', program], cwd=root, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert (run / 'estimate.csv').stat().st_size > 0 and report.stat().st_size > 0


def test_what_is_renamed_is_on_the_disk_before_and_the_rename_after(tmp_path, monkeypatch):
    """A power cut cannot be tried here; the order of the calls that it depends on can."""
    calls, fsync, replace = [], os.fsync, os.replace

    def synced(handle):
        calls.append(('sync', Path(os.readlink(f'/proc/self/fd/{handle}')).name))
        fsync(handle)

    def renamed(old, new):
        calls.append(('rename', Path(new).name))
        replace(old, new)

    monkeypatch.setattr(os, 'fsync', synced)
    monkeypatch.setattr(os, 'replace', renamed)
    with whole(tmp_path / 'bag') as path:
        (path / 'deep').mkdir(parents=True)
        (path / 'deep' / 'b').write_text('b')
        (path / 'a').write_text('a')
    assert {('sync', name) for name in ('a', 'b', 'deep', 'bag')} == set(calls[:4])
    assert calls[4:] == [('rename', 'bag'), ('sync', tmp_path.name)]
    calls.clear()
    with whole(tmp_path / 'file') as path:
        path.write_text('a')
    assert calls == [('sync', 'file'), ('rename', 'file'), ('sync', tmp_path.name)]


@locks
def test_who_waits_for_a_folder_goes_on_when_it_is_free_or_patience_ends(tmp_path):
    with files.one_at_a_time(tmp_path, 60.0):
        begun = time.monotonic()
        with files.one_at_a_time(tmp_path, 0.1):
            assert time.monotonic() - begun >= 0.1
    with files.one_at_a_time(tmp_path, 60.0), files.one_at_a_time(tmp_path / 'nowhere', 60.0):
        assert time.monotonic() - begun < 30.0


# -- shared files are found after every kind of installation --


def touch(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


SITE, DEBIAN = 'lib/python3.12/site-packages', 'lib/python3.12/dist-packages'


# pip in a venv and colcon; Debian's Python; colcon on Ubuntu; pip install --target
@pytest.mark.parametrize('place', [SITE, DEBIAN, f'local/{DEBIAN}', '.'])
def test_installed_files_lie_in_share_of_the_prefix(tmp_path, place):
    module = touch(tmp_path / place / 'sonar_imm' / 'resources.py')
    touch(tmp_path / 'share' / 'sonar_imm' / 'package.xml')
    assert share_folder(module) == tmp_path / 'share' / 'sonar_imm'


def test_a_source_tree_is_its_own_share_also_behind_the_links_of_a_symlink_install(tmp_path):
    root, link = tmp_path / 'ws' / 'src' / 'sonar_imm', tmp_path / 'build'
    module = touch(root / 'sonar_imm' / 'resources.py')
    touch(root / 'setup.py')
    touch(root / 'resource' / 'sonar_imm')
    # An older version installed above the workspace does not matter.
    touch(tmp_path / 'share' / 'sonar_imm' / 'package.xml')
    link.symlink_to(module.parent, target_is_directory=True)
    assert share_folder(module) == share_folder(link / 'resources.py') == root


def test_a_shared_file_is_found_and_what_is_missing_is_named(tmp_path):
    module = touch(tmp_path / 'sonar_imm' / 'resources.py')
    with pytest.raises(FileNotFoundError, match='install the package with pip or colcon'):
        share_folder(module)
    assert 'ros__parameters' in shared_file('config/diver.yaml').read_text(encoding='utf-8')
    with pytest.raises(FileNotFoundError, match="no shared file 'bags/nothing'"):
        shared_file('bags/nothing')
