"""Images that Blender could not write completely, as on a full disk."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def scene(bpy, lodgs, tmp_path):
    """A scene with a camera that LODGS renders to PNG files, in one colour and without a trainer."""
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    lodgs("render.engine").use(scene)
    scene.render.resolution_x, scene.render.resolution_y = 96, 72
    scene.render.filepath = str(tmp_path / "frame_")
    scene.frame_start, scene.frame_end = 1, 4

    def render_frame(depsgraph, width, height, *_, **__):
        noise = np.random.default_rng(0).random((height, width), np.float32)
        planes = {f"Combined.{channel}": noise for channel in "RGBA"}
        return lodgs("render.renderer").RenderedFrame(planes, 0.0)

    with lodgs("render.engine").use_renderer(render_frame):
        yield scene


@pytest.fixture
def cut(bpy, tmp_path):
    """Cut the files with given names when they are written, as a full disk does."""
    names = []

    def handler(*_) -> None:
        for path in filter(lambda path: path.is_file(), (tmp_path / name for name in names)):
            path.write_bytes(path.read_bytes()[:4096])

    bpy.app.handlers.render_write.insert(0, handler)
    yield names
    bpy.app.handlers.render_write.remove(handler)


def test_incomplete_frame_is_deleted_and_ends_the_animation(bpy, scene, cut, tmp_path, capfd):
    cut.append("frame_0002.png")
    with pytest.raises(
        RuntimeError, match=r"Cannot write .*frame_0002\.png: the image is incomplete\. Free some"
    ):
        bpy.ops.render.render(animation=True)
    assert [path.name for path in sorted(tmp_path.glob("*.png"))] == ["frame_0001.png"]
    assert "error: Cannot write" in capfd.readouterr().err
    cut.clear()
    assert bpy.ops.render.render(animation=True) == {"FINISHED"}
    assert len(list(tmp_path.glob("*.png"))) == 4


@pytest.mark.parametrize("name", ["frame_.png", "frame_0004.png"])
def test_incomplete_last_image_is_deleted(bpy, scene, cut, tmp_path, capfd, name):
    cut.append(name)
    bpy.ops.render.render(animation="0" in name, write_still="0" not in name)
    assert not (tmp_path / name).exists()
    assert f"error: Cannot write {tmp_path / name}: the image is incomplete." in capfd.readouterr().err


def test_other_files_stay(bpy, scene, tmp_path, capfd):
    (tmp_path / "frame_0001.png").write_bytes(b"mine")
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    assert (tmp_path / "frame_0001.png").read_bytes() == b"mine" and not capfd.readouterr().err
