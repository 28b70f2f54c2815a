# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What /diagnostics says, from invented histories and from a real node."""

from collections import Counter
import time

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from helpers.node_bench import a_fix, FIX, Rig, values_of
import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy

from msg_adapters.inputs import inputs_of, needed
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.diagnostics import clock_offset, Meter, Reporter, Stamp, summary
from sonar_imm.nodes.qos import latched_qos, output_qos


class Desk:
    """A reporter whose clock the test sets."""

    def __init__(self, rise=1, fall=1, **wanted):
        self.meter = Meter()
        topics = {name: f'/{name}' for name in ('arrivals', 'altitude', 'nav')}
        topics = {'fix': '/usbl/fix', **topics}
        self.reporter = Reporter(
            *('diver', topics, self.meter),
            **{'one_of': ('fix', 'arrivals'), 'rise': rise, 'fall': fall, **wanted},
        )

    def report(self, now, **changes):
        state = {
            'enabled': True, 'stale_after': 5.0, 'counts': Counter(used=3),
            'health': {'NIS': 1.5}, 'lost': {}, 'incompatible': {}, **changes,
        }  # fmt: skip
        message = self.reporter.report(Time(sec=9), now, **state)
        assert message.header.stamp.sec == 9
        self.input, self.tracker = message.status
        self.values = {pair.key: pair.value for status in message.status for pair in status.values}

    def follow(self, now, *, fix=(), refused=(), dropped=0, spent=(), says=(), **given):
        """What is heard and measured until `now`, a report, and what it has to say: levels,
        `values`, and words of each entry. estimates: how many, their age, how long they waited,
        and the period of messages."""
        count, age, wait, *period = given.pop('estimates', (0, 0.0, 0.0))
        for k in range(count, 0, -1):
            then = now - k * (period[0] if period else 0.1)
            self.meter.arrived('fix', then)
            self.meter.estimates.published(then, age, wait)
        for name in ('fix', 'arrivals', 'altitude', 'nav'):
            for second in fix if name == 'fix' else given.pop(name, ()):
                self.meter.arrived(name, second)
        for reason in refused:
            self.meter.refuse('fix', reason)
        for seconds in spent:
            self.meter.spent(seconds)
        self.meter.dropped['fix'] += dropped
        levels = {name: given.pop(name) for name in ('input', 'tracker') if name in given}
        values = given.pop('values', {})
        self.report(now, **given)
        for name, level in levels.items():
            entry = getattr(self, name)
            assert entry.level == level, (now, name, entry.message)
        assert values.items() <= self.values.items()
        said = f'{self.input.message}|{self.tracker.message}'
        assert all(words in said for words in ([says] if isinstance(says, str) else says)), said


