# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters: what is taken, what is refused and in which words."""

import math

import attrs
from helpers.refusals import multiplying
from hypothesis import given
from hypothesis import strategies as st
import pytest
import yaml

from sonar_imm import parameters
from sonar_imm.parameters import Config, ConfigError, live, parameter, parameters_from_yaml
from sonar_imm.trackers import SYSTEMS


@attrs.frozen(kw_only=True)
class Walker(Config):
    speed: float = live(0.5, 'm/s', 'how fast', range=(0.0, 3.0))
    steps: int = parameter(3, '', 'how many', range=(1, None))
    calm: bool = live(True, '', 'whether he rests')
    gait: str = parameter('walk', '', 'how he moves', choices=('walk', 'march', 'crawl'))
    name: str = parameter('', '', 'of the walker')
    weights: tuple = parameter((0.25, 0.75), '', 'of legs', range=(0.0, 1.0))
    stops: tuple = parameter((), '', 'where he rests', range=(None, 99), kind='int[]')
    roads: tuple = parameter(('a', 'b'), '', 'which roads')

    def check(self):
        return ['speed must exceed steps'] if self.speed == 2.0 and self.steps > 2 else []


def problems(**values):
    with pytest.raises(ConfigError) as caught:
        Walker.from_mapping(values)
    return caught.value.problems


# -- one value ------------------------------------------------------------------------------------

GAIT = "parameter 'gait' must be one of walk, march, crawl"


@pytest.mark.parametrize(
    'values, sentence',
    [
        ({'speed': -0.1}, "parameter 'speed' must be between 0 and 3, got -0.1 m/s"),
        ({'speed': 3.0000001}, "parameter 'speed' must be between 0 and 3, got 3.0000001 m/s"),
        ({'speed': math.nan}, "parameter 'speed' must be finite, got nan"),
        ({'speed': -math.inf}, "parameter 'speed' must be finite, got -inf"),
        ({'weights': [math.nan]}, "parameter 'weights' must be finite, got nan"),
        ({'weights': [math.inf]}, "parameter 'weights' must be finite, got inf"),
        ({'steps': 0}, "parameter 'steps' must be at least 1, got 0"),
        ({'stops': [5, 100]}, "parameter 'stops' must be at most 99, got 100"),
        ({'weights': [0.5, 1.5]}, "parameter 'weights' must be between 0 and 1, got 1.5"),
        ({'speed': '1.0'}, "parameter 'speed' must be a number, got '1.0'"),
        ({'speed': None}, "parameter 'speed' must be a number, got None"),
        ({'speed': True}, "parameter 'speed' must be a number, got True"),
        ({'steps': True}, "parameter 'steps' must be a whole number, got True"),
        ({'steps': 2.0}, "parameter 'steps' must be a whole number, got 2.0"),
        ({'calm': 1}, "parameter 'calm' must be true or false, got 1"),
        ({'name': 7}, "parameter 'name' must be text, got 7"),
        ({'gait': 'run'}, f"{GAIT}, got 'run'"),
        ({'gait': 'mach'}, f"{GAIT}, got 'mach' (did you mean 'march'?)"),
        ({'weights': 0.5}, "parameter 'weights' must be a list of float, got 0.5"),
        ({'weights': [0.5, 'x']}, "parameter 'weights' must be a number, got 'x'"),
        ({'weights': [[0.5]]}, "parameter 'weights' must be a number, got [0.5]"),
        ({'stops': [1, 2.5]}, "parameter 'stops' must be a whole number, got 2.5"),
        ({'stops': [False]}, "parameter 'stops' must be a whole number, got False"),
        ({'roads': ['a', 1]}, "parameter 'roads' must be text, got 1"),
        ({'roads': b'ab'}, "parameter 'roads' must be a list of str, got b'ab'"),
    ],
)
def test_a_bad_value_gets_one_sentence(values, sentence):
    assert problems(**values) == (sentence,)
    with pytest.raises(ConfigError) as caught:
        Walker(**values)
    assert caught.value.problems == (sentence,)


