"""The LODGS tab of the 3D viewport's sidebar: panels only show state and offer operators."""

from importlib import import_module
from pkgutil import iter_modules

_MODULES = [import_module(f"{__name__}.{found.name}") for found in iter_modules(__path__)]
CLASSES = tuple(cls for module in _MODULES for cls in module.CLASSES)


def register() -> None:
    """What panels add to Blender's own."""
    for module in _MODULES:
        if hasattr(module, "register"):
            module.register()


def unregister() -> None:
    for module in reversed(_MODULES):
        if hasattr(module, "unregister"):
            module.unregister()
