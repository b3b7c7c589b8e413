"""Published level-of-detail methods behind one interface, one folder per method.

A folder's ``__init__.py`` declares the method (``METHOD``, a `MethodInfo`) and does not import torch. Its
``train.py`` defines the class ``Method``, derived from ``optimize.method.Method``. New folders need no
registration.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any

from ..documents import quote
from ..errors import LodgsError
from ..optimize.method_info import PRESETS, MethodInfo
from ..optimize.parameters import Parameters, override

if TYPE_CHECKING:
    from ..optimize.method import Method
    from ..optimize.training_data import TrainingData
    from ..splats.gaussians import SplatRows

__all__ = ["METHODS", "PRESETS", "MethodInfo", "create", "discover", "method_info", "resolve_parameters"]


def discover() -> dict[str, MethodInfo]:
    """Return the methods in this package by name, ordered by number."""
    folders = [f"{__name__}.{module.name}" for module in iter_modules(__path__) if module.ispkg]
    methods = [replace(import_module(folder).METHOD, package=folder) for folder in folders]
    return {method.name: method for method in sorted(methods, key=lambda method: method.number)}


METHODS = discover()
"""All methods by name."""


def method_info(name: str) -> MethodInfo:
    """Return the description of a method.

    Raises:
        LodgsError: the method is unknown.
    """
    if name not in METHODS:
        raise LodgsError(f"Unknown method: {quote(name)}.", f"Choose one of: {', '.join(METHODS)}.")
    return METHODS[name]


def resolve_parameters(method: str, preset: str, changes: dict[str, Any]) -> Parameters:
    """Return the parameters of a preset, with changes by parameter name.

    Raises:
        LodgsError: the method or preset is unknown, or a change is invalid.
    """
    info = method_info(method)
    if unused := sorted(set(changes) & set(info.unused)):
        raise LodgsError(f"{info.label} does not use the parameter '{unused[0]}'.", "Remove it.")
    return override(info.preset(preset), changes)


def create(
    name: str,
    data: TrainingData,
    parameters: Parameters,
    seed: int,
    backend: str,
    base: SplatRows | None = None,
) -> Method:
    """Create a method, ready for its first training step.

    Args:
        name: key of METHODS.
        backend: rasterizer backend; it decides the device of the tensors (``rasterize.tensor_device``).
        base: initial splats instead of the scene's points, if the method supports them (``from_base``). Must
            be in memory unless the method reads them in parts (``streams_base``).

    Raises:
        LodgsError: the scene has too few points, or no view sees any.
    """
    method = import_module(f"{method_info(name).package}.train").Method
    return method(data, parameters, seed, backend, base)