def test_values_become_what_the_kind_says():
    walker = Walker(speed=1, weights=[1, 0], stops=[3], roads=['x'])
    assert walker == Walker(speed=1.0, weights=(1.0, 0.0), stops=(3,), roads=('x',))
    assert {type(each) for each in (walker.speed, *walker.weights)} == {float}
    assert hash(walker) == hash(Walker(speed=1.0, weights=(1, 0), stops=(3,), roads=('x',)))
    assert type(Walker(steps=2).steps) is int
    assert Walker(weights=[], stops=(), roads=[]).weights == ()  # a list may be empty
    # The ends of a range belong to it.
    assert (Walker(speed=0.0).speed, Walker(speed=3.0).speed) == (0.0, 3.0)
    assert Walker(weights=[0.0, 1.0]).weights == (0.0, 1.0)


# -- several values -------------------------------------------------------------------------------


def test_every_mistake_is_told_at_once():
    given = problems(sped=1.0, speed=9.0, steps=0, colour='red')
    assert given == (
        "unknown parameter 'sped' (did you mean 'speed'?)",
        "unknown parameter 'colour'",
        "parameter 'speed' must be between 0 and 3, got 9.0 m/s",
        "parameter 'steps' must be at least 1, got 0",
    )
    assert str(ConfigError(*given)) == '; '.join(given)
    # Unknown names may be passed over, but not bad values.
    assert Walker.from_mapping({'sped': 1.0, 'steps': 4}, ignore_unknown=True).steps == 4
    with pytest.raises(ConfigError, match='steps'):
        Walker.from_mapping({'sped': 1.0, 'steps': 0}, ignore_unknown=True)


def test_rules_across_parameters_come_after_those_of_each():
    assert problems(speed=2.0) == ('speed must exceed steps',)
    assert problems(speed=2.0, gait='run') == (f"{GAIT}, got 'run'",)
    with pytest.raises(ConfigError, match='must exceed'):
        attrs.evolve(Walker(speed=2.0, steps=2), steps=3)
    assert Walker(speed=2.0, steps=2).steps == 2
    with pytest.raises(attrs.exceptions.FrozenInstanceError):
        Walker.from_mapping({}).speed = 1.0


@pytest.mark.parametrize('system', SYSTEMS)
@given(
    values=st.dictionaries(
        st.one_of(st.text(max_size=5), st.sampled_from(['seed', 'history', 'gate', 'method'])),
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
            lambda each: st.lists(each, max_size=3) | st.dictionaries(st.text(), each, max_size=2),
            max_leaves=3,
        ),
        max_size=4,
    )
)
def test_any_mapping_gives_a_config_or_sentences(system, values):
    try:
        config = SYSTEMS[system].config_type().from_mapping(values)
    except ConfigError as error:
        assert error.problems and all(isinstance(problem, str) for problem in error.problems)
    else:
        assert set(values) <= set(config.as_dict())


# -- changes while running ------------------------------------------------------------------------


def test_only_what_is_not_read_only_may_change():
    walker = Walker()
    walker.require_changeable(Walker(speed=1.0, calm=False))
    walker.require_changeable(Walker(weights=[0.25, 0.75]))  # the same value again
    with pytest.raises(ValueError) as caught:
        walker.require_changeable(Walker(speed=1.0, steps=4, stops=(1,)))
    assert str(caught.value) == 'these parameters need a new tracker: steps, stops'


# -- what is known of them ------------------------------------------------------------------------


def test_specs_say_what_was_declared():
    specs = {spec.name: spec for spec in Walker.specs()}
    assert list(specs) == 'speed steps calm gait name weights stops roads'.split()
    kinds = ['float', 'int', 'bool', 'str', 'str', 'float[]', 'int[]', 'str[]']
    assert [spec.kind for spec in specs.values()] == kinds and set(kinds) <= set(parameters.KINDS)
    speed = specs['speed']
    assert (speed.default, speed.unit, speed.low, speed.high) == (0.5, 'm/s', 0.0, 3.0)
    assert not speed.read_only and specs['steps'].read_only
    assert specs['gait'].choices == ('walk', 'march', 'crawl')

    # A derived class keeps the parameters of its base.
    @attrs.frozen(kw_only=True)
    class Runner(Walker):
        pulse: int = parameter(120, '', 'beats per minute')

    assert [spec.name for spec in Runner.specs()] == ['pulse', *specs]  # its own first
    assert Runner(pulse=90, speed=1.0).as_dict()['pulse'] == 90