OK, WARN = DiagnosticStatus.OK, DiagnosticStatus.WARN
ERROR, STALE = DiagnosticStatus.ERROR, DiagnosticStatus.STALE
FINE = {'input': OK, 'tracker': OK}
USED = 'not used: too_late'
HISTORIES = {
    'each input that is needed alone': [
        {'now': 19.5, 'fix': range(20), 'input': STALE, 'tracker': STALE,
         'says': 'no message yet on /nav|waiting for input: no message yet on /nav'},
        {'now': 21.0, 'nav': [20.0], **FINE},
        {'now': 29.5, 'fix': range(21, 30), 'input': STALE,
         'says': 'no message for 9.5 s on /nav|'},
    ],
    # Two publishers that disagree by three seconds: every other message is too late.
    'a share of messages of no use, forgotten after a while': [
        {'now': k + 1.0, 'fix': k + np.arange(10) / 10.0,
         'counts': Counter(used=10 * (k + 1) - (n := 5 * min(max(k - 9, 0), 10)), too_late=n),
         **({'tracker': OK} if k < 10 or k >= 29 else {}),
         **({'tracker': WARN, 'says': USED} if 12 <= k < 20 else {})}
        for k in range(40)
    ],
    'estimates of a node that is too slow': [
        {'now': 0.0},
        {'now': 10.0, 'estimates': (100, 20.3, 20.2), 'dropped': 30},
        {'now': 10.1, 'lost': {'fix': 70}, 'tracker': WARN,
         'says': ['estimates are 20.2 s old: input comes faster', '100 of 170 messages lost'],
         'values': {'age of estimates p50 [s]': '20.3', 'waited in the queue p50 [s]': '20.2'}},
    ],
    'old estimates, over when nothing comes': [
        {'now': 5.0, 'estimates': (50, 20.0, 19.0), 'tracker': WARN, 'says': ' old'},
        {'now': 20.0, 'stale_after': 60.0, 'tracker': OK},
    ],
    'a slow publisher, judged by its period': [
        {'now': 60.0, 'estimates': (12, 8.0, 0.01, 5.0), 'stale_after': 60.0, 'tracker': OK},
        {'now': 120.0, 'estimates': (12, 16.0, 0.01, 5.0), 'stale_after': 60.0,
         'says': 'arrive that late'},
        # A limit that is set counts.
        {'now': 120.5, 'max_age': 20.0, 'stale_after': 60.0, 'tracker': OK},
    ],
    'a silent start is stale': [
        {'now': 1.0, 'input': STALE, 'values': {'fix silent for [s]': 'nan'}},
    ],
    'rates are those since the last report': [
        {'now': 0.0},
        {'now': 2.0, 'fix': np.arange(10) / 5.0, 'input': OK, 'values': {
            'fix rate [Hz]': '5', 'fix silent for [s]': '0.2', 'arrivals received': '0',
            'count: used': '3', 'NIS': '1.5',
        }},
    ],
    'silence becomes stale': [
        {'now': 6.0, 'fix': [1.0], 'input': OK},
        {'now': 6.5, 'input': STALE, 'tracker': STALE,
         'says': 'no message for 5.5 s on /usbl/fix|'},
    ],
    'counts of a tracker that was reset begin at zero': [
        {'now': 1.0, 'fix': [0.5], 'counts': Counter(too_late=1000)},
        {'now': 2.0, 'counts': Counter(too_late=0), 'tracker': OK},
    ],
    'single messages of no use are no warning': [
        {'now': second + 1.0, 'fix': second + np.arange(100) / 100.0, 'tracker': OK,
         'counts': Counter(used=95 * second, too_late=5 * second)}
        for second in range(30)
    ],
    'what is not needed is missed once it was heard, and not when it is slow': [
        {'now': 39.5, 'fix': range(40), 'altitude': range(4), 'input': WARN,
         'says': 'nothing more on /altitude for 36.5 s|'},
        # Slower from now on: every ten seconds in the mean.
        {'now': 59.5, 'fix': range(40, 60), 'altitude': [39.6], 'input': OK},
    ],
    'one input of several that serve is enough': [
        # Five times ten seconds after the last one are not over.
        {'now': 59.5, 'fix': range(60), 'arrivals': (0, 10, 20), **FINE},
        {'now': 71.5, 'fix': range(60, 72), 'tracker': OK,
         'says': 'nothing more on /arrivals for 51.5 s|'},
    ],
    'refusals warn while they last': [
        {'now': 0.0},
        {'now': 1.0, 'fix': (0.0, 0.1, 0.2, 0.3), 'refused': ['nan'], 'input': WARN,
         'values': {'refused: nan': '1'}},
        {'now': 2.0, 'fix': [1.5], 'refused': ['frame'], 'input': ERROR,
         'says': 'every message is refused: frame|'},
        {'now': 3.0, 'fix': [2.5], 'input': OK},
    ],
    'losses and incompatible peers warn': [
        {'now': 1.0, 'fix': [1.0], 'lost': {'fix': 4}, 'input': WARN,
         'values': {'lost on fix': '4'}},
        {'now': 1.5, 'incompatible': {'fix': 'RELIABILITY'}, 'input': WARN,
         'values': {'incompatible peer on fix': 'RELIABILITY'}},
    ],
    'compute time, and a tracker that cannot keep up': [
        {'now': 0.0},
        {'now': 1.0, 'fix': np.arange(10) / 10.0, 'spent': [0.25] * 2 + [0.05] * 99,
         'tracker': OK, 'values': {'compute time p50 [ms]': '50', 'compute time p99 [ms]': '250'}},
        {'now': 2.0, 'fix': 1.0 + np.arange(30) / 30.0, 'tracker': WARN},
    ],
    'what is lost counts as input that cannot be kept up with': [
        {'now': 0.0},
        # 19 a second at 50 ms each are no second of work.
        {'now': 1.0, 'fix': np.arange(10) / 10.0, 'spent': [0.05] * 10, 'lost': {'fix': 9},
         'tracker': OK},
        {'now': 2.0, 'fix': 1.0 + np.arange(10) / 10.0, 'lost': {'fix': 20}, 'tracker': WARN,
         'says': '|input comes faster than it can be processed'},
    ],
    'dropped messages warn while they are dropped': [
        {'now': 0.0},
        {'now': 1.0, 'fix': [0.5], 'dropped': 3, 'tracker': WARN, 'says': '3 messages dropped'},
        {'now': 2.0, 'fix': [1.5], 'tracker': OK,
         'values': {'fix dropped, waited too long': '3'}},
    ],
    'internal errors and disabling show': [
        {'now': 1.0, 'fix': [0.0], 'enabled': False, 'says': ['disabled', '|disabled']},
        # Without input, which it does not wait for.
        {'now': 60.0, 'enabled': False, 'tracker': OK, 'input': STALE},
        {'now': 61.0, 'fix': [60.5], 'counts': {'internal_error': 1}, 'tracker': ERROR},
    ],
    'obstacles that all move alike warn of the navigation': [
        {'now': 0.0, 'fix': [0.0], 'health': {'moving_alike': 1}, 'tracker': WARN,
         'says': 'navigation'},
        {'now': 1.0, 'fix': [0.5], 'health': {'moving_alike': 0}, 'tracker': OK},
    ],
}  # fmt: skip
"""What happens until each report, and what it says."""


