"""Assemble the source of shaders from constants, harmonics, shared code and the shader's file.

WGSL has no imports. The constants of :mod:`..rendering` and the basis of :mod:`...splats.sh` are therefore
generated from Python, so they are defined once.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

from ...editing.bake_filter import MIP_VARIANCE
from ...splats import sh as harmonics
from ..rendering import ALPHA_MAX, ALPHA_MIN, DILATION, TRANSMITTANCE_MIN

SHADERS = Path(__file__).parent / "shaders"
CONSTANTS = {
    "ALPHA_MAX": ALPHA_MAX,
    "ALPHA_MIN": ALPHA_MIN,
    "LOG2_ALPHA_MIN": math.log2(ALPHA_MIN),
    "DILATION": DILATION,
    "MIP_VARIANCE": MIP_VARIANCE,
    "TRANSMITTANCE_MIN": TRANSMITTANCE_MIN,
    "LOG2_E": math.log2(math.e),
    "LN2": math.log(2),
    "WINDOW_MIDDLE": 1 / sum(math.exp(-(distance**2) / 4.5) for distance in range(-5, 6)),
}


@cache
def source_of(shader: str) -> str:
    """Return the source of a shader by its file name without extension."""
    constants = "\n".join(f"const {name}: f32 = {value!r};" for name, value in CONSTANTS.items())
    shared, own = ((SHADERS / f"{name}.wgsl").read_text(encoding="utf-8") for name in ("common", shader))
    return "\n".join([constants, shared, _harmonics() if "basis" in own else "", own])


class _Term:
    """A WGSL expression, built by arithmetic in Python."""

    def __init__(self, text: str) -> None:
        self.text = text

    @staticmethod
    def _operation(a: Any, sign: str, b: Any) -> _Term:
        texts = (x.text if isinstance(x, _Term) else repr(float(x)) for x in (a, b))
        return _Term(f"({f' {sign} '.join(texts)})")

    def __add__(self, value: Any) -> _Term:
        return self._operation(self, "+", value)

    def __radd__(self, value: Any) -> _Term:
        return self._operation(value, "+", self)

    def __sub__(self, value: Any) -> _Term:
        return self._operation(self, "-", value)

    def __rsub__(self, value: Any) -> _Term:
        return self._operation(value, "-", self)

    def __mul__(self, value: Any) -> _Term:
        return self._operation(self, "*", value)

    def __rmul__(self, value: Any) -> _Term:
        return self._operation(value, "*", self)


def _harmonics() -> str:
    """Generate ``basis`` and ``basis_gradient`` of :mod:`...splats.sh` in WGSL, degree by degree."""
    count = harmonics.coefficient_count(harmonics.MAX_DEGREE)
    direction = _Term("d.x"), _Term("d.y"), _Term("d.z")
    values: list[Any] = [None] * count
    slopes: list[list[Any]] = [[None] * count for _ in range(3)]
    harmonics.basis(*direction, harmonics.MAX_DEGREE, values)
    harmonics.basis_gradient(*direction, harmonics.MAX_DEGREE, *slopes)

    def text(value: Any) -> str:
        return value.text if isinstance(value, _Term) else repr(float(value))

    def function(name: str, kind: str, lines: list[str]) -> str:
        body = ""
        for degree in range(harmonics.MAX_DEGREE + 1):
            body += f"    if (degree < {degree}u) {{ return; }}\n" if degree else ""
            body += "".join(
                f"    (*out)[{k}] = {lines[k]};\n"
                for k in range(degree**2, harmonics.coefficient_count(degree))
            )
        return f"fn {name}(d: vec3f, degree: u32, out: ptr<function, array<{kind}, {count}>>) {{\n{body}}}\n"

    triples = [f"vec3f({', '.join(map(text, triple))})" for triple in zip(*slopes, strict=True)]
    return function("basis", "f32", [text(value) for value in values]) + function(
        "basis_gradient", "vec3f", triples
    )
