# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The stamp gate by cases, the replay history by properties with a step that cannot commute."""

import hashlib

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from sonar_imm.estimation.history import ReplayHistory, StampGate

S = 1_000_000_000
HUNDRED, NEXT, THOUSAND = [*range(100, 200)], [*range(200, 300)], [*range(1000, 2000)]
OUTAGE = *HUNDRED, 260, *range(200, 260), *range(261, 300)
BEYOND = [*range(5 * 10**9 - 50, 5 * 10**9)]
LATE = [*range(1000, 1050)]


def chain(state, stamp_ns, items):
    """A step in which every byte and every order matters."""
    return hashlib.sha256(state + stamp_ns.to_bytes(8, 'big') + b'|'.join(items)).digest()


def run(history, arrivals, step=chain):
    """Insert all in bounded memory; the last word on every stamp, and the verdicts."""
    final, verdicts = {}, []
    for stamp_ns, key in arrivals:
        inserted = history.insert(stamp_ns, key, key, step)
        final.update(inserted.revised)
        verdicts.append(inserted.verdict)
        assert len(history) <= history.window_ns + 1 or history.state_limit
    return final, verdicts


def sorted_truth(arrivals):
    """The same chain, written without a history."""
    state, truth = b'', {}
    for stamp_ns in sorted({stamp for stamp, _ in arrivals}):
        keys = sorted({key for stamp, key in arrivals if stamp == stamp_ns})
        state = truth[stamp_ns] = chain(state, stamp_ns, keys)
    return truth


@st.composite
def bounded_shuffles(draw):
    """Items sent at their stamps that arrive at most `window` later: sorted by stamp + delay."""
    window = draw(st.integers(0, 12))
    item = st.tuples(*(st.integers(0, most) for most in (60, 5, window, 99)))
    sent = draw(st.lists(item, min_size=1, max_size=40))
    sent.sort(key=lambda entry: (entry[0] + entry[2], entry[3]))
    return window, [(stamp, bytes([key])) for stamp, key, _, _ in sent]


@given(bounded_shuffles(), st.sampled_from([None, 4, 9]))
def test_shuffled_inside_the_window_equals_sorted(case, state_limit):
    window, arrivals = case
    final, verdicts = run(ReplayHistory(b'', window, state_limit=state_limit), arrivals)
    assert final == sorted_truth(arrivals)
    assert verdicts.count('used') == len(set(arrivals))
    assert verdicts.count('duplicate') == len(arrivals) - len(set(arrivals))


@given(st.lists(st.integers(0, 400), max_size=150), st.sampled_from([4, 7, 16]))
def test_states_are_bounded_and_any_order_gives_the_same(stamps, limit):
    """Late ones far back need a state that is not kept."""
    few, all_states = ReplayHistory(b'', 300, state_limit=limit), ReplayHistory(b'', 300)
    for stamp_ns in [*range(0, 200, 3), *stamps]:
        key = bytes([stamp_ns % 251])
        item = stamp_ns, key, key, chain
        assert few.insert(*item) == all_states.insert(*item)
        assert limit // 2 < len(few.states) <= limit or len(few) <= limit
    assert few.state == all_states.state and len(few) >= len(all_states)


@given(
    st.lists(st.tuples(st.integers(0, 60), st.binary(max_size=1)), max_size=40), st.integers(0, 12)
)
def test_any_order_equals_the_accepted_items_sorted(arrivals, window):
    history = ReplayHistory(b'', window)
    final, verdicts = run(history, arrivals)
    used = [arrival for arrival, verdict in zip(arrivals, verdicts) if verdict == 'used']
    assert final == sorted_truth(used)
    assert history.state == (sorted_truth(used)[history.newest_ns] if used else b'')


def test_an_item_exactly_at_the_edge_of_the_window_is_used_with_the_right_base():
    arrivals = [(0, b'a'), (4, b'b'), (14, b'c')]
    history = ReplayHistory(b'', 10)
    run(history, arrivals)
    assert history.insert(3, b'late', b'late', chain).verdict == 'too_late'
    edge = history.insert(4, b'edge', b'edge', chain)
    assert edge.verdict == 'used'
    # Revised states come oldest first and end with the newest.
    assert [stamp for stamp, _ in edge.revised] == [4, 14]
    assert edge.revised[-1] == (14, history.state)
    assert history.state == sorted_truth([*arrivals, (4, b'edge')])[14]


