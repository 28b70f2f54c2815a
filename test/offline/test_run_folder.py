# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a run leaves behind, byte for byte."""

import csv
import gc
import json
import os
from pathlib import Path
import re
import shutil
import signal
import sys

from helpers.dive_scenes import single_run, START_NS, write_dive
from helpers.estimates import same
import numpy as np
import pytest

from sonar_imm import files
from sonar_imm.estimates import Estimate
from sonar_imm.files import MARKER, mount_points, remove_leftovers, UNFINISHED
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline import run_folder
from sonar_imm_tools.offline.run_folder import CsvTable, ParquetTable, RunFolder
from sonar_imm_tools.recordings.sources import BagError

ESTIMATES = single_run(count=20)[0]


@pytest.fixture
def folder(tmp_path):
    folder = RunFolder(tmp_path / 'run')
    folder.path.mkdir()
    return folder


def test_estimates_come_back_bit_for_bit_and_leave_the_same_bytes(folder, tmp_path):
    folder.write_estimates([], 'diver')
    assert folder.read_estimates() == []
    made = []
    for name in 'ab':
        (tmp_path / name).mkdir()
        said = RunFolder(tmp_path / name).write_estimates(ESTIMATES, 'diver')
        assert said == {'first_stamp_ns': ESTIMATES[0].stamp_ns, 'estimates': 20, 'rows': 20}
        made.append(contents(tmp_path / name))
    assert made[0] == made[1] and len(made[0]) == 3
    read = RunFolder(tmp_path / 'a').read_estimates()
    assert all(same(*pair) for pair in zip(read, ESTIMATES, strict=True))


def test_an_earlier_run_is_kept_unless_told_otherwise(folder):
    folder.path.rmdir()
    with folder.fresh() as unfinished:
        unfinished.write_json('run.json', {})
    (folder.path / 'notes.txt').write_text('mine')
    kept = contents(folder.path)
    with pytest.raises(BagError, match='--overwrite'), folder.fresh():
        pytest.fail('the folder was given out')
    with pytest.raises(KeyError), folder.fresh(overwrite=True) as unfinished:
        unfinished.write_json('run.json', {'new': 1})
        raise KeyError
    assert contents(folder.path) == kept == {**kept, 'notes.txt': b'mine', 'run.json': b'{}\n'}
    with folder.fresh(overwrite=True) as unfinished:
        unfinished.write_json('run.json', {'new': 1})
        assert contents(folder.path)['run.json'] == b'{}\n'
    assert json.loads((folder.path / 'run.json').read_text()) == {'new': 1}
    assert sorted(contents(folder.path)) == ['.sonar_imm', 'notes.txt', 'run.json']
    with pytest.raises(BagError, match='is a file'):
        RunFolder(folder.path / 'run.json').fresh().__enter__()


def test_a_broken_run_json_is_one_sentence(folder):
    with pytest.raises(BagError, match='no finished run'):
        folder.read_run()
    for text in ('', '{', '[]', '3', '{"system": "diver"}'):
        (folder.path / 'run.json').write_text(text)
        with pytest.raises(BagError, match='cannot be understood'):
            folder.read_run()


GOOD_RUN = {
    'system': 'diver', 'bag': '', 'topics': {'/fix': 'fix'}, 'parameters': {}, 'versions': {},
    'counts': {'used': 1}, 'world_frame': 'enu',
    'refused': {'nan': {'count': 1, 'example': 'it is not a number'}},
}  # fmt: skip


@pytest.mark.parametrize('name', GOOD_RUN)
def test_entries_of_a_wrong_kind_are_one_sentence(folder, name):
    folder.write_json('run.json', GOOD_RUN)
    assert folder.read_run() == GOOD_RUN
    for value in (None, 5, True, [], ['a'], {'a': []}, 'whale'):
        folder.write_json('run.json', {**GOOD_RUN, name: value})
        # What is in a name of a bag and in mappings is judged where it is used.
        if (name, value) == ('bag', 'whale') or (
            isinstance(value, dict) and name in ('parameters', 'counts', 'versions')
        ):
            folder.read_run()
            continue
        with pytest.raises(BagError, match='cannot be understood'):
            folder.read_run()


