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

"""Fewer instructions for LLVM than numba writes for a kernel.

Most of what numba writes packs arrays into structures in memory and unpacks them again, and LLVM
takes it all out. Here a variable with one value has no place in memory, an element of a C-ordered
array is found from its data and shape at once, and a range counts in two numbers. The machine code
computes the same; a kernel takes a fifth to a fourth less time to compile.

This takes the place of methods of numba's private ``Lower``, which have the same text in all of
`KNOWN`. With any other numba, or where a method has another form or is missing, numba's own serve.
"""

from __future__ import annotations

import gc
from inspect import signature
from typing import Any

import numba
from numba.core import cgutils, event, ir, types
from numba.np.arrayobj import load_item, store_item

_MEMINFO, _PARENT, _ITEMS, _ITEMSIZE, _DATA, _SHAPE, _STRIDES = range(7)
"""The fields of an array in numba."""

KNOWN = range(58, 69)
"""The versions of numba, 0.58 to 0.68, whose methods were read; tests run with the first and the
last."""

_Base: Any = object  # not numba's class, which may be missing: `fewer_passes` joins the two


class _Short(_Base):
    """Lowers a kernel; LLVM optimises it together with its callees, not alone before."""

    def lower(self) -> None:
        config: Any = numba.config
        before, config.OPT = config.OPT, type(config.OPT)(0)
        try:
            super().lower()
        finally:
            config.OPT = before

    def _find_singly_assigned_variable(self) -> None:
        """`_once`: variables with one assignment, which comes before every use on every way to it;
        as numba does, those of one block."""
        self._values: dict[str, Any] = {}
        self._counting: dict[Any, bool] = {}
        self._positive: dict[int, Any] = {}
        self._parts: dict[int, tuple[Any, dict[Any, Any]]] = {}
        lifetime = self.func_ir.variable_lifetime
        dominators = lifetime.cfg.dominators()
        places: dict[str, list[int]] = {}
        for label, block in self.blocks.items():
            for each in block.find_insts(ir.Assign):
                places.setdefault(each.target.name, []).append(label)
        once = {name: labels[0] for name, labels in places.items() if len(labels) == 1}
        elsewhere = lifetime.usedefs.usemap
        self._singly_assigned_vars = once.keys() - set[str]().union(*elsewhere.values())
        self._blk_local_varmap: dict[str, Any] = {}
        for label, used in elsewhere.items():
            for name in used:
                place = once.get(name)
                if place is not None and not (place < label and place in dominators[label]):
                    del once[name]
        self._once = set() if self._disable_sroa_like_opt else set(once)

    def _is_plain(self, name: str) -> bool:
        """Whether a variable holds nothing whose references are counted."""
        return not self._counts(self.typeof(name))

    def _counts(self, kind: Any) -> bool:
        if kind not in self._counting:
            model = self.context.data_model_manager[kind]
            self._counting[kind] = model.contains_nrt_meminfo()
        return self._counting[kind]

    def _alloca_var(self, name: str, fetype: Any) -> None:
        if not (name in self._once and self._is_plain(name)):
            super()._alloca_var(name, fetype)

    def storevar(self, value: Any, name: str, argidx: Any = None) -> None:
        once = name in self._once
        if not self._is_plain(name):
            super().storevar(value, name, argidx)
        elif not once:
            self._alloca_var(name, self.typeof(name))
            self.builder.store(value, self.getvar(name))
        if once:
            self._values[name] = value
            if self._is_array(name):
                for part in (_DATA, *((_SHAPE, d) for d in range(self.typeof(name).ndim))):
                    self._part(value, part, keep=True)

    def loadvar(self, name: str) -> Any:
        return self._values[name] if name in self._values else super().loadvar(name)

    def delvar(self, name: str) -> None:
        if not self._is_plain(name):
            super().delvar(name)

    def _is_array(self, name: str) -> bool:
        array = self.typeof(name)
        return type(array) is types.Array and array.layout == 'C' and array.aligned

    def _kept(self, value: Any) -> dict[Any, Any]:
        """The parts that are known of a structure."""
        return self._parts.get(id(value), (None, {}))[1]

    def _part(self, array: Any, part: Any, keep: bool = False) -> Any:
        """A field of an array, or one entry of a tuple in it."""
        kept = self._kept(array)
        if part in kept:
            return kept[part]
        found = self.builder.extract_value(array, part)
        if keep:
            self._parts.setdefault(id(array), (array, {}))[1][part] = found
        return found

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        short = getattr(self, f'_short_{expr.op}', None)
        result = short(resty, expr) if short else None
        if result is None:
            result = super().lower_expr(resty, expr)
        if expr.op == 'build_tuple' and all(isinstance(each, types.Integer) for each in resty):
            items = [self.loadvar(each.name) for each in expr.items]
            self._parts[id(result)] = result, dict(enumerate(items))
        return result

    def _short_static_getitem(self, resty: Any, expr: Any) -> Any:
        if not self._is_array(expr.value.name) or expr.index_var is None:
            return None
        signature = self.fndesc.calltypes[expr]
        return self.lower_getitem(resty, expr, expr.value, expr.index_var, signature)

    def _short_getattr(self, resty: Any, expr: Any) -> Any:
        if expr.attr != 'shape' or not self._is_array(expr.value.name):
            return None
        return self._part(self.loadvar(expr.value.name), _SHAPE)

    def _made(self, kind: Any, parts: dict[Any, Any]) -> Any:
        """A structure of these parts."""
        made = self.context.get_constant_undef(kind)
        for part, each in parts.items():
            made = self.builder.insert_value(made, each, part)
        self._parts[id(made)] = made, parts
        return made

    def _short_call(self, resty: Any, expr: Any) -> Any:
        """`range` with steps of 1 or -1."""
        if resty is not types.range_state64_type or expr.kws or expr.vararg:
            return None
        kinds = [self.typeof(each.name) for each in expr.args]
        by = getattr(kinds[2], 'literal_value', 0) if len(kinds) == 3 else 1
        if by not in (1, -1):
            return None
        values = [
            self.context.cast(self.builder, self.loadvar(each.name), kind, types.int64)
            for each, kind in zip(expr.args, kinds, strict=True)
        ]
        zero = values[0].type(0)
        start, stop = (zero, values[0]) if len(values) == 1 else values[:2]
        made = self._made(resty, {0: start, 1: stop, 2: zero.type(by)})
        if by == 1 and self._is_positive(start, kinds[0] if len(values) > 1 else None):
            self._positive[id(made)] = made
        return made

    def _is_positive(self, value: Any, kind: Any) -> bool:
        """Whether a whole number is known to be zero or more."""
        constant = getattr(value, 'constant', getattr(kind, 'literal_value', -1))
        return id(value) in self._positive or (isinstance(constant, int) and constant >= 0)

    def _short_getiter(self, resty: Any, expr: Any) -> Any:
        whole = self.loadvar(expr.value.name)
        parts = self._kept(whole)
        if self.typeof(expr.value.name) is not types.range_state64_type or not parts:
            return None
        builder, (start, stop, step) = self.builder, (parts[each] for each in range(3))
        first, last = (start, stop) if step.constant == 1 else (stop, start)
        places = [cgutils.alloca_once(builder, start.type) for _ in range(2)]
        builder.store(start, places[0])
        builder.store(builder.sub(last, first), places[1])
        made = self._made(resty, {0: places[0], 1: stop, 2: step, 3: places[1]})
        if id(whole) in self._positive:
            self._positive[id(made)] = made
        return made

    def _short_iternext(self, resty: Any, expr: Any) -> Any:
        if self.typeof(expr.value.name) is not types.range_iter64_type:
            return None
        builder, whole = self.builder, self.loadvar(expr.value.name)
        place, step, left = (self._part(whole, each) for each in (0, 2, 3))
        value, count = builder.load(place), builder.load(left)
        builder.store(builder.add(value, step), place)
        builder.store(builder.sub(count, count.type(1), flags=['nsw']), left)
        if id(whole) in self._positive:
            self._positive[id(value)] = value
        more = builder.icmp_signed('>', count, count.type(0))
        return self._made(resty, {0: value, 1: more})

    def _short_pair_first(self, resty: Any, expr: Any) -> Any:
        return self._kept(self.loadvar(expr.value.name)).get(0)

    def _short_pair_second(self, resty: Any, expr: Any) -> Any:
        return self._kept(self.loadvar(expr.value.name)).get(1)

    def _at(self, array: Any, index: Any) -> tuple[Any, int, Any] | None:
        """Type of `array`, of how many of its axes the index is a whole number, and a pointer to
        where it is; None for any other index."""
        kinds = self.typeof(index.name)
        whole = isinstance(kinds, types.BaseTuple)
        kinds = kinds.types if whole else (kinds,)
        if self.context.enable_boundscheck or not self._is_array(array.name):
            return None
        ty = self.typeof(array.name)
        if not all(isinstance(each, types.Integer) for each in kinds):
            return None
        if not 0 < len(kinds) <= ty.ndim:
            return None
        base, at, builder = self.loadvar(array.name), self.loadvar(index.name), self.builder
        position = None
        for d in range(ty.ndim):
            length = self._part(base, (_SHAPE, d))
            if position is not None:
                position = builder.mul(position, length)
            if d >= len(kinds):
                continue
            kind = kinds[d]
            item = self.context.cast(builder, self._part(at, d) if whole else at, kind, types.intp)
            if kind.signed and not self._is_positive(item, kind):
                negative = builder.icmp_signed('<', item, item.type(0))
                item = builder.select(negative, builder.add(item, length), item)
            position = item if position is None else builder.add(position, item)
        return ty, len(kinds), builder.gep(self._part(base, _DATA), [position])

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        found = self._at(value, index)
        if found is None:
            return super().lower_getitem(resty, expr, value, index, signature)
        array, axes, pointer = found
        if axes == array.ndim:
            item, kind = load_item(self.context, self.builder, array, pointer), array.dtype
        else:
            kind = signature.return_type
            item = self._view(self.loadvar(value.name), array, kind, axes, pointer)
        return self.context.cast(self.builder, item, kind, resty)

    def _view(self, base: Any, array: Any, kind: Any, axes: int, pointer: Any) -> Any:
        """Of type `kind`, what an array has at whole numbers on its first axes."""
        builder, items = self.builder, self._part(base, (_SHAPE, axes))
        for d in range(axes + 1, array.ndim):
            items = builder.mul(items, self._part(base, (_SHAPE, d)))
        parts: dict[Any, Any] = {
            each: self._part(base, each) for each in (_MEMINFO, _PARENT, _ITEMSIZE)
        }
        parts |= {_ITEMS: items, _DATA: pointer}
        for field in (_SHAPE, _STRIDES):
            for d in range(axes, array.ndim):
                parts[field, d - axes] = self._part(base, (field, d))
        view = self._made(kind, parts)
        self.incref(kind, view)
        return view

    def incref(self, typ: Any, val: Any) -> None:
        if self._counts(typ):
            super().incref(*self._counted(typ, val))

    def decref(self, typ: Any, val: Any) -> None:
        if self._counts(typ):
            super().decref(*self._counted(typ, val))

    def _counted(self, typ: Any, val: Any) -> tuple[Any, Any]:
        """Of an array what has its count of references."""
        if type(typ) is not types.Array:
            return typ, val
        return types.MemInfoPointer(typ.dtype), self._part(val, _MEMINFO)

    def lower_setitem(self, target: Any, index: Any, value: Any, signature: Any) -> Any:
        kind = self.typeof(value.name)
        number = isinstance(kind, (types.Number, types.Boolean))
        found = self._at(target, index) if number else None
        if found is None or found[1] < found[0].ndim:
            return super().lower_setitem(target, index, value, signature)
        array, _, pointer = found
        item = self.context.cast(self.builder, self.loadvar(value.name), kind, array.dtype)
        store_item(self.context, self.builder, array, item, pointer)


