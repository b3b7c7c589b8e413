"""The extension's zip: its contents, and its installation without a checkout."""

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]

INSTALL = """
import os, sys
import bpy
zip, ply = sys.argv[1:]
assert bpy.ops.extensions.package_install_files(
    filepath=zip, repo="user_default", enable_on_install=True) == {"FINISHED"}
assert "bl_ext.user_default.lodgs" in bpy.context.preferences.addons
from pathlib import Path
assert list(Path(os.environ["BLENDER_USER_RESOURCES"]).rglob("site-packages/plyfile.py")), "no wheel"
import bl_ext.user_default.lodgs as lodgs
assert os.environ["BLENDER_USER_RESOURCES"] in lodgs.__file__
assert bpy.ops.lodgs.import_splats(filepath=ply) == {"FINISHED"}
(root,) = [o for o in bpy.data.objects if o.lodgs.is_root]
assert len(root.lodgs.levels[0].object.data.points) == 20
heavy = {"torch", "numba", "pycolmap", "PIL", "OpenEXR"}
assert not heavy & {name.split(".")[0] for name in sys.modules}
assert bpy.ops.preferences.addon_disable(module="bl_ext.user_default.lodgs") == {"FINISHED"}
assert not hasattr(bpy.types.Object, "lodgs")
assert not [f for f in bpy.app.handlers.load_post if "lodgs" in f.__module__]
print("INSTALLED AND WORKING")
sys.stdout.flush()
os._exit(0)
"""


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    from tools.extension import build

    return build(tmp_path_factory.mktemp("dist"))


def test_zip_contains_only_the_packages_and_their_files(archive):
    with zipfile.ZipFile(archive) as file:
        names = file.namelist()
    code = {
        p.relative_to(REPOSITORY).as_posix()
        for r in ("blender_lodgs", "training")
        for p in (REPOSITORY / r).rglob("*.*")
        if p.suffix in (".py", ".pyi", ".typed", ".wgsl")
    }
    data = {"__init__.py", "blender_manifest.toml", "LICENSE"}
    data |= {"pyproject.toml", *(f"requirements/{name}.txt" for name in ("trainer", "cluster", "cuda"))}
    data |= {p.relative_to(REPOSITORY).as_posix() for p in (REPOSITORY / "farm").rglob("*.js")}
    wheels = set(tomllib.loads((REPOSITORY / "blender_manifest.toml").read_text())["wheels"])
    assert {n for n in names if not n.endswith("/")} == code | data | {w.removeprefix("./") for w in wheels}


def test_version_is_the_same_everywhere():
    from training import VERSION

    assert tomllib.loads((REPOSITORY / "blender_manifest.toml").read_text())["version"] == VERSION
    assert f"\nversion: {VERSION}\n" in (REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")


def test_zip_installs_and_imports(archive, tmp_path):
    from tests.blender.fake_trainer import splats
    from training.splats.ply import write_ply

    write_ply(tmp_path / "some.ply", splats(20))
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    (tmp_path / "user").mkdir()
    process = subprocess.run(
        [sys.executable, "-c", INSTALL, str(archive), str(tmp_path / "some.ply")],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert "INSTALLED AND WORKING" in process.stdout, process.stdout + process.stderr
    assert "Traceback" not in process.stderr
