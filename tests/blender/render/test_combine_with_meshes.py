"""Combining splats with meshes and separating them again."""

import pytest

from tests.blender.fake_trainer import splats
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level


@pytest.fixture
def scene(bpy, tmp_path):
    """A scene with splats and an object of the user."""
    write_bundle(tmp_path / "b.ply", Bundle("flod", [Level(1, splats(5))]))
    assert bpy.ops.lodgs.import_splats(filepath=str(tmp_path / "b.ply")) == {"FINISHED"}
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("user object", None))
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
def test_separating_restores_the_scene(bpy, lodgs, scene, transparent):
    scene.render.film_transparent = scene.view_layers[0].use_pass_z = transparent
    original = state(bpy, lodgs)
    assert not bpy.ops.lodgs.separate_meshes.poll()
    for _ in range(2):  # the second call keeps the values from before the first one
        assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    assert scene.lodgs_render.meshes.cycles.samples == 128
    assert state(bpy, lodgs)[:4] == (2, True, True, True)
    assert bpy.ops.lodgs.separate_meshes() == {"FINISHED"}
    assert state(bpy, lodgs) == original and scene.lodgs_render.meshes is None
    assert not bpy.ops.lodgs.separate_meshes.poll()


def test_deleted_crops_do_not_crash_a_combined_scene(bpy, scene):
    """Blender 5.2 crashes if an update handler removes node groups after the second scene was evaluated."""
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    for _ in range(3):
        assert bpy.ops.lodgs.add_crop(shape="BOX") == {"FINISHED"}
        bpy.context.view_layer.update()
        bpy.ops.object.delete()
        bpy.context.view_layer.update()


def test_undo_combines_again(bpy, lodgs, scene):
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.lodgs.combine_with_meshes("EXEC_DEFAULT", True)  # True: one undo step, as in the interface
    combined = state(bpy, lodgs)
    bpy.ops.lodgs.separate_meshes("EXEC_DEFAULT", True)
    assert state(bpy, lodgs) != combined
    bpy.ops.ed.undo()
    assert state(bpy, lodgs) == combined and bpy.context.scene.lodgs_render.meshes is not None


def test_nodes_of_the_user_are_not_removed(bpy, lodgs, scene):
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    lodgs("compat").compositor_tree(scene).nodes.new("CompositorNodeBlur")
    combined = state(bpy, lodgs)
    with pytest.raises(RuntimeError, match="additional compositor nodes"):
        bpy.ops.lodgs.separate_meshes()
    assert state(bpy, lodgs) == combined


def test_combining_works_again_after_deleting_the_mesh_scene(bpy, lodgs, scene):
    scene.view_layers[0].use_pass_z = False
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    bpy.data.scenes.remove(scene.lodgs_render.meshes)
    assert scene.lodgs_render.meshes is None
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    layers = [
        n for n in lodgs("compat").compositor_tree(scene).nodes if n.bl_idname == "CompositorNodeRLayers"
    ]
    assert {node.scene for node in layers} == {scene, scene.lodgs_render.meshes}
    assert bpy.ops.lodgs.separate_meshes() == {"FINISHED"}
    assert not scene.render.film_transparent and not scene.view_layers[0].use_pass_z


@pytest.mark.parametrize("updated", [False, True])
def test_copied_scene_leaves_the_meshes_of_its_original(bpy, lodgs, scene, updated):
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    meshes = scene.lodgs_render.meshes
    meshes.cycles.samples = 7
    bpy.ops.scene.new(type="LINK_COPY")
    copy = bpy.context.scene
    if updated:
        assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
        assert copy.lodgs_render.meshes != meshes and copy.lodgs_render.meshes.cycles.samples == 7
        nodes = lodgs("compat").compositor_tree(copy).nodes
        assert {node.scene for node in nodes if node.bl_idname == "CompositorNodeRLayers"} == {
            copy, copy.lodgs_render.meshes,
        }  # fmt: skip
    assert bpy.ops.lodgs.separate_meshes() == {"FINISHED"}
    assert copy.lodgs_render.meshes is None and not copy.render.film_transparent
    assert scene.lodgs_render.meshes == meshes and set(bpy.data.scenes) == {scene, copy, meshes}
    nodes = lodgs("compat").compositor_tree(scene).nodes
    assert {node.scene for node in nodes if node.bl_idname == "CompositorNodeRLayers"} == {scene, meshes}


