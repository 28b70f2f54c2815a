"""One frame for one tracker."""

import pytest

from msg_adapters.frames import FrameGuard
from sonar_imm.measurements import Fix, Rejection


def fix(frame_id):
    return Fix(stamp_ns=1, position=(0.0, 0.0, 0.0), frame_id=frame_id)


def refused(guard, frame_id):
    with pytest.raises(Rejection) as caught:
        guard.check(fix(frame_id))
    return caught.value


def test_the_first_named_frame_stays():
    guard = FrameGuard()
    guard.check(fix(''))
    guard.check(fix('map'))
    guard.check(fix('map'))
    rejection = refused(guard, 'odom')
    assert rejection.reason == 'frame'
    assert rejection.sentence == "the frame 'odom' is not the frame 'map' of the tracks"
    refused(guard, '')


def test_reset_lets_the_next_one_decide():
    guard = FrameGuard()
    guard.check(fix('map'))
    guard.reset()
    guard.check(fix('odom'))
    refused(guard, 'map')


def test_a_told_frame_holds_from_the_start_and_survives_reset():
    guard = FrameGuard('harbour')
    refused(guard, 'map')
    guard.reset()
    refused(guard, '')
    guard.check(fix('harbour'))