_NEEDLESS = (
    'WithLifting InlineClosureLikes MakeFunctionToJitFunction InlineInlinables '
    'FindLiterallyCalls LiteralUnroll LiteralPropagationSubPipelinePass InlineOverloads '
    'AnnotateTypes'
).split()
"""Passes over a kernel for closures, `with`, literals, which none has, and for listings."""


def fewer_passes() -> dict[str, Any]:
    """numba's way to machine code without what is `_NEEDLESS`; LLVM optimises a kernel and its
    callees together, not each alone before. With other private parts of numba nothing of it."""
    if not any(numba.__version__.startswith(f'0.{minor}.') for minor in KNOWN):
        return {}
    try:
        from numba.core.compiler import CompilerBase, DefaultPassBuilder
        from numba.core.compiler_machinery import PassManager, register_pass
        from numba.core.lowering import Lower
        from numba.core.typed_passes import NativeLowering

        for name, ours in vars(_Short).items():
            numbas = None if name.startswith('__') else getattr(Lower, name, None)
            if numbas and len(signature(numbas).parameters) != len(signature(ours).parameters):
                return {}
    except (ImportError, TypeError):
        return {}

    class ShortLower(_Short, Lower):
        pass

    @register_pass(mutates_CFG=True, analysis_only=False)
    class Lowering(NativeLowering):
        _name = 'kernel_lowering'
        lowering_class = ShortLower

    class Passes(CompilerBase):
        def define_pipelines(self) -> list[PassManager]:
            state, passes = self.state, PassManager('kernel')
            for each, description in DefaultPassBuilder.define_nopython_pipeline(state).passes:
                if each.__name__ not in _NEEDLESS:
                    passes.add_pass(Lowering if each is NativeLowering else each, description)
            passes.finalize()
            return [passes]

    return {'pipeline_class': Passes}


