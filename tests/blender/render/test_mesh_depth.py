"""Folder of the mesh depth files."""

import stat
from types import SimpleNamespace


def test_depth_of_an_unsaved_file_is_in_a_private_folder(bpy, lodgs, monkeypatch, tmp_path):
    """This also holds if Blender has no temporary folder."""
    mesh_depth = lodgs("render.mesh_depth")
    scene = bpy.context.scene
    monkeypatch.setattr(mesh_depth.tempfile, "tempdir", str(tmp_path))
    fake_bpy = SimpleNamespace(app=SimpleNamespace(tempdir=""), data=bpy.data, path=bpy.path)
    monkeypatch.setattr(mesh_depth, "bpy", fake_bpy)
    mesh_depth._temporary_folder.cache_clear()
    pattern = mesh_depth.depth_file_pattern(scene)
    (folder,) = tmp_path.iterdir()
    assert pattern.is_relative_to(folder) and pattern == mesh_depth.depth_file_pattern(scene)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    mesh_depth._temporary_folder.cache_clear()
