# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm survey``: from folders of soundings to products that other programs read."""

import csv
import json
import os
import re
import shutil

from attrs import asdict, evolve
from helpers import survey_vectors as vectors
from helpers.clusters import small_cluster
from helpers.commands import run
import numpy as np
import pytest

from msg_adapters.soundings import write_soundings
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.soundings import COLUMNS, Soundings
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm_tools.recordings.export.points import places_of, read_points, write_table
from sonar_imm_tools.recordings.writer import BagWriter, ros_message
from sonar_imm_tools.survey import adjustment, jobs, resuming
from sonar_imm_tools.survey.looks import looks_of
from sonar_imm_tools.survey.making import plan_tiles

rasterio = pytest.importorskip('rasterio')
pyarrow_parquet = pytest.importorskip('pyarrow.parquet')

SMALL = ('lines=3', 'cross_lines=1', 'spacing=25', 'length=80', 'ping_interval=0.7', 'ghost=false')
PRODUCTS = (
    'survey.tif', 'provenance.parquet', 'coverage.geojson', 'adjustment.json', 'crossings.csv',
    'report.html',
)  # fmt: skip
PARAMETERS = BathymetryConfig().as_dict()
RECORD = {'system': 'bathymetry', 'bag': 'a.bag', 'topics': {}, 'parameters': PARAMETERS}


@pytest.fixture(scope='module')
def lines(tmp_path_factory):
    out = tmp_path_factory.mktemp('survey') / 'runs'
    settings = [word for setting in SMALL for word in ('--set', setting)]
    assert run('simulate', 'survey', out, '--soundings', *settings) == 0
    return out


@pytest.fixture(scope='module')
def made(lines, tmp_path_factory):
    out = tmp_path_factory.mktemp('made') / 'chart'
    assert run('survey', lines, out, '--adjust') == 0
    return out


def read(path):
    with rasterio.open(path) as file:
        return dict(zip(file.descriptions, file.read().astype(float))), file.transform, file


def survey_of(out):
    return json.loads((out / 'survey.json').read_text())


def products(out):
    files = [out / name for name in PRODUCTS] + sorted((out / 'tiles').iterdir())
    return {str(file.relative_to(out)): file.read_bytes() for file in files}


@pytest.fixture
def runs(lines, tmp_path):
    """A copy of the lines."""
    return shutil.copytree(lines, tmp_path / 'runs')


def shorten(line, *rows):
    """Keep only these rows of the table of a line."""
    table = line / 'soundings.csv'
    kept = table.read_text().splitlines()[slice(*rows)]
    table.write_text('\n'.join(kept) + '\n')


def place(points, line, **record):
    """Write soundings as a line."""
    line.mkdir(parents=True)
    write_table(line / 'soundings.csv', points)
    if record:
        (line / 'run.json').write_text(json.dumps({**RECORD, **record}))


def test_the_chart_lies_on_the_true_floor(lines, made):
    bands, transform, file = read(made / 'survey.tif')
    assert file.crs is None and np.isnan(file.nodata)
    truth = np.load(lines / 'truth.npz')
    rows, columns = np.nonzero(np.isfinite(bands['depth']))
    x = transform.c + (columns + 0.5) * transform.a - truth['ext'][0]
    y = transform.f + (rows + 0.5) * transform.e - truth['ext'][1]
    inside = (x > 0) & (y > 0) & (x < truth['ext'][2] - 1) & (y < truth['ext'][3] - 1)
    rows, columns = rows[inside], columns[inside]
    z = truth['truth_z'][x[inside].astype(int), y[inside].astype(int)]
    error = -bands['depth'][rows, columns] - z
    assert len(z) > 2000 and np.median(np.abs(error - np.median(error))) < 0.08
    assert np.mean(np.abs(error) < 2.0 * bands['uncertainty'][rows, columns]) > 0.93
    # Fish stay visible as what competes.
    assert np.nanmax(bands['hypotheses']) >= 2 and np.nanmax(bands['lines']) == 4


