"""Vectors of 8 or 16 float32 numbers, as values in Numba kernels.

The compiler vectorises a loop only if it can prove that arrays do not overlap and that no index is negative,
and it writes the sums of a loop to memory in every iteration. The vectors of this module stay in registers.
A vector has the width of AVX-512 if the processor has it, otherwise that of AVX. The compiler divides vectors
for narrower registers.

Arithmetic operators and comparisons apply lane by lane; a number applies to all lanes. The functions below
are declarations for kernels: Python cannot call them.
"""
# llvmlite and Numba declare too few types
# pyrefly: ignore-errors

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Mapping
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

from .compile import numba


def _features() -> Mapping[str, bool]:
    """Return the processor's features that Numba compiles for."""
    if numba.config.CPU_FEATURES is not None:  # type: ignore[attr-defined]
        return {name: True for name in re.findall(r"\+([^,]+)", numba.config.CPU_FEATURES)}
    try:
        return llvm.get_host_cpu_features()
    except RuntimeError:  # unknown for this system
        return {}


WIDTH = 16 if _features().get("avx512f") else 8
"""Number of lanes."""
FLOATS = ir.VectorType(ir.FloatType(), WIDTH)
INTEGERS = ir.VectorType(ir.IntType(32), WIDTH)


class VectorType(types.Type):
    """Numba type of a vector; ``content`` is its LLVM type."""

    def __init__(self, name: str, content: ir.Type) -> None:
        super().__init__(name)
        self.content = content


@register_model(VectorType)
class _Model(models.PrimitiveModel):
    def __init__(self, manager, vector_type) -> None:
        super().__init__(manager, vector_type, vector_type.content)


LANES = VectorType("Lanes", FLOATS)
MASK = VectorType("Mask", ir.VectorType(ir.IntType(1), WIDTH))
NUMBER, INDEX, ARRAY = types.float32, types.intp, types.Array(types.float32, 1, "C")
BYTES = types.Array(types.uint8, 1, "C")
ROWS = types.Array(types.float32, 2, "C")
"""Array (K, WIDTH). ``rows[k] = value`` stores lanes, or copies a number to all lanes."""


def _spread(builder: ir.IRBuilder, number: ir.Value) -> ir.Value:
    lanes = builder.insert_element(FLOATS(ir.Undefined), number, ir.IntType(32)(0))
    return builder.shuffle_vector(lanes, FLOATS(ir.Undefined), INTEGERS([0] * WIDTH))


def _define(function: Callable, result: types.Type, *cases: tuple[types.Type, ...]) -> Callable:
    """Return a decorator of the function that builds the instructions of ``function``.

    If there are several ``cases`` of argument types, numbers are copied to all lanes.
    """

    def decorate(build: Callable) -> Callable:
        @infer_global(function)
        class _(ConcreteTemplate):
            pass

        _.cases = [signature(result, *case) for case in cases]

        def lower(context, builder, signature, args):
            if len(cases) > 1:
                args = [
                    _spread(builder, arg) if kind is NUMBER else arg
                    for kind, arg in zip(signature.args, args, strict=True)
                ]
            value = build(builder, *args)
            return context.get_dummy_value() if value is None else value

        for case in cases:
            lower_builtin(function, *case)(lower)
        return build

    return decorate


