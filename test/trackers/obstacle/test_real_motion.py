"""Real motion under simulated detections (semi-synthetic): the stated band holds what it says."""

import pytest

from benchmarks.real_navigation import data_folder, dead_reckoned, summary


@pytest.mark.skipif(
    not (data_folder() / 'dvl.csv').exists(),
    reason='the recorded navigation is not there (SONAR_IMM_DATA)',
)
def test_the_band_holds_the_offset_under_real_motion():
    found = summary(dead_reckoned(data_folder()), runs=20)
    assert found['tracked'] == 20
    assert found['band_coverage'] >= 0.8
    assert found['nees'] < 2.0
    # It knows more than where obstacles are drawn, and than its own first answer.
    assert found['rmse_m'] < 0.9 * min(found['answering_zero_rmse_m'], found['spread_of_truth_m'])
    assert found['rmse_m'] < 0.9 * found['first_answer_rmse_m']
