"""Assemble the source of the kernels from constants, harmonics and ``kernels.cu``."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from ..source import CONSTANTS, by_degree, harmonic_expressions


@cache
def kernel_source() -> str:
    """Return the source of all kernels, C++ without headers."""
    constants = [f"#define {name} {value!r}f" for name, value in CONSTANTS.items()]
    constants.append("#define INFINITE __int_as_float(0x7f800000)")
    vector = "struct Vector { float x, y, z; };"
    own = (Path(__file__).parent / "kernels.cu").read_text(encoding="utf-8")
    return "\n".join([*constants, vector, _harmonics(), '#line 1 "kernels.cu"', own])


def _harmonics() -> str:
    """Generate ``basis`` and ``basis_gradient`` of :mod:`...splats.sh` in C++."""

    def function(name: str, kind: str, expressions: list[str]) -> str:
        lines = [f"    out[{k}] = {text};\n" for k, text in enumerate(expressions)]
        body = by_degree(lines, "    if (degree < {0}) {{ return; }}\n")
        return f"__device__ inline void {name}(Vector d, int degree, {kind}* out) {{\n{body}}}\n"

    values, slopes = harmonic_expressions(lambda number: f"{number!r}f")
    triples = [f"Vector{{{', '.join(triple)}}}" for triple in slopes]
    return function("basis", "float", values) + function("basis_gradient", "Vector", triples)
