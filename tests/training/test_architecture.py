"""Import rules: only the extension imports bpy, Blender needs no package of the trainer, imports go down.

Every relative import counts, also one inside a function or for annotations.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parents[2]
TRAINER_ONLY = {
    "torch", "numba", "pycolmap", "PIL", "OpenEXR", "scipy", "torchmetrics", "matplotlib", "pxr",
}  # fmt: skip
PROGRAMS = ("sfm", "sfm_known_poses", "undistort", "pycolmap_process")
"""Files that import pycolmap, in processes of their own."""
BLENDER_ONLY = {"bpy", "bpy_extras", "gpu", "gpu_extras", "mathutils"}

LAYERS = {
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
        ("color", "errors", "packages", "plugins", "__init__"),
    ),
}
"""Layers of both packages, from the top. Each part imports only parts of lower layers, and itself."""

Import = tuple[str, str]
"""Importing file and imported file."""


@cache
def parsed() -> dict[str, ast.Module]:
    """Return the packages' syntax trees by path relative to the root."""
    paths = (path for package in LAYERS for path in sorted((ROOT / package).rglob("*.py")))
    return {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8")) for path in paths}


@cache
def import_nodes(file: str) -> list[ast.Import | ast.ImportFrom]:
    return [node for node in ast.walk(parsed()[file]) if isinstance(node, ast.Import | ast.ImportFrom)]


def absolute_imports(file: str) -> set[str]:
    """Return the names of top-level packages that a file imports absolutely."""
    names = set()
    for node in import_nodes(file):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif node.level == 0 and node.module:
            names.add(node.module.split(".")[0])
    return names


def file_of(module: tuple[str, ...]) -> str | None:
    """Return the file of a module of these packages, or None."""
    path = "/".join(module)
    return next((file for file in (f"{path}.py", f"{path}/__init__.py") if file in parsed()), None)


@cache
def relative_imports() -> frozenset[Import]:
    imports = set()
    for file in parsed():
        for node in import_nodes(file):
            if not isinstance(node, ast.ImportFrom) or not node.level:
                continue
            package = Path(file).parts[: -node.level]
            source = (*package, *(node.module or "").split(".")) if node.module else package
            for alias in node.names:
                target = file_of((*source, alias.name)) or file_of(source)
                assert target, f"{file}:{node.lineno} imports a missing module"
                imports.add((file, target))
    return frozenset(imports)


def part_of(file: str) -> tuple[str, str]:
    """Return the package of a file, and its folder or module directly inside the package."""
    package, name = Path(file).parts[:2]
    return package, name.removesuffix(".py")


def layer(file: str) -> int:
    """Return the number of a file's layer in its package, counted from the top."""
    package, name = part_of(file)
    for number, parts in enumerate(LAYERS[package]):
        if name in parts:
            return number
    raise AssertionError(f"{file} is in no layer of LAYERS")


def goes_up(imported: Import) -> bool:
    """Return whether an import breaks the order of layers, or is one of Blender's side by the trainer."""
    source, target = imported
    if part_of(source) == part_of(target):
        return False
    if part_of(source)[0] != part_of(target)[0]:
        return part_of(source)[0] == "training"
    return layer(target) <= layer(source)


def cycles(imports: frozenset[Import]) -> list[list[str]]:
    """Return the groups of files that import each other, directly or through others."""
    files = sorted({file for pair in imports for file in pair})
    numbers = {file: number for number, file in enumerate(files)}
    rows, columns = zip(*((numbers[source], numbers[target]) for source, target in imports), strict=True)
    graph = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(files), len(files)))
    _, labels = connected_components(graph, connection="strong")
    groups = [
        [file for file, own in zip(files, labels, strict=True) if own == label] for label in set(labels)
    ]
    return sorted(group for group in groups if len(group) > 1 or (group[0], group[0]) in imports)


def test_every_file_is_in_a_layer():
    assert len(parsed()) > 80
    layers = {layer(file) for file in parsed() if file.startswith("training")}
    assert layers == set(range(len(LAYERS["training"])))


