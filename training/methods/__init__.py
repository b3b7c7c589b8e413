"""The papers' methods behind one interface, a folder each. Importing this package needs no torch; making a
method does.

A folder's ``__init__.py`` declares the method (``METHOD``, a `MethodInfo`; no torch), its ``train.py`` holds
the class ``Method``, which derives from ``optimize.method.Method``. Folders are found, not listed.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING

from ..documents import quote
from ..errors import LodgsError
from ..optimize.method_info import PRESETS, MethodInfo
from ..optimize.parameters import Parameters, override

if TYPE_CHECKING:
    from ..optimize.method import Method
    from ..optimize.training_data import TrainingData
    from ..splats.gaussians import SplatRows

__all__ = ["METHODS", "PRESETS", "MethodInfo", "create", "found", "method_info", "parameters_of"]


def found() -> dict[str, MethodInfo]:
    """The methods whose folders lie in this package, by name, in the order of their numbers."""
    folders = [f"{__name__}.{module.name}" for module in iter_modules(__path__) if module.ispkg]
    methods = [replace(import_module(folder).METHOD, package=folder) for folder in folders]
    return {method.name: method for method in sorted(methods, key=lambda method: method.number)}


METHODS = found()
"""Every method, by name."""


def method_info(name: str) -> MethodInfo:
    """What a method says of itself.

    Raises:
        LodgsError: there is no such method.
    """
    if name not in METHODS:
        raise LodgsError(f"There is no method {quote(name)}.", f"Choose one of: {', '.join(METHODS)}.")
    return METHODS[name]


def parameters_of(method: str, preset: str, changes: dict) -> Parameters:
    """The parameters that a method is trained with: a preset's, with changes by name.

    Raises:
        LodgsError: there is no such method or preset, or a change is not possible.
    """
    info = method_info(method)
    if idle := sorted(set(changes) & set(info.unused)):
        raise LodgsError(f"{info.label} has no use for '{idle[0]}'.", "Leave it out.")
    return override(info.preset(preset), changes)


def create(
    name: str,
    data: TrainingData,
    parameters: Parameters,
    seed: int,
    backend: str,
    base: SplatRows | None = None,
) -> Method:
    """The method of a job, ready for its first step.

    Args:
        name: a key of METHODS.
        backend: the rasterizer's; the tensors live where it draws (``rasterize.tensor_device``).
        base: splats to begin with instead of the scene's points, where the method can (``from_base``); in
            memory, but for methods that take them in parts (``streams_base``).

    Raises:
        LodgsError: the scene has too few points, or no view sees any.
    """
    method = import_module(f"{method_info(name).package}.train").Method
    return method(data, parameters, seed, backend, base)
