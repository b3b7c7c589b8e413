"""Methods and rules of third-party packages, which installed packages declare as entry points."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.metadata import entry_points
from types import ModuleType

METHODS_GROUP = "lodgs.methods"
"""Entry points of packages with ``METHOD`` and a submodule ``train``, as the folders of ``methods``."""
RULES_GROUP = "lodgs.rules"
"""Entry points of modules with ``RULE``, as the modules of ``lod.rules``."""

_INSTALLED = "lodgs"
"""Name under which plug-ins import this package."""


def load_plugins(group: str, add: Callable[[ModuleType], None]) -> None:
    """Import the modules of an entry-point group, sorted by name, and pass each to ``add``.

    A plug-in that fails to import, or that ``add`` rejects with an exception, is skipped with a warning.
    """
    try:
        entries = sorted(entry_points(group=group), key=lambda entry: entry.name)
    except Exception as error:  # malformed metadata of any installed package
        warnings.warn(f"Cannot search for plug-ins of LODGS: {_reason(error)}.", stacklevel=2)
        return
    if entries:
        _provide_installed_name()
    for entry in entries:
        try:
            add(import_module(entry.module))
        except (Exception, SystemExit) as error:
            package = entry.dist.name if entry.dist else entry.value
            warnings.warn(
                f"Skipped '{entry.name}' ({group}) of the package {package}: {_reason(error)}.", stacklevel=2
            )


def _reason(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".removesuffix(".")


def _provide_installed_name() -> None:
    """Make plug-ins import this package where it has another name: in a checkout and in Blender."""
    if _root() != _INSTALLED and not any(isinstance(finder, _Alias) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Alias())


def _root() -> str:
    return __name__.rpartition(".")[0]


class _Alias(MetaPathFinder, Loader):
    """Importer that finds the modules of this package under its installed name."""

    def find_spec(self, fullname, path=None, target=None) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if f"{fullname}.".startswith(f"{_INSTALLED}.") else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = import_module(_root() + spec.name.removeprefix(_INSTALLED))
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state  # the import system has replaced it