def test_export_of_one_run_is_the_same_grid(lines, tmp_path):
    """Node by node, also across the seams of tiles; a survey keeps what it reads in float32."""
    line = shutil.copytree(lines / 'line_001', tmp_path / 'runs' / 'line_001')
    (line / 'run.json').write_text(json.dumps(RECORD))
    assert run('survey', line.parent, tmp_path / 'out', '--resolution', 1) == 0
    assert run('export', line, tmp_path / 'one.tif', '--cell', 1) == 0
    survey, there, _ = read(tmp_path / 'out' / 'survey.tif')
    chart, here, _ = read(tmp_path / 'one.tif')
    top, left = round(there.f - here.f), round(here.c - there.c)
    rows, columns = chart['depth'].shape
    for name in ('depth', 'uncertainty', 'count', 'hypotheses', 'competing_depth'):
        whole = survey[name][top : top + rows, left : left + columns]
        assert np.isfinite(chart[name]).sum() > 30, name
        assert chart[name] == pytest.approx(whole, abs=1e-4, nan_ok=True), name


def test_tiles_are_the_chart(made):
    whole, transform, _ = read(made / 'survey.tif')
    tiles = survey_of(made)['tiles']
    files = {path.stem for path in (made / 'tiles').iterdir()}
    assert files == {tile['name'] for tile in tiles} and len(files) == len(tiles)
    for tile in tiles:
        bands, own, _ = read(made / 'tiles' / f'{tile["name"]}.tif')
        assert own.c == tile['i'] * 64 * tile['cell'] and own.a == tile['cell']
        times = round(tile['cell'] / transform.a)
        top = round((transform.f - own.f) / transform.a)
        left = round((own.c - transform.c) / transform.a)
        repeated = np.kron(bands['depth'], np.ones((times, times)))
        there = whole['depth'][top : top + 64 * times, left : left + 64 * times]
        assert np.array_equal(there, repeated, equal_nan=True)
        assert set(bands['cell'][np.isfinite(bands['depth'])]) == {tile['cell']}


