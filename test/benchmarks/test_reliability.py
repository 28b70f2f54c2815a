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

"""The tables of docs/reliability.md are those of its results, and what falls short is said."""

import json

from helpers.source import ROOT
import pytest

from benchmarks import reliability

if not (ROOT / 'docs' / 'reliability.md').is_file():
    pytest.skip('these tests read the source tree', allow_module_level=True)

GOOD = {
    'faults': [
        {
            'fault': 'a burst',
            'system': 'diver',
            'recovered': 2,
            'limit': 3,
            'losses': {'count: too_late': 7},
            'traceback': False,
        }
    ],
    'signals': [{'system': 'diver', 'signal': 'SIGINT', 'tried': 20, 'clean': 20, 'why': []}],
    'damage': [{'what': 'full disk', 'tried': 3, 'said': 3, 'silent': 0, 'failed': 0}],
    'flood': [],
    'soak': {
        'diver': {
            'hours': 24.0,
            'messages': 86400.0,
            'memory_mb': 250.0,
            'slope_mb_per_h': 0.01,
            'slope_low': 0.0,
            'slope_high': 0.02,
            'p99_first_ms': 1.0,
            'p99_last_ms': 1.1,
            'uncounted': 0.0,
        }
    },
    'soak_live': {},
    'hostile': {},
}


def test_the_page_says_what_the_results_say():
    parts = json.loads(reliability.RESULT.read_text(encoding='utf-8'))
    page = reliability.PAGE.read_text(encoding='utf-8')
    assert set(reliability.TABLES) == set(reliability.PARTS)
    assert all(f'<!-- reliability: {name} -->' in page for name in reliability.PARTS)
    assert page == reliability.page_of(page, parts), 'run python -m benchmarks.reliability'


def test_a_table_is_made_of_its_part():
    page = 'a\n<!-- reliability: faults -->\nold\n<!-- /reliability -->\nb\n'
    told = reliability.page_of(page, GOOD)
    assert '| a burst |  | 2; 7 too_late |' in told and 'old' not in told
    assert told.startswith('a\n') and told.endswith('b\n')
    assert reliability.page_of(told, GOOD) == told
    assert 'Not measured yet' in reliability.page_of(page, {})


def test_what_is_good_falls_short_of_nothing():
    assert reliability.short_of(GOOD) == []


@pytest.mark.parametrize(
    'part, row, change',
    [
        ('faults', 0, {'recovered': None}),
        ('faults', 0, {'recovered': 4}),
        ('faults', 0, {'traceback': True}),
        ('signals', 0, {'clean': 19}),
        ('damage', 0, {'silent': 1}),
        ('damage', 0, {'failed': 1}),
        ('soak', 'diver', {'slope_low': 1.5}),
        ('soak', 'diver', {'p99_last_ms': 2.5}),
        ('soak', 'diver', {'uncounted': 1.0}),
    ],
)
def test_what_falls_short_is_said(part, row, change):
    spoilt = json.loads(json.dumps(GOOD))
    spoilt[part][row] |= change
    assert len(reliability.short_of(spoilt)) == 1


def test_a_part_that_is_missing_is_said():
    assert reliability.short_of({}) == [f'{name}: not measured' for name in reliability.PARTS]
