"""The extension's operators: thin classes that each call one function, which scripts and tests call too."""

from importlib import import_module
from pkgutil import iter_modules

MODULES = tuple(import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__))
