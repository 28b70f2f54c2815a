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

"""Playing under control: pace, pause, jumps, rate, the end and loops."""

import threading
import time

import pytest

from sonar_imm_tools.viewing.material import Shown
from sonar_imm_tools.viewing.playback import Playback, Status

STEP = 20_000_000
FIRST = 1_700_000_000 * 10**9
TIMES = [FIRST + k * STEP for k in range(20)]
LIMIT = 120.0


class Played:
    """A playback of twenty messages 20 ms apart in a thread of its own."""

    def __init__(self, **options):
        self.playback = Playback(TIMES[0], TIMES[-1], **options)
        self.received, self.states, self.times = [], [], []
        self._thread = threading.Thread(
            target=self.playback.run,
            args=(messages, self._hear, self.times.append, self.states.append),
        )

    def _hear(self, shown):
        self.received.append((shown.log_ns, time.monotonic()))

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.playback.stop()
        self._thread.join(LIMIT)
        assert not self._thread.is_alive()

    def wait(self, predicate):
        end = time.monotonic() + LIMIT
        while not predicate():
            assert time.monotonic() < end
            time.sleep(0.002)

    @property
    def stamps(self):
        return [stamp for stamp, _ in self.received]


def messages(from_ns):
    """The newest message before `from_ns`, then those from it on."""
    earlier = [stamp for stamp in TIMES if stamp < from_ns][-1:]
    return [Shown('/fix', t, b'') for t in earlier + [t for t in TIMES if t >= from_ns]]


def test_nothing_is_played_before_it_is_asked_for():
    with Played() as played:
        time.sleep(0.1)
        assert played.received == [] and played.states == []


def test_it_plays_in_order_and_never_early():
    with Played() as played:
        begin = time.monotonic()
        state = played.playback.change(play=True)
        assert (state.status, state.now_ns, state.jumped) == (Status.PLAYING, FIRST, False)
        played.wait(lambda: played.states)
    assert played.stamps == TIMES
    for stamp, when in played.received:
        assert when - begin >= (stamp - FIRST) / 1e9 - 1e-3
    assert played.states[-1].status is Status.ENDED and played.states[-1].now_ns == TIMES[-1]
    assert played.times == sorted(played.times) and played.times[-1] <= TIMES[-1]
    assert len(played.times) < 2 * len(TIMES)  # it waits for the next one, and does not poll


def least(rate, measured):
    """The least of five turns at a rate, given when it began: a busy machine may be late with
    some."""
    found = []
    for _ in range(5):
        with Played(rate=rate) as played:
            begin = time.monotonic()
            played.playback.change(play=True)
            played.wait(lambda: played.states)
            found.append(measured(played, begin))
        assert played.stamps == TIMES
    return min(found)


def test_a_higher_rate_shortens_it():
    took = least(1000.0, lambda played, begin: time.monotonic() - begin)
    assert took < 0.38 / 2  # at rate 1 it takes .38 s


def test_at_any_rate_messages_are_on_time():
    def late(played, begin):
        return max(when - begin - (t - FIRST) / 1e10 for t, when in played.received)

    assert least(10.0, late) < 0.02


def test_a_pause_holds_the_time():
    with Played() as played:
        played.playback.change(play=True)
        played.wait(lambda: len(played.received) > 3)
        paused = played.playback.change(play=False)
        assert paused.status is Status.PAUSED
        count = len(played.received)
        time.sleep(0.15)
        assert len(played.received) <= count + 1  # one may have been on its way
        assert played.playback.change(play=False).now_ns == paused.now_ns
        played.playback.change(play=True, rate=100.0)
        played.wait(lambda: played.states)
    assert played.stamps == TIMES


def test_a_jump_shows_the_newest_before_also_while_paused():
    with Played() as played:
        state = played.playback.change(play=False, seek_ns=TIMES[7] + 1)
        assert (state.now_ns, state.jumped, state.status) == (TIMES[7] + 1, True, Status.PAUSED)
        played.wait(lambda: played.received)
        time.sleep(0.05)
        assert played.stamps == [TIMES[7]]
        played.playback.change(play=True, rate=100.0)
        played.wait(lambda: played.states)
    assert played.stamps == TIMES[7:]


@pytest.mark.parametrize(('asked', 'got'), [(0, FIRST), (2**62, TIMES[-1])])
def test_a_jump_stays_inside(asked, got):
    with Played() as played:
        assert played.playback.change(play=False, seek_ns=asked).now_ns == got


def test_playing_on_from_the_end_begins_anew():
    with Played(rate=1000.0) as played:
        played.playback.change(play=True)
        played.wait(lambda: played.states)
        assert played.playback.change(play=False).status is Status.ENDED
        state = played.playback.change(play=True)
        assert state.jumped and state.now_ns == FIRST
        played.wait(lambda: len(played.states) == 2)
    assert played.stamps == TIMES * 2


def test_a_loop_says_that_it_jumped():
    with Played(rate=1000.0, loop=True) as played:
        played.playback.change(play=True)
        played.wait(lambda: len(played.states) >= 2)
    first = played.states[0]
    assert first.status is Status.PLAYING and first.jumped and first.now_ns == FIRST
    assert played.stamps[: 2 * len(TIMES)] == TIMES * 2


@pytest.mark.parametrize('rate', [0.0, -1.0, float('nan'), float('inf')])
def test_a_rate_that_makes_no_sense_is_not_taken(rate):
    with Played(rate=2.0) as played:
        assert played.playback.change(play=False, rate=rate).rate == 2.0
