# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""ROS parameters from `Config` classes: declared, explained, checked and applied in one place.

ROS checks little: it accepts NaN, does not range-check arrays, answers ``1500`` for a double with
a traceback, and says nothing about a misspelt key. So the start values are read from the overrides
and checked by the `Config` classes first, all mistakes in one `ConfigError`; only good values are
declared. Changes at run time go through the same classes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
import sys
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from ..gone import GONE
from ..parameters import Config, ConfigError, did_you_mean, ParameterSpec

C = TypeVar('C', bound=Config)

_TYPES = {
    'bool': Parameter.Type.BOOL,
    'int': Parameter.Type.INTEGER,
    'float': Parameter.Type.DOUBLE,
    'str': Parameter.Type.STRING,
    'float[]': Parameter.Type.DOUBLE_ARRAY,
    'int[]': Parameter.Type.INTEGER_ARRAY,
    'str[]': Parameter.Type.STRING_ARRAY,
}


class NodeParameters:
    """The parameters of one node, spread over several `Config` classes."""

    def __init__(self, node: Node, config_types: Iterable[type[Config]]):
        """Read the overrides, check them, declare. Raises `ConfigError` with one sentence for each
        mistake."""
        self._node = node
        self._types = tuple(config_types)
        given = {name: given.value for name, given in _overrides(node).items()}
        # Where two classes share a parameter, the first one, the tracker's, describes it.
        self._specs = {
            spec.name: spec
            for config_type in reversed(self._types)
            for spec in config_type.specs_with(given)
        }
        self._configs = self._build(self._start_values())
        for spec in self._specs.values():
            self._declare(spec)
        node.add_on_set_parameters_callback(self._check)

    def __getitem__(self, config_type: type[C]) -> C:
        """Give the current, validated config of one class."""
        return self._configs[config_type]

    def values(self) -> dict[str, Any]:
        """The parameters of all classes by name; where two share one, the last one's."""
        return {
            name: value
            for config in self._configs.values()
            for name, value in config.as_dict().items()
        }

    def on_change(self, apply: Callable[[], None]) -> None:
        """Call `apply` after a change made from outside has been taken over."""

        def take_over(changed: list[Parameter]) -> None:
            if ours := self._ours(changed):
                values = _plain_values(ours)
                self._configs = self._build(self.values() | values)
                apply()
                changes = ', '.join(f'{name} is {value} now' for name, value in values.items())
                self._node.get_logger().info(f'parameters changed: {changes}')

        self._node.add_post_set_parameters_callback(take_over)

    def warn_of_unknown(self) -> None:
        """Warn of each start value nobody declared: ROS drops a misspelt key in silence.

        To be called when everything is declared, the qos_overrides of the endpoints included.
        """
        for name in _overrides(self._node):
            if not self._node.has_parameter(name):
                why = f'is not known and has no effect{self._meant(name)}'
                why = GONE.get(f'parameter {name}', why)
                self._node.get_logger().warning(f"parameter '{name}' {why}")

    def _meant(self, name: str) -> str:
        """What could be meant by an unknown name: of a quality of service often the topic as it
        was called before it was remapped."""
        family, _, rest = name.partition('.')
        topic, _, what = rest.partition('.')
        if family == 'qos_overrides' and topic:
            now = f'{family}.{self._node.resolve_topic_name(topic)}.{what}'
            if now != name and self._node.has_parameter(now):
                return f" (that topic is remapped: write '{now}')"
            return did_you_mean(name, self._node._parameters)
        return did_you_mean(name, self._specs)

    def _start_values(self) -> dict[str, Any]:
        given = self._ours(_overrides(self._node).values())
        problems = [trouble for p in given if (trouble := _type_problem(self._specs[p.name], p))]
        if not problems:
            values = _plain_values(given)
            problems = [
                trouble
                for name, value in values.items()
                if (trouble := self._specs[name].problem(value))
            ]
        if problems:
            raise ConfigError(*problems)
        return values

    def _build(self, values: Mapping[str, Any]) -> dict[type[Config], Any]:
        """Build a config of each class, with the mistakes of all classes in one `ConfigError`."""
        built: dict[type[Config], Any] = {}
        problems: list[str] = []
        for config_type in self._types:
            try:
                built[config_type] = config_type.from_mapping(values, ignore_unknown=True)
            except ConfigError as error:
                problems += error.problems
        if problems:
            raise ConfigError(*problems)
        return built

    def _declare(self, spec: ParameterSpec) -> None:
        value, described = self.values()[spec.name], descriptor(spec)
        if value != []:
            self._node.declare_parameter(spec.name, value, described, ignore_override=True)
            return
        # rclpy takes an empty list for an array of bytes. A parameter that has only a type has no
        # value, and then `ros2 param dump` shows those of no parameter of the node.
        kind = _TYPES[spec.kind]
        self._node.declare_parameter(spec.name, kind, ignore_override=True)
        self._node.set_parameters([Parameter(spec.name, kind, [])])
        described.name, described.type = spec.name, kind.value
        self._node.set_descriptor(spec.name, described)

    def _ours(self, parameters: Iterable[Parameter]) -> list[Parameter]:
        return [p for p in parameters if p.name in self._specs]

    def _check(self, changed: list[Parameter]) -> SetParametersResult:
        """Judge a change of good type, which rclpy has checked by now."""
        try:
            self._build(self.values() | _plain_values(self._ours(changed)))
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """Write what ``ros2 param describe`` shows of a parameter."""
    made = ParameterDescriptor(
        description=spec.description + (f' [{spec.unit}]' if spec.unit else ''),
        additional_constraints=', '.join(spec.choices) or spec.range_text(),
        read_only=spec.read_only,
    )
    if spec.low is None and spec.high is None:
        return made
    if spec.kind == 'float':
        low = -sys.float_info.max if spec.low is None else float(spec.low)
        high = sys.float_info.max if spec.high is None else float(spec.high)
        made.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    if spec.kind == 'int':
        low = -(2**63) if spec.low is None else int(spec.low)
        high = 2**63 - 1 if spec.high is None else int(spec.high)
        made.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return made


