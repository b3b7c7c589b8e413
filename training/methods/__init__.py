"""Published level-of-detail methods behind one interface, one folder per method.

A folder's ``__init__.py`` declares the method (``METHOD``, a `MethodInfo`) and does not import torch. Its
``train.py`` defines the class ``Method``, derived from ``optimize.method.Method``. New folders need no
registration. Other packages add methods of the same form as entry points (``plugins.METHODS_GROUP``).
"""

from __future__ import annotations

import re
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ..documents import quote
from ..errors import LodgsError
from ..optimize.method_info import PRESETS, MethodInfo
from ..optimize.parameters import Parameters, override
from ..plugins import METHODS_GROUP, load_plugins

if TYPE_CHECKING:
    from ..optimize.method import Method
    from ..optimize.training_data import TrainingData
    from ..splats.gaussians import SplatRows

__all__ = ["METHODS", "PRESETS", "MethodInfo", "create", "discover", "method_info", "resolve_parameters"]


def discover() -> dict[str, MethodInfo]:
    """Return the methods in this package and of plug-ins by name, ordered by number."""
    folders = [f"{__name__}.{module.name}" for module in iter_modules(__path__) if module.ispkg]
    methods = [replace(import_module(folder).METHOD, package=folder) for folder in folders]

    def add(module: ModuleType) -> None:
        _check_plugin(module, methods)
        methods.append(replace(module.METHOD, package=module.__name__))

    load_plugins(METHODS_GROUP, add)
    return {method.name: method for method in sorted(methods, key=lambda method: method.number)}


def _check_plugin(module: ModuleType, methods: list[MethodInfo]) -> None:
    """Raise ValueError or ImportError unless a module declares a method that can be added to others."""
    method = module.METHOD
    if not isinstance(method, MethodInfo):
        raise ValueError("METHOD is not a MethodInfo")
    if not re.fullmatch("[a-z0-9_]+", method.name):
        raise ValueError(f"the name {quote(method.name)} has characters other than a-z, 0-9 and _")
    for key in ("name", "number"):
        if getattr(method, key) in [getattr(other, key) for other in methods]:
            raise ValueError(f"another method has the {key} {quote(getattr(method, key))}")
    if missing := sorted(PRESETS.keys() - method.presets.keys()):
        raise ValueError(f"it has no preset {quote(missing[0])}")
    if unknown := sorted({*method.panel_parameters} - {field.name for field in method.fields}):
        raise ValueError(f"panel_parameters names an unknown parameter {quote(unknown[0])}")
    if find_spec(f"{module.__name__}.train") is None:
        raise ImportError(f"no module {module.__name__}.train")


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
