# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The grid of looks: closed forms, the reference vectors, and surveys with truth."""

import errno
import resource

from attrs import evolve
from helpers import survey_vectors as vectors
import numpy as np
import pytest

from sonar_imm.soundings import COLUMNS
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm_tools.offline.jobs import sentence_of
from sonar_imm_tools.recordings.export.points import Points
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.simulation.survey import budget, scenario, simulate
from sonar_imm_tools.survey import adjustment as module
from sonar_imm_tools.survey import grid as grid_module
from sonar_imm_tools.survey import jobs
from sonar_imm_tools.survey import looks as looks_module
from sonar_imm_tools.survey.adjustment import adjust, Crossing, misties, Priors
from sonar_imm_tools.survey.chart import chart_of, OF_ONE_RUN, write_geotiff
from sonar_imm_tools.survey.grid import grid_of_looks
from sonar_imm_tools.survey.line import BASIS, budget_of, line_of
from sonar_imm_tools.survey.looks import FLOOR, gradients, Looks, looks_of, strips

BUDGET = budget()
HEAVE, OWN = BUDGET.heave**2, 0.04**2


def columns_of(x, y, z, **more):
    """Columns of soundings straight below the array, where attitude and speed of sound do nothing
    much."""
    n = len(x)
    columns = {name: np.zeros(n) for name in COLUMNS}
    given = {'x': x, 'y': y, 'z': z, 'range': np.full(n, 1e-3), **more}
    return columns | {name: np.zeros(n) + np.array(value) for name, value in given.items()}


def line(x, y, z, own=OWN, label=0.0, geometry=0.0):
    variance = {'vertical_uncertainty': own + HEAVE + geometry**2, 'geometry_std': geometry}
    columns = columns_of(x, y, z, label=label, **variance)
    return line_of(Points(np.full(len(x), 5), columns), BUDGET)


def at_a_node(z=-10.0, n=1, **more):
    """A line of n soundings at one place."""
    return line([0.5] * n, [0.5] * n, [z] * n, **more)


def node(parts, **options):
    return grid_of_looks(vectors.together(parts), 1.0, (0, 0, 1, 1), BUDGET, **options)


def test_a_sounding_at_a_node_is_the_node_and_those_of_a_line_share_their_errors():
    """A thousand soundings of one line do not make its heave better known."""
    made = node([at_a_node()])
    assert made.z == pytest.approx([-10.0]) and made.sd == pytest.approx([np.sqrt(OWN + HEAVE)])
    assert made.count.tolist() == made.lines.tolist() == made.hypotheses.tolist() == [1]
    assert np.isnan(made.odds).all() and np.isnan(made.competing_z).all()
    made = node([at_a_node(n=1000)])
    assert made.sd == pytest.approx([np.sqrt(HEAVE + 2.0 * OWN / 1001)], rel=1e-6)
    assert made.sd[0] > BUDGET.heave
    made = node([at_a_node(n=1000, geometry=0.3)])
    assert made.sd == pytest.approx([np.sqrt(HEAVE + 0.3**2)], rel=0.01)
    single = node([at_a_node(geometry=0.3)])
    assert single.sd == pytest.approx([np.sqrt(OWN + HEAVE + 0.3**2)])


@pytest.mark.parametrize('apart, inflated', [(0.0, 1.0), (0.2, None)])
def test_looks_of_two_lines_average(apart, inflated):
    made = node([at_a_node(), at_a_node(-10.0 + apart, own=4.0 * OWN)])
    v, z = np.array([OWN, 4.0 * OWN]) + HEAVE, np.array([-10.0, -10.0 + apart])
    mean = np.average(z, weights=1.0 / v)
    wanted = (inflated or np.sum((z - mean) ** 2 / v)) / np.sum(1.0 / v)
    assert made.z == pytest.approx([mean]) and made.lines.tolist() == [2]
    assert made.sd == pytest.approx([np.sqrt(wanted)])


