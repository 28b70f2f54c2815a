# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import numpy as np
import pytest
from scipy.optimize import least_squares

from msg_adapters.arrivals import read_arrivals
from sonar_imm_tools.recordings.convert import convert_arrivals
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError

RECEIVERS = 'receiver,x,y,depth\n0,0,0,1\n1,10,0,2\n2,0,20,3\n'


@pytest.fixture
def convert(tmp_path):
    def run(text, receivers=RECEIVERS, transmitters=None, **options):
        for name, content in (('in', text), ('rx', receivers), ('tx', transmitters)):
            if content is not None:
                (tmp_path / f'{name}.csv').write_text(content)
        if transmitters is not None:
            options['transmitters'] = tmp_path / 'tx.csv'
        return convert_arrivals(
            tmp_path / 'in.csv', tmp_path / 'out', receivers=tmp_path / 'rx.csv', **options
        )

    return run


def pings_of(path):
    with BagReader(path) as bag:
        return [item.measurement for item in measurements_of(bag, 'diver')]


def test_one_way_arrivals_are_stamped_with_the_earliest(convert):
    report = convert('ping,receiver,arrival_s\n7,1,100.250\n8,0,105\n7,0,100.125\n', toa_std=0.001)
    first, second = pings_of(report.path)
    assert first.stamp_ns == 100_125_000_000 and first.passive
    assert first.rx_id.tolist() == [1, 0] and first.toa.tolist() == [0.125, 0.0]
    assert first.rx.tolist() == [[10, 0, -2], [0, 0, -1]]
    assert first.var_toa == pytest.approx([1e-6, 1e-6]) and np.isnan(first.bearing).all()
    assert len(second) == 1 and second.stamp_ns == 105 * 10**9
    assert 'earliest arrival' in report.notes['emission']


def test_travel_times_from_transmitters(convert):
    report = convert(
        'stamp,tx,rx,toa_ms,std_toa,bearing,std_bearing\n'
        '5,A,1,12.5,1e-4,0.5,0.1\n5,A,0,10,,,\n6,B,2,7,,,\n',
        transmitters='transmitter,x,y,z\nA,1,2,3\nB,4,5,6\n',
    )
    first, second = pings_of(report.path)
    assert first.stamp_ns == 5 * 10**9 and not first.passive
    assert first.tx.tolist() == [[1, 2, 3], [1, 2, 3]] and second.tx.tolist() == [[4, 5, 6]]
    assert first.tx_id.tolist() == [1, 1] and second.tx_id.tolist() == [2]
    assert first.toa == pytest.approx([0.0125, 0.010])
    assert first.var_toa[0] == pytest.approx(1e-8) and np.isnan(first.var_toa[1])
    assert first.bearing[0] == 0.5 and first.var_bearing[0] == pytest.approx(0.01)
    assert np.isnan(first.bearing[1])


def test_transmitters_may_be_among_the_receivers(convert):
    (ping,) = pings_of(convert('stamp,transmitter,receiver,toa\n5,2,1,0.1\n').path)
    assert ping.tx.tolist() == [[0, 20, -3]] and ping.tx_id.tolist() == [2]


def test_elevation_and_the_depth_a_diver_reports_are_kept(convert):
    report = convert(
        'stamp,transmitter,receiver,toa,elevation,std_elevation,depth,std_depth\n'
        '5,2,1,0.1,-0.2,0.01,11.5,0.2\n'
    )
    (ping,) = pings_of(report.path)
    assert ping.elevation.tolist() == [-0.2] and ping.depth.tolist() == [11.5]
    assert ping.var_elevation[0] == pytest.approx(1e-4)
    assert ping.var_depth[0] == pytest.approx(0.04)