@attrs.frozen(kw_only=True)
class Sleeper(Walker):
    rest: float = parameters.constant(8.0, 'h', 'how long he sleeps', range=(0.0, 24.0))
    steps: int = parameters.inherited(Walker, 'steps', 1, constant=True)


def test_a_constant_is_checked_but_no_parameter():
    names = [spec.name for spec in Sleeper.specs()]
    assert names == [spec.name for spec in Walker.specs() if spec.name != 'steps']
    sleeper = Sleeper(rest=7, steps=2)
    assert (sleeper.rest, sleeper.steps) == (7.0, 2) and list(sleeper.as_dict()) == names
    for name in ('rest', 'steps'):
        with pytest.raises(ConfigError, match=f"unknown parameter '{name}'"):
            Sleeper.from_mapping({name: 1})
        assert Sleeper.from_mapping({name: 1}, ignore_unknown=True) == Sleeper()
        with pytest.raises(ConfigError, match=f"'{name}' must be "):
            Sleeper(**{name: -1})
    with pytest.raises(ValueError, match='need a new tracker: rest'):
        sleeper.require_changeable(Sleeper(steps=2))


def test_plain_values_come_back_and_an_empty_list_needs_its_kind():
    with pytest.raises(TypeError, match='kind='):
        parameter((), '', 'which')
    values = Walker(stops=(1, 2)).as_dict()
    assert values['stops'] == [1, 2] and values['weights'] == [0.25, 0.75]
    assert list(values) == [spec.name for spec in Walker.specs()]
    assert Walker.from_mapping(values) == Walker(stops=(1, 2))


def test_ranges_in_words():
    for limits, words in (
        ((None, None), ''), ((0.0, None), 'at least 0'), ((None, 1e6), 'at most 1e+06'),
        ((-1.5, 2), 'between -1.5 and 2'),
    ):  # fmt: skip
        given = dict(zip(('low', 'high'), limits))
        spec = parameters.ParameterSpec('x', 'float', 0.0, 'what', **given)
        assert spec.range_text() == words


def test_the_table_has_one_row_per_parameter():
    rows = parameters.markdown_table(Walker.specs()).splitlines()
    assert len(rows) == 2 + len(Walker.specs())
    assert rows[2] == r'| `speed`\* | `0.5` m/s | how fast |'
    assert rows[5] == '| `gait` | `"walk"`; `walk`, `march`, `crawl` | how he moves |'
    assert '| `weights` | double[] `[0.25, 0.75]` | ' in rows[7]
    assert all(row.count('|') == 4 for row in rows)


def test_a_near_name_is_suggested_and_a_far_one_is_not():
    near = parameters.did_you_mean
    assert near('sped', ['steps', 'speed']) == " (did you mean 'speed'?)"
    assert near('colour', ['steps', 'speed']) == near(7, ['steps']) == near('x', []) == ''


# -- parameter files ------------------------------------------------------------------------------


def test_a_plain_mapping_and_a_ros_file_say_the_same():
    plain = 'speed: 1.5\nstops: [1, 2]\n'
    ros = '/**:\n  ros__parameters:\n    speed: 1.5\n    stops: [1, 2]\n'
    assert parameters_from_yaml(plain) == parameters_from_yaml(ros)
    assert parameters_from_yaml(ros) == {'speed': 1.5, 'stops': [1, 2]}
    for nothing in ('', '# nothing\n', '/**:\n  ros__parameters:\n'):
        assert parameters_from_yaml(nothing) == {}


NODES = """
/**:
  ros__parameters: {speed: 1.0, steps: 2}
/ship/walker_node:
  ros__parameters: {speed: 2.0}
other_node:
  ros__parameters: {steps: 9, calm: false}
"""


def test_a_node_takes_what_all_take_and_what_bears_its_name():
    assert parameters_from_yaml(NODES, node_name='walker_node') == {'speed': 2.0, 'steps': 2}
    due = {'speed': 1.0, 'steps': 9, 'calm': False}
    assert parameters_from_yaml(NODES, node_name='other_node') == due
    assert parameters_from_yaml(NODES, node_name='nobody') == {'speed': 1.0, 'steps': 2}
    assert parameters_from_yaml(NODES)['calm'] is False
    turned = NODES + '/*:\n  ros__parameters: {speed: 3.0}\n'  # later sections win
    assert parameters_from_yaml(turned, node_name='walker_node') == {'speed': 3.0, 'steps': 2}


