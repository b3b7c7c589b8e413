"""The verbs: one thin operator class a verb, each calling one function that scripts and tests call too."""

from importlib import import_module
from pkgutil import iter_modules

MODULES = tuple(import_module(f"{__name__}.{found.name}") for found in iter_modules(__path__))