def test_mesh_scene_copies_markers_and_excluded_collections(bpy, lodgs, scene):
    cameras = [bpy.data.objects.new(name, bpy.data.cameras.new(name)) for name in "AB"]
    for name in ("hidden", "indirect"):
        scene.collection.children.link(bpy.data.collections.new(name))
    for frame, camera in zip((1, 10), cameras, strict=True):
        scene.collection.objects.link(camera)
        scene.timeline_markers.new(camera.name, frame=frame).camera = camera
    layer = scene.view_layers[0].layer_collection.children
    layer["hidden"].exclude = True
    layer["indirect"].indirect_only = True
    scene.render.frame_map_new = 200
    bpy.ops.lodgs.combine_with_meshes()
    meshes = scene.lodgs_render.meshes
    assert meshes.render.frame_map_new == 200
    assert {marker.frame: marker.camera for marker in meshes.timeline_markers} == {
        1: cameras[0],
        10: cameras[1],
    }
    copied = meshes.view_layers[0].layer_collection.children
    assert copied["hidden"].exclude and copied["indirect"].indirect_only and not copied["indirect"].exclude


def test_splats_of_a_moved_root_are_excluded_from_the_mesh_scene(bpy, lodgs, scene):
    [root] = lodgs("data.roots").roots(scene)
    [collection] = root.users_collection
    scene.collection.objects.link(root)
    collection.objects.unlink(root)
    bpy.ops.lodgs.combine_with_meshes()
    copied = scene.lodgs_render.meshes.view_layers[0].layer_collection.children
    splats = lodgs("data.roots").levels_collection(root)
    assert copied[collection.name].children[splats.name].exclude


@pytest.mark.parametrize("shadows", [False, True])
def test_mesh_in_the_collection_of_a_splat_scene_is_rendered(bpy, lodgs, scene, shadows):
    [root] = lodgs("data.roots").roots(scene)
    collection, splats = lodgs("data.roots").collection_of(root), lodgs("data.roots").levels_collection(root)
    collection.objects.link(bpy.data.objects.new("mesh", bpy.data.meshes.new("mesh")))
    scene.lodgs_render.shadows = shadows
    bpy.ops.lodgs.combine_with_meshes()
    meshes = scene.lodgs_render.meshes.view_layers[0]
    copied = meshes.layer_collection.children[collection.name]
    assert not copied.exclude and not copied.indirect_only
    assert copied.children[splats.name].exclude != shadows and "mesh" in meshes.objects


@pytest.mark.parametrize("name", ["collection_of", "levels_collection"])
def test_instances_of_splats_are_no_meshes(bpy, lodgs, scene, instance_of, name):
    """Cycles would draw them as points. The original scene still renders them with any engine."""
    [root] = lodgs("data.roots").roots(scene)
    instance_of(getattr(lodgs("data.roots"), name)(root))
    level = root.lodgs.levels[0].object
    bpy.ops.lodgs.combine_with_meshes()

    def rendered_points(rendered_scene):
        layer = rendered_scene.view_layers[0]
        layer.update()
        copy = level.evaluated_get(layer.depsgraph)
        return not copy.hide_render, copy.visible_camera

    meshes = scene.lodgs_render.meshes
    assert rendered_points(meshes) == (False, False) and rendered_points(scene) == (True, True)
    scene.lodgs_render.shadows = True  # as ellipsoids that the camera does not see
    assert rendered_points(meshes) == (True, False) and rendered_points(scene) == (True, True)


def test_viewport_quality_cannot_render_a_video(bpy, lodgs, scene):
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "VIDEO"
    settings.file_format = "FFMPEG"
    with pytest.raises(lodgs("training.errors").LodgsError, match="image format"):
        next(lodgs("render.viewport_quality").render_animation(bpy.context, range(1, 2)))


def test_captures_hide_splats(bpy, lodgs, scene):
    [root] = lodgs("data.roots").roots(scene)
    assert [level.object.hide_render for level in root.lodgs.levels] == [False]
    lodgs("render.capture")._prepare(scene, 64, 48)
    bpy.context.view_layer.update()  # evaluates drivers
    assert [level.object.hide_render for level in root.lodgs.levels] == [True]


@pytest.fixture
def linked_instance(bpy, lodgs, scene, instance_of, tmp_path):
    """An instance of a linked collection of levels, in a file without a splat scene of its own."""
    [root] = lodgs("data.roots").roots(scene)
    name = lodgs("data.roots").levels_collection(root).name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, linked):
        linked.collections = [name]
    return instance_of(linked.collections[0])


def test_captures_hide_instances_of_linked_splats(bpy, lodgs, linked_instance):
    lodgs("render.capture")._prepare(bpy.context.scene, 64, 48)
    bpy.context.view_layer.update()
    assert [obj.hide_render for obj in linked_instance.instance_collection.objects] == [True]


def test_instances_of_linked_splats_are_combined_with_meshes(bpy, linked_instance):
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    meshes = bpy.context.scene.lodgs_render.meshes
    [level] = linked_instance.instance_collection.objects
    meshes.view_layers[0].update()
    assert level.evaluated_get(meshes.view_layers[0].depsgraph).hide_render
    assert bpy.ops.lodgs.separate_meshes() == {"FINISHED"}