def test_lines_vote_and_soundings_do_not():
    """Sixty echoes of fish in one line against four soundings of the floor in each of four."""
    made = node([at_a_node(-8.0, 60), *(at_a_node(n=4, label=1.0) for _ in range(4))])
    assert made.z == pytest.approx([-10.0]) and made.lines.tolist() == [4]
    assert made.competing_z == pytest.approx([-8.0]) and made.competing_count.tolist() == [60.0]
    assert made.hypotheses.tolist() == [2] and made.odds[0] > 0.0 and made.label.tolist() == [1]
    assert made.seen_line.tolist() == [1, 2, 3, 4] and made.seen_count.tolist() == [4] * 4
    assert made.seen_residual == pytest.approx([0.0] * 4, abs=1e-9)


def test_an_outlier_that_is_alone_in_its_cell_competes_with_what_lies_around():
    """And stays visible; a cell that nobody saw stays empty, a cell that many saw is as before."""
    x, y = np.array([(0.5, 0.5), (-0.5, 0.5), (1.5, 0.5), (0.5, 1.5), (0.5, -0.5)]).T
    made = node([line(x, y, [-6.0, -10.0, -10.0, -10.0, -10.0])])
    assert made.z == pytest.approx([-10.0]) and made.count.tolist() == [4]
    assert made.competing_z == pytest.approx([-6.0]) and made.competing_count.tolist() == [1.0]
    assert len(node([line(x[1:], y[1:], [-10.0] * 4)]).z) == 0
    many = line([0.5] * 5 + [1.5], [0.5] * 6, [-10.0] * 5 + [-10.2])
    assert node([many]).count.tolist() == [5]


def test_a_slope_is_carried_to_the_node_and_what_is_not_known_of_corrections_added():
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-2.0, 3.0, (2, 400))
    made = node([line(x, y, -10.0 + 0.3 * x - 0.2 * y)])
    assert made.z == pytest.approx([-10.0 + 0.05], abs=0.004)
    parts, covariance = [at_a_node(), at_a_node()], np.zeros((2, 6, 2, 6))
    covariance[:, 3, :, 3] = [[0.09, 0.02], [0.02, 0.01]]
    made = node(parts, covariance=covariance)
    assert made.sd == pytest.approx([np.sqrt((OWN + HEAVE) / 2 + (0.09 + 0.01 + 0.04) / 4)])
    assert node(parts, crossing_rms=0.3).sd == pytest.approx([np.sqrt((OWN + HEAVE) / 2 + 0.09)])


def test_the_order_of_soundings_changes_no_bit_and_tiles_meet_without_a_seam():
    parts = vectors.lines(vectors.scene())[:3]

    def grid(parts, *where):
        return grid_of_looks(vectors.together(parts), 1.0, where, BUDGET)

    first, rng = grid(parts, 60, 40, 20, 20), np.random.default_rng(1)
    mixed = [part.chosen(rng.permutation(len(part))) for part in parts]
    sorted_again = [
        part.chosen(np.lexsort((part.xy[:, 1], part.xy[:, 0], part.stamp_ns))) for part in mixed
    ]
    second = grid(sorted_again, 60, 40, 20, 20)
    assert first.z.tobytes() == second.z.tobytes() and first.sd.tobytes() == second.sd.tobytes()
    # Nor does the number of a line: other numbers only change the order of sums.
    assert grid(parts[::-1], 60, 40, 20, 20).z == pytest.approx(first.z, abs=1e-3)
    whole = grid(parts, 40, 40, 24, 12)
    halves = [grid(parts, x, 40, 12, 12) for x in (40, 52)]
    z, odds = (np.concatenate([getattr(each, n) for each in halves]) for n in ('z', 'odds'))
    assert z == pytest.approx(whole.z, abs=1e-12)
    assert odds == pytest.approx(whole.odds, abs=1e-9, nan_ok=True)


@pytest.fixture(scope='module')
def scene():
    """The reference vectors, their box, and their lines with the corrections of the prototype."""
    data = vectors.scene()
    parts = [part.corrected(c) for part, c in zip(vectors.lines(data), data['estimate'])]
    return data, vectors.box(data), vectors.together(parts)


