# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters: declared once, used by the tracker, the ROS node, the offline YAML check and the
documentation.

A tracker is built from one frozen attrs class that derives from `Config`. Every field is made with
`parameter(...)`, which keeps the unit, the range and the description beside the default::

    @frozen(kw_only=True)
    class WalkerConfig(Config):
        speed: float = parameter(0.5, 'm/s', 'speed of the walker', range=(0.0, 10.0))

A long description begins on the next line; `live` in place of `parameter` declares what a running
node may change, `constant` what only code may set: it is checked like a parameter, but neither
declared, documented nor read from YAML.

Parameters that several classes share stand in a base of theirs, written with ``slots=False`` so
that a class can have several such bases; `inherited` gives one of them another default.

`Config.from_mapping` builds a config from untrusted keys and reports *every* mistake in one
sentence each; `Config.specs` lists what a node has to declare; `markdown_table` writes the table
for the docs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import copy
import difflib
from functools import lru_cache, partial
from importlib.metadata import entry_points, EntryPoint
import json
from pathlib import Path
import re
import sys
from typing import Any, TypeVar

import attrs
from attrs import frozen

from .gone import GONE

C = TypeVar('C', bound='Config')

MODELS = 'sonar_imm.models'
"""The entry-point group of models of motion, see `trackers.own_models`."""
KINDS = ('bool', 'int', 'float', 'str', 'float[]', 'int[]', 'str[]')
MOST_NAMED, MOST_SHOWN = 20, 200
"""Unknown parameters that are named, and characters of a value that is wrong."""
MOST_YAML = 1_000_000
"""Characters of a YAML file, and values in it with its anchors written out."""
_KEY = 'sonar_imm.parameter'


class ConfigError(ValueError):
    """A configuration a user can mend. `problems` holds one sentence for each mistake."""

    def __init__(self, *problems: str):
        self.problems = tuple(problems)
        super().__init__('; '.join(problems))


def _shown(value: Any) -> str:
    """A value as it was given, cut where nobody would read on."""
    text = repr(value)
    return text if len(text) <= MOST_SHOWN else f'{text[:MOST_SHOWN]}...'


@frozen
class ParameterSpec:
    """What is known of one parameter. `kind` is one of KINDS; `low` and `high` are inclusive and
    hold for every element of an array. group: entry-point group whose names are choices too.
    constant: the field is no parameter."""

    name: str
    kind: str
    default: Any
    description: str
    unit: str = ''
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = True
    group: str = ''
    constant: bool = False

    def problem(self, value: Any) -> str | None:
        """Say what is wrong with `value`, or None when it is good."""
        if self.kind.endswith('[]'):
            if isinstance(value, (str, bytes)) or not hasattr(value, '__iter__'):
                kind = self.kind.removesuffix('[]')
                return f"parameter '{self.name}' must be a list of {kind}, got {_shown(value)}"
            for element in value:
                trouble = self._scalar_problem(element, self.kind[:-2])
                if trouble:
                    return trouble
            return None
        return self._scalar_problem(value, self.kind)

    def _scalar_problem(self, value: Any, kind: str) -> str | None:
        name = f"parameter '{self.name}'"
        if kind == 'bool':
            return (
                None
                if isinstance(value, bool)
                else f'{name} must be true or false, got {_shown(value)}'
            )
        if kind == 'str':
            if not isinstance(value, str):
                return f'{name} must be text, got {_shown(value)}'
            if self.choices and value not in self.choices and not self._registered(value):
                known = ', '.join(self.choices)
                if self.group:
                    known += f' or a name that a package registers as {self.group}'
                if gone := GONE.get(f'choice {self.name} {value}'):
                    return f"{name}: '{value}' {gone}"
                hint = did_you_mean(value, self.choices)
                return f'{name} must be one of {known}, got {_shown(value)}{hint}'
            return None
        if (
            isinstance(value, bool)
            or not isinstance(value, (int, float))
            or (kind == 'int' and not isinstance(value, int))
        ):
            wanted = 'a whole number' if kind == 'int' else 'a number'
            return f'{name} must be {wanted}, got {_shown(value)}'
        if not abs(value) <= sys.float_info.max:  # whole numbers of JSON have no limit
            return f'{name} must be finite, got {_shown(value)}'
        if (self.low is not None and value < self.low) or (
            self.high is not None and value > self.high
        ):
            return f'{name} must be {self.range_text()}, got {_shown(value)} {self.unit}'.rstrip()
        return None

    def _registered(self, value: str) -> bool:
        return bool(self.group) and registered(self.group, value) is not None

    @property
    def ros_kind(self) -> str:
        """The kind in the words of ROS, e.g. ``double`` or ``double[]``."""
        names = {'float': 'double', 'int': 'integer', 'str': 'string', 'bool': 'bool'}
        return names[self.kind.removesuffix('[]')] + ('[]' if self.kind.endswith('[]') else '')

    def range_text(self) -> str:
        """The range in words, e.g. ``at least 0`` or ``between 0 and 1``; empty without limits."""
        if self.low is not None and self.high is not None:
            return f'between {self.low:g} and {self.high:g}'
        if self.low is not None:
            return f'at least {self.low:g}'
        if self.high is not None:
            return f'at most {self.high:g}'
        return ''

    def convert(self, value: Any) -> Any:
        """The canonical Python value: tuples for lists, float for whole numbers given to a
        float."""
        if self.kind == 'float':
            return float(value)
        if self.kind.endswith('[]'):
            cast = {'float': float, 'int': int, 'str': str}[self.kind[:-2]]
            return tuple(cast(element) for element in value)
        return value


