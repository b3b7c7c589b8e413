"""Who may import whom: only the extension knows Blender, what Blender loads needs no trainer, arrows go down.

Every relative import is an arrow from a file to a file, also a late one and one that only annotates.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TRAINER_ONLY = {
    "torch", "numba", "pycolmap", "PIL", "OpenEXR", "scipy", "torchmetrics", "matplotlib", "pxr",
}  # fmt: skip
PROGRAMS = ("sfm", "sfm_known_poses", "undistort", "pycolmap_process")
"""Files that import pycolmap, in processes of their own."""
BLENDER_ONLY = {"bpy", "bpy_extras", "gpu", "gpu_extras", "mathutils"}

FLOORS = {
    "blender_lodgs": (
        ("__init__",),
        ("operators", "panels", "commands"),
        ("render",),
        ("viewport", "runs"),
        ("data",),
        ("nodes",),
        ("attributes", "compat", "extension"),
    ),
    "training": (
        ("__main__",),
        ("cli", "api"),
        ("render",),
        ("runs",),
        ("evaluate",),
        ("methods",),
        ("optimize",),
        ("rasterize",),
        ("editing",),
        ("lod",),
        ("scenes",),
        ("splats",),
        ("settings",),
        ("documents",),
        ("files",),
        ("errors", "packages", "plugins", "__init__"),
    ),
}
"""The rooms of both packages, from the top: each may import those on the floors below it, and itself."""

Arrow = tuple[str, str]


@cache
def parsed() -> dict[str, ast.Module]:
    """The packages' files by their path from the root."""
    paths = (path for package in FLOORS for path in sorted((ROOT / package).rglob("*.py")))
    return {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8")) for path in paths}


def absolute_imports(file: str) -> set[str]:
    """Top-level packages that a file imports absolutely, anywhere in it."""
    found = set()
    for node in ast.walk(parsed()[file]):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.split(".")[0])
    return found


def file_of(module: tuple[str, ...]) -> str | None:
    """The file of a module of ours; None where there is no such module."""
    path = "/".join(module)
    return next((file for file in (f"{path}.py", f"{path}/__init__.py") if file in parsed()), None)


@cache
def arrows() -> frozenset[Arrow]:
    """(importing file, imported file) for each relative import."""
    found = set()
    for file, tree in parsed().items():
        for node in ast.walk(tree):
            if not isinstance(node, ast.ImportFrom) or not node.level:
                continue
            package = Path(file).parts[: -node.level]
            source = (*package, *(node.module or "").split(".")) if node.module else package
            for alias in node.names:
                target = file_of((*source, alias.name)) or file_of(source)
                assert target, f"{file}:{node.lineno} imports what is not there"
                found.add((file, target))
    return frozenset(found)


def room(file: str) -> tuple[str, str]:
    """The package and the room that a file is in: a folder, or a file that stands in the package itself."""
    package, inside = Path(file).parts[:2]
    return package, inside.removesuffix(".py")


def floor(file: str) -> int:
    """On which floor of its package a file's room is, counted from the top."""
    package, name = room(file)
    for number, rooms in enumerate(FLOORS[package]):
        if name in rooms:
            return number
    raise AssertionError(f"{file} is in no room that FLOORS knows")


def climbs(arrow: Arrow) -> bool:
    importing, imported = arrow
    if room(importing) == room(imported):
        return False
    if room(importing)[0] != room(imported)[0]:
        return room(importing)[0] == "training"  # the trainer knows nothing of Blender
    return floor(imported) <= floor(importing)


def circles(graph: frozenset[Arrow]) -> list[list[str]]:
    """The groups of files of which each is reached from each other."""

    def reached(start: str) -> set[str]:
        found, ahead = set(), [start]
        while ahead:
            here = ahead.pop()
            new = {target for source, target in graph if source == here} - found
            found |= new
            ahead += new
        return found

    beyond = {file: reached(file) for file in {source for source, _ in graph}}
    groups = {
        frozenset(other for other in beyond[file] if file in beyond.get(other, ()))
        for file in beyond
        if file in beyond[file]
    }
    return [sorted(group) for group in groups]


def test_every_file_is_in_a_room():
    assert len(parsed()) > 80
    assert {floor(file) for file in parsed() if file.startswith("training")} == set(
        range(len(FLOORS["training"]))
    )


def test_no_arrow_climbs():
    climbing = {arrow for arrow in arrows() if climbs(arrow)}
    assert not climbing, "\n".join(f"{a} imports {b}" for a, b in sorted(climbing))