_PLAIN = types.Number, types.Boolean, types.Array, types.BaseTuple, types.SliceType
_resolved: dict[Any, tuple[Any, ...]] = {}


def _resolve_once(function: Any, context: Any, args: Any, kws: Any) -> Any:
    """What `function`, an operator or one of numpy, is for these types. numba tries every way to
    call it, anew at each place in the source; a fifth of the time."""
    if kws or not all(isinstance(each, _PLAIN) for each in args):
        return _resolve(function, context, args, kws)
    key = id(function), id(context), tuple(args)
    if key not in _resolved:
        _resolved[key] = _resolve(function, context, args, kws), function, context  # keep the ids
    return _resolved[key][0]


_Function: Any = types.Function
_resolve: Any = getattr(_Function, 'get_call_type', None)


def _without_locks(broadcast: Any) -> Any:
    """numba tells nobody that it takes a lock; it takes one for each call of LLVM, and telling is
    a twelfth of the time."""

    def of_event(kind: str, *rest: Any, **named: Any) -> None:
        if not kind.endswith('_lock'):
            broadcast(kind, *rest, **named)

    return of_event


_BROADCASTS = {name: getattr(event, name) for name in ('start_event', 'end_event')}


class _WhileCompiling(event.Listener):
    """While numba compiles: other functions in the place of some of numba's, and Python looks for
    cycles of garbage rarely, for numba makes millions of objects that stay, and a tenth of the
    time went into looking at them."""

    COLLECTIONS = 100_000, 50, 100

    def __init__(self) -> None:
        self._depth, self._before = 0, gc.get_threshold()

    def on_start(self, _: Any) -> None:
        if self._depth == 0:
            self._before = gc.get_threshold()
            if self._before[0]:  # else somebody wants none at all
                gc.set_threshold(*self.COLLECTIONS)
            _Function.get_call_type = _resolve_once
            for name, broadcast in _BROADCASTS.items():
                setattr(event, name, _without_locks(broadcast))
        self._depth += 1

    def on_end(self, _: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            gc.set_threshold(*self._before)
            _Function.get_call_type = _resolve
            for name, broadcast in _BROADCASTS.items():
                setattr(event, name, broadcast)


event.register('numba:compile', _WhileCompiling())
