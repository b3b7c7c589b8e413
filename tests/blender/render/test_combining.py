"""Combining with meshes can be taken back, and leaves the scene as it was."""

import pytest

from tests.blender.fake_trainer import splats
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level


@pytest.fixture
def scene(bpy, tmp_path):
    """A scene with splats and an object of the artist's."""
    write_bundle(tmp_path / "b.ply", Bundle("flod", [Level(1, splats(5))]))
    assert bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "b.ply")) == {"FINISHED"}
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("the artist's", None))
    return bpy.context.scene


def state(bpy, lodgs):
    scene = bpy.context.scene
    tree = getattr(scene, "compositing_node_group", None) or getattr(scene, "node_tree", None)
    in_use = scene.use_nodes if hasattr(scene, "node_tree") else tree is not None
    return (
        len(bpy.data.scenes), in_use, scene.render.film_transparent, scene.view_layers[0].use_pass_z,
        sorted(node.bl_idname for node in tree.nodes) if tree and in_use else [],
        sorted(obj.name for obj in bpy.data.objects),
    )  # fmt: skip


@pytest.mark.parametrize("transparent", [False, True])
def test_it_leaves_the_scene_as_it_was(bpy, lodgs, scene, transparent):
    scene.render.film_transparent = scene.view_layers[0].use_pass_z = transparent
    before = state(bpy, lodgs)
    assert not bpy.ops.lodgs.separate_meshes.poll()
    for _ in range(2):  # pressed again, combining remembers what was before the first time
        assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    assert scene.lodgs_render.meshes.cycles.samples == 128
    assert state(bpy, lodgs)[:4] == (2, True, True, True)
    assert bpy.ops.lodgs.separate_meshes() == {"FINISHED"}
    assert state(bpy, lodgs) == before and scene.lodgs_render.meshes is None
    assert not bpy.ops.lodgs.separate_meshes.poll()


def test_undo_combines_again(bpy, lodgs, scene):
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.lodgs.combine_with_meshes("EXEC_DEFAULT", True)  # True: one undo step, as by hand
    combined = state(bpy, lodgs)
    bpy.ops.lodgs.separate_meshes("EXEC_DEFAULT", True)
    assert state(bpy, lodgs) != combined
    bpy.ops.ed.undo()
    assert state(bpy, lodgs) == combined and bpy.context.scene.lodgs_render.meshes is not None


def test_nodes_of_the_artists_are_not_taken_away(bpy, lodgs, scene):
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    lodgs("compat").compositor_tree(scene).nodes.new("CompositorNodeBlur")
    combined = state(bpy, lodgs)
    with pytest.raises(RuntimeError, match="nodes of your own"):
        bpy.ops.lodgs.separate_meshes()
    assert state(bpy, lodgs) == combined


def test_after_the_meshes_scene_is_deleted_it_combines_anew(bpy, lodgs, scene):
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    bpy.data.scenes.remove(scene.lodgs_render.meshes)
    assert scene.lodgs_render.meshes is None
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    layers = [
        n for n in lodgs("compat").compositor_tree(scene).nodes if n.bl_idname == "CompositorNodeRLayers"
    ]
    assert {node.scene for node in layers} == {scene, scene.lodgs_render.meshes}


def test_the_meshes_scene_has_the_cameras_of_markers_and_no_collection_that_is_left_out(bpy, lodgs, scene):
    cameras = [bpy.data.objects.new(name, bpy.data.cameras.new(name)) for name in "AB"]
    hidden, aside = (bpy.data.collections.new(name) for name in ("hidden", "aside"))
    for each in (hidden, aside):
        scene.collection.children.link(each)
    for frame, camera in zip((1, 10), cameras, strict=True):
        scene.collection.objects.link(camera)
        scene.timeline_markers.new(camera.name, frame=frame).camera = camera
    layer = scene.view_layers[0].layer_collection.children
    layer["hidden"].exclude, layer["aside"].indirect_only = True, True
    bpy.ops.lodgs.combine_with_meshes()
    meshes = scene.lodgs_render.meshes
    assert {marker.frame: marker.camera for marker in meshes.timeline_markers} == {
        1: cameras[0],
        10: cameras[1],
    }
    there = meshes.view_layers[0].layer_collection.children
    assert there["hidden"].exclude and there["aside"].indirect_only and not there["aside"].exclude


def test_splats_are_left_out_of_the_meshes_where_their_root_has_moved(bpy, lodgs, scene):
    [root] = lodgs("data.roots").roots(scene)
    [collection] = root.users_collection
    scene.collection.objects.link(root)
    collection.objects.unlink(root)
    bpy.ops.lodgs.combine_with_meshes()
    there = scene.lodgs_render.meshes.view_layers[0].layer_collection.children
    assert there[collection.name].exclude


def test_frames_of_viewport_quality_are_no_movie(bpy, lodgs, scene):
    compat = scene.render.image_settings
    if hasattr(compat, "media_type"):
        compat.media_type = "VIDEO"
    scene.render.image_settings.file_format = "FFMPEG"
    with pytest.raises(lodgs("training.errors").LodgsError, match="image format"):
        next(lodgs("render.viewport_quality").render_animation(bpy.context, range(1, 2)))


def test_captures_leave_splats_out_whichever_level_is_shown(bpy, lodgs, scene):
    [root] = lodgs("data.roots").roots(scene)
    assert [level.object.hide_render for level in root.lodgs.levels] == [False]
    lodgs("render.capture")._prepare(scene, 64, 48)
    bpy.context.view_layer.update()  # when drivers have their say
    assert [level.object.hide_render for level in root.lodgs.levels] == [True]