def test_a_clock_that_stands_still_cannot_eat_the_memory():
    history = ReplayHistory(b'', 10, scan_limit=3)
    _, verdicts = run(history, [(5, bytes([i])) for i in range(5)])
    assert verdicts == ['used'] * 3 + ['full'] * 2
    assert history.insert(6, b'', b'', chain).verdict == 'used'


def test_a_step_that_raises_leaves_the_history_as_it_was():
    history = ReplayHistory(b'', 10)
    run(history, [(1, b'a'), (5, b'b')])
    before = history.state

    def broken(state, stamp_ns, items):
        if stamp_ns == 5:
            raise ArithmeticError
        return chain(state, stamp_ns, items)

    with pytest.raises(ArithmeticError):
        history.insert(3, b'c', b'c', broken)
    assert (history.state, len(history)) == (before, 2)
    revised = history.insert(3, b'c', b'c', chain).revised
    assert revised[-1][1] == sorted_truth([(1, b'a'), (3, b'c'), (5, b'b')])[5]


def gate(restart_after=3):
    return StampGate(window_ns=10 * S, max_gap_ns=100 * S, restart_after=restart_after)


def decide(stamp_gate, *seconds):
    return [stamp_gate.decide(int(s * S), s) for s in seconds]


@pytest.mark.parametrize('arrivals, verdicts, abandoned', [
    ([1000, 1010, 1000, 1110, 1100], 'uuuuu', 0),  # late by no more than the window
    ([1000, 989.999], 'ul', 0),
    ([1000, 1001, 9_000_000, 1002, 1003], 'uuduu', 1),
    ([1000, 9_000_000, 5, 8_000_000, 600, 7_000_000, 1001], 'udldldu', 3),  # no two agree
    ([s for i in range(20) for s in (1000 + i, 5 + i)], 20 * 'ul', 0),  # good ones between
    ([1000, *[9_000_000] * 50, 1001], 'u' + 50 * 'd' + 'u', 50),  # a scan of many items
])  # fmt: skip
def test_stamps_that_are_off_restart_nothing(arrivals, verdicts, abandoned):
    words = {'u': 'use', 'l': 'too_late', 'd': 'doubtful'}
    decisions = decide(gate(), *arrivals)
    assert [d.verdict for d in decisions] == [words[letter] for letter in verdicts]
    used = [(s,) for s, letter in zip(arrivals, verdicts) if letter == 'u']
    assert [d.released for d in decisions if d.verdict == 'use'] == used
    assert sum(d.abandoned for d in decisions) == abandoned


@pytest.mark.parametrize('restarted', [(5_000_000, 5_000_001, 5_000_002), (5, 7, 6)])
def test_a_restarted_clock_hands_everything_out_again(restarted):
    decisions = decide(gate(), 1000, 1001, *restarted, restarted[-1] + 1)
    assert [d.verdict for d in decisions[-2:]] == ['restart', 'use']
    assert decisions[-2].released == restarted
    assert decisions[-2].reinstated == sum(d.verdict == 'too_late' for d in decisions)
    # An outlying first stamp costs nothing.
    last = decide(gate(), 9_000_000, 1000, 1001, 1002)[-1]
    assert (last.verdict, last.released) == ('restart', (1000, 1001, 1002))


def restarts(decisions):
    return [k for k, d in enumerate(decisions) if d.verdict == 'restart']


def released(decisions):
    return [item for d in decisions for item in d.released]


@pytest.mark.parametrize('restart_after, window', [(3, 0), (5, 10)])
@pytest.mark.parametrize('lateness', [3.0, 30.0, 90.0])
def test_random_lateness_is_no_restart(restart_after, window, lateness):
    random, sent = np.random.default_rng(1), np.arange(1000, 11_000)
    late = random.uniform(size=len(sent)) < 0.1
    arrived = sent[np.argsort(sent + late * lateness * random.uniform(size=len(sent)))]
    decisions = decide(StampGate(window * S, 600 * S, restart_after), *arrived)
    assert restarts(decisions) == []
    assert len(released(decisions)) >= len(sent) - late.sum()


def recording(length, seed=None):
    """Stamps of a recording; with a seed, shuffled by less than the window and one in ten lost."""
    stamps = np.arange(500.0, 500.0 + length)
    if seed is None:
        return stamps
    random = np.random.default_rng(seed)
    stamps = stamps[np.argsort(stamps + 9.0 * random.uniform(size=length), kind='stable')]
    return stamps[random.uniform(size=length) > 0.1]


