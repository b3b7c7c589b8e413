"""Panels of the LODGS tab in the 3D viewport's sidebar; they show state and offer operators."""

from importlib import import_module
from pkgutil import iter_modules

MODULES = tuple(import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__))