_PAIRS = (LANES, LANES), (LANES, NUMBER), (NUMBER, LANES)
_define(operator.add, LANES, *_PAIRS)(ir.IRBuilder.fadd)
_define(operator.sub, LANES, *_PAIRS)(ir.IRBuilder.fsub)
_define(operator.mul, LANES, *_PAIRS)(ir.IRBuilder.fmul)
_define(operator.truediv, LANES, *_PAIRS)(ir.IRBuilder.fdiv)
_define(operator.neg, LANES, (LANES,))(lambda builder, a: builder.fsub(FLOATS([0.0] * WIDTH), a))
_define(operator.gt, MASK, *_PAIRS)(lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_define(operator.ge, MASK, *_PAIRS)(lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
_define(operator.lt, MASK, *_PAIRS)(lambda builder, a, b: builder.fcmp_ordered("<", a, b))
_define(operator.or_, MASK, (MASK, MASK))(ir.IRBuilder.or_)
_define(operator.and_, MASK, (MASK, MASK))(ir.IRBuilder.and_)


def select(mask, value, other) -> Any:
    """Return ``value`` in lanes where the mask is true, and ``other`` elsewhere."""


_define(select, LANES, *((MASK, *pair) for pair in _PAIRS))(ir.IRBuilder.select)
_define(select, NUMBER, (types.boolean, NUMBER, NUMBER))(ir.IRBuilder.select)


def smaller(value, other) -> Any:
    """Return the minimum of each lane."""


@_define(smaller, LANES, *_PAIRS)
def _build_smaller(builder, value, other):
    return builder.select(builder.fcmp_ordered("<", value, other), value, other)


def larger(value, other) -> Any:
    """Return the maximum of each lane."""


@_define(larger, LANES, *_PAIRS)
def _build_larger(builder, value, other):
    return builder.select(builder.fcmp_ordered(">", value, other), value, other)


for _function, _build in ((smaller, _build_smaller), (larger, _build_larger)):
    _define(_function, NUMBER, (NUMBER, NUMBER))(_build)


def spread(number) -> Any:
    """Copy a number to all lanes."""


_define(spread, LANES, (NUMBER,))(_spread)


def ramp() -> Any:
    """Return 0, 1, 2, ..."""


_define(ramp, LANES, ())(lambda builder: FLOATS([float(lane) for lane in range(WIDTH)]))


def magnitude(value) -> Any:
    """Return the absolute value of each lane."""


@_define(magnitude, LANES, (LANES,))
def _build_magnitude(builder, value):
    return _intrinsic_call(builder, "fabs", value)


def root(value) -> Any:
    """Return the square root of each lane."""


@_define(root, NUMBER, (NUMBER,))
@_define(root, LANES, (LANES,))
def _build_root(builder, value):
    return _intrinsic_call(builder, "sqrt", value)


def floor(value) -> Any:
    """Return the next lower integer of each lane."""


@_define(floor, LANES, (LANES,))
def _build_floor(builder, value):
    return _intrinsic_call(builder, "floor", value)


def _intrinsic_call(builder: ir.IRBuilder, name: str, value: ir.Value) -> ir.Value:
    suffix = f"v{WIDTH}f32" if value.type == FLOATS else "f32"
    kind = ir.FunctionType(value.type, [value.type])
    return builder.call(
        cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.{suffix}"), [value]
    )


def scaled(value, exponent) -> Any:
    """Multiply by 2 to the power of an integer, if the result is a normal number."""


@_define(scaled, LANES, (LANES, LANES))
def _build_scaled(builder, value, exponent):
    shifted = builder.shl(builder.fptosi(exponent, INTEGERS), INTEGERS([23] * WIDTH))
    return builder.bitcast(builder.add(builder.bitcast(value, INTEGERS), shifted), FLOATS)


def exponent(value) -> Any:
    """Return the integer n of each positive normal number m 2^n with 1 <= m < 2."""


@_define(exponent, LANES, (LANES,))
def _build_exponent(builder, value):
    bits = builder.lshr(builder.bitcast(value, INTEGERS), INTEGERS([23] * WIDTH))
    return builder.sitofp(builder.sub(bits, INTEGERS([127] * WIDTH)), FLOATS)


def load(array, index) -> Any:
    """Return the elements from ``index`` on. The index is not checked."""


@_define(load, LANES, (ARRAY, INDEX))
def _build_load(builder, array, index):
    return builder.load(_address(builder, array, index), align=4)


def store(array, index, value):
    """Replace the elements from ``index`` on. The index is not checked."""


@_define(store, types.void, (ARRAY, INDEX, LANES))
def _build_store(builder, array, index, value):
    builder.store(value, _address(builder, array, index), align=4)


def store_bytes(array, index, value):
    """Store the integer parts of lanes, 0 to 255, from ``index`` on. The index is not checked."""


@_define(store_bytes, types.void, (BYTES, INDEX, LANES))
def _build_store_bytes(builder, array, index, value):
    integers = builder.fptoui(value, ir.VectorType(ir.IntType(8), WIDTH))
    address = builder.gep(builder.extract_value(array, 4), [index], inbounds=True)
    builder.store(integers, builder.bitcast(address, integers.type.as_pointer()), align=1)


def load_row(rows, k) -> Any:
    """Return row ``k`` of an array (K, WIDTH). The index is not checked."""


@_define(load_row, LANES, (ROWS, INDEX))
def _build_load_row(builder, rows, k):
    return _build_load(builder, rows, builder.mul(k, k.type(WIDTH)))


@_define(operator.setitem, types.void, (ROWS, INDEX, LANES))
def _build_set_row(builder, rows, k, value):
    _build_store(builder, rows, builder.mul(k, k.type(WIDTH)), value)


def _address(builder: ir.IRBuilder, array: ir.Value, index: ir.Value) -> ir.Value:
    data = builder.extract_value(array, 4)  # see numba.core.datamodel.models.ArrayModel
    return builder.bitcast(builder.gep(data, [index], inbounds=True), FLOATS.as_pointer())


def _shuffled(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, lanes: list[int]) -> ir.Value:
    return builder.shuffle_vector(a, b, ir.VectorType(ir.IntType(32), len(lanes))(lanes))


def _fold(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, distance: int) -> ir.Value:
    """In each group of four lanes, add those at this distance, first of ``a``, then of ``b``.

    Processors shuffle lanes within such groups faster than across them.
    """
    first = (0, 1) if distance == 2 else (0, 2)
    low = [i + lane for group in range(0, WIDTH, 4) for i in (group, group + WIDTH) for lane in first]
    return builder.fadd(
        _shuffled(builder, a, b, low), _shuffled(builder, a, b, [lane + distance for lane in low])
    )


def _group_total(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """Add all groups of four lanes."""
    size = WIDTH
    while size > 4:
        size //= 2
        halves = [_shuffled(builder, value, value, list(range(i, i + size))) for i in (0, size)]
        value = builder.fadd(*halves)
    return value


def total(value) -> Any:
    """Return the sum of all lanes."""


@_define(total, NUMBER, (LANES,))
def _build_total(builder, value):
    value = _group_total(builder, value)
    for lanes in ([2, 3, 2, 3], [1, 1, 1, 1]):
        value = builder.fadd(value, _shuffled(builder, value, value, lanes))
    return builder.extract_element(value, ir.IntType(32)(0))


def store_totals(array, index, a, b, c, d, e, f, g, h):
    """Store the sums of all lanes of eight vectors from ``index`` on."""


@_define(store_totals, types.void, (ARRAY, INDEX, *(LANES,) * 8))
def _build_store_totals(builder, array, index, *vectors):
    for distance in (2, 1):
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors = [_fold(builder, a, b, distance) for a, b in pairs]
    sums = _shuffled(builder, *(_group_total(builder, vector) for vector in vectors), list(range(8)))
    builder.store(sums, builder.bitcast(_address(builder, array, index), sums.type.as_pointer()), align=4)


def any_of(mask) -> Any:
    """Test if any lane is true."""


@_define(any_of, types.boolean, (MASK,))
def _build_any_of(builder, mask):
    bits = builder.bitcast(mask, ir.IntType(WIDTH))
    return builder.icmp_unsigned("!=", bits, bits.type(0))