def test_no_import_goes_up():
    upward = sorted(pair for pair in relative_imports() if goes_up(pair))
    assert not upward, "\n".join(f"{source} imports {target}" for source, target in upward)


def test_there_is_no_cycle():
    for group in cycles(relative_imports()):
        inside = sorted(pair for pair in relative_imports() if {*pair} <= {*group})
        raise AssertionError("a cycle:\n" + "\n".join(f"{a} imports {b}" for a, b in inside))


@pytest.mark.parametrize(("package", "limit"), [("training/methods", 20), ("training/lod", 19)])
def test_imports_inside_a_package_are_few(package, limit):
    """Imports of a rule's base class do not count: every rule has one."""
    inside = [
        (file, target)
        for file, target in relative_imports()
        if file.startswith(f"{package}/")
        and target.startswith(f"{package}/")
        and not (file.startswith("training/lod/rules/") and target == "training/lod/rule.py")
    ]
    assert 0 < len(inside) <= limit, sorted(inside)


KERNELS = tuple(f"training/rasterize/cpu/{name}.py" for name in ("blend", "project", "project_backward"))
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
"""Files that may import the tree of splats; all others use it through ``Rule`` and ``MethodInfo``."""


def test_only_its_own_files_import_the_tree():
    importing = {
        a for a, b in relative_imports() if b.startswith(tuple(TREE)) and not a.startswith(tuple(TREE))
    }
    assert not importing, sorted(importing)


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        (("blender_lodgs/render/engine.py", "blender_lodgs/runs/processes.py"), False),
        (("blender_lodgs/data/scenes.py", "blender_lodgs/data/objects.py"), False),
        (("blender_lodgs/data/scenes.py", "blender_lodgs/viewport/views.py"), True),
        (("blender_lodgs/viewport/views.py", "blender_lodgs/runs/jobs.py"), True),
        (("blender_lodgs/data/scenes.py", "training/scenes/colmap.py"), False),
        (("training/errors.py", "blender_lodgs/compat.py"), True),
    ],
)
def test_goes_up(pair, expected):
    assert goes_up(pair) is expected


def test_cycles():
    graph = frozenset({("a", "b"), ("b", "c"), ("c", "a"), ("c", "d"), ("e", "a")})
    assert cycles(graph) == [["a", "b", "c"]]
    assert cycles(graph - {("c", "a")}) == []


def test_only_the_extension_imports_bpy():
    for file in parsed():
        if file.startswith("training/"):
            assert not absolute_imports(file) & BLENDER_ONLY, file
    assert "bpy" in absolute_imports("blender_lodgs/__init__.py")


def test_extension_imports_no_package_of_the_trainer():
    for file in parsed():
        if file.startswith("blender_lodgs/"):
            assert not absolute_imports(file) & TRAINER_ONLY, file


def test_imports_inside_the_packages_are_relative():
    for file in parsed():
        assert not absolute_imports(file) & {"training", "blender_lodgs", "bl_ext"}, file


def test_modules_for_blender_need_no_package_of_the_trainer():
    """Import all modules that the extension uses, with the trainer's packages blocked."""
    loaded = {
        b for a, b in relative_imports() if a.startswith("blender_lodgs/") and b.startswith("training/")
    }
    modules = sorted(file.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for file in loaded)
    assert len(modules) > 10
    blocked = f"""
import importlib, sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {TRAINER_ONLY!r}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Blocker())
for name in {modules!r}:
    importlib.import_module(name)
"""
    process = subprocess.run([sys.executable, "-c", blocked], cwd=ROOT, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr


def test_pycolmap_runs_only_in_processes_of_its_own():
    """pycolmap replaces the handler of SIGTERM, so a trainer that imports it could not save and stop."""
    programs = {f"training/scenes/{name}.py" for name in PROGRAMS}
    for file in [file for file in parsed() if "pycolmap" in absolute_imports(file)]:
        assert file in programs, file
    for file in programs:
        at_import = [node for node in parsed()[file].body if isinstance(node, (ast.Import, ast.ImportFrom))]
        assert all(alias.name != "pycolmap" for node in at_import for alias in node.names), file
