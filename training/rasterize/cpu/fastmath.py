"""A vectorisable exp2, memory prefetching, and tests and memory access of SIMD lanes for Numba kernels.

Numba supports SVML only with Intel's LLVM, and libm's exp is scalar.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .compile import FAST, f32, inlined
from .lanes import WIDTH, exponent, floor, larger, load, scaled, smaller, store

LOG2_E, LOG2_TERM = f32(np.log2(np.e)), f32(2 / np.log(2))
LOWEST_EXPONENT, HIGHEST_EXPONENT = f32(-126), f32(126)
LOWEST = f32(-30)
# minimax polynomial of 2^f on [0, 1), exact at both ends: relative error under 1e-7 besides rounding
P1, P2, P3, P4, P5 = f32(0.6931517), f32(0.24015927), f32(0.055818677), f32(0.008990995), f32(0.0018793186)


@intrinsic
def float_bits(typing_context, x):
    """Reinterpret a float32 as int32."""
    return types.int32(types.float32), lambda context, builder, _, args: builder.bitcast(
        args[0], ir.IntType(32)
    )


@intrinsic
def bits_float(typing_context, bits):
    """Reinterpret an int32 as float32."""
    return types.float32(types.int32), lambda context, builder, _, args: builder.bitcast(
        args[0], ir.FloatType()
    )


@intrinsic
def truncated(typing_context, x):
    """Convert a float32 to int32, without Python's checks and widening."""
    return types.int32(types.float32), lambda context, builder, _, args: builder.fptosi(
        args[0], ir.IntType(32)
    )


@intrinsic
def _prefetch(typing_context, array, row, line):
    """Prefetch 64 bytes of a row from offset 64 · line."""

    def generate(context, builder, signature, args):
        fields = context.make_array(signature.args[0])(context, builder, args[0])
        stride = cgutils.unpack_tuple(builder, fields.strides)[0]
        byte, integer = ir.IntType(8).as_pointer(), ir.IntType(32)
        address = builder.gep(
            builder.bitcast(fields.data, byte),
            [builder.add(builder.mul(stride, args[1]), builder.shl(args[2], args[2].type(6)))],
        )
        signature = ir.FunctionType(ir.VoidType(), [byte, integer, integer, integer])
        function = cgutils.get_or_insert_function(builder.module, signature, "llvm.prefetch.p0")
        builder.call(
            function, [address, integer(0), integer(3), integer(1)]
        )  # read, high locality, data cache
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp), generate


@intrinsic
def _any_positive(typing_context, rows):
    """Test if any of the first 16 values of 16 rows of a float32 array is positive.

    As a loop, the compiler would gather the values of a column from all rows.
    """

    def generate(context, builder, signature, args):
        fields = context.make_array(signature.args[0])(context, builder, args[0])
        stride = cgutils.unpack_tuple(builder, fields.strides)[0]
        lanes = ir.VectorType(ir.FloatType(), 16)
        data = builder.bitcast(fields.data, ir.IntType(8).as_pointer())
        largest = lanes(None)
        for row in range(16):
            address = builder.gep(data, [builder.mul(stride, stride.type(row))])
            values = builder.load(builder.bitcast(address, lanes.as_pointer()), align=4)
            largest = builder.select(builder.fcmp_ordered(">", values, largest), values, largest)
        positive = builder.bitcast(builder.fcmp_ordered(">", largest, lanes(None)), ir.IntType(16))
        return builder.icmp_unsigned("!=", positive, positive.type(0))

    return types.boolean(rows), generate


prefetch: Any = _prefetch  # type checkers do not know that Numba passes the first argument
any_positive: Any = _any_positive


@inlined(FAST)
def exp2(x):
    """Compute 2^x for x <= 127, and 2^-30 below -30. The integer part of x is added to the exponent bits."""
    x = x if x > LOWEST else LOWEST
    floor = np.floor(x)
    f = x - floor
    p = f32(1) + f * (P1 + f * (P2 + f * (P3 + f * (P4 + f * P5))))
    return bits_float(float_bits(p) + (truncated(floor) << np.int32(23)))  # pyrefly: ignore[missing-argument]


@inlined(FAST - {"reassoc"})
def exp2_lanes(x):
    """Compute 2^x for -126 <= x <= 127; other results are undefined."""
    integer = floor(x)
    f = x - integer
    return scaled(f32(1) + f * (P1 + f * (P2 + f * (P3 + f * (P4 + f * P5)))), integer)


@inlined(FAST - {"reassoc"})
def exp_lanes(x):
    """Compute e^x, clamped to normal numbers."""
    return exp2_lanes(smaller(larger(x * LOG2_E, LOWEST_EXPONENT), HIGHEST_EXPONENT))


@inlined(FAST - {"reassoc"})
def log2_lanes(x):
    """Compute the logarithm of positive normal numbers, with a relative error under 1e-6 besides rounding.

    For m = x / 2^n in [3/4, 3/2) and t = (m - 1) / (m + 1), ln m = 2 (t + t³/3 + t⁵/5 + ...).
    """
    n = exponent(x * f32(4 / 3))
    m = scaled(x, f32(0) - n)
    t = (m - f32(1)) / (m + f32(1))
    tt = t * t
    series = f32(1) + tt * (f32(1 / 3) + tt * (f32(1 / 5) + tt * (f32(1 / 7) + tt * f32(1 / 9))))
    return n + LOG2_TERM * t * series


@inlined(FAST - {"reassoc"})
def read_lanes(values, row, x, width, spare):
    """Return the values of an image's row from column ``x`` on, and zeros beyond its end.

    The image is flat, because a kernel counts references to each view of an array by atomic operations.
    """
    if x + WIDTH <= width:
        return load(values, row * width + x)
    for j in range(WIDTH):
        spare[j] = values[row * width + x + j] if x + j < width else f32(0)
    return load(spare, 0)


@inlined(FAST - {"reassoc"})
def write_lanes(values, row, x, width, spare, value):
    """Write values to a flat image's row from column ``x`` to its end."""
    if x + WIDTH <= width:
        store(values, row * width + x, value)
    else:
        store(spare, 0, value)
        for j in range(width - x):
            values[row * width + x + j] = spare[j]
