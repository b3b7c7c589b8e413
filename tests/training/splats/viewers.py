"""How three families of viewers read a PLY header, written from their rules and as strict as they are.

Each returns the finest rows as a float array (N, columns), or raises ValueError as the viewer would fail.
"""

import re

import numpy as np

SIZES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}


def strict(data: bytes) -> dict[str, tuple[int, int, list[str]]]:
    """splat-transform, SuperSplat: an unknown keyword throws, no lists, and the size must fit exactly.

    Returns element name -> (offset from the first data byte, count, column names).
    """
    end = data.index(b"\nend_header\n") + len(b"\nend_header\n")
    if end > 128 * 1024:
        raise ValueError("header too long")
    elements, stride = {}, {}
    for line in data[:end].decode("ascii").split("\n")[:-1]:
        words = line.split(" ")
        match words[0]:
            case "ply" | "comment" | "end_header":
                pass
            case "format":
                if words[1:] != ["binary_little_endian", "1.0"]:
                    raise ValueError(line)
            case "element":
                name = words[1]
                elements[name], stride[name] = (int(words[2]), []), 0
            case "property":
                if len(words) != 3:
                    raise ValueError(line)
                elements[name][1].append(words[2])
                stride[name] += SIZES[words[1]]
            case _:
                raise ValueError(f"unrecognised header line {line!r}")
    found, offset = {}, 0
    for name, (count, columns) in elements.items():
        found[name] = (offset, count, columns)
        offset += count * stride[name]
    if end + offset != len(data):
        raise ValueError("size does not fit the header")
    return found


def fixed_record(data: bytes, degree: int) -> np.ndarray:
    """SIBR: the vertex count is on line 3, the rest of the header is skipped, records are all float."""
    lines = data.split(b"\n", 3)
    found = re.fullmatch(rb"element vertex (\d+)", lines[2])
    if not found:
        raise ValueError("line 3 is not the vertex count")
    start = data.index(b"\nend_header\n") + len(b"\nend_header\n")
    width = 3 + 3 + 3 * (degree + 1) ** 2 + 1 + 3 + 4
    return np.frombuffer(data, "<f4", int(found[1]) * width, start).reshape(-1, width)


def sums_all_properties(data: bytes) -> np.ndarray:
    """antimatter15, gsplat.js: a header within 10 KB; the stride counts every property line in it."""
    head = data[: 10 * 1024]
    start = head.index(b"\nend_header\n") + len(b"\nend_header\n")
    count = int(re.search(rb"element vertex (\d+)\n", head)[1])
    width = len(re.findall(rb"(?m)^property float ", head[:start]))
    if start + 4 * width * count > len(data):
        raise ValueError("out of bounds")
    return np.frombuffer(data, "<f4", count * width, start).reshape(-1, width)