@pytest.mark.parametrize('length', [30, 1000])
@pytest.mark.parametrize('lossy', [False, True])
def test_a_looped_recording_restarts_each_time_and_loses_nothing(length, lossy):
    arrivals = np.concatenate([recording(length, seed if lossy else None) for seed in range(4)])
    decisions = decide(StampGate(10 * S, 600 * S, 5), *arrivals)
    assert len(restarts(decisions)) == 3
    assert released(decisions) == arrivals.tolist()


def restarts_at(after, arrivals, at, due=None, window=10, gap=600):
    """The restarts are at `at`, and `due` is released; None: everything."""
    decisions = decide(StampGate(window * S, gap * S, after), *arrivals)
    assert restarts(decisions) == at and released(decisions) == list(due or arrivals)
    return True


def test_what_is_late_what_is_a_restart_and_what_comes_of_it():
    for window, after in ((0, 3), (10, 5)):  # a burst of late messages
        burst = [*HUNDRED, *range(165, 170), *NEXT]
        assert restarts_at(after, burst, [], [*HUNDRED, *NEXT], window)
    # What an outage held back; a clock set back a little reaches its old time.
    assert restarts_at(5, OUTAGE, [], [*HUNDRED, 260, *range(250, 260), *range(261, 300)], gap=100)
    back = [*range(1970, 2100)]
    assert restarts_at(5, THOUSAND + back, [], THOUSAND + [*range(1989, 2100)])
    for back in (350, 3600, 10**9):  # one set back beyond any lateness is believed at once
        assert restarts_at(5, BEYOND + [5 * 10**9 - back + i for i in range(10)], [54])
    for rate, n in ((1, 100), (10, 102)):  # one set back inside the stream, after a long run
        stamps = [s + i / rate for s, k in ((1000, 500), (1250, 200)) for i in range(k * rate)]
        assert restarts_at(5, stamps, [500 * rate + n - 1])
    for ahead in (20, 100, 299):  # an outlying first stamp inside the gap is outvoted
        assert restarts_at(5, [1000 + ahead, *LATE], [5], window=5)
    # A stray stamp puts off a restart: the run begins again after it.
    assert restarts_at(5, [1500, *LATE[:20]], [5], window=5)
    decisions = decide(StampGate(5 * S, 600 * S, 5), 1500, *LATE[:3], 3, *LATE[3:20])
    assert restarts(decisions) == [9]


def test_what_is_held_is_bounded():
    stamp_gate = StampGate(window_ns=10, max_gap_ns=100, restart_after=3, hold=4)
    decisions = [stamp_gate.decide(s, None) for s in (1, 900, 900, 900, 900, 900, 2)]
    assert [d.abandoned for d in decisions] == [0, 0, 0, 0, 0, 1, 4]


@st.composite
def clocks(draw):
    """Stamps of clocks that tick, stop, repeat themselves and are set anew."""
    stamps = []
    for _ in range(draw(st.integers(1, 6))):
        start = draw(st.sampled_from([1, 50, 400, 2**40]))
        steps = draw(st.lists(st.sampled_from([-7, -1, 0, 1, 1, 1, 5]), max_size=60))
        stamps += [max(1, start + int(sum(steps[:i]))) for i in range(len(steps))]
    return stamps


@given(
    st.one_of(st.lists(st.integers(1, 2**62), max_size=60), clocks()),
    st.integers(0, 10),
    st.sampled_from([1, 100, 10**9]),
    st.sampled_from([4, 30, 1000]),
)
def test_every_item_has_exactly_one_fate(stamps, window, gap, hold):
    stamp_gate = StampGate(window, gap, 3, max_late_ns=100, hold=hold)
    decisions = [stamp_gate.decide(stamp, stamp) for stamp in stamps]
    too_late = sum((d.verdict == 'too_late') - d.reinstated for d in decisions)
    abandoned = sum(d.abandoned for d in decisions)
    fates = len(released(decisions)), too_late, abandoned, stamp_gate.holding
    assert sum(fates) == len(stamps) and min(fates) >= 0


def test_nonsense_is_refused():
    for change in ({'window_ns': -1}, {'scan_limit': 0}, {'state_limit': 3}):
        with pytest.raises(ValueError, match='a history needs'):
            ReplayHistory(**{'initial': b'', 'window_ns': 0, **change})
    with pytest.raises(ValueError, match='restart_after'):
        StampGate(window_ns=0, max_gap_ns=1, restart_after=0)
