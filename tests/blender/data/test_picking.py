"""Which splat scene is at a pixel, against where two scenes were put."""

import numpy as np
import pytest

from training.splats.bundle import Level
from training.splats.gaussians import Splats

SIZE = 200, 100


def one(opacity: float, place) -> Splats:
    return Splats(
        means=np.float32([place]), quats=np.float32([[1, 0, 0, 0]]), log_scales=np.full((1, 3), np.log(0.2)),
        opacity_logits=np.float32([np.log(opacity / (1 - opacity))]), sh=np.zeros((1, 1, 3), np.float32),
    )  # fmt: skip


@pytest.fixture
def scene_of(bpy, lodgs):
    """``scene_of(name, opacity, place)``: a splat scene of one splat at a place."""

    def made(name, opacity, place):
        collection = bpy.data.collections.new(name)
        bpy.context.scene.collection.children.link(collection)
        root = bpy.data.objects.new(name, None)
        collection.objects.link(root)
        root.lodgs.is_root = True
        lodgs("data.scenes").set_level(root, Level(1, one(opacity, place)))
        return root

    return made


@pytest.fixture
def at(bpy, lodgs):
    """What is at a pixel, seen along -z without perspective, 4 units wide and 2 high."""
    from mathutils import Matrix

    view, clip = Matrix.Identity(4), Matrix.Diagonal((0.5, 1, -0.1, 1))

    def found(x, y):
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        return lodgs("data.picking").scene_at(depsgraph, None, view, clip, SIZE, (x, y))

    return found


def test_the_nearest_that_hides_what_is_behind_is_picked(scene_of, at):
    near, far = scene_of("near", 0.9, (1, 0, 2)), scene_of("far", 0.9, (1, 0, -2))
    assert at(150, 50) == near
    assert at(50, 50) is None and at(150, 95) is None
    near.location.x = -2
    assert at(50, 50) == near and at(150, 50) == far
    near.scale, near.location = (0.1, 0.1, 0.1), (0.9, 0, -0.9)  # the same place but nearer, in other units
    assert at(150, 50) == near


def test_fog_is_looked_through(scene_of, at):
    scene_of("fog", 0.3, (0, 0, 2))
    assert at(100, 50) is None
    behind = scene_of("behind", 0.9, (0, 0, -2))
    assert at(100, 50) == behind