@pytest.fixture
def desk():
    return Desk()


@pytest.mark.parametrize('name', HISTORIES)
def test_what_is_reported_of(desk, name):
    if name.startswith('each input'):
        desk = Desk(required=('fix', 'nav'), one_of=())
    for step in HISTORIES[name]:
        desk.follow(**step)
    assert (desk.input.name, desk.tracker.name) == ('diver: input', 'diver: tracker')


@pytest.mark.parametrize(
    'system, settings, required, one_of',
    [
        ('diver', {}, [], ['fix', 'fixes', 'relative', 'arrivals']),
        ('diver', {'tags': ('amy',)}, [],
         ['fix', 'amy/fix', 'fixes', 'relative', 'amy/relative', 'arrivals']),
        ('obstacle', {}, ['detections', 'nav'], []),
        ('bathymetry', {}, [], ['snapshot', 'port/snapshot', 'starboard/snapshot']),
        ('bathymetry', {'navigation': 'required'}, ['nav'],
         ['snapshot', 'port/snapshot', 'starboard/snapshot']),
        ('fathometer', {}, [], ['csdm', 'pressure', 'trace']),
    ],
)  # fmt: skip
def test_what_each_system_needs(system, settings, required, one_of):
    assert needed(inputs_of(system), settings) == (required, one_of)


@pytest.mark.parametrize(
    'age, wait, level, words',
    [
        (0.4, 0.1, OK, 'tracking'),
        (3.0, 0.1, WARN, 'because their messages arrive that late'),
        (3.0, np.nan, WARN, 'because their messages arrive that late'),
        (3600.0, 0.1, OK, 'stamps are 3600 s behind'),
        (-3600.0, 0.1, OK, 'stamps are 3600 s ahead of'),
        (4e7, 0.1, OK, 'tracking'),  # a recording
        (4e7, 5.0, WARN, 'estimates are 5.0 s old'),
        # What waits in the node is no clock, and hides none.
        (3602.0, 2.0, WARN, ['estimates are 2.0 s old', 'stamps are 3600 s behind']),
        (-3598.0, 2.0, WARN, ['estimates are 2.0 s old', 'stamps are 3600 s ahead of']),
        (100.0, 100.0, WARN, 'estimates are 100.0 s old'),
    ],
)
def test_the_cause_of_old_estimates_is_told_apart(desk, age, wait, level, words):
    desk.follow(5.0, estimates=(50, age, wait), tracker=level, says=words)
    said = 'the clock of this computer' in desk.tracker.message
    assert said == ('3600 s' in ''.join(words))