def test_json_never_holds_nan_and_a_fingerprint_notices_one_changed_byte(tmp_path):
    given = {'a': [float('nan'), 1.0, (float('inf'),)], 'b': {'c': 'x'}}
    text = json.dumps(run_folder.finite(given), allow_nan=False)
    assert json.loads(text) == {'a': [None, 1.0, [None]], 'b': {'c': 'x'}}
    made = []
    for content in (b'12345', b'12346'):
        (tmp_path / 'a.mcap').write_bytes(content)
        made.append(run_folder.fingerprint(tmp_path))
    assert made[0]['bag_bytes'] == 5 and made[0]['bag_sha256'] != made[1]['bag_sha256']


def test_tables_have_the_columns_and_types_of_the_contract_and_exact_numbers(tmp_path):
    """CSV and Parquet say the same."""

    def written(table):
        with table:
            for estimate in ESTIMATES:
                table.write(estimate.stamp_ns, estimate.columns())
            with pytest.raises(ValueError, match='columns change'):
                table.write(2, {'b': np.zeros(2)})
        return table

    written(CsvTable(tmp_path / 'table.csv'))
    names, *rows = csv.reader((tmp_path / 'table.csv').read_text().splitlines())
    columns = ESTIMATES[0].columns()
    assert names == ['stamp_ns', *columns] and int(rows[0][0]) == START_NS
    table = dict(zip(names, zip(*rows)))
    assert [float(x) for x in table['px']] == [each.state[0, 0] for each in ESTIMATES]
    assert table['track_id'][0] == '7'
    parquet = pytest.importorskip('pyarrow.parquet')
    written(ParquetTable(tmp_path / 'table.parquet', {'system': 'diver'}))
    read = parquet.read_table(tmp_path / 'table.parquet')
    assert read.column_names == names and read.schema.metadata[b'system'] == b'diver'
    kinds = {name: read[name].to_numpy().dtype.type for name in names}
    wanted = {name: value.dtype.type for name, value in columns.items()}
    assert kinds == {'stamp_ns': np.int64, **wanted}
    for name, texts in table.items():
        number = read[name].to_numpy().astype(float)
        np.testing.assert_array_equal(number, np.array(texts, float))


def test_bins_of_one_stamp_and_side_are_one_estimate(tmp_path, monkeypatch):
    pytest.importorskip('pyarrow.parquet')
    columns = {name: np.repeat(column, 2) for name, column in ESTIMATES[0].columns().items()}
    made = []
    for stamp, side in ((5, 0), (5, 1), (6, 1), (7, 0)):
        bins = {**columns, 'side': np.full(2, side)}
        made.append(Estimate.from_columns(bins, stamp_ns=stamp, frame_id='map'))
    with ParquetTable(tmp_path / 'bins.parquet', {'frame_id': 'map'}) as table:
        for estimate in made:
            table.write(estimate.stamp_ns, estimate.columns())
    monkeypatch.setattr(RunFolder, 'bins', lambda self: self.path / 'bins.parquet')
    read = RunFolder(tmp_path).read_estimates()
    assert all(same(*pair) for pair in zip(read, made, strict=True))


@pytest.mark.parametrize('rows, count', [(0, 0), (0, 3), (1, 5), (65535, 3)])
def test_parquet_of_few_and_of_many_rows(tmp_path, rows, count):
    parquet = pytest.importorskip('pyarrow.parquet')
    with ParquetTable(tmp_path / 'table.parquet') as table:
        for k in range(count):
            table.write(k, {'x': np.full(rows, k, np.float32), 'n': np.arange(rows, dtype='u1')})
    read = parquet.read_table(tmp_path / 'table.parquet')
    assert read.num_rows == rows * count
    assert read.column_names == (['stamp_ns', 'x', 'n'] if count else ['stamp_ns'])
    if read.num_rows:
        np.testing.assert_array_equal(read['x'].to_numpy(), np.repeat(np.arange(count), rows))
        groups = parquet.ParquetFile(tmp_path / 'table.parquet').num_row_groups
        assert groups == (1 if rows == 1 else 2)


