"""PLY header readers that are as strict as three families of viewers.

Each returns the finest rows as a float array (N, columns), or raises ValueError if the viewer would fail.
"""

import re

import numpy as np

SIZES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}


def strict(data: bytes) -> dict[str, tuple[int, int, list[str]]]:
    """Read as splat-transform and SuperSplat do: no unknown keywords, no lists, and an exact size.

    Returns:
        Element name -> (offset from the first data byte, count, column names).
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
    layout, offset = {}, 0
    for name, (count, columns) in elements.items():
        layout[name] = (offset, count, columns)
        offset += count * stride[name]
    if end + offset != len(data):
        raise ValueError("size does not fit the header")
    return layout


def fixed_record(data: bytes, degree: int) -> np.ndarray:
    """Read as SIBR does: vertex count on line 3, no further header checks, float records."""
    lines = data.split(b"\n", 3)
    match = re.fullmatch(rb"element vertex (\d+)", lines[2])
    if not match:
        raise ValueError("line 3 is not the vertex count")
    start = data.index(b"\nend_header\n") + len(b"\nend_header\n")
    width = 3 + 3 + 3 * (degree + 1) ** 2 + 1 + 3 + 4
    return np.frombuffer(data, "<f4", int(match[1]) * width, start).reshape(-1, width)


def read_all_properties(data: bytes) -> np.ndarray:
    """Read as antimatter15 and gsplat.js do: header within 10 KB, stride of all its property lines."""
    head = data[: 10 * 1024]
    start = head.index(b"\nend_header\n") + len(b"\nend_header\n")
    count = int(re.search(rb"element vertex (\d+)\n", head)[1])
    width = len(re.findall(rb"(?m)^property float ", head[:start]))
    if start + 4 * width * count > len(data):
        raise ValueError("out of bounds")
    return np.frombuffer(data, "<f4", count * width, start).reshape(-1, width)
