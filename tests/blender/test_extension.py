"""The extension's zip: its contents, and its installation without a checkout."""

import functools
import http.server
import os
import shutil
import subprocess
import sys
import threading
import tomllib
import zipfile
from pathlib import Path

import pytest

from tools import extension

REPOSITORY = Path(__file__).resolve().parents[2]
_LOCKS = "trainer", "cluster", "torch-cpu", "pip"

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


REPOSITORY_SESSION = """
import json, os, sys
from pathlib import Path
import bpy
url, dist = sys.argv[1:]
preferences = bpy.context.preferences
preferences.system.use_online_access = True
repository = preferences.extensions.repos.new(name="LODGS", module="lodgs_test", remote_url=url)
repository.use_remote_url = True
index = list(preferences.extensions.repos).index(repository)
installed = Path(repository.directory, "lodgs")

def version():
    return [line for line in (installed / "blender_manifest.toml").read_text().splitlines()
            if line.startswith("version")]

def sync():
    assert bpy.ops.extensions.repo_sync(repo_index=index) == {"FINISHED"}

sync()
assert bpy.ops.extensions.package_install(repo_index=index, pkg_id="lodgs") == {"FINISHED"}
assert "bl_ext.lodgs_test.lodgs" in preferences.addons
assert hasattr(bpy.types.Object, "lodgs")
old = version()
for file in Path(dist).with_name("next").iterdir():
    os.replace(file, Path(dist, file.name))
sync()
assert bpy.ops.extensions.package_upgrade_all() == {"FINISHED"}
assert version() == ['version = "99.0.0"'] != old
assert hasattr(bpy.types.Object, "lodgs")
assert bpy.ops.extensions.package_uninstall(repo_index=index, pkg_id="lodgs") == {"FINISHED"}
assert not installed.exists() and not hasattr(bpy.types.Object, "lodgs")
assert "bl_ext.lodgs_test.lodgs" not in preferences.addons
print("INSTALLED, UPDATED AND REMOVED")
sys.stdout.flush()
os._exit(0)
"""


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    return extension.build(tmp_path_factory.mktemp("dist"))


def test_zip_contains_only_the_packages_and_their_files(archive):
    with zipfile.ZipFile(archive) as file:
        names = file.namelist()
    tracked = extension.tracked_files()
    code = {name for name in tracked if name.startswith(("blender_lodgs/", "training/"))}
    assert {Path(name).suffix for name in code} == {".cu", ".html", ".py", ".pyi", ".typed", ".wgsl"}
    data = {"__init__.py", "blender_manifest.toml", "LICENSE"}
    data |= {"pyproject.toml", *(f"requirements/{name}.txt" for name in _LOCKS)}
    data |= {p.relative_to(REPOSITORY).as_posix() for p in (REPOSITORY / "farm").rglob("*.js")}
    data |= {
        path.relative_to(REPOSITORY).as_posix() for path in (REPOSITORY / "training" / "viewer").glob("*")
    }
    wheels = set(tomllib.loads((REPOSITORY / "blender_manifest.toml").read_text())["wheels"])
    assert {n for n in names if not n.endswith("/")} == code | data | {w.removeprefix("./") for w in wheels}


def test_zip_installs_and_imports(archive, tmp_path):
    from tests.blender.fake_trainer import splats
    from training.splats.ply import write_ply

    write_ply(tmp_path / "some.ply", splats(20))
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    (tmp_path / "user").mkdir()
    process = subprocess.run(
        [sys.executable, "-c", INSTALL, str(archive), str(tmp_path / "some.ply")],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert "INSTALLED AND WORKING" in process.stdout, process.stdout + process.stderr
    assert "Traceback" not in process.stderr


@pytest.mark.slow
@pytest.mark.one_blender
def test_blender_installs_updates_and_removes_from_a_repository(archive, tmp_path):
    dist = tmp_path / "dist"
    dist.mkdir()
    shutil.copy2(archive, dist)
    extension.write_repository(dist)
    page = (dist / "index.html").read_text(encoding="utf-8")
    assert "lodgs-" in page and page.count("<th>") == page.count("<td>") and "<td>~</td>" not in page
    extension.build(tmp_path / "next", version="99.0.0")
    extension.write_repository(tmp_path / "next")
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=dist)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}/index.json"
        (tmp_path / "user").mkdir()
        process = subprocess.run(
            [sys.executable, "-c", REPOSITORY_SESSION, url, str(dist)],
            cwd=tmp_path, env=os.environ | {"BLENDER_USER_RESOURCES": str(tmp_path / "user")},
            capture_output=True, text=True, timeout=600, check=False,
        )  # fmt: skip
        server.shutdown()
    assert "INSTALLED, UPDATED AND REMOVED" in process.stdout, process.stdout + process.stderr
    assert "Traceback" not in process.stderr