def test_bad_rows_are_named(convert):
    report = convert(
        'ping,receiver,arrival\n1,0,5\n1,9,5\n,0,5\n1,1,x\n',
        receivers=RECEIVERS + '2,5,5,5\n,1,1,1\n3,x,1,1\n',
    )
    assert report.bad_rows == 6 and len(pings_of(report.path)) == 1
    text = ' / '.join(report.problems)
    for words in (
        "line 5: receiver '2' is listed twice",
        'line 6: the receiver has no name',
        "line 7: x is 'x'",
        "line 3: the position of receiver '9'",
        'line 4: the ping is empty',
        "line 5: arrival is 'x'",
    ):
        assert words in text


def test_named_receivers_are_numbered_and_told(convert):
    report = convert(
        'ping,receiver,arrival\n1,north,5\n1,south,6\n',
        receivers='name,x,y\nsouth,0,0\nnorth,0,9\n',
    )
    assert pings_of(report.path)[0].rx_id.tolist() == [2, 1]
    assert report.notes['receivers'] == 'south = 1, north = 2'


@pytest.mark.parametrize(
    'text, receivers, words',
    [
        ('a,b\n', RECEIVERS, 'no column for receiver'),
        ('receiver,foo\n', RECEIVERS, 'no column for ping and arrival'),
        ('transmitter,receiver,toa\n', RECEIVERS, 'no column for stamp'),
        ('ping,receiver,arrival\n', 'receiver,x\n', 'no column for y'),
        ('ping,receiver,arrival\n', 'receiver,x,y\n', 'lists no receiver'),
        ('ping,receiver,arrival\n', RECEIVERS, 'nothing that could be converted'),
    ],
)
def test_files_of_another_kind_are_explained(convert, text, receivers, words):
    with pytest.raises(BagError, match=words):
        convert(text, receivers)


def test_the_real_arrivals_lead_back_to_the_fixes(real_data, tmp_path):
    folder = real_data / 'yaps_ssu1'
    report = convert_arrivals(
        folder / 'arrivals.csv',
        tmp_path / 'bag',
        receivers=folder / 'receivers.csv',
        truth=folder / 'gps_truth.csv',
    )
    assert report.messages == {'/arrivals': 123, '/truth/estimate': 450} and not report.bad_rows
    pings = pings_of(report.path)
    assert sum(len(ping) for ping in pings) == 2008 and all(ping.passive for ping in pings)
    fixes = np.loadtxt(folder / 'fixes.csv', delimiter=',', skiprows=1)
    ping = min(pings, key=lambda item: abs(item.stamp_ns * 1e-9 - fixes[5, 0]))

    def residuals(unknown):
        where = np.array([unknown[0], unknown[1], -1.0])
        return np.linalg.norm(ping.rx - where, axis=1) / 1545.0 + unknown[2] / 1545.0 - ping.toa

    solved = least_squares(residuals, [80.0, -80.0, 0.0], loss='soft_l1', f_scale=1e-3).x
    assert np.hypot(*(solved[:2] - fixes[5, 1:3])) < 1.0  # the fixes are another robust solution


def test_a_tag_that_is_named_keeps_its_number(tmp_path):
    (tmp_path / 'rx.csv').write_text('receiver,x,y\n1,0,0\n2,50,0\n3,0,50\n')
    rows = [
        f'{ping},{tag},{receiver},{100 + ping + 0.01 * receiver}'
        for ping in (1, 2)
        for tag in ('amy', 'bob')
        for receiver in (1, 2, 3)
    ]
    text = '\n'.join(['ping,tag,receiver,arrival', *rows]) + '\n'
    (tmp_path / 'toa.csv').write_text(text)
    report = convert_arrivals(
        tmp_path / 'toa.csv', tmp_path / 'bag', receivers=tmp_path / 'rx.csv'
    )
    assert report.messages == {'/arrivals': 4}
    assert report.notes['tag'] == 'amy is 1, bob is 2'
    with BagReader(tmp_path / 'bag') as bag:
        pings = [read_arrivals(item.message) for item in bag.messages()]
    assert sorted(ping.tx_id[0] for ping in pings) == [1, 1, 2, 2]
    assert all(ping.passive and len(set(ping.tx_id.tolist())) == 1 for ping in pings)