@pytest.mark.parametrize(
    'text, words',
    [
        ('a: b: c', 'not a YAML file'),
        ('- 1\n- 2\n', 'must hold a mapping, this one holds a list'),
        ('just words', 'must hold a mapping, this one holds a str'),
        ('speed: [1, 2]\ngap: 2026-13-45', 'not a YAML file'),
        ('/**:\n  ros__parameters: 5\n', 'ros__parameters'),
        ('a:\n  ros__parameters: [1]\n', 'ros__parameters'),
        ('[' * 100_000, 'not a YAML file: it is nested too deeply'),
        ('speed: ' + '1' * 1_000_001, 'more than 1000000 characters'),
        ('a: &a [1, *a]', 'its anchors multiply'),
        (multiplying('[{}]'), 'its anchors multiply'),
        (multiplying('{{<<: [{}]}}'), 'its anchors multiply'),
        ('speed: !!python/object/apply:os.system ["true"]', 'not a YAML file'),
    ],
)
def test_a_file_that_is_none_is_told_in_one_line(text, words):
    with pytest.raises(ConfigError, match=words) as caught:
        parameters_from_yaml(text)
    assert len(caught.value.problems) == 1 and '\n' not in str(caught.value)


@pytest.mark.parametrize('form', ['{}', '5:\n  ros__parameters: {{{}}}'])
def test_keys_that_are_no_text_are_named(form):
    text = form.format('7: 1.0, true: 2' if '{{' in form else '7: 1.0\ntrue: 2\n')
    due = "unknown parameter '7'", "unknown parameter 'True'"
    assert problems(**parameters_from_yaml(text)) == due


def test_groups_of_parameters_are_named_not_guessed():
    nested = 'ship:\n  walker_node:\n    ros__parameters: {speed: 1.0}\n'
    (sentence,) = problems(**parameters_from_yaml(nested))
    assert sentence == "unknown parameter 'ship.walker_node.ros__parameters.speed'"
    (sentence,) = problems(**parameters_from_yaml('speed: {mean: 1.0}'))
    assert sentence == "unknown parameter 'speed.mean' (did you mean 'speed'?)"


@given(st.text(max_size=40))
def test_any_text_is_a_mapping_or_refused(text):
    try:
        values = parameters_from_yaml(text)
    except ConfigError:
        return
    assert all(isinstance(key, str) for key in values)


# -- much of it -----------------------------------------------------------------------------------


def test_thousands_of_unknown_names_are_counted():
    found = problems(**{f'speed{k:05d}': 1.0 for k in range(16_000)})
    assert len(found) == 21
    assert found[0] == "unknown parameter 'speed00000' (did you mean 'speed'?)"
    assert found[-1] == '15980 more unknown parameters'


@pytest.mark.parametrize('name', ['speed', 'calm', 'gait', 'name', 'steps', 'stops'])
def test_a_long_value_is_cut(name):
    value = 'y' * 400_000 if name in ('gait', 'stops') else ['y'] * 400_000
    (found,) = problems(**{name: value})
    assert 200 < len(found) < 400 and found.endswith('...')


def test_a_file_is_parsed_once_however_often_it_is_asked(monkeypatch):
    parsed = []
    load = yaml.safe_load
    monkeypatch.setattr(yaml, 'safe_load', lambda text: parsed.append(text) or load(text))
    text = '/**:\n  ros__parameters:\n    stops: [1, 2]\n'
    first = parameters_from_yaml(text, node_name='walker')
    first['stops'].append(3)
    assert parameters_from_yaml(text, node_name='runner') == {'stops': [1, 2]}
    assert len(parsed) == 1


def test_anchors_that_do_not_multiply_are_used_and_counted_only_where_there_are_some(monkeypatch):
    text = 'speed: &v 2.0\nlags: &l [1, 2]\nmore: [*v, *v, *l]\n'
    assert parameters_from_yaml(text)['more'] == [2.0, 2.0, [1, 2]]
    monkeypatch.setattr(yaml, 'compose', None)
    assert parameters_from_yaml('/**:\n  ros__parameters:\n    steps: 5\n') == {'steps': 5}