def _overrides(node: Node) -> dict[str, Parameter]:
    """Give the start values from the command line and the parameter files.

    rclpy has no public way to ask for those that are not declared.
    """
    return node._parameter_overrides


def _type_problem(spec: ParameterSpec, given: Parameter) -> str | None:
    """Say so when the ROS type is not the declared one; a whole number for a double is usual."""
    wanted = _TYPES[spec.kind]
    if given.type_ == wanted or _is_empty_list(spec, given):
        return None
    pair = (given.type_, wanted)
    if pair == (Parameter.Type.INTEGER, Parameter.Type.DOUBLE):
        return (
            f"parameter '{spec.name}' is a double: write {float(given.value)!r} "
            f'instead of {given.value}'
        )
    if pair == (Parameter.Type.INTEGER_ARRAY, Parameter.Type.DOUBLE_ARRAY):
        return (
            f"parameter '{spec.name}' is a list of doubles: write "
            f'{[float(v) for v in given.value]} instead of {list(given.value)}'
        )
    if given.type_ == Parameter.Type.NOT_SET:
        return f"parameter '{spec.name}' is given without a value"
    return (
        f"parameter '{spec.name}' must be of type {wanted.name.lower()}, "
        f'got {given.type_.name.lower()} {_plain(given.value)!r}'
    )


def _is_empty_list(spec: ParameterSpec, given: Parameter) -> bool:
    """Recognize ``name: []``, which arrives without a type, or with that of bytes."""
    untyped = Parameter.Type.NOT_SET, Parameter.Type.BYTE_ARRAY
    return spec.kind.endswith('[]') and given.type_ in untyped and not given.value


def _plain_values(parameters: Iterable[Parameter]) -> dict[str, Any]:
    return {p.name: [] if p.value is None else _plain(p.value) for p in parameters}


def _plain(value: Any) -> Any:
    return value if isinstance(value, (bool, int, float, str)) else list(value)