def centred(error):
    return error - np.nanmedian(error)


def test_the_vectors_with_the_gradients_of_the_prototype(scene, monkeypatch):
    """Its gradients are planes within looks alone, all looks of one weight: with them nine nodes
    in ten are its own, and further from the truth than those of all that looks tell."""

    def planes_within_looks(looks, ix, iy):
        return gradients(evolve(looks, noise=np.full(len(looks), 0.05**2 - FLOOR)), ix, iy)

    data, where, parts = scene
    monkeypatch.setattr(looks_module, 'FURTHEST', 0)
    monkeypatch.setattr(grid_module, 'FEW', 0)
    monkeypatch.setattr(grid_module, 'gradients', planes_within_looks)
    z = vectors.dense(grid_of_looks(parts, 1.0, where, BUDGET), where, 'z')
    assert np.nanmean(np.abs(centred(z - data['adjusted_z'])) < 0.03) > 0.895
    assert np.sqrt(np.nanmean(centred(z - data['truth_z']) ** 2)) > 0.08


def test_the_vectors_with_the_corrections_of_the_prototype(scene):
    data, where, parts = scene
    made = grid_of_looks(parts, 1.0, where, BUDGET)
    z, sd, hypotheses, competing = (
        vectors.dense(made, where, name) for name in ('z', 'sd', 'hypotheses', 'competing_z')
    )
    truth = data['truth_z'].astype(float)
    assert np.isfinite(z).mean() > 0.998
    ours, theirs = centred(z - truth), centred(data['adjusted_z'] - truth)
    rmse = [np.sqrt(np.nanmean(error**2)) for error in (ours, theirs)]
    assert rmse[0] < 0.075 < rmse[1]  # .0674 and .0883
    assert 0.93 < np.nanmean(np.abs(ours) < 2.0 * sd) < 0.985
    # Gradients use neighbouring cells too, so that nodes differ, and are nearer to the truth.
    apart = np.abs(centred(z - data['adjusted_z']))
    assert np.nanmedian(apart) < 0.006 and np.nanmean(apart < 0.03) > 0.84
    assert np.mean((hypotheses > 1) == (data['hypotheses'] > 1)) > 0.98
    # Where the prototype sees a competing depth of some soundings, so does this.
    both = (data['competing_count'] >= 3) & (hypotheses > 1)
    assert both.sum() > 90
    assert np.nanmedian(np.abs(competing - data['competing_z'])[both]) < 0.45


@pytest.mark.statistics
@pytest.mark.parametrize(
    'terrain, slope, cell', [('flat', 0.0, 1.0), ('flat', 0.0, 5.0), ('slope', 0.1, 1.0)]
)
def test_two_sigma_hold_the_truth_of_one_run(terrain, slope, cell):
    """Errors as stated; the mean by soundings was inside in .74 of the cells, by 5 m in .54."""
    shares, values = [], {'terrain': terrain, 'slope': slope, 'length': 200, 'ping_interval': 0.2}
    for seed in range(6):
        made = simulate(scenario('flat', values), seed)
        chart = chart_of(made.points[0], cell, BUDGET, 1500.0)
        rows, columns = chart.shape
        x = chart.west + cell * (np.arange(columns) + 0.5)
        y = chart.north - cell * (np.arange(rows) + 0.5)
        error = -chart.bands['depth'] - made.floor.at(*np.meshgrid(x, y))
        seen = np.isfinite(error)
        shares.append(np.mean(np.abs(error[seen]) < 2.0 * chart.bands['uncertainty'][seen]))
    assert 0.93 < np.mean(shares) < 0.98 and min(shares) > 0.85, shares


