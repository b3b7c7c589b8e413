"""The text of the shaders: the definition's constants and harmonics, what all share, and a file of their own.

WGSL has no imports, so the constants of :mod:`..rendering` and the basis of :mod:`...splats.sh` are written
into it: nothing stands twice.
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
    """The text of a shader, by the name of its file without the ending."""
    constants = "\n".join(f"const {name}: f32 = {value!r};" for name, value in CONSTANTS.items())
    shared, own = ((SHADERS / f"{name}.wgsl").read_text(encoding="utf-8") for name in ("common", shader))
    return "\n".join([constants, shared, _harmonics() if "basis" in own else "", own])


class _Term:
    """An expression in WGSL that grows as Python calculates with it."""

    def __init__(self, text: str) -> None:
        self.text = text

    @staticmethod
    def _joined(one: Any, sign: str, other: Any) -> _Term:
        texts = (each.text if isinstance(each, _Term) else repr(float(each)) for each in (one, other))
        return _Term(f"({f' {sign} '.join(texts)})")

    def __add__(self, other: Any) -> _Term:
        return self._joined(self, "+", other)

    def __radd__(self, other: Any) -> _Term:
        return self._joined(other, "+", self)

    def __sub__(self, other: Any) -> _Term:
        return self._joined(self, "-", other)

    def __rsub__(self, other: Any) -> _Term:
        return self._joined(other, "-", self)

    def __mul__(self, other: Any) -> _Term:
        return self._joined(self, "*", other)

    def __rmul__(self, other: Any) -> _Term:
        return self._joined(other, "*", self)


def _harmonics() -> str:
    """``basis`` and ``basis_gradient`` of :mod:`...splats.sh` as WGSL, band by band."""
    most = harmonics.coefficient_count(harmonics.MAX_DEGREE)
    direction = _Term("d.x"), _Term("d.y"), _Term("d.z")
    values: list[Any] = [None] * most
    slopes: list[list[Any]] = [[None] * most for _ in range(3)]
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
        return f"fn {name}(d: vec3f, degree: u32, out: ptr<function, array<{kind}, {most}>>) {{\n{body}}}\n"

    triples = [f"vec3f({', '.join(map(text, triple))})" for triple in zip(*slopes, strict=True)]
    return function("basis", "f32", [text(value) for value in values]) + function(
        "basis_gradient", "vec3f", triples
    )