Range = tuple[float | None, float | None]
"""Lowest and highest value, both inclusive; None for no limit."""


def parameter(
    default: Any,
    unit: str,
    description: str,
    *,
    range: Range = (None, None),
    kind: str | None = None,
    choices: tuple[str, ...] = (),
    read_only: bool = True,
    group: str = '',
    constant: bool = False,
) -> Any:
    """One field of a `Config`. The kind follows from the default; an empty list needs `kind`.

    The description is read alone, in ``ros2 param describe`` and in the parameter files: it does
    not refer to the parameter before it. `unit` is empty where there is none.
    """
    return _field(
        ParameterSpec(
            name='',
            kind=kind or _kind_of(default),
            default=default,
            description=description,
            unit=unit,
            low=range[0],
            high=range[1],
            choices=choices,
            read_only=read_only,
            group=group,
            constant=constant,
        )
    )


live = partial(parameter, read_only=False)
"""`parameter` of what a running node may change without losing its tracks."""
constant = partial(parameter, constant=True)
"""A field of a `Config` that is no parameter: tests and benchmarks may construct it."""


def inherited(
    base: type[Config], name: str, default: Any, *, range: Range | None = None, **changes: Any
) -> Any:
    """The parameter `name` of `base` with another default, to be assigned to that name in a class
    that derives from `base`.

    changes: what else differs, e.g. ``unit``, or ``constant=True``. Raises KeyError when `base`
    has no such parameter.
    """
    spec = attrs.fields_dict(base)[name].metadata[_KEY]
    if range is not None:
        changes |= {'low': range[0], 'high': range[1]}
    return _field(attrs.evolve(spec, default=default, **changes))