def test_the_other_files_say_what_they_should(lines, made):
    adjustment = json.loads((made / 'adjustment.json').read_text())
    names = {(row['line'], row['name']): row for row in adjustment['parameters']}
    assert len(names) == 3 + 3 * 4
    roll = names['', 'roll_deg']
    assert roll['value'] == pytest.approx(1.0, abs=0.1) and roll['told'] > 0.99
    assert roll['prior_std'] == pytest.approx(2.0)
    assert adjustment['crossings']['rms_after'] < 0.3 * adjustment['crossings']['rms_before']
    unknown = adjustment['not_told']
    assert unknown[0]['share'] > 0.99
    # The level, and no tide of one line alone.
    offsets = [entry['combination'].count('offset_m') for entry in unknown]
    assert offsets.count(4) == 1, unknown
    with (made / 'crossings.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6 and all(int(row['cells']) > 20 for row in rows)
    assert all(float(row['rms_after']) < float(row['rms_before']) for row in rows)
    table = pyarrow_parquet.read_table(made / 'provenance.parquet').to_pydict()
    assert list(table) == ['x', 'y', 'cell', 'line', 'count', 'residual']
    assert set(table['line']) == {f'line_{k:03d}' for k in range(4)}
    bands, _, _ = read(made / 'survey.tif')
    assert len(set(zip(table['x'], table['y']))) <= np.isfinite(bands['depth']).sum()
    survey = survey_of(made)
    first = survey['lines'][0]
    points = read_points(lines / 'line_000' / 'soundings.csv')
    assert first['soundings'] == len(points) and first['failure'] == ''
    assert first['bounds'][0] == pytest.approx(points['x'].min())
    assert survey['crs'] == {'epsg': None} and survey['options']['adjust'] is True
    coverage = json.loads((made / 'coverage.geojson').read_text())
    assert 'local' in coverage['name'] and coverage['features']
    page = (made / 'report.html').read_text(encoding='utf-8')
    for title in ('Depth', 'Uncertainty', 'Competing depths', 'Misties', 'Not determined</h2>'):
        assert f'<h2>{title}' in page
    assert page.count('Plotly.newPlot(') >= 4
    assert '4 lines with' in page and 'roll_deg' in page and 'offset_m line_000' in page
    assert not re.search(r'<(script|link)[^>]+(src|href)=', page)  # nothing from elsewhere


def test_other_programs_read_the_products(lines, made, tmp_path):
    """What QGIS reads them with: GDAL for rasters and for vectors, Arrow for the table."""
    pyogrio = pytest.importorskip('pyogrio')
    place = ('--crs', 32632, '--origin', '500000,6000000')
    assert run('survey', lines, tmp_path / 'out', '--resolution', 2, *place) == 0
    for out, number in ((made, None), (tmp_path / 'out', 32632)):
        with rasterio.open(out / 'survey.tif') as file:
            assert file.tags(ns='IMAGE_STRUCTURE')['LAYOUT'] == 'COG'
            assert set(file.dtypes) == {'float32'} and file.count == 11
            assert file.descriptions[:2] == ('depth', 'uncertainty')
            assert (file.crs.to_epsg() if file.crs else None) == number
            depth, box = file.read(1, masked=True), file.bounds
        layers = pyogrio.list_layers(out / 'coverage.geojson')
        assert layers[0][1] == 'Polygon'
        info = pyogrio.read_info(out / 'coverage.geojson')
        assert info['features'] >= 1 and '4326' in info['crs']
        west, south, east, north = info['total_bounds']
        if number:
            (west, east), (south, north) = rasterio.warp.transform(
                'EPSG:4326', f'EPSG:{number}', [west, east], [south, north]
            )
        table = pyarrow_parquet.read_table(out / 'provenance.parquet')
        x, y = table['x'].to_numpy(), table['y'].to_numpy()
        half = 0.5 * table['cell'].to_numpy().max()
        # Without --adjust the misties are part of the uncertainty; tiles are made with auto only.
        adjustment = json.loads((out / 'adjustment.json').read_text())
        sure = np.nanmin(read(out / 'survey.tif')[0]['uncertainty'])
        assert (sure > adjustment['crossings']['rms_before']) == (number is not None)
        assert (out / 'tiles').exists() == (number is None)
        # All three lie at one place, and the depths are those of the floor.
        for values, low, high in ((x, west, east), (y, south, north)):
            assert low - 2.0 < values.min() - half and values.max() + half < high + 2.0
        assert box.left - 2.0 < west and east < box.right + 2.0
        assert 10.0 < depth.min() and depth.max() < 30.0


@pytest.mark.parametrize('where', ['processes', 'cluster'])
def test_the_same_bytes_with_many_processes_and_on_a_cluster(lines, made, tmp_path, where):
    if where == 'processes':
        assert run('survey', lines, tmp_path / 'out', '--adjust', '--jobs', 3) == 0
    else:
        with small_cluster(silence_logs='CRITICAL') as there:
            address = ('--scheduler', there.scheduler_address)
            assert run('survey', lines, tmp_path / 'out', '--adjust', *address) == 0
    assert products(tmp_path / 'out') == products(made)


WORK = ('statistics', 'solve', 'covariance', 'misties', 'tile')


class Work:
    """Counts what is made; `dies` interrupts one kind of work at its nth time."""

    def __init__(self, monkeypatch):
        self.made, self.dies = dict.fromkeys(WORK, 0), ('', 0)
        equations = adjustment._Equations
        for kind, place, name in (
            ('statistics', jobs, 'looks_of'),
            ('solve', equations, 'solve'),
            ('covariance', equations, 'covariance'),
            ('misties', resuming, 'misties'),
            ('tile', jobs, 'grid_of_looks'),
        ):
            monkeypatch.setattr(place, name, self.counted(kind, getattr(place, name)))

    def counted(self, kind, real):
        def work(*arguments, **named):
            if self.dies == (kind, self.made[kind] + 1):
                raise KeyboardInterrupt
            self.made[kind] += 1
            return real(*arguments, **named)

        return work

    def taken(self):
        """What was made since it was last asked."""
        made, self.made = self.made, dict.fromkeys(WORK, 0)
        return made


def test_resume_makes_only_what_changed(runs, tmp_path, monkeypatch):
    out, reads = tmp_path / 'out', []

    def noted(path):
        reads.append(path.parent.name)
        return read_points(path)

    assert run('survey', runs, out, '--adjust') == 0
    before, work = products(out), Work(monkeypatch)
    monkeypatch.setattr(jobs, 'read_points', noted)
    os.utime(runs / 'line_000' / 'soundings.csv')  # another time, the same content
    assert run('survey', runs, out, '--adjust', '--resume') == 0
    assert reads == [] and products(out) == before and not any(work.taken().values())
    shorten(runs / 'line_003', -200)
    assert run('survey', runs, out, '--adjust', '--resume') == 0
    made = work.taken()
    # As reported the other three lines are what they were; each round moves all four.
    assert set(reads) == {'line_003'} and made.pop('tile') > 0
    assert made == {'statistics': 1 + 3 * 4, 'solve': 3, 'covariance': 1, 'misties': 2}
    # The same as one made at once.
    assert run('survey', runs, tmp_path / 'anew', '--adjust') == 0
    assert products(tmp_path / 'anew') == products(out)
    assert run('survey', runs, out, '--resume') == 2
    assert run('survey', runs, out, '--overwrite') == 0


@pytest.mark.parametrize(
    'dies', [('statistics', 6), ('solve', 3), ('covariance', 1), ('misties', 2), ('tile', 2)]
)
def test_a_survey_that_was_interrupted_makes_nothing_again(
    lines, tmp_path, made, monkeypatch, dies
):
    """A power cut in the first round of the adjustment, before the third is solved, after it,
    before the last misties, while tiles are made."""
    work, out = Work(monkeypatch), tmp_path / 'out'
    work.dies = dies
    assert run('survey', lines, out, '--adjust') == 130
    assert not (out / 'survey.json').exists()
    before, work.dies = work.taken(), ('', 0)
    assert run('survey', lines, out, '--adjust', '--resume') == 0
    assert products(out) == products(made)
    after = work.taken()
    tiles = len(list((out / '.work' / 'tiles').glob('*.npz')))
    whole = {'statistics': 4 * 4, 'solve': 3, 'covariance': 1, 'misties': 2, 'tile': tiles}
    assert {kind: before[kind] + after[kind] for kind in WORK} == whole
    assert run('survey', lines, out, '--adjust', '--resume') == 0
    assert products(out) == products(made) and not any(work.taken().values())


def test_an_adjustment_that_cannot_be_read_is_made_again(lines, tmp_path, made, monkeypatch):
    out = shutil.copytree(made, tmp_path / 'out')
    kept = out / '.work' / 'adjustment.npz'
    kept.write_bytes(kept.read_bytes()[:-100])
    (out / '.work' / 'misties.json').write_text('[]')
    work = Work(monkeypatch)
    assert run('survey', lines, out, '--adjust', '--resume') == 0
    assert products(out) == products(made)
    again = {'statistics': 3 * 4, 'solve': 3, 'covariance': 1, 'misties': 1, 'tile': 0}
    assert work.taken() == again


def test_lines_with_origins_of_their_own_lie_in_one_frame(lines, tmp_path, capsys):
    """Each line in metres from its own first position, as lines in latitude and longitude are."""
    earth, runs = Origin(54.3, 10.15), tmp_path / 'runs'
    for k, line in enumerate(sorted(lines.glob('line_*'))):
        own = Origin(54.3 + 0.002 * k, 10.15 - 0.003 * k)
        points = read_points(line / 'soundings.csv').placed(earth, None, (0.0, 0.0, 0.0), own)
        place(points, runs / line.name, origin=asdict(own))
    depths = []
    for source, name in ((runs, 'out'), (lines, 'same')):
        assert run('survey', source, tmp_path / name, '--resolution', 2) == 0
        depths.append(read(tmp_path / name / 'survey.tif')[0]['depth'])
    assert np.nanmedian(np.abs(depths[0] - depths[1])) < 0.01

    assert run('survey', runs, tmp_path / 'utm', '--resolution', 2, '--crs', 25832) == 0
    _, transform, file = read(tmp_path / 'utm' / 'survey.tif')
    assert file.crs.to_epsg() == 25832
    there = np.ravel(places_of(np.array([10.15]), np.array([54.3]), 25832))
    east, south = transform.a * file.width / 2, transform.e * file.height / 2
    assert np.abs(there[:2] - [transform.c + east, transform.f + south]).max() < 300.0

    (runs / 'line_001' / 'run.json').write_text(json.dumps(RECORD))
    assert run('survey', runs, tmp_path / 'third', '--resolution', 2) == 0
    assert 'line_001: other lines state where' in capsys.readouterr().err


def test_groups_that_do_not_overlap_are_adjusted_with_a_warning(lines, tmp_path, capsys):
    for k, (source, east) in enumerate([(0, 0.0), (1, 0.0), (0, 5000.0), (1, 5000.0)]):
        points = read_points(lines / f'line_{source:03d}' / 'soundings.csv')
        place(points.moved((east, 0.0, 0.0)), tmp_path / 'runs' / f'line_{k}')
    out = tmp_path / 'out'
    assert run('survey', tmp_path / 'runs', out, '--adjust', '--resolution', 4) == 0
    assumed, sentence = survey_of(out)['warnings']
    assert 'without run.json' in assumed and sentence in capsys.readouterr().err
    assert '2 groups that do not overlap' in sentence and 'priors alone' in sentence


def test_parquet_and_a_coordinate_system(lines, tmp_path):
    csv_tables = pytest.importorskip('pyarrow.csv')
    runs, out = tmp_path / 'runs', tmp_path / 'out'
    folder = runs / 'deep' / 'line'
    folder.mkdir(parents=True)
    table = csv_tables.read_csv(lines / 'line_000' / 'soundings.csv')
    pyarrow_parquet.write_table(table, folder / 'soundings.parquet')
    (folder / 'run.json').write_text(json.dumps({**RECORD, 'epsg': 32632}))
    assert run('survey', runs, out, '--origin', '500000,6000000,1.5', '--resolution', 2) == 0
    _, transform, file = read(out / 'survey.tif')
    assert file.crs.to_epsg() == 32632 and 499_000 < transform.c < 501_000
    coverage = json.loads((out / 'coverage.geojson').read_text())
    east, north = coverage['features'][0]['geometry']['coordinates'][0][0]
    assert east == pytest.approx(9.0, abs=0.01) and north == pytest.approx(54.15, abs=0.05)
    assert run('survey', runs, tmp_path / 'b', '--crs', 32633) == 2


def test_recordings_of_soundings_are_lines_too(lines, made, tmp_path, capsys):
    """As a node publishes them, or as the bag `estimate` of a run has them."""
    runs = tmp_path / 'runs'
    shutil.copytree(lines / 'line_000', runs / 'line_000')
    record(lines / 'line_000', runs / 'line_000' / 'estimate')  # the same line, not another
    record(lines / 'line_001', runs / 'day' / 'line_001')
    record(lines / 'line_002', tmp_path / 'line_002')
    (file,) = (tmp_path / 'line_002').glob('*.mcap')
    shutil.copy(file, runs / 'line_002.mcap')
    record(lines / 'line_003', runs / 'line_003')
    with BagWriter(runs / 'other') as bag:  # not a line, and no mistake
        bag.write('/x', ros_message('std_msgs/msg/Float64', data=1.0), 1)
    assert run('survey', runs, tmp_path / 'out', '--adjust') == 0
    names = [line['name'] for line in survey_of(tmp_path / 'out')['lines']]
    assert names == [f'line_{k:03d}' for k in range(4)]
    depths = (read(out / 'survey.tif')[0]['depth'] for out in (tmp_path / 'out', made))
    assert np.nanmax(np.abs(np.subtract(*depths))) < 1e-3
    # Two sonars in a recording are two lines, which nobody has told apart.
    shutil.rmtree(runs / 'line_003')
    record(lines / 'line_003', runs / 'line_003', '/a/soundings', '/b/soundings')
    capsys.readouterr()
    assert run('survey', runs, tmp_path / 'again') == 0
    assert 'has the topics /a/soundings and /b/soundings' in capsys.readouterr().err


def record(line, bag, *topics):
    points = read_points(line / 'soundings.csv')
    with BagWriter(bag) as writer:
        for stamp in np.unique(points.stamp_ns).tolist():
            rows = points.stamp_ns == stamp
            columns = {**points.columns, **{f'p{name}': points[name] for name in 'xyz'}}
            ping = {name: columns[name][rows].astype(kind) for name, kind in COLUMNS.items()}
            message = write_soundings(Soundings(stamp, 'map', ping), ros_message)
            for topic in topics or ('/bathymetry/soundings',):
                writer.write(topic, message, stamp)


@pytest.mark.parametrize(
    'change, words, said',
    [
        ('none', '', 'holds no line'), ('missing', '', 'is no folder'),
        ('crs', '', 'line_000 is in EPSG 32632 and line_001 in EPSG 32633'),
        ('apart', '--adjust', 'no two lines overlap'),
        ('broken', '', 'no line can be read; the first: '),
        ('', '--resolution 0.001', 'too large'), ('', '--fix other', 'no line other'),
        ('', '--crs 1', 'EPSG number 1'), ('', '--resolution fine', 'neither auto'),
        ('', '--resume --overwrite', 'exclude'),
        ('', '--jobs 2 --scheduler tcp://a:1', 'exclude'),
    ],
)  # fmt: skip
def test_what_cannot_be_done_is_one_sentence_and_writes_nothing(
    lines, tmp_path, capsys, monkeypatch, change, words, said
):
    if '--crs' in words:  # is refused before the work
        monkeypatch.setattr('sonar_imm_tools.survey.making.make', None)
    runs, out = tmp_path / 'runs', tmp_path / 'out'
    if change != 'missing':
        runs.mkdir()
    for k in {'none': (), 'missing': (), 'apart': (0,)}.get(change, (0, 1)):
        line = shutil.copytree(lines / f'line_{k:03d}', runs / f'line_{k:03d}')
        if change == 'crs':
            (line / 'run.json').write_text(json.dumps({**RECORD, 'epsg': 32632 + k}))
        if change == 'broken':
            (line / 'soundings.csv').write_text('stamp_ns,x\n1,2\n')
    assert run('survey', runs, out, *words.split()) in (1, 2)
    error = capsys.readouterr().err
    assert said in error and 'Traceback' not in error and not out.exists()


def test_cells_follow_depth():
    looks = [looks_of(line, 2.0) for line in vectors.lines(vectors.scene())]
    plan = plan_tiles(looks, 0.0)
    assert {tile.cell for tile in plan} <= {0.5, 1.0, 2.0}
    deep = [evolve(each, z=10.0 * each.z) for each in looks]
    assert min(tile.cell for tile in plan_tiles(deep, 0.0)) >= 4.0
    assert len({(tile.cell, tile.i, tile.j) for tile in plan}) == len(plan)
