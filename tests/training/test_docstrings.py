"""Whatever is public in ``training`` says what it is: `make docs` shows nothing else."""

import inspect
from importlib import import_module
from pkgutil import walk_packages

import pytest

import training

MODULES = sorted(found.name for found in walk_packages(training.__path__, "training."))


def public(owner, module: str):
    """(name, object) of what ``owner`` defines here without an underscore; what it imports is left out."""
    for name, value in vars(owner).items():
        value = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        described = value.fget if isinstance(value, property) else value
        home = getattr(described, "__module__", "")  # a ufunc, scipy's expit for one, has none
        if not name.startswith("_") and callable(described) and home == module:
            yield name, value


def described(owner, name: str) -> bool:
    """Whether it has a docstring, its own or that of what it overrides; dataclasses make empty ones up."""
    text = inspect.getdoc(getattr(owner, name))
    return bool(text) and not text.startswith(f"{name}(")


@pytest.mark.parametrize("name", MODULES)
def test_whatever_is_public_has_a_docstring(name):
    module = import_module(name)
    bare = [found for found, _ in public(module, name) if not described(module, found)]
    for owner, value in public(module, name):
        if inspect.isclass(value):
            bare += [f"{owner}.{found}" for found, _ in public(value, name) if not described(value, found)]
    assert bare == [] and module.__doc__
