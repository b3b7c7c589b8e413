"""Input that goes wrong in every way: strategies that spoil good files, texts and JSON values."""

from __future__ import annotations

import json
import re
import struct
from copy import deepcopy

from hypothesis import strategies as st

ODD_NUMBERS = [
    "-0", "-1", "0", "1e400", "-1e400", "1e-400", "nan", "NaN", "inf", "-Infinity", "1.5", "65536",
    "2147483648", "4294967295", "9223372036854775807", "18446744073709551616", "1" + "0" * 400, "9" * 5000,
    "1e38", "1e300", "1e-300", "0x10", "1_000", "٣",
]  # fmt: skip
"""Texts in place of a number."""
ODD_BYTES = [
    *(struct.pack("<f", value) for value in (float("nan"), float("inf"), -float("inf"), 3.4e38, 1e-45, -0.0)),
    *(struct.pack("<d", value) for value in (float("nan"), float("inf"), 1e308, 1e20)),
    *(struct.pack("<Q", value) for value in (0, 1, 2**31, 2**32 - 1, 2**60, 2**63, 2**64 - 1)),
    b"\0" * 64, b"\xff" * 64, b"\n", b"\r\n", b" ", b"\xef\xbb\xbf", "é".encode("latin-1"), b"\x1a",
]  # fmt: skip
"""Bytes in place of others."""
ODD_VALUES = st.one_of(
    st.sampled_from(
        [
            None, True, False, 0, -1, 1, 2**31, 2**63, -(2**64), 10**400, 1e308, -1e308, 1e-320, 0.5,
            float("nan"), float("inf"), "", "a", "\0", "a\0b", "\ud800", "../..", "/", "NaN", "x" * 5000, [],
            {}, [[]], [None], [1, 2, 3], [[1, 0], [0]], {"a": 1}, {"": {}}, [True], ["a"], [1e308] * 16,
        ]
    ),
    st.integers(), st.floats(), st.text(max_size=8),
    st.integers(2, 60).map(lambda depth: json.loads("[" * depth + "]" * depth)),
)  # fmt: skip
"""Values in place of one in JSON or TOML."""


@st.composite
def spoiled(draw, seeds: list[bytes]) -> bytes:
    """One of the seeds after one to four of: a bit flipped, bytes odd, zeroed, cut, doubled, left out, put
    in, taken from another seed; a number in a text odd; brackets without an end."""
    data = draw(st.sampled_from(seeds))
    for _ in range(draw(st.sampled_from([1, 1, 2, 4]))):
        data = draw(_one_change(data, seeds))
    return data


@st.composite
def _one_change(draw, data: bytes, seeds: list[bytes]) -> bytes:
    # half of the places lie near the begin, where heads are
    most = draw(st.sampled_from([len(data), min(len(data), 400)]))
    at = draw(st.integers(0, most))
    length = draw(st.sampled_from([1, 4, 8, 100, 4000, len(data)]))
    head, cut, tail = data[:at], data[at : at + length], data[at + length :]
    match draw(st.integers(0, 10)):
        case 0:
            return head + bytes([cut[0] ^ (1 << draw(st.integers(0, 7)))]) + cut[1:] + tail if cut else data
        case 1:
            odd = draw(st.sampled_from(ODD_BYTES))
            return head + odd + data[at + len(odd) :]
        case 2:
            return head + bytes(len(cut)) + tail
        case 3:
            return head
        case 4:
            return head + cut + cut + tail
        case 5:
            return head + tail
        case 6:
            return head + draw(st.binary(max_size=16)) + cut + tail
        case 7:
            other = draw(st.sampled_from(seeds))
            begin = draw(st.integers(0, len(other)))
            return head + other[begin : begin + length] + tail
        case 8 | 9:
            numbers = list(re.finditer(rb"-?\d+(\.\d+)?(e-?\d+)?", data[:20_000]))
            if not numbers:
                return data
            number = draw(st.sampled_from(numbers))
            odd = draw(st.sampled_from(ODD_NUMBERS)).encode()
            return data[: number.start()] + odd + data[number.end() :]
        case _:
            opening = draw(st.sampled_from([b"[", b"{", b'{"a":', b"[{a=", b"a.", b'"', b"(", b"\n["]))
            return head + opening * draw(st.sampled_from([1, 20, 1000, 40_000])) + tail


@st.composite
def spoiled_value(draw, value):
    """A value as JSON has it after one to three of: an odd value in some place, a key gone, new or renamed,
    an entry twice."""
    value = deepcopy(value)
    for _ in range(draw(st.integers(1, 3))):
        places = list(_places(value))
        if not places:
            return draw(ODD_VALUES)
        inside, key = draw(st.sampled_from(places))
        match draw(st.integers(0, 5)):
            case 0:
                del inside[key]
            case 1 if isinstance(inside, list):
                inside.append(deepcopy(inside[key]))
            case 1:
                inside[draw(st.text(max_size=8))] = inside.pop(key)
            case _:
                inside[key] = deepcopy(draw(ODD_VALUES))
    return value


def _places(value):
    """Each container in a value with each key or index of it."""
    if isinstance(value, dict | list):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            yield value, key
            yield from _places(value[key])