@frozen(kw_only=True, slots=False)
class Config:
    """Base of every parameter set. Derive with ``@attrs.frozen(kw_only=True)``; override `check`
    for rules across fields."""

    def __attrs_post_init__(self) -> None:
        problems = [
            trouble
            for spec in self._fields()
            if (trouble := spec.problem(getattr(self, spec.name)))
        ]
        if not problems:
            problems = list(self.check())
        if problems:
            raise ConfigError(*problems)

    def for_inputs(self: C, inputs: frozenset[str]) -> C:
        """The same for a recording of which it is known that it feeds just these inputs."""
        return self

    def check(self) -> list[str]:
        """Sentences about fields that do not fit together; an empty list when all is well."""
        return []

    @classmethod
    def specs(cls) -> tuple[ParameterSpec, ...]:
        """The parameters: those of the class itself, then those of each base, where an `inherited`
        one stays among its neighbours."""
        return tuple(spec for spec in cls._fields() if not spec.constant)

    @classmethod
    def specs_with(cls, values: Mapping[str, Any]) -> tuple[ParameterSpec, ...]:
        """`specs`, and what is declared because `values` are given: names with a dot, of what
        another parameter names."""
        return cls.specs()

    @classmethod
    def attributes(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """The attributes of a config by parameters of `specs_with`."""
        return dict(values)

    @classmethod
    def _fields(cls) -> tuple[ParameterSpec, ...]:
        """The parameters and the constants."""
        fields = attrs.fields_dict(cls)
        declared = [
            field.name
            for owner in cls.__mro__
            if attrs.has(owner)
            for field in attrs.fields(owner)
            if not field.inherited
        ]
        last = {name: place for place, name in enumerate(declared)}
        return tuple(
            attrs.evolve(fields[name].metadata[_KEY], name=name)
            for name in sorted(last, key=last.__getitem__)
            if _KEY in fields[name].metadata
        )

    @classmethod
    def from_mapping(
        cls: type[C], values: Mapping[str, Any], *, ignore_unknown: bool = False
    ) -> C:
        """Build from untrusted keys. Raises `ConfigError` naming every unknown key (with a
        suggestion) and bad value."""
        specs = {spec.name: spec for spec in cls.specs_with(values)}
        unknown = [key for key in values if key not in specs]
        problems = [] if ignore_unknown else unknown_parameters(unknown, specs)
        known = {key: value for key, value in values.items() if key in specs}
        problems += [
            trouble for key, value in known.items() if (trouble := specs[key].problem(value))
        ]
        if problems:
            raise ConfigError(*problems)
        return cls(**cls.attributes(known))

    def require_changeable(self, other: Config) -> None:
        """Raise ValueError naming the parameters of `other` that differ and are read-only."""
        fixed = [
            spec.name
            for spec in self._fields()
            if spec.read_only and getattr(other, spec.name) != getattr(self, spec.name)
        ]
        if fixed:
            raise ValueError(f'these parameters need a new tracker: {", ".join(fixed)}')

    def as_dict(self) -> dict[str, Any]:
        """Plain Python values, lists instead of tuples: fit for YAML, JSON and ROS."""
        return {
            spec.name: list(value)
            if isinstance(value := getattr(self, spec.name), tuple)
            else value
            for spec in self.specs()
        }


def small_text(path: Path, encoding: str = 'utf-8', errors: str = 'strict') -> str:
    """The text of a file of parameters, cut where it is too long for one: a device or a pipe may
    have no end. Raises OSError and UnicodeDecodeError."""
    with path.open(encoding=encoding, errors=errors) as stream:
        return stream.read(MOST_YAML + 1)


def yaml_tree(text: str) -> Any:
    """What a YAML text holds. Raises `ConfigError` for one that is none, or that would be much
    larger than it looks: an anchor (``&a``) that is used (``*a``) stands for all that it names."""
    return copy.deepcopy(_tree(text))


@lru_cache(maxsize=2)  # a file is asked for several nodes, and 400 kB take two seconds
def _tree(text: str) -> Any:
    import yaml

    try:
        if len(text) > MOST_YAML:
            raise yaml.YAMLError(f'it has more than {MOST_YAML} characters')
        if '*' in text and '&' in text:
            _written_out(yaml.compose(text, yaml.SafeLoader), {})
        return yaml.safe_load(text)
    except RecursionError:
        raise ConfigError('not a YAML file: it is nested too deeply') from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise ConfigError(f'not a YAML file: {" ".join(str(error).split())}') from None


def _written_out(node: Any, known: dict[int, int]) -> int:
    """How many values a composed YAML node has with its anchors written out. known: of the nodes
    that were counted. Raises yaml.YAMLError for more than `MOST_YAML`, or no end of them."""
    import yaml

    if node is None or isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        known[id(node)] = MOST_YAML  # met again inside of itself
        parts = node.value
        if isinstance(node, yaml.MappingNode):
            parts = [part for pair in node.value for part in pair]
        known[id(node)] = 1 + sum(_written_out(part, known) for part in parts)
    if known[id(node)] >= MOST_YAML:
        raise yaml.YAMLError('its anchors multiply')
    return known[id(node)]


def parameters_from_yaml(text: str, *, node_name: str = '') -> dict[str, Any]:
    """The parameters in a YAML text: a ROS 2 parameter file (``/**:`` or the node's name) or a
    plain mapping.

    Raises `ConfigError` for a text that is not YAML or not a mapping.
    """
    tree = yaml_tree(text)
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(
            f'a parameter file must hold a mapping, this one holds a {type(tree).__name__}'
        )
    sections = {
        key: section['ros__parameters']
        for key, section in tree.items()
        if isinstance(section, dict) and 'ros__parameters' in section
    }
    if not sections:
        return _flat(tree)
    values: dict[str, Any] = {}
    for key, section in sections.items():
        if not isinstance(section, (dict, type(None))):
            kind = type(section).__name__
            raise ConfigError(f'ros__parameters of {key} must hold a mapping, it holds a {kind}')
        name = str(key).strip('/').split('/')[-1]
        if key in ('/**', '/*') or not node_name or name == node_name:
            values.update(_flat(section or {}))
    return values


def _flat(tree: Mapping[Any, Any], before: str = '') -> dict[str, Any]:
    """Values by their names; those of a mapping stand behind its name and a dot, as in ROS."""
    values: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict) and value:
            values.update(_flat(value, f'{before}{key}.'))
        else:
            values[f'{before}{key}'] = value
    return values