def test_the_budget_is_that_of_the_run_and_what_cannot_be_done_is_said_in_a_sentence(tmp_path):
    assert budget_of(None) == (BUDGET, 1500.0)
    parameters = BathymetryConfig().as_dict() | {'heave_std': 0.2, 'sound_speed': 1480.0}
    found, speed = budget_of({'parameters': parameters})
    assert found.heave == 0.2 and found.attitude == BUDGET.attitude and speed == 1480.0
    none = Points(np.zeros(0, np.int64), {name: np.zeros(0) for name in COLUMNS})
    two = Points(np.arange(2), {name: np.array([0.1, 9.0]) for name in COLUMNS})
    for points, cell, words in ((none, 1.0, 'no soundings'), (two, 1e-4, 'too large')):
        with pytest.raises(BagError, match=words):
            chart_of(points, cell, BUDGET, 1500.0)
    pytest.importorskip('rasterio')
    with pytest.raises(BagError, match='EPSG number 1'):
        write_geotiff(tmp_path / 'g.tif', chart_of(two, 1.0, BUDGET, 1500.0), 1, OF_ONE_RUN)


def test_geotiff_is_read_by_rasterio_north_up_in_its_crs(tmp_path):
    rasterio = pytest.importorskip('rasterio')
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0.0, 20.0, 300) + 500_000.0, rng.uniform(0.0, 10.0, 300) + 6_000_000.0
    columns = columns_of(x, y, -20.0 + 0.1 * (x - 5e5), vertical_uncertainty=0.01)
    chart = chart_of(Points(np.arange(300), columns), 1.0, BUDGET, 1500.0)
    write_geotiff(tmp_path / 'g.tif', chart, 32632, OF_ONE_RUN)
    with rasterio.open(tmp_path / 'g.tif') as file:
        assert file.crs.to_epsg() == 32632 and np.isnan(file.nodata)
        assert file.descriptions == OF_ONE_RUN
        assert OF_ONE_RUN[:4] == ('depth', 'uncertainty', 'label', 'count')
        assert file.tags(ns='IMAGE_STRUCTURE')['LAYOUT'] == 'COG'
        depth, uncertainty, label, count = file.read([1, 2, 3, 4])
        row, column = file.index(x[17], y[17])
    assert count[row, column] >= 1
    assert depth[row, column] == pytest.approx(chart.bands['depth'][row, column], rel=1e-6)
    # The floor rises to the east: so do the columns.
    assert np.nanmean(depth[:, 0]) > np.nanmean(depth[:, -1]) + 1.5
    for band in (uncertainty, label):
        assert (np.isfinite(band) == np.isfinite(depth)).all()


# -- what the jobs of a survey keep on the disk


