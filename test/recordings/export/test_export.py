# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

import numpy as np
import pytest

from sonar_imm.estimates import PLACES
from sonar_imm.soundings import COLUMNS
from sonar_imm_tools.recordings.export.points import Points, read_points, write_las, write_xyz
from sonar_imm_tools.recordings.sources import BagError


def points(n=300, seed=2):
    rng = np.random.default_rng(seed)
    columns = {name: rng.uniform(0.1, 1.0, n) for name in COLUMNS}
    columns['x'], columns['y'] = rng.uniform(-5.0, 20.0, n), rng.uniform(3.0, 13.0, n)
    columns['z'] = -20.0 + 0.1 * columns['x']
    columns['vertical_uncertainty'] = rng.uniform(0.01, 0.04, n)
    columns['label'] = rng.integers(0, 2, n).astype(float)
    columns['side'] = rng.integers(0, 2, n).astype(float)
    columns['intensity'] = rng.uniform(-30.0, 20.0, n)
    stamps = 1_700_000_000_000_000_000 + 1_000_000_000 * rng.integers(0, 10, n)
    return Points(stamps, columns)


def test_xyz_is_read_by_numpy(tmp_path):
    item = points()
    write_xyz(tmp_path / 'a.xyz', item)
    table = np.loadtxt(tmp_path / 'a.xyz')
    for k, name in enumerate('xyz'):
        assert table[:, k] == pytest.approx(item[name], abs=5.1e-4)
    assert table[:, 3] == pytest.approx(np.sqrt(item['vertical_uncertainty']), abs=5.1e-4)


@pytest.mark.parametrize('name', ['a.las', 'a.laz'])
def test_las_is_read_by_laspy(tmp_path, name):
    laspy = pytest.importorskip('laspy')
    item = points().moved((500_000.0, 6_000_000.0, 0.0))
    write_las(tmp_path / name, item, 32632)
    las = laspy.read(tmp_path / name)
    for axis in 'xyz':
        assert np.asarray(las[axis]) == pytest.approx(item[axis], abs=5.1e-4)
    for extra in ('vertical_uncertainty', 'horizontal_uncertainty', 'beam_angle', 'range'):
        assert np.asarray(las[extra]) == pytest.approx(item[extra].astype(np.float32))
    assert np.asarray(las.user_data) == pytest.approx(item['label'])
    assert np.asarray(las.point_source_id) == pytest.approx(item['side'])
    decibels = np.asarray(las.intensity) / 100.0 + item['intensity'].min()
    assert decibels == pytest.approx(item['intensity'], abs=0.0051)
    assert set(las.classification) == {40}
    wkt = [vlr for vlr in las.header.vlrs if 'Wkt' in type(vlr).__name__]
    assert 'UTM zone 32N' in wkt[0].string and las.header.global_encoding.wkt
    if name.endswith('laz'):
        write_las(tmp_path / 'b.las', item, 32632)
        assert (tmp_path / name).stat().st_size < (tmp_path / 'b.las').stat().st_size


@pytest.mark.parametrize(
    'text, word',
    [
        ('stamp_ns,x,y\n', 'no column z and'),
        (','.join(['stamp_ns', *COLUMNS]) + '\n1,2\n', 'not numbers'),
        (','.join(['stamp_ns', *COLUMNS]) + '\n' + ','.join(['a'] * 12) + '\n', 'not numbers'),
    ],
)
def test_broken_tables_are_refused(tmp_path, text, word):
    path = tmp_path / 'soundings.csv'
    path.write_text(text)
    with pytest.raises(BagError, match=word):
        read_points(path)
    with pytest.raises(BagError, match='cannot be read'):
        read_points(tmp_path / 'none.csv')


@pytest.mark.parametrize('exact', [True, False])
def test_places_of_a_table_are_the_exact_ones_where_it_has_them(tmp_path, exact):
    names = [name for name in COLUMNS if exact or name not in PLACES]
    row = dict.fromkeys(names, '1') | {'x': '500000.0', 'px': '500000.001'}
    lines = [','.join(['stamp_ns', *names]), ','.join(['7', *(row[name] for name in names)])]
    (tmp_path / 'soundings.csv').write_text('\n'.join(lines) + '\n')
    read = read_points(tmp_path / 'soundings.csv')
    assert read['x'].tolist() == [500000.001 if exact else 500000.0]
    assert not set(PLACES) & set(read.columns)
