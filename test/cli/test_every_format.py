# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Every row of the table of formats goes the whole road: convert, info, track, export."""

from pathlib import Path

from helpers.field_files import BAGS, FORMATS, line
import pytest

from sonar_imm_tools.cli import main

TABLE = Path(__file__).resolve().parents[2] / 'docs' / 'reference' / 'formats.md'
OUT = {'diver': 'csv', 'obstacle': 'geojson', 'bathymetry': 'xyz', 'fathometer': 'csv'}
QUICK = {
    'fathometer': ['--set', 'particles=200'],
    'bathymetry': ['--set', 'particles_per_model=50'],
}
NO_NAVIGATION = ('pings.npz', 'survey.bag', 'swath.bag', 'micron.bag')
"""What does not say where on Earth it was; of soundings not even where in metres."""
ARRAY = ['--params', str(BAGS / 'fathometer_pressure' / 'parameters.yaml')]


def test_each_row_of_the_table_has_a_file_here():
    lines = TABLE.read_text().partition('## In')[2].partition('###')[0].splitlines()
    rows = [row.split(' | ')[0].strip('| ') for row in lines if row.startswith('| ')]
    assert rows[1:] == list(dict.fromkeys(each.row for each in FORMATS))


@pytest.mark.parametrize('each', FORMATS, ids=lambda each: each.name)
def test_from_a_file_to_tracks_in_a_file(tmp_path, each, capsys):
    source, run = tmp_path / each.name, tmp_path / 'run'
    count = {'bathymetry': 12, 'obstacle': 60}.get(each.system, 30)
    each.make(source, line(count, each.step))
    bag = source
    if each.kind != 'none':
        bag = tmp_path / 'bag'
        words = [each.kind, str(source)] if each.kind else [str(source)]
        options = [option.format(tmp_path) for option in each.options]
        assert main(['convert', *words, str(bag), *options]) == 0
        assert each.kind or 'is taken for' in capsys.readouterr().err
    # What only describes the ground is for a tracker beside other inputs.
    assert main(['info', str(bag)]) == (0 if each.system else 1)
    printed = capsys.readouterr().out
    if not each.system:
        assert 'fits obstacle ground' in printed
        return
    suggested = printed.split('to track it: sonar-imm ')[1].splitlines()[0]
    assert f'--system {each.system}' in suggested
    words = suggested.replace('OUT_DIR', str(run)).split()
    words += ARRAY if each.name.endswith('.wav') else QUICK.get(each.system, [])
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert f'{each.system} <- ' in printed and 'no track was made' not in printed
    nowhere = each.name in NO_NAVIGATION
    out = tmp_path / f'out.{"csv" if nowhere and each.system == "obstacle" else OUT[each.system]}'
    if nowhere and each.system == 'bathymetry':
        assert main(['export', str(run), str(out)]) == 2
        assert 'the recording has no navigation' in capsys.readouterr().err
        return
    assert main(['export', str(run), str(out)]) == 0
    assert out.stat().st_size > 100