def test_a_table_is_read_as_it_was_kept_or_not_there_with_its_signature(tmp_path):
    """No file may be larger than a kilobyte: a write fails as on a full disk, of which numpy says
    "1630 requested and 448 written"."""
    path, usual = tmp_path / 'looks.npy', resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1024, usual[1]))
        with pytest.raises(OSError, match='too large') as caught:
            jobs._save_table(path, {'z': np.zeros(1000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    assert caught.value.errno == errno.EFBIG
    assert sentence_of(caught.value) == f'{path}: File too large'
    path.with_suffix('.json').write_text('{}')
    with pytest.raises(ValueError, match='shape'):
        jobs._save_table(path, {'a': np.zeros(2), 'b': np.zeros(3)})
    assert not list(tmp_path.iterdir())
    columns = {'stamp_ns': np.arange(3), 'xy': np.arange(6.0).reshape(3, 2)}
    jobs._save_table(path, columns)
    table = np.load(path)
    for name, column in columns.items():
        np.testing.assert_array_equal(table[name], column)


# -- the crossing adjustment beside dense least squares and the reference vectors


def small(seed=1, lines=3, cells=60):
    """Looks of lines over the same cells, all partials known: depth 10 to 14 m, gradient zero."""
    rng, made, n = np.random.default_rng(seed), [], np.zeros(cells, np.int64)
    for k in range(lines):
        side = rng.choice([-1.0, 1.0], cells)
        D, Y = rng.uniform(10.0, 14.0, cells), rng.uniform(3.0, 30.0, cells)
        basis = np.zeros((cells, BASIS))
        basis[:, 0], basis[:, 1] = side * Y, (Y * Y / D - D) / 1500.0
        basis[:, 8] = 0.5 * Y * Y / D
        z = -12.0 + basis[:, 0] * 0.01 + 0.2 * k + basis[:, 1] * 2.0 + rng.normal(0, 0.03, cells)
        looks = Looks(
            cell=2.0, ix=np.arange(cells) * 40,  # far apart: nothing tells a gradient
            iy=n, line=n + k, side=(side < 0.0).astype(np.int64), count=np.full(cells, 9.0),
            time=1e9 + 1000.0 * k + rng.uniform(0.0, 60.0, cells), z=z, basis=basis,
            place=np.zeros((cells, 2)), noise=np.full(cells, 0.03**2),
            moments=np.zeros((cells, 6)),
        )  # fmt: skip
        made.append(looks)
    return made


def dense(made, priors):
    """Partials (m, P) of states and of the floor, heights (m,), their variance, covariance of
    errors in common, by blocks of ten seconds, and of layers, and precision of all that is
    unknown, written down row by row."""
    looks = Looks.joined(made)
    looks = looks.chosen(np.lexsort((looks.side, looks.line, looks.iy, looks.ix)))
    L, m = len(made), len(looks)
    J = np.zeros((m, 3 + 3 * L))
    for row, (b, k) in enumerate(zip(looks.basis, looks.line)):
        J[row, 0] = b[0]
        J[row, 3 + 3 * k : 6 + 3 * k] = 1.0, b[1], b[0]
    line = (priors.line_offset, priors.line_sound_speed, priors.line_roll)
    prior = np.array([priors.roll, priors.pitch, priors.heading, *line * L])
    cell = np.unique(looks.ix, return_inverse=True)[1]
    A = np.hstack([J, -np.eye(cell.max() + 1)[cell]])  # z + J beta = h
    P = np.diag(np.concatenate([prior**-2, np.zeros(A.shape[1] - len(prior))]))
    times = np.floor(looks.time / 10.0)
    same = [each[:, None] == each for each in (looks.line, times)]
    common = BUDGET.attitude**2 * np.outer(J[:, 0], J[:, 0]) + BUDGET.heave**2
    depth = 2.0 * looks.basis[:, 8] - 1500.0 * looks.basis[:, 1]
    layers = module.LAYERS_STD * looks.basis[:, 1] * (depth / np.median(depth) - 1.0)
    v = 0.03**2 / 5.0 + 0.02**2
    return A, looks.z, v, common * same[0] * same[1], np.outer(layers, layers), P, len(prior)


def corrected(made):
    """Statistics of `made` at corrected places: where all is linear, heights and partials."""

    def statistics(corrections):
        level = [np.zeros((len(looks), 2)) for looks in made]
        moves = [module.partials(looks.basis, g, 1500.0) for looks, g in zip(made, level)]
        moved = zip(made, moves, corrections)
        return [evolve(looks, z=looks.z + a @ c) for looks, a, c in moved]

    return statistics


@pytest.fixture
def plain(monkeypatch):
    """One round, no Student weights: what is left is linear."""
    values = {'REWEIGHTINGS': 1, 'ROUNDS': 1, 'NU': 1e12, 'SECOND_ORDER': 0.0}
    for name, value in values.items():
        monkeypatch.setattr(module, name, value)


def test_states_are_generalized_least_squares(plain):
    """Unknown blocks with a prior are errors with a covariance."""
    made, priors = small(), Priors()
    A, z, v, common, layers, P, n = dense(made, priors)
    W = np.linalg.inv(v * np.eye(len(z)) + common + layers)
    N = A.T @ W @ A + P
    wanted = np.linalg.solve(N, -A.T @ W @ z)[:n]
    found = adjust(lambda corrections: made, 3, BUDGET, priors)
    assert found.value == pytest.approx(wanted, rel=1e-6, abs=1e-9)
    # The published standard deviation is the larger of this and the consider one.
    assert (found.std >= np.sqrt(np.diag(np.linalg.inv(N))[:n]) * (1 - 1e-6)).all()


def test_the_consider_covariance_is_that_of_the_plain_estimate(plain):
    made, priors = small(), Priors()
    A, z, v, common, _, P, n = dense(made, priors)
    inverse, V = np.linalg.inv(A.T @ A / v + P), v * np.eye(len(z)) + common
    C = (inverse @ (A.T @ V @ A / v**2 + P) @ inverse)[:n, :n]
    found = adjust(lambda corrections: made, 3, BUDGET, priors, states=False)
    wanted = (inverse @ (-A.T @ z / v))[:n]
    assert found.value == pytest.approx(wanted, rel=1e-6, abs=1e-9)
    assert found.covariance == pytest.approx(C, rel=1e-6, abs=1e-12)


def test_layers_at_a_depth_are_not_taken_for_the_speed_of_all():
    """Where the mean speed grows with the depth, that at the median depth is found."""
    made = small(lines=4, cells=400)
    depth = np.where(np.arange(400) % 10 < 6, 10.0, 18.0)
    for looks in made:
        side = looks.basis[:, 0]
        looks.z[:] -= 2.0 * looks.basis[:, 1]
        looks.basis[:, 1] = (side**2 / depth - depth) / 1500.0
        looks.basis[:, 8] = 0.5 * side**2 / depth
        looks.z[:] += looks.basis[:, 1] * (2.0 + 10.0 * (depth / 10.0 - 1.0))
    plain, found = (adjust(corrected(made), 4, BUDGET, states=states) for states in (False, True))
    off = [np.abs(each.value[each.kind == 4].mean() + 2.0) for each in (plain, found)]
    assert off[0] > 0.6 and off[1] < 0.3


def test_the_level_is_that_of_the_priors():
    found = adjust(corrected(small()), 3, BUDGET)
    offsets = found.kind == 3
    mean = offsets / offsets.sum()
    assert np.sqrt(mean @ found.covariance @ mean) == pytest.approx(0.5 / np.sqrt(3), rel=0.02)
    ((lines, std),) = found.levels()
    assert lines.tolist() == [0, 1, 2] and std == pytest.approx(0.5 / np.sqrt(3), rel=0.02)
    assert found.value[offsets].sum() == pytest.approx(0.0, abs=1e-3)
    # Lines 0.2 m apart come together, whatever their level.
    assert np.diff(found.value[offsets]) == pytest.approx(-0.2, abs=0.06)
    given = module.described(found, ['a', 'b', 'c'])
    rows = {(row['line'], row['name']): row for row in given['parameters']}
    assert given['not_told'][0]['share'] > 0.99 and {line for line, _ in rows} == {*'abc', ''}
    told = rows['', 'pitch_deg']['told']
    assert told == pytest.approx(0.0, abs=1e-6)  # the floor is level: nothing tells it
    # A line whose tide is known holds the level.
    found = adjust(corrected(small()), 3, BUDGET, fixed=[1])
    offsets = found.value[found.kind == 3]
    assert offsets[1] == pytest.approx(0.0, abs=2e-3)
    assert offsets == pytest.approx([0.2, 0.0, -0.2], abs=0.06)
    assert found.std[found.kind == 3].max() < 0.1
    assert found.levels()[0][1] == pytest.approx(module.FIXED, rel=0.1)


def test_rounds_hold_the_totals(monkeypatch):
    """Statistics at corrected places: three rounds end where one does, not at three times it."""
    made = small()
    monkeypatch.setattr(module, 'CLOSE', 1e-6)
    thrice = adjust(corrected(made), 3, BUDGET)
    monkeypatch.setattr(module, 'ROUNDS', 1)
    once = adjust(corrected(made), 3, BUDGET)
    assert thrice.value == pytest.approx(once.value, abs=2e-3)
    assert thrice.rms[-1] < 0.3 * thrice.rms[0] and len(thrice.rms) == 4


def test_lines_that_do_not_overlap_and_misties_of_those_that_do():
    near, far = small(lines=2), small(lines=2)
    moved = [evolve(looks, ix=looks.ix + 10**6, line=looks.line + 2) for looks in far]
    apart = adjust(lambda corrections: near + moved, 4, BUDGET)
    levels = [(lines.tolist(), round(std / 0.5, 2)) for lines, std in apart.levels()]
    assert levels == [([0, 1], 0.71), ([2, 3], 0.71)]
    with pytest.raises(ValueError, match='no two lines'):
        adjust(lambda corrections: [near[0], near[0].chosen(np.zeros(0, np.int64))], 2, BUDGET)
    pairs, cells = misties(small())
    assert set(pairs) == {(0, 1), (0, 2), (1, 2)} and cells == 60
    assert pairs[0, 2].median == pytest.approx(-0.4, abs=0.2) and pairs[0, 2].cells == 60
    assert module.robust_rms(np.array([-1.0, 1.0, 1.0])) == pytest.approx(1.4826)


@pytest.fixture(scope='module')
def of_the_vectors():
    lines = vectors.lines(vectors.scene())
    return [looks_of(line, 2.0).numbered(k) for k, line in enumerate(lines)]


def test_strips_of_the_floor_are_the_floor(of_the_vectors, monkeypatch):
    """What a survey needs at once does not grow with it, and no bit on where strips end."""
    whole, pairs = Crossing.of(of_the_vectors), misties(of_the_vectors)
    monkeypatch.setattr(looks_module, 'LOOKS_AT_ONCE', 6000)
    most = [len(looks) for looks, _ in strips(of_the_vectors)]
    assert len(most) == 4 and max(most) < 10_000
    parts = Crossing.of(of_the_vectors)
    assert parts.cells == whole.cells and misties(of_the_vectors) == pairs
    for name in ('z', 'variance', 'g', 'partials', 'depth'):
        here, there = (
            getattr(each, name)[np.lexsort((each.z, each.time, each.line))]
            for each in (parts, whole)
        )
        assert np.array_equal(here, there), name


def test_a_part_of_the_cells_tells_the_same(of_the_vectors, monkeypatch):
    """Equations of more looks than are wanted are those of every fourth cell."""
    whole = Crossing.of(of_the_vectors)
    monkeypatch.setattr(module, 'MOST_LOOKS', len(whole.z) // 3)
    part = Crossing.of(of_the_vectors)
    assert len(part.z) < 0.3 * len(whole.z) and part.cells == -(-whole.cells // 4)
    assert np.array_equal(np.unique(part.cell), np.arange(part.cells))
    assert part.rms() == pytest.approx(whole.rms(), rel=0.05)


@pytest.mark.parametrize('states', [True, False])
def test_the_vectors(states):
    data = vectors.scene()
    lines = vectors.lines(data)

    def statistics(corrections):
        moved = [line.corrected(c) for line, c in zip(lines, corrections)]
        return [looks_of(line, 2.0).numbered(k) for k, line in enumerate(moved)]

    found = adjust(statistics, 7, BUDGET, states=states)
    truth, prototype = data['corrections'], data['estimate']
    roll, pitch, heading = np.degrees(found.corrections[:, :3].T)
    assert roll == pytest.approx(np.degrees(truth[:, 0]), abs=0.05)
    assert np.sqrt(np.mean((roll - np.degrees(prototype[:, 0])) ** 2)) < 0.02
    assert abs(pitch[0]) < 0.35 and abs(heading[0]) < 0.11
    offset, speed = found.corrections[:, 3], found.corrections[:, 4] - 4.0
    for other in (truth[:, 3], prototype[:, 3]):
        assert np.std(offset - other) < 0.025
    assert np.sqrt(np.mean(speed**2)) < (0.5 if states else 1.0)
    assert np.sqrt(np.mean((speed / found.std[found.kind == 4]) ** 2)) < 1.5
    # The level is not told: the true one lies inside two stated standard deviations.
    mean = (found.kind == 3) / 7.0
    level = np.sqrt(mean @ found.covariance @ mean)
    assert level == pytest.approx(0.5 / np.sqrt(7.0), rel=0.02)
    assert found.rms[-1] < 0.2 * found.rms[0]