def sections_of(text: str) -> list[str]:
    """The nodes that a ROS 2 parameter file is for, e.g. ``/**`` or ``/diver``; of nodes in a
    namespace the whole name. Nothing for a text that is none, or a plain mapping."""
    try:
        tree = yaml_tree(text)
    except ConfigError:
        return []
    return list(_sections(tree, '')) if isinstance(tree, dict) else []


def _sections(tree: Mapping[Any, Any], before: str) -> Iterable[str]:
    for key, section in tree.items():
        name = str(key)
        full = f'{before.rstrip("/")}/{name.lstrip("/")}' if before else name
        if isinstance(section, dict) and 'ros__parameters' in section:
            yield full
        elif isinstance(section, dict):
            yield from _sections(section, full)


def markdown_table(specs: Iterable[ParameterSpec]) -> str:
    """Return the table of `specs` for the documentation, one row a parameter; a star marks those
    that may change while a node runs. Ranges are in the parameter file. Choices that the
    description explains are not listed besides."""
    rows = ['| parameter | default | what |', '|---|---|---|']
    for spec in specs:
        words = set(re.findall(r'\w+', spec.description))
        listed = () if words.issuperset(spec.choices) else spec.choices
        kind = f'{spec.ros_kind} ' if spec.ros_kind.endswith('[]') else ''
        value = f'{kind}`{json.dumps(spec.default)}` {spec.unit}'.rstrip()
        choices = ', '.join(f'`{choice}`' for choice in listed)
        name = f'`{spec.name}`' + ('' if spec.read_only else r'\*')
        default = '; '.join(filter(None, (value, choices)))
        rows.append(f'| {name} | {default} | {spec.description} |')
    return '\n'.join(rows) + '\n'


def registered(group: str, name: str) -> EntryPoint | None:
    """What an installed package registers under that name, None for nothing. Raises `ConfigError`
    when several packages do, with different things."""
    return _registered(group, name, tuple(sys.path))


@lru_cache(maxsize=64)
def _registered(group: str, name: str, path: tuple[str, ...]) -> EntryPoint | None:
    """path: where packages are looked for, which takes milliseconds."""
    found = {entry.value: entry for entry in entry_points(group=group, name=name)}
    if len(found) > 1:
        raise ConfigError(f"'{name}' is registered as {group} by {' and by '.join(sorted(found))}")
    return next(iter(found.values()), None)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``" (did you mean 'x'?)"`` or an empty text."""
    close = difflib.get_close_matches(str(name), list(known), n=1)
    return f" (did you mean '{close[0]}'?)" if close else ''


def unknown_parameters(names: Sequence[str], known: Iterable[str]) -> list[str]:
    """Return a sentence for each parameter that does not exist, or no longer exists; of many the
    first ones."""
    first = names[:MOST_NAMED]
    sentences = [
        f"parameter '{name}' {gone}"
        if (gone := GONE.get(f'parameter {name}'))
        else f"unknown parameter '{name}'{did_you_mean(name, known)}"
        for name in first
    ]
    more = len(names) - len(first)
    return [*sentences, *([f'{more} more unknown parameters'] if more else [])]


def _field(spec: ParameterSpec) -> Any:
    return attrs.field(
        default=spec.default, converter=_convert_quietly(spec), metadata={_KEY: spec}
    )


def _kind_of(default: Any) -> str:
    if isinstance(default, tuple):
        if not default:
            raise TypeError('an empty list default needs kind=')
        return _kind_of(default[0]) + '[]'
    return {bool: 'bool', int: 'int', float: 'float', str: 'str'}[type(default)]


def _convert_quietly(spec: ParameterSpec) -> Any:
    """Convert what can be converted; leave the rest for `problem` to name."""

    def convert(value: Any) -> Any:
        return (
            value
            if attrs.evolve(spec, low=None, high=None, choices=()).problem(value)
            else spec.convert(value)
        )

    return convert