@pytest.mark.usefixtures('quick')
def test_a_node_reports_under_its_full_name_and_at_its_period(make_bench, walker):
    # no /clock at all: still it reports
    bench = make_bench('-r', '__ns:=/auv1', p=['use_sim_time:=true'])
    received = bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    bench.start(TrackerNode, 'walker')
    bench.spin_until(lambda: len(received) >= 3 and 'message' in received[-1].status[0].message)
    names = [status.name for status in received[-1].status]
    assert names == ['auv1/walker: input', 'auv1/walker: tracker']
    assert values_of(received[-1])['fix topic'] == '/auv1/fix'
    given = 'no message yet on /auv1/fix or /auv1/fixes or /auv1/relative or /auv1/arrivals'
    assert received[-1].status[0].message == given


def levels(heard, desk=None):
    """Levels of the input after each period. heard: of each (messages of an input by its name,
    refused ones, what else is reported)."""
    desk, found = desk or Desk(rise=2, fall=5), []
    for second, (messages, refused, *more) in enumerate(heard):
        for name, count in messages.items():
            for k in range(count):
                desk.meter.arrived(name, second + k / max(count, 2))
        for name in refused:
            desk.meter.refuse(name, f'bad_{name}')
        desk.report(second + 0.9, **(more[0] if more else {}))
        found.append(desk.input.level[0])
    return found


def test_a_level_rises_after_two_bad_periods_falls_after_five_good_ones_and_does_not_flap():
    def of(refused):
        return levels([({'fix': 2}, ['fix'] * int(bad)) for bad in refused])

    assert of([0, 1, 0, 1, 1, 0, 0, 0, 0, 0, 0]) == [0, 0, 0, 0, 1, 1, 1, 1, 1, 0, 0]
    found = of(np.random.default_rng(5).random(600) < 0.5)
    assert np.count_nonzero(np.diff(found)) <= 2 * 600 * 0.5**6 + 8 and np.mean(found) > 0.8
    assert not any(of([1, 0] * 100))  # every other period, never two in a row
    # All refused in one period and some in the next are some in both.
    assert levels([({'fix': 1 + second % 2}, ['fix']) for second in range(6)]) == [0] + [1] * 5


@pytest.mark.parametrize('beside', ['', 'heard', 'heard, and refused once'])
def test_periods_without_a_message_say_nothing(beside):
    """A sensor that is heard every few periods is judged by the periods in which it is, whatever
    is heard `beside` it in all of them."""
    heard = [
        ({'altitude': int(bool(beside)), 'fix': int(second % 4 == 0)},
         ['altitude'] * ('refused' in beside and second == 0)
         + ['fix'] * (second % 4 == 0 and second < 30))
        for second in range(60)
    ]  # fmt: skip
    found = levels(heard)
    first, level = 8 if 'refused' in beside else 4, 1 if beside else 2
    assert found[:first] == [0] * first and found[first:32] == [level] * (32 - first)
    assert found[47] == level and found[48:] == [0] * 12


def test_losses_of_a_latched_input_are_over_as_others():
    lost = [{'lost': {'/tf_static': min(second + 1, 4)}} for second in range(16)]
    found = levels([({'fix': 1, 'tf_static': 1 - k % 2}, (), more) for k, more in enumerate(lost)])
    assert found[2:4] == [1, 1] and found[-1] == 0


def test_the_health_of_a_node_is_its_worst_entry(desk):
    desk.follow(1.0, fix=[1.0], lost={'fix': 4})
    given = summary('diver', [desk.input, desk.tracker])
    assert (given.level, given.name) == (WARN, 'diver')
    assert given.message == desk.input.message
    assert {pair.key for pair in given.values} == {'input', 'tracker'}
    desk.report(2.0, counts={'internal_error': 1})
    assert summary('diver', [desk.input, desk.tracker]).level == ERROR
    desk.report(60.0, counts={'internal_error': 1})
    assert desk.input.level == STALE
    given = summary('diver', [desk.input, desk.tracker])
    assert given.level == ERROR  # a caught error is worse than silence
    assert given.message == desk.tracker.message != desk.input.message


def test_a_warning_is_the_same_one_when_its_numbers_change():
    desk, found = Desk(rise=2, fall=5), []
    for second, share in enumerate((12, 15, 9)):
        desk.follow(
            second + 0.9, fix=[second], warnings=[f'{share} % of the pings were passed over']
        )
        found.append(desk.tracker.level[0])
    assert found == [0, 1, 1] and desk.tracker.message.startswith('9 %')


