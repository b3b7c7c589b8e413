"""The LODGS tab of the 3D viewport's sidebar: panels only show state and offer operators."""

from importlib import import_module
from pkgutil import iter_modules

CLASSES = tuple(
    cls for found in iter_modules(__path__) for cls in import_module(f"{__name__}.{found.name}").CLASSES
)