def test_track_writes_the_table_that_is_asked_for(tmp_path, capsys, monkeypatch):
    parquet = pytest.importorskip('pyarrow.parquet')
    bags = [str(write_dive(tmp_path / name, count=30)) for name in 'ab']
    out = tmp_path / 'out'
    assert main(['track', *bags, str(out)]) == 0
    with (out / 'a' / 'estimate.csv').open(newline='') as file:
        positions = [float(row['px']) for row in csv.DictReader(file)]
    # The same runs lack the files; then they have them.
    for table, said in (('--parquet', ' 2 tracked, 0'), ('--parquet', ' 0 tracked, 2')):
        assert main(['track', *bags, str(out), table]) == 0
        assert f'{said} kept' in capsys.readouterr().out
    first, second = (out / name / 'estimate.parquet' for name in 'ab')
    assert first.read_bytes() == second.read_bytes()
    assert not (out / 'a' / 'estimate.csv').exists()
    read = parquet.read_table(first)
    assert positions == read['px'].to_pylist()
    run = json.loads((out / 'a' / 'run.json').read_text())
    assert json.loads(read.schema.metadata[b'parameters']) == run['parameters']
    assert read.schema.metadata[b'sonar_imm'].decode() == run['versions']['sonar_imm']
    assert main(['track', *bags, str(out), '--no-table']) == 0
    assert ' 0 tracked, 2 kept' in capsys.readouterr().out
    assert main(['track', bags[0], str(out / 'c'), '--no-table']) == 0
    assert set(os.listdir(out / 'c')) == {'.sonar_imm', 'estimate', 'run.json'}
    assert main(['track', bags[0], str(out / 'd'), '--no-table', '--parquet']) == 2
    assert 'exclude each other' in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, 'pyarrow', None)  # said at once
    assert main(['track', bags[0], str(out / 'd'), '--parquet']) == 2
    assert "pip install 'sonar_imm[parquet]'" in capsys.readouterr().err
    assert not (out / 'd').exists()


def test_a_run_says_how_large_it_is_and_how_fast_it_was(tmp_path, capsys):
    bag, out = write_dive(tmp_path / 'a', count=30), tmp_path / 'out'
    assert main(['track', str(bag), str(out)]) == 0
    run = json.loads((out / 'run.json').read_text())
    there = sum(path.stat().st_size for path in out.rglob('*') if path.is_file())
    own = sum((out / name).stat().st_size for name in ('run.json', '.sonar_imm'))
    assert there - own <= run['written_bytes'] <= there
    read = run['timings']['mb_per_s'] * run['timings']['wall_s']
    assert read == pytest.approx(run['bag_bytes'] * 1e-6)
    p50, p99, total = (run['timings'][f'tracker_{name}_ms'] for name in ('p50', 'p99', 'total'))
    assert 0.0 < p50 <= p99 <= total < 1e3 * run['timings']['wall_s']
    said = r'^  0\.\d+ MB read at \S+ MB/s, 0\.\d+ MB written$'
    assert re.search(said, capsys.readouterr().out, re.M)


# -- overwriting replaces only folders that this package made, as a whole, not through links


OLD, NEW = single_run(count=3)[0], single_run(count=5)[0]
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
    for name, estimates in (('old', OLD), ('new', NEW)):
        make(folder / name / 'out', estimates)
    return contents(folder / 'old' / 'out'), contents(folder / 'new' / 'out')


@pytest.fixture
def out(tmp_path):
    """A folder with a run, a note of the user and a link of the user."""
    out = tmp_path / 'out'
    make(out, OLD)
    (out / 'notes').mkdir()
    (out / 'notes' / 'mine.txt').write_text('mine')
    (out / 'elsewhere').symlink_to(tmp_path)
    return out


@pytest.fixture
def disk2(out, tmp_path):
    """Where the `estimate` of the run lies in truth."""
    shutil.move(out / 'estimate', tmp_path / 'disk2')
    (out / 'estimate').symlink_to(tmp_path / 'disk2')
    return tmp_path / 'disk2'


def finished(out):
    """The contents but for markers of unfinished folders that could not be removed."""
    return {k: v for k, v in contents(out).items() if not (UNFINISHED in k and MARKER in k)}


def is_whole(out, run):
    """Whether `out` holds a run and all that is the user's, and nothing else."""
    return finished(out) == {**run, 'notes/mine.txt': b'mine', 'elsewhere': str(out.parent)}


