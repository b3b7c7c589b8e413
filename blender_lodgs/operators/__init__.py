"""The verbs: one thin operator class a verb, each calling one function that scripts and tests call too."""

from importlib import import_module
from pkgutil import iter_modules

_MODULES = [import_module(f"{__name__}.{found.name}") for found in iter_modules(__path__)]
CLASSES = tuple(cls for module in _MODULES for cls in getattr(module, "CLASSES", ()))


def register() -> None:
    """Menus and the like of the operators that have some."""
    for module in _MODULES:
        if hasattr(module, "register"):
            module.register()


def unregister() -> None:
    for module in reversed(_MODULES):
        if hasattr(module, "unregister"):
            module.unregister()
