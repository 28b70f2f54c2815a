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

"""The page: whole, safe, the same each time."""

from html.parser import HTMLParser

from helpers.dive_scenes import single_run
import numpy as np

from msg_adapters.fixes import write_fix
from sonar_imm.measurements import Fix
from sonar_imm_tools.cli import main
from sonar_imm_tools.evaluation.diver.scoring import score
from sonar_imm_tools.evaluation.diver.sections import diver_part, Material
from sonar_imm_tools.evaluation.diver.series import series_of
from sonar_imm_tools.evaluation.diver.truth import Truth
from sonar_imm_tools.evaluation.judging import Check
from sonar_imm_tools.evaluation.page import Card, Section
from sonar_imm_tools.evaluation.report import report_html, run_part
from sonar_imm_tools.recordings.writer import BagWriter, ros_message

RUN = {
    'system': 'diver',
    'bag': '/data/my <dive>.bag',
    'topics': {'/fix': 'fix'},
    'parameters': {'model_set': 'heading_speed', 'speed_mean': 0.75},
    'counts': {'used': 60},
    'versions': {'sonar_imm': '0.1.0'},
    'refused': {'nan': {'count': 3, 'example': '/fix: not <b>finite</b>'}},
}


def material(truth=True, count=60, **changes):
    estimates, true_rows, _ = single_run(count=count)
    series = series_of(estimates)
    known = Truth.from_series(series_of(true_rows)) if truth else None
    return Material(
        run={**RUN, **changes}, metrics=score(series, known), series=series, truth=known
    )


def html(*materials):
    return report_html([diver_part(one) for one in materials])


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
    text = html(material())
    page = Page(text)
    assert page.loads == []
    assert page.headings[:5] == [
        'my <dive>.bag',
        'Map',
        'Error, and the predicted error',
        'Which motion model held',
        'Normalised innovations (NIS)',
    ]
    assert 'Refused input' in page.headings
    assert 'not &lt;b&gt;finite' in text and 'not <b>finite' not in text


def test_the_same_material_makes_the_same_bytes():
    assert html(material()) == html(material())


def test_without_truth_the_stated_uncertainty_is_shown():
    page = Page(html(material(truth=False)))
    assert 'Stated uncertainty' in page.headings
    assert 'Error, and the predicted error' not in page.headings


def test_several_runs_share_a_page_without_sharing_ids():
    page = Page(html(material(), material(bag='other.bag')))
    assert 'other.bag' in page.headings
    figure_ids = [one for one in page.ids if one.startswith('figure-')]
    assert len(figure_ids) == len(set(figure_ids)) == 8


def test_a_run_without_tracks_still_makes_a_page():
    series = series_of([])
    page = Page(html(Material(run=RUN, metrics=score(series), series=series)))
    assert 'Map' in page.headings


def test_checks_against_the_live_node_come_first():
    checks = [Check('bytes', 'equal', 'equal', True)]
    page = Page(report_html([diver_part(material(), checks)]))
    assert page.headings[1] == 'Live node against offline tracker'


def test_runs_of_several_systems_share_a_page():
    other = run_part(
        {**RUN, 'system': 'whale', 'bag': 'whale.bag'},
        {'size': {'rmse_m': 2.0}},
        [],
        summary='A whale.',
        cards=[Card('30 m', 'Length')],
        sections=[Section('Whale', 'Seen from the side.')],
    )
    text = report_html([diver_part(material()), other])
    page = Page(text)
    assert page.headings.index('whale.bag') < page.headings.index('Whale')
    assert 'sonar_imm · diver tracker' in text and 'sonar_imm · whale tracker' in text
    assert 'size.rmse_m' in text


SCRIPT = '<script>alert(1)</script>'


def test_what_a_recording_names_is_text_on_the_page(tmp_path):
    """A topic, a frame, a folder and a refused message that would be a script."""
    bag = tmp_path / 'a<script>alert(1)<script>'
    with BagWriter(bag) as writer:
        for k in range(12):
            fix = Fix(
                stamp_ns=(1_700_000_000 + k) * 10**9,
                position=[0.7 * k, 0.0, 0.0],
                frame_id=SCRIPT,
                covariance=np.eye(2),
            )
            message = write_fix(fix, ros_message)
            if k == 5:
                message.header.frame_id = f'{SCRIPT}_ned'
            writer.write(f'/{SCRIPT}/fix', message, fix.stamp_ns)
    out, page = tmp_path / 'out', tmp_path / 'page.html'
    assert main(['track', str(bag), str(out), '--set', f'map_frame={SCRIPT}']) == 0
    assert main(['evaluate', str(out), '--report', str(page)]) in (0, 1)
    text = page.read_text()
    assert '&lt;script&gt;alert(1)' in text
    assert 'script>alert(1)' not in text
