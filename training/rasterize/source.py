"""Constants and spherical harmonics for shaders and kernels, so that Python alone defines them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ..editing.bake_filter import MIP_VARIANCE
from ..splats import sh as harmonics
from .rendering import ALPHA_MAX, ALPHA_MIN, DILATION, TRANSMITTANCE_MIN

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
COEFFICIENTS = harmonics.coefficient_count(harmonics.MAX_DEGREE)


class _Term:
    """An expression in WGSL or C++, built by arithmetic in Python; ``number`` writes a literal."""

    def __init__(self, text: str, number: Callable[[float], str]) -> None:
        self.text = text
        self._number = number

    def _operation(self, a: Any, sign: str, b: Any) -> _Term:
        texts = (x.text if isinstance(x, _Term) else self._number(float(x)) for x in (a, b))
        return _Term(f"({f' {sign} '.join(texts)})", self._number)

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


def harmonic_expressions(
    number: Callable[[float], str] = repr,
) -> tuple[list[str], list[tuple[str, str, str]]]:
    """Return ``basis`` and ``basis_gradient`` of :mod:`..splats.sh` as expressions of a vector ``d``.

    Args:
        number: writes a literal.
    """
    x, y, z = (_Term(f"d.{axis}", number) for axis in "xyz")
    values: list[Any] = [None] * COEFFICIENTS
    slopes: list[list[Any]] = [[None] * COEFFICIENTS for _ in range(3)]
    harmonics.basis(x, y, z, harmonics.MAX_DEGREE, values)
    harmonics.basis_gradient(x, y, z, harmonics.MAX_DEGREE, *slopes)

    def text(value: Any) -> str:
        return value.text if isinstance(value, _Term) else number(float(value))

    triples = [(text(a), text(b), text(c)) for a, b, c in zip(*slopes, strict=True)]
    return [text(value) for value in values], triples


def by_degree(lines: list[str], stop: str) -> str:
    """Join the lines of all coefficients, with ``stop.format(degree)`` before each degree above 0."""
    body = ""
    for degree in range(harmonics.MAX_DEGREE + 1):
        body += stop.format(degree) if degree else ""
        body += "".join(lines[degree**2 : harmonics.coefficient_count(degree)])
    return body
