"""Photographs in Blender: their cameras are found by the trainer, and the scene is imported."""

import time

import numpy as np
import pytest

from tests.training.scenes.test_reconstruct import EYES, photograph
from training.scenes.images import write_png


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walk") / "photos"
    folder.mkdir()
    for number, eye in enumerate(EYES):
        write_png(folder / f"{number}.png", photograph(eye))
    return folder


def test_photographs_become_a_scene(bpy, lodgs, photos):
    assert bpy.ops.lodgs.find_cameras(directory=str(photos)) == {"FINISHED"}
    work = lodgs("runs.reconstructing").current
    assert "All 6 photographs found their place" in work.message and work.fraction == 1
    (root,) = lodgs("data.scenes").roots(bpy.context.scene)
    assert root == work.root and len(root.lodgs.cameras.objects) == 6
    assert root.lodgs.scene_folder == str(photos.parent / "photos_scene")
    bpy.context.view_layer.update()
    eyes = np.array([
        obj.matrix_world.translation for obj in sorted(root.lodgs.cameras.objects, key=lambda o: o.name)
    ])  # fmt: skip
    apart, truly = (np.linalg.norm(each[:, None] - each[None], axis=2) for each in (eyes, EYES))
    np.testing.assert_allclose(apart / apart.sum() * truly.sum(), truly, atol=0.05)


def test_what_is_stopped_goes_on(bpy, lodgs, photos, tmp_path):
    reconstructing = lodgs("runs.reconstructing")
    work = reconstructing.start(photos, tmp_path / "out")
    with pytest.raises(RuntimeError, match="being found already"):
        bpy.ops.lodgs.find_cameras(directory=str(photos))
    end = time.monotonic() + 60
    while work.step() and "of" not in work.message.split("photograph")[-1]:
        assert time.monotonic() < end
        time.sleep(0.02)
    assert bpy.ops.lodgs.cancel_find_cameras() == {"FINISHED"}
    while work.step():
        time.sleep(0.02)
    assert "goes on from there" in work.message and not work.problem
    assert not lodgs("data.scenes").roots(bpy.context.scene)
    assert bpy.ops.lodgs.find_cameras(directory=str(photos), out=str(tmp_path / "out")) == {"FINISHED"}


def test_what_is_no_scene_is_a_sentence(bpy, lodgs, tmp_path):
    (tmp_path / "photos").mkdir()
    with pytest.raises(RuntimeError, match="holds 0 photographs that can be read"):
        bpy.ops.lodgs.find_cameras(directory=str(tmp_path / "photos"))
    work = lodgs("runs.reconstructing").current
    assert work.problem and not work.running and not lodgs("data.scenes").roots(bpy.context.scene)