@pytest.mark.parametrize('marker', [True, False])
def test_what_is_the_users_comes_along(out, whole_runs, marker):
    if not marker:  # runs of versions without markers are known by their run.json
        (out / MARKER).unlink()
        RunFolder(out).write_json('run.json', {**RECORD, 'versions': {'sonar_imm': '0.9'}})
    make(out, NEW, overwrite=True)
    assert is_whole(out, whole_runs[1])
    assert os.listdir(out.parent) == ['out']


def test_a_run_whose_estimate_is_a_link_is_replaced_and_its_target_stays(out, disk2):
    kept = contents(disk2)
    make(out, NEW, overwrite=True)
    assert len(RunFolder(out).read_estimates()) == 5 and not (out / 'estimate').is_symlink()
    assert contents(disk2) == kept


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


def each_step(out, new, attempt):
    """Make a run anew, `attempt(number)` ends in its `number`-th step, until that has none; the
    run has to be the old or the new one whole. attempt: gives whether it ended."""
    old = contents(out)
    shutil.copytree(out, out.parent / 'kept', symlinks=True)
    number, ends, ended = 0, set(), True
    while ended:
        number += 1
        ended = attempt(number)
        # What is the user's may wait in the folder of an unfinished command for the next one.
        remove_leftovers(out)
        ends.add(is_whole(out, new))
        if is_whole(out, new):
            shutil.rmtree(out)
            shutil.copytree(out.parent / 'kept', out, symlinks=True)
        assert finished(out) == old, number
    assert number > 20 and ends == {True, False}


@pytest.mark.parametrize('linked', [False, True])
def test_a_failure_at_each_step_leaves_the_old_or_the_new_whole(
    out, whole_runs, monkeypatch, request, linked
):
    disk2 = request.getfixturevalue('disk2') if linked else out / 'notes'
    kept = contents(disk2)

    def fail():
        raise OSError(28, 'No space left on device')

    def attempt(number):
        with monkeypatch.context() as patches:
            left = failing(patches, number, fail)
            try:
                make(out, NEW, overwrite=True)
            except (OSError, BagError) as caught:
                assert 'No space left' in str(caught)
        return left[0] <= 0

    each_step(out, whole_runs[1], attempt)
    assert contents(disk2) == kept


def killed_in(number, change):
    """Whether a process that makes `change()` is killed in its `number`-th step."""
    if not (child := os.fork()):
        gc.disable()  # what other tests left behind may have threads, which a fork has not
        failing(pytest.MonkeyPatch(), number, lambda: os.kill(os.getpid(), signal.SIGKILL))
        status = 1
        try:
            change()
            status = 0
        finally:
            os._exit(status)
    ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert ended in (0, -signal.SIGKILL), ended  # a crash would never come to an end
    return ended != 0


def test_a_kill_at_each_step_leaves_the_old_or_the_new_whole(out, tmp_path, whole_runs):
    def attempt(number):
        killed = killed_in(number, lambda: make(out, NEW, overwrite=True))
        # Any command that reads or writes the run finds it.
        assert RunFolder(out).read_run()['estimates'] in (3, 5), number
        remove_leftovers(out)
        for path in tmp_path.glob(f'*{UNFINISHED}*'):
            path.rmdir()  # of one that was killed before its marker; it is empty
        return killed

    each_step(out, whole_runs[1], attempt)


def test_a_kill_while_a_run_moves_into_a_folder_of_the_user_is_repaired(tmp_path, whole_runs):
    out = tmp_path / 'out'
    number, killed = 0, True
    while killed:
        number += 1
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        (out / 'mine.txt').write_text('mine')
        killed = killed_in(number, lambda: make(out, NEW))
        try:
            make(out, NEW)
        except BagError as error:  # what is there counts as ours
            assert '--overwrite' in str(error)
            make(out, NEW, overwrite=True)
        found = {k: v for k, v in contents(out).items() if UNFINISHED not in k}
        assert found == {**whole_runs[1], 'mine.txt': b'mine'}, number
    assert number > 20


