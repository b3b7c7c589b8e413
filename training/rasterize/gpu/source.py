"""Assemble the source of shaders from constants, harmonics, shared code and the shader's file.

WGSL has no imports.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from ..source import COEFFICIENTS, CONSTANTS, by_degree, harmonic_expressions

SHADERS = Path(__file__).parent / "shaders"


@cache
def source_of(shader: str) -> str:
    """Return the source of a shader by its file name without extension."""
    constants = "\n".join(f"const {name}: f32 = {value!r};" for name, value in CONSTANTS.items())
    shared, own = ((SHADERS / f"{name}.wgsl").read_text(encoding="utf-8") for name in ("common", shader))
    return "\n".join([constants, shared, _harmonics() if "basis" in own else "", own])


def _harmonics() -> str:
    """Generate ``basis`` and ``basis_gradient`` of :mod:`...splats.sh` in WGSL."""

    def function(name: str, kind: str, expressions: list[str]) -> str:
        lines = [f"    (*out)[{k}] = {text};\n" for k, text in enumerate(expressions)]
        body = by_degree(lines, "    if (degree < {0}u) {{ return; }}\n")
        parameters = f"d: vec3f, degree: u32, out: ptr<function, array<{kind}, {COEFFICIENTS}>>"
        return f"fn {name}({parameters}) {{\n{body}}}\n"

    values, slopes = harmonic_expressions()
    triples = [f"vec3f({', '.join(triple)})" for triple in slopes]
    return function("basis", "f32", values) + function("basis_gradient", "vec3f", triples)
