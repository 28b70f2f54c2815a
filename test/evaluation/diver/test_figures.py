# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The figures of divers: ellipses, order of models, first view."""

from helpers.dive_scenes import covariance, single_run
import numpy as np
from scipy.stats import chi2, norm

from sonar_imm.measurements import Fix
from sonar_imm_tools.evaluation.diver import figures
from sonar_imm_tools.evaluation.diver.scoring import fix_series
from sonar_imm_tools.evaluation.diver.series import match, series_of, Truth
from sonar_imm_tools.evaluation.plotting import view_of


def test_ellipses_hold_the_probability_they_claim():
    covariance = np.array([[[4.0, 1.2], [1.2, 1.0]]])
    mean = np.array([[3.0, -2.0]])
    outline = figures.outlines(mean, covariance, probability=0.9)
    assert np.isnan(outline[-1]).all()
    offset = outline[:-1] - mean
    distance = np.einsum('ni,ij,nj->n', offset, np.linalg.inv(covariance[0]), offset)
    np.testing.assert_allclose(distance, chi2.ppf(0.9, 2), rtol=1e-12)


def test_models_are_ordered_by_heading_with_the_others_below():
    names = ('heading_090', 'hover', 'heading_000')
    assert [names[i] for i in figures.model_order(names)] == [
        'hover',
        'heading_000',
        'heading_090',
    ]
    assert figures.model_label('heading_022') == '22°'


def test_the_same_heading_of_two_families_is_one_row():
    names = ('steady_heading_000', 'steady_hover', 'brisk_heading_000', 'brisk_hover', 'quiet')
    found, added = figures.headings_together(names, np.array([[0.1, 0.2, 0.3, 0.25, 0.15]]))
    assert found == ('heading_000', 'hover', 'quiet')
    np.testing.assert_allclose(added, [[0.4, 0.45, 0.15]])
    alone = figures.headings_together(('heading_000', 'hover'), np.eye(2))
    assert alone[0] == ('heading_000', 'hover')
    np.testing.assert_array_equal(alone[1], np.eye(2))


def test_the_first_view_holds_tracks_and_truth_but_not_the_clutter():
    estimates, true_rows, _ = single_run(count=60)
    truth, clutter = Truth.from_series(series_of(true_rows)), np.array([[500.0, 500.0]])
    series = series_of(estimates)
    fixes = fix_series([Fix(stamp_ns=1, position=[*clutter[0], 0.0])])
    assert fixes.place_covariance.shape == (1, 3, 3)
    figure = figures.map_figure(series, truth, fixes)
    low, high = figure.layout.xaxis.range
    assert low < series.state[:, 0].min() and series.state[:, 0].max() < high < 500.0
    assert figure.layout.yaxis.scaleanchor == 'x'


def test_tracks_have_the_names_of_their_targets():
    estimates, _, _ = single_run(count=20)
    series = series_of(estimates)
    series.target_id[:] = 4
    drawn = figures.map_figure(series, None, None, {'4': 'Schmidt <b>'})
    (track,) = np.unique(series.track_id)
    assert f'Schmidt &lt;b&gt; (track {track})' in {each.name for each in drawn.data}
    section = next(iter(figures.sections({}, series, names={'4': 'Schmidt'})))
    assert f'Schmidt (track {track})' in {each.name for each in section.figure.data}


def test_no_points_leave_the_view_open():
    assert view_of(np.empty((0, 2))) == (None, None)


def test_the_error_of_a_track_is_drawn_over_the_seconds_of_the_run_in_its_band():
    estimates, true_rows, times = single_run(count=60)
    series = series_of(estimates)
    series.track_id[:10] = 6  # another track goes before
    matching = match(series, Truth.from_series(series_of(true_rows)), cutoff=10.0)
    figure = figures.error_figure(matching, 7)
    assert {name for name in figure.to_dict()['layout'] if name.startswith('yaxis')} == {
        'yaxis',
        'yaxis2',
    }
    drawn = figure.data
    lines = [line for line in drawn if line.name == 'error of the track']
    bands = [line for line in drawn if line.name == 'predicted 95 % band']
    assert len(lines) == len(bands) == 2
    for axis, line in enumerate(lines):
        np.testing.assert_allclose(line.x, times[10:], atol=1e-3)
        np.testing.assert_allclose(line.y, matching.error[10:, axis], atol=1e-3)
        half = norm.ppf(0.975) * np.sqrt(covariance()[axis, axis])
        np.testing.assert_allclose(np.sort(bands[axis].y), np.repeat([-half, half], 50), rtol=1e-3)