def test_there_is_no_circle_of_files():
    for group in circles(arrows()):
        inside = sorted(arrow for arrow in arrows() if {*arrow} <= {*group})
        raise AssertionError("a circle:\n" + "\n".join(f"{a} imports {b}" for a, b in inside))


def arrows_inside(package: str) -> set[Arrow]:
    return {arrow for arrow in arrows() if all(file.startswith(f"{package}/") for file in arrow)}


@pytest.mark.parametrize(("package", "limit"), [("training/methods", 21), ("training/lod", 26)])
def test_files_of_a_package_hardly_import_each_other(package, limit):
    inside = arrows_inside(package)
    assert 0 < len(inside) <= limit, sorted(inside)


KERNELS = ("training/rasterize/cpu/blend.py", "training/rasterize/cpu/project.py")
"""Files with long numerical kernels."""


def test_files_and_functions_are_short():
    """At most 500 lines a file, 60 lines a function."""
    for file, tree in parsed().items():
        assert len((ROOT / file).read_text(encoding="utf-8").splitlines()) <= 500, file
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and file not in KERNELS:
                assert (node.end_lineno or 0) - node.lineno < 60, f"{file}: {node.name}"


TREE = {
    "training/lod/rules/cut.py",
    "training/lod/tree/",
    "training/methods/tree/",
    "blender_lodgs/nodes/rules/cut.py",
}
"""Files that know the tree of splats; all others use it through ``Rule`` and ``MethodInfo``."""


def test_only_its_own_files_import_the_tree():
    importing = {a for a, b in arrows() if b.startswith(tuple(TREE)) and not a.startswith(tuple(TREE))}
    assert not importing, sorted(importing)


@pytest.mark.parametrize(
    ("arrow", "answer"),
    [
        (("blender_lodgs/render/engine.py", "blender_lodgs/runs/processes.py"), False),
        (("blender_lodgs/data/scenes.py", "blender_lodgs/data/objects.py"), False),
        (("blender_lodgs/data/scenes.py", "blender_lodgs/viewport/views.py"), True),
        (("blender_lodgs/viewport/views.py", "blender_lodgs/runs/jobs.py"), True),
        (("blender_lodgs/data/scenes.py", "training/scenes/colmap.py"), False),
        (("training/errors.py", "blender_lodgs/compat.py"), True),
    ],
)
def test_what_climbing_is(arrow, answer):
    assert climbs(arrow) is answer


def test_circles_are_found():
    graph = frozenset({("a", "b"), ("b", "c"), ("c", "a"), ("c", "d"), ("e", "a")})
    assert circles(graph) == [["a", "b", "c"]]
    assert circles(graph - {("c", "a")}) == []


def test_only_the_extension_imports_bpy():
    for file in parsed():
        if file.startswith("training/"):
            assert not absolute_imports(file) & BLENDER_ONLY, file
    assert "bpy" in absolute_imports("blender_lodgs/__init__.py")


def test_the_extension_never_imports_the_trainers_packages():
    for file in parsed():
        if file.startswith("blender_lodgs/"):
            assert not absolute_imports(file) & TRAINER_ONLY, file


def test_imports_inside_the_packages_are_relative():
    for file in parsed():
        assert not absolute_imports(file) & {"training", "blender_lodgs", "bl_ext"}, file


def test_what_blender_loads_works_without_the_trainer():
    """All modules of the trainer's that the extension imports, where its packages are missing."""
    loaded = {b for a, b in arrows() if a.startswith("blender_lodgs/") and b.startswith("training/")}
    modules = sorted(file.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for file in loaded)
    assert len(modules) > 10
    blocked = f"""
import importlib, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {TRAINER_ONLY!r}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Absent())
for name in {modules!r}:
    importlib.import_module(name)
"""
    done = subprocess.run([sys.executable, "-c", blocked], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_pycolmap_runs_only_in_processes_of_its_own():
    """It replaces the handler of SIGTERM, so that a trainer that imports it cannot save and stop."""
    programs = {f"training/scenes/{name}.py" for name in PROGRAMS}
    for file in [file for file in parsed() if "pycolmap" in absolute_imports(file)]:
        assert file in programs, file
    for file in programs:
        at_import = [node for node in parsed()[file].body if isinstance(node, (ast.Import, ast.ImportFrom))]
        assert all(alias.name != "pycolmap" for node in at_import for alias in node.names), file