@pytest.mark.usefixtures('quick')
def test_health_waits_for_those_who_ask_later(make_bench, walker):
    rig = Rig(make_bench())
    bench = rig.bench
    rig.send(a_fix(1.0))
    bench.spin_until(lambda: rig.node._announcer.health.level == OK)
    late = bench.listen(DiagnosticStatus, '/walker/health', latched_qos())
    bench.spin_until(lambda: late)
    assert (late[0].name, late[0].message) == ('walker', 'receiving; tracking')
    for topic in ('/walker/health', '/walker/processed'):
        (offered,) = bench.peer.get_publishers_info_by_topic(topic)
        assert offered.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL


def two_clocks(rng, offset=3.0, share=0.5, jitter=0.05, count=40):
    return -1.7e9 + offset * (rng.random(count) < share) + jitter * rng.random(count)


def two_publishers(desk, used=(True, True), frames=('map', 'map')):
    """Two publishers, the stamps of the second one are three seconds older."""
    for k, age in enumerate(two_clocks(np.random.default_rng(1))):
        second = bool(age > -1.7e9 + 1.5)
        desk.meter.arrived('fix', 0.1 * k)
        desk.meter.stamped('fix', Stamp(age, frames[second], used[second]))
    desk.report(4.0, publishers={'/usbl/fix': ['/rov/usbl', '/ship/usbl']}.get)
    assert desk.input.level == OK
    return desk.input.message


def test_two_publishers_whose_clocks_disagree_are_said(desk):
    """Messages of either are used; only a person can know which one is right."""
    assert two_publishers(desk) == (
        'stamps on /usbl/fix are of two groups 3.0 s apart: the clocks of its publishers '
        '/rov/usbl and /ship/usbl disagree, or one is later'
    )
    assert float(desk.values['fix offset of stamps [s]']) == pytest.approx(3.0, abs=0.05)
    desk.report(4.1, publishers={'/usbl/fix': ['/usbl']}.get)  # of one it is the way they take
    assert 'fix offset of stamps [s]' not in desk.values


@pytest.mark.parametrize(
    'used, frames, which',
    [
        ((True, False), ('map', 'map'), 'of the older stamps is not used (20 of 20 messages)'),
        ((False, True), ('map', 'map'), 'of the newer stamps is not used (20 of 20 messages)'),
        ((True, False), ('a', 'b'), "of the older stamps, of frame 'b', is not used (20 of 20"),
        ((False, False), ('a', 'b'), ''),
    ],
)
def test_which_of_two_publishers_is_not_used_is_said(desk, used, frames, which):
    said = two_publishers(desk, used, frames)
    assert f'; the publisher {which}' in said if which else 'not used' not in said


def test_stamps_of_one_clock_are_no_two(desk):
    rng = np.random.default_rng(2)
    steps = np.repeat([0.0, 3.0], 20)
    others = {
        'too few': two_clocks(rng, count=39),
        'the way they take': two_clocks(rng, offset=0.4, jitter=0.01),
        'varying delays': rng.exponential(3.0, 40), 'some late': two_clocks(rng, share=0.1),
        'set once': steps + 0.01 * rng.random(40), 'played fast': -4.0 * np.arange(40.0),
        'wide groups': two_clocks(rng, jitter=2.0), 'one stamp': np.zeros(40),
    }  # fmt: skip
    assert {name: clock_offset(ages) for name, ages in others.items()} == dict.fromkeys(others, 0)


@pytest.mark.usefixtures('quick')
def test_a_node_with_two_publishers_whose_clocks_disagree_says_so(make_bench, walker):
    rig = Rig(make_bench())
    received = rig.bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    other = rig.bench.publisher(FIX, '/fix', 10)
    start = time.time()
    rig.bench.spin_until(lambda: received)
    # As long as it takes: where the machine was busy meanwhile, messages came late as well.
    for k in range(1000):
        now = time.time() - start + 100.0
        rig.fix.publish(a_fix(now))
        other.publish(a_fix(now + 7.0))
        rig.bench.spin_until(lambda count=2 * k + 2: rig.answer[0] == count)
        if '7.0 s apart' in received[-1].status[0].message:
            break
    else:
        pytest.fail(received[-1].status[0].message)
    name = f'/{rig.bench.peer.get_name()}'
    assert f'of its publishers {name} and {name} disagree' in received[-1].status[0].message
    rig.bench.peer.destroy_publisher(other)
    rig.bench.spin_until(lambda: 'apart' not in received[-1].status[0].message)
