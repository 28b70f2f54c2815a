"""The page: whole, safe, the same each time."""

from html.parser import HTMLParser

from dive_scenes import single_run
import numpy as np
import pytest
from scipy.stats import chi2

from sonar_imm.evaluation import figures
from sonar_imm.evaluation.report import belief_sentence, report_html, ReportInput
from sonar_imm.evaluation.scoring import fix_series, score
from sonar_imm.evaluation.series import series_of
from sonar_imm.evaluation.truth import Truth
from sonar_imm.measurements import Fix

RUN = {'system': 'diver', 'bag': '/data/my <dive>.bag', 'topics': {'/fix': 'fix'},
       'parameters': {'model_set': 'heading_speed', 'speed_mean': 0.75},
       'counts': {'used': 60}, 'versions': {'sonar_imm': '0.1.0'},
       'refused': {'nan': {'count': 3, 'example': '/fix: not <b>finite</b>'}}}


def material(truth=True, count=60, **changes):
    estimates, true_rows, _ = single_run(count=count)
    series = series_of(estimates)
    known = Truth.from_series(series_of(true_rows)) if truth else None
    return ReportInput(run={**RUN, **changes}, metrics=score(series, known), series=series,
                       truth=known)


class Page(HTMLParser):
    """Headings, ids and whatever the page would load from elsewhere."""

    def __init__(self, text):
        super().__init__()
        self.headings, self.ids, self.loads, self._open = [], [], [], None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.ids += [attributes['id']] if 'id' in attributes else []
        self.loads += [attributes[name] for name in ('src', 'href') if name in attributes]
        self._open = tag

    def handle_data(self, data):
        if self._open in ('h1', 'h2'):
            self.headings.append(data)
            self._open = None


def test_the_page_is_whole_and_loads_nothing():
    text = report_html(material())
    page = Page(text)
    assert page.loads == []
    assert page.headings[:5] == ['my <dive>.bag', 'Map', 'Error, and the error it predicted',
                                 'Which motion model held', 'Surprise of each measurement (NIS)']
    assert 'Refused input' in page.headings
    assert 'not &lt;b&gt;finite' in text and 'not <b>finite' not in text


def test_the_same_material_makes_the_same_bytes():
    assert report_html(material()) == report_html(material())


def test_without_truth_the_stated_uncertainty_is_shown():
    page = Page(report_html(material(truth=False)))
    assert 'Stated uncertainty' in page.headings
    assert 'Error, and the error it predicted' not in page.headings


def test_several_runs_share_a_page_without_sharing_ids():
    page = Page(report_html(material(), material(bag='other.bag')))
    assert 'other.bag' in page.headings
    figure_ids = [one for one in page.ids if one.startswith('figure-')]
    assert len(figure_ids) == len(set(figure_ids)) == 8


def test_a_run_without_tracks_still_makes_a_page():
    series = series_of([])
    page = Page(report_html(ReportInput(run=RUN, metrics=score(series), series=series)))
    assert 'Map' in page.headings


def test_checks_against_the_live_node_come_first():
    one = material()
    checks = ({'name': 'bytes', 'result': 'equal', 'wanted': 'equal', 'good': True},)
    page = Page(report_html(ReportInput(run=one.run, metrics=one.metrics, series=one.series,
                                        checks=checks)))
    assert page.headings[1] == 'Live node against offline tracker'


@pytest.mark.parametrize('coverage, words', [(0.6, 'more sure'), (0.95, 'can be believed'),
                                             (1.0, 'more careful')])
def test_belief_is_put_in_words(coverage, words):
    assert words in belief_sentence(coverage)


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
    assert [names[i] for i in figures.model_order(names)] == ['hover', 'heading_000',
                                                              'heading_090']
    assert figures.model_label('heading_022') == '22°'


@pytest.mark.parametrize('count, most', [(0, 10), (10, 10), (11, 10), (99, 10)])
def test_thinning_keeps_at_most_what_it_says(count, most):
    left = len(np.arange(count)[figures.thin(count, most)])
    assert left <= most and left >= min(count, most // 2)


def test_the_first_view_holds_tracks_and_truth_but_not_the_clutter():
    estimates, true_rows, _ = single_run(count=60)
    truth, clutter = Truth.from_series(series_of(true_rows)), np.array([[500.0, 500.0]])
    series = series_of(estimates)
    fixes = fix_series([Fix(stamp_ns=1, position=[*clutter[0], 0.0])])
    figure = figures.map_figure(series, truth, fixes)
    low, high = figure.layout.xaxis.range
    assert low < series.state[:, 0].min() and series.state[:, 0].max() < high < 500.0
    assert figure.layout.yaxis.scaleanchor == 'x'


def test_no_points_leave_the_view_open():
    assert figures.view_of(np.empty((0, 2))) == (None, None)
