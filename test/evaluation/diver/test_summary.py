"""The sentences about a run of the diver tracker."""

from sonar_imm.evaluation.diver.summary import summary_sentence


def metrics(tracked, raw):
    return {
        'position': {'n': 5, 'rmse_m': tracked},
        'raw_fix': {'n': 5, 'rmse_m': raw},
        'consistency': {'coverage': {'95': 0.95}},
    }


def test_the_raw_fixes_may_be_the_truth_itself():
    assert 'the truth itself' in summary_sentence(metrics(0.5, 0.0))
    assert 'removes 75 %' in summary_sentence(metrics(0.5, 2.0))
    assert 'adds 100 %' in summary_sentence(metrics(2.0, 1.0))
