"""The LODGS tab of the 3D viewport's sidebar: panels only show state and offer operators."""

from importlib import import_module
from pkgutil import iter_modules

MODULES = tuple(import_module(f"{__name__}.{found.name}") for found in iter_modules(__path__))