def test_a_folder_that_others_made_is_not_replaced(tmp_path):
    out = tmp_path / 'out'
    (out / 'estimate').mkdir(parents=True)
    for name in ('estimate.csv', 'report.html', 'metrics.json', 'estimate/thesis.tex'):
        (out / name).write_text('mine')
    before = contents(out)

    def is_refused(words):
        with pytest.raises(BagError, match=words):
            make(out, NEW, overwrite=True)
        (out / MARKER).unlink(missing_ok=True)

    is_refused(r'no results folder that sonar-imm made .*\.sonar_imm')
    (out / MARKER).symlink_to(tmp_path)
    is_refused('no results folder')
    (out / MARKER).write_text(json.dumps({'made_by': 'sonar_imm', 'kind': 'survey'}))
    is_refused('holds a survey, not a results')
    assert contents(out) == before and os.listdir(tmp_path) == ['out']


def test_what_lies_in_the_bag_of_a_run_is_not_deleted(out):
    (out / 'estimate' / 'thesis.tex').write_text('mine')
    with pytest.raises(BagError, match='estimate holds thesis.tex, which is of no run'):
        make(out, NEW, overwrite=True)
    assert (out / 'estimate' / 'thesis.tex').read_text() == 'mine'


@pytest.mark.parametrize(
    'name, words',
    [
        ('link', 'is a link to'), ('file', 'is a file'), ('fifo', 'is a file'),
        ('.', 'the current folder'), ('..', 'the current folder'), ('home', 'your home folder'),
        ('bag', 'is a recording'), ('parent', 'which is being read'),
        ('mount', 'is a mount point'),
    ],
)  # fmt: skip
def test_odd_places_are_one_sentence_and_stay(out, tmp_path, monkeypatch, name, words):
    (tmp_path / 'link').symlink_to(out)
    (tmp_path / 'file').write_text('mine')
    os.mkfifo(tmp_path / 'fifo')
    targets = {kind: tmp_path / kind for kind in ('link', 'file', 'fifo')}
    targets |= {'.': Path('.'), '..': Path('..'), 'bag': out / 'estimate'}
    if name in ('.', '..'):
        monkeypatch.chdir(out if name == '.' else out / 'notes')
    elif name == 'home':
        monkeypatch.setenv('HOME', str(out))
    elif name == 'mount':
        monkeypatch.setattr(files, 'mount_points', lambda place: [place / 'estimate'])
    before = contents(out)
    inputs = [out / 'estimate'] if name in ('bag', 'parent') else []
    with pytest.raises(BagError, match=words):
        make(targets.get(name, out), NEW, overwrite=True, inputs=inputs)
    assert contents(out) == before


def test_mount_points_are_those_of_the_system():
    assert Path('/') in mount_points(Path('/')) and Path('/proc') in mount_points(Path('/proc'))
    assert mount_points(Path(__file__)) == []
    assert 'is the root of all folders' in files.hindrance(Path('/'), 'results')


@pytest.mark.parametrize('made', ['nothing', 'marker of a run', 'marker of another folder'])
def test_folders_of_the_user_that_look_unfinished_are_never_removed(out, made):
    mine = out.parent / f'out{UNFINISHED}2024'
    if made == 'nothing':
        mine.mkdir()
    elif made == 'marker of a run':
        shutil.copytree(out, mine, symlinks=True)
    else:
        with files.beside(out) as place:
            shutil.copytree(place, mine)
    inside = out / f'run{UNFINISHED}2024'
    inside.mkdir()
    for folder in (mine, inside):
        (folder / 'thesis.tex').write_text('mine')
    before = contents(mine)
    make(out, NEW, overwrite=True)
    assert contents(mine) == before and (inside / 'thesis.tex').exists()


def test_links_are_neither_followed_nor_written_through(out, tmp_path):
    with files.beside(out) as place:
        shutil.copytree(place, tmp_path / 'target')
    (tmp_path / place.name).symlink_to(tmp_path / 'target')
    remove_leftovers(out)
    assert (tmp_path / 'target' / MARKER).exists() and (tmp_path / place.name).is_symlink()
    # A folder from others may hold links to files of the user.
    mine, metrics = tmp_path / 'mine.txt', out / 'metrics.json'
    mine.write_text('mine')
    metrics.symlink_to(mine)
    RunFolder(out).write_json('metrics.json', {'a': 1})
    assert mine.read_text() == 'mine' and not metrics.is_symlink()
    assert json.loads(metrics.read_text()) == {'a': 1}
