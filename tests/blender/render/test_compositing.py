"""Where the depth of meshes lies (what it does to pictures is tested with the engine)."""

import stat
from types import SimpleNamespace


def test_depth_of_an_unsaved_file_lies_where_nobody_else_can_put_something(bpy, lodgs, monkeypatch, tmp_path):
    """Also where Blender has no temporary folder of its own."""
    compositing, scene = lodgs("render.compositing"), bpy.context.scene
    monkeypatch.setattr(compositing.tempfile, "tempdir", str(tmp_path))
    without = SimpleNamespace(app=SimpleNamespace(tempdir=""), data=bpy.data, path=bpy.path)
    monkeypatch.setattr(compositing, "bpy", without)
    compositing._temporary_folder.cache_clear()
    found = compositing.depth_file_pattern(scene)
    (own,) = tmp_path.iterdir()
    assert found.is_relative_to(own) and found == compositing.depth_file_pattern(scene)
    assert stat.S_IMODE(own.stat().st_mode) == 0o700
    compositing._temporary_folder.cache_clear()
