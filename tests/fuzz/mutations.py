"""Strategies that corrupt valid files, texts and JSON values."""

from __future__ import annotations

import json
import re
import struct
from copy import deepcopy

from hypothesis import strategies as st

UNUSUAL_NUMBERS = [
    "-0", "-1", "0", "1e400", "-1e400", "1e-400", "nan", "NaN", "inf", "-Infinity", "1.5", "65536",
    "2147483648", "4294967295", "9223372036854775807", "18446744073709551616", "1" + "0" * 400, "9" * 5000,
    "1e38", "1e300", "1e-300", "0x10", "1_000", "٣",
]  # fmt: skip
"""Replacements for numbers in texts."""
UNUSUAL_BYTES = [
    *(struct.pack("<f", value) for value in (float("nan"), float("inf"), -float("inf"), 3.4e38, 1e-45, -0.0)),
    *(struct.pack("<d", value) for value in (float("nan"), float("inf"), 1e308, 1e20)),
    *(struct.pack("<Q", value) for value in (0, 1, 2**31, 2**32 - 1, 2**60, 2**63, 2**64 - 1)),
    b"\0" * 64, b"\xff" * 64, b"\n", b"\r\n", b" ", b"\xef\xbb\xbf", "é".encode("latin-1"), b"\x1a",
]  # fmt: skip
"""Replacements for bytes."""
UNUSUAL_VALUES = st.one_of(
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
"""Replacements for values in JSON or TOML."""


@st.composite
def corrupted(draw, seeds: list[bytes]) -> bytes:
    """Return a seed after one to four changes.

    Flip a bit; replace, zero, truncate, repeat, delete or insert bytes; copy bytes from another seed; replace
    a number in a text; or insert unclosed brackets.
    """
    data = draw(st.sampled_from(seeds))
    for _ in range(draw(st.sampled_from([1, 1, 2, 4]))):
        data = draw(_one_change(data, seeds))
    return data


@st.composite
def _one_change(draw, data: bytes, seeds: list[bytes]) -> bytes:
    # Half of the changes affect the beginning, which contains the header.
    limit = draw(st.sampled_from([len(data), min(len(data), 400)]))
    offset = draw(st.integers(0, limit))
    length = draw(st.sampled_from([1, 4, 8, 100, 4000, len(data)]))
    head, middle, tail = data[:offset], data[offset : offset + length], data[offset + length :]
    match draw(st.integers(0, 10)):
        case 0:
            if not middle:
                return data
            return head + bytes([middle[0] ^ (1 << draw(st.integers(0, 7)))]) + middle[1:] + tail
        case 1:
            replacement = draw(st.sampled_from(UNUSUAL_BYTES))
            return head + replacement + data[offset + len(replacement) :]
        case 2:
            return head + bytes(len(middle)) + tail
        case 3:
            return head
        case 4:
            return head + middle + middle + tail
        case 5:
            return head + tail
        case 6:
            return head + draw(st.binary(max_size=16)) + middle + tail
        case 7:
            source = draw(st.sampled_from(seeds))
            begin = draw(st.integers(0, len(source)))
            return head + source[begin : begin + length] + tail
        case 8 | 9:
            numbers = list(re.finditer(rb"-?\d+(\.\d+)?(e-?\d+)?", data[:20_000]))
            if not numbers:
                return data
            number = draw(st.sampled_from(numbers))
            replacement = draw(st.sampled_from(UNUSUAL_NUMBERS)).encode()
            return data[: number.start()] + replacement + data[number.end() :]
        case _:
            opening = draw(st.sampled_from([b"[", b"{", b'{"a":', b"[{a=", b"a.", b'"', b"(", b"\n["]))
            return head + opening * draw(st.sampled_from([1, 20, 1000, 40_000])) + tail


@st.composite
def corrupted_value(draw, value):
    """Return a JSON value after one to three changes.

    Replace a value, or delete, add, rename or repeat a key or an entry.
    """
    value = deepcopy(value)
    for _ in range(draw(st.integers(1, 3))):
        entries = list(_entries(value))
        if not entries:
            return draw(UNUSUAL_VALUES)
        container, key = draw(st.sampled_from(entries))
        match draw(st.integers(0, 5)):
            case 0:
                del container[key]
            case 1 if isinstance(container, list):
                container.append(deepcopy(container[key]))
            case 1:
                container[draw(st.text(max_size=8))] = container.pop(key)
            case _:
                container[key] = deepcopy(draw(UNUSUAL_VALUES))
    return value


def _entries(value):
    """Yield each container in a value with each of its keys or indices."""
    if isinstance(value, dict | list):
        for key in list(value) if isinstance(value, dict) else range(len(value)):
            yield value, key
            yield from _entries(value[key])


@st.composite
def corrupted_comments(draw, content):
    """Return a bundle, as bytes, with a corrupted value in one of its JSON comments."""
    end = content.index(b"end_header")
    comments = content[:end].split(b"comment lodsplat ")
    index = draw(st.integers(1, len(comments) - 1))
    comment, *lines = comments[index].split(b"\n")
    comments[index] = b"\n".join([json.dumps(draw(corrupted_value(json.loads(comment)))).encode(), *lines])
    return b"comment lodsplat ".join(comments) + content[end:]
