"""Visible splats and their weights, compared with the arrays of the imported splats."""

import json

import numpy as np
import pytest

COUNT = 300


def make_splats(lodgs, seed=0, count=COUNT, degree=1, **extras):
    rng = np.random.default_rng(seed)
    return lodgs("training.splats.gaussians").Splats(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        log_scales=rng.normal(-3, 0.5, (count, 3)).astype(np.float32),
        opacity_logits=rng.normal(size=count).astype(np.float32),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
        extras=extras,
    )


@pytest.fixture
def two_levels(bpy, lodgs):
    """Return the root of a scene and the splats of its two levels."""
    level = lodgs("training.splats.levels").Level
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    splats = [make_splats(lodgs, seed) for seed in range(2)]
    with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
        for number, s_min in ((2, 0.0), (1, 0.003)):
            lodgs("data.scenes").set_level(root, level(number, splats[number - 1], {"s_min": s_min}))
        bundle = lodgs("training.splats.levels").Bundle("flod", [], "bands")
        lodgs("data.scenes").set_bundle_facts(root, bundle)
    root.location, root.rotation_euler, root.scale = (1, 2, 3), (0.3, 0.2, 0.1), (2, 2, 2)
    bpy.context.view_layer.update()
    return root, splats


def visible_sets(bpy, lodgs):
    return lodgs("data.shown").visible_splats(bpy.context.evaluated_depsgraph_get())


def test_arrays_have_activated_values_in_scene_space(bpy, lodgs, two_levels):
    root, splats = two_levels
    root.lodgs.single_level = 2
    lodgs("nodes.display").keep_harmonics(root.lodgs.levels[1].object)
    bpy.context.view_layer.update()
    [(visible, arrays)] = visible_sets(bpy, lodgs)
    truth = splats[1]
    assert visible.level == 2 and visible.object == root.lodgs.levels[1].object
    assert np.allclose(visible.matrix_world, np.array(root.lodgs.axes.matrix_world), atol=1e-6)
    assert np.array_equal(arrays.means, truth.means)
    assert np.allclose(arrays.scales, np.exp(truth.log_scales.astype(float)), rtol=1e-6)
    assert np.allclose(arrays.opacities, 1 / (1 + np.exp(-truth.opacity_logits.astype(float))), atol=1e-6)
    norm = np.linalg.norm(truth.quats.astype(float), axis=1, keepdims=True)
    assert np.allclose(arrays.quats, truth.quats / norm, atol=1e-6)
    assert np.array_equal(arrays.sh, truth.sh)
    assert arrays.weights is None
    assert all(a.dtype == np.float32 for a in (arrays.means, arrays.quats, arrays.scales, arrays.sh))


def test_bands_select_splats_by_distance(bpy, lodgs, two_levels):
    root, splats = two_levels
    settings = root.lodgs
    settings.mode, s_min = "SELECTIVE", json.loads(settings.levels[0].facts)["s_min"]
    bpy.context.scene.camera.location = (3, 2, 3)
    settings.bands.gamma = s_min * 1777.7 / 0.8  # a border near the centre of the splats
    bpy.context.view_layer.update()
    border = s_min / settings.bands.gamma * settings.focal_px
    world_position = np.append(bpy.context.scene.camera.location, 1)
    center = np.linalg.solve(np.array(root.lodgs.axes.matrix_world, float), world_position)[:3]
    sets = visible_sets(bpy, lodgs)
    assert [visible.level for visible, _ in sets] == [1, 2]
    for (visible, arrays), truth in zip(sets, splats, strict=True):
        near = np.linalg.norm(truth.means - center, axis=1) < border
        assert np.array_equal(arrays.means, truth.means[near if visible.level == 2 else ~near])


def test_octree_weights_do_not_change_opacities(bpy, lodgs, two_levels):
    root, splats = two_levels
    Bundle, facts = lodgs("training.splats.levels").Bundle, {"d_max": 1.2, "d_max_focal": 1000.0}
    lodgs("data.scenes").set_bundle_facts(root, Bundle("", [], "octree", facts, cumulative=True))
    root.lodgs.mode = "SELECTIVE"
    bpy.context.view_layer.update()
    sets = visible_sets(bpy, lodgs)
    assert [len(arrays) for _, arrays in sets] != [COUNT, COUNT]
    assert (sets[0][1].weights == 1).all()
    fading = sets[1][1].weights
    assert ((fading > 0) & (fading <= 1)).all() and (fading < 1).any()
    opacities = 1 / (1 + np.exp(-splats[1].opacity_logits))
    nearest = np.abs(sets[1][1].opacities[:, None] - opacities).min(axis=1)
    assert nearest.max() < 1e-6


def test_instances_are_visible_and_hidden_objects_are_not(bpy, lodgs, two_levels, instance_of):
    root, _ = two_levels
    loose = lodgs("data.objects").new_splats("loose", make_splats(lodgs, 5, 7))
    points = lodgs("data.objects").new_points("points", np.zeros((3, 3)), np.zeros((3, 3), np.uint8), 1.0)
    for obj in (loose, points):
        bpy.context.scene.collection.objects.link(obj)
    carrier = instance_of(root.users_collection[0], (10, 0, 0))
    sets = visible_sets(bpy, lodgs)
    assert [(visible.level, len(arrays)) for visible, arrays in sets] == [(0, 7), (2, COUNT), (2, COUNT)]
    first, second = (visible.matrix_world[:3, 3] for visible, _ in sets[1:])
    assert sorted(np.abs(first - second).round(5)) == [0, 0, 10]
    loose.hide_set(True)
    carrier.hide_viewport = True
    bpy.context.view_layer.update()
    assert [visible.level for visible, _ in visible_sets(bpy, lodgs)] == [2]
    root.users_collection[0].hide_viewport = True
    bpy.context.view_layer.update()
    assert visible_sets(bpy, lodgs) == []


def test_instances_follow_the_animated_choice_of_the_camera(lodgs, two_levels, instance_of, measure_renders):
    """The training cameras are fixed to the splats of each instance; other cameras stay in the world."""
    (root, _), shown = two_levels, lodgs("data.shown")
    instance_of(root.users_collection[0], (10, 0, 0))
    root.lodgs.mode = "SELECTIVE"
    for frame, choice in ((1, "TRAINING"), (2, "CAMERA")):
        root.lodgs.camera_choice = choice
        root.lodgs.keyframe_insert("camera_choice", frame=frame)

    def count_positions(depsgraph):
        queries = [shown.rule_query(item, depsgraph) for item in shown.splat_instances(depsgraph)]
        return len({query.position for query in queries})

    assert measure_renders(count_positions) == {1: 1, 2: 2}


def test_instances_of_linked_scenes_have_level_numbers(bpy, lodgs, two_levels, instance_of, tmp_path):
    root, _ = two_levels
    root.lodgs.mode, name = "SELECTIVE", root.users_collection[0].name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "scene.blend"), link=True) as (_, linked):
        linked.collections = [name]
    instance_of(linked.collections[0])
    instances = lodgs("data.shown").splat_instances(bpy.context.evaluated_depsgraph_get())
    assert [instance.level for instance in instances] == [1, 2]
    assert lodgs("render.engine").level_numbers(bpy.context.scene) == [1, 2]


def test_instances_of_the_splats_show_no_cameras(bpy, lodgs, two_levels, instance_of):
    root, _ = two_levels
    importing = lodgs("data.importing")
    camera = lodgs("training.scenes.cameras").Camera("photo", 640, 480, 500.0, 500.0, 320.0, 240.0, np.eye(4))
    importing._add_views(bpy.context, root, [camera], 1.0, 0.01)
    carrier = instance_of(bpy.data.collections[f"{root.name} splats"])
    depsgraph = bpy.context.evaluated_depsgraph_get()
    kinds = {item.object.type for item in depsgraph.object_instances if item.is_instance}
    assert kinds == {"POINTCLOUD"}
    assert any(item.object.type == "CAMERA" for item in depsgraph.object_instances)
    sets = visible_sets(bpy, lodgs)
    assert [(visible.level, len(arrays)) for visible, arrays in sets] == [(2, COUNT), (2, COUNT)]
    bpy.data.objects.remove(root.lodgs.levels[0].object)
    assert lodgs("data.roots").levels_collection(root) == carrier.instance_collection


def test_renders_and_viewports_have_separate_visibility(bpy, lodgs, two_levels):
    """Renders include objects hidden in viewports only, and exclude objects hidden in renders only."""
    rendered = []

    class Engine(bpy.types.RenderEngine):
        bl_idname, bl_label = "LODGS_TEST", "Test"

        def render(self, depsgraph):
            instances = lodgs("data.shown").splat_instances(depsgraph)
            rendered.extend(instance.object.name for instance in instances)

    for name in ("a", "b"):
        bpy.context.scene.collection.objects.link(
            lodgs("data.objects").new_splats(name, make_splats(lodgs, 5, 7))
        )
    bpy.data.objects["a"].hide_render = True
    bpy.data.objects["b"].hide_viewport = True
    bpy.context.view_layer.update()
    bpy.utils.register_class(Engine)
    try:
        bpy.context.scene.render.engine = "LODGS_TEST"
        bpy.context.scene.render.resolution_percentage = 1
        bpy.ops.render.render()
    finally:
        bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
        bpy.utils.unregister_class(Engine)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    visible = [instance.object.name for instance in lodgs("data.shown").splat_instances(depsgraph)]
    assert rendered == ["b", "scene level 2"] and visible == ["a", "scene level 2"]


def test_splats_removed_by_modifiers_are_not_read(bpy, lodgs):
    """Blender drops all attributes with the last point. The scene then has no visible splats."""
    obj = lodgs("data.objects").new_splats("obj", make_splats(lodgs))
    bpy.context.scene.collection.objects.link(obj)
    group = bpy.data.node_groups.new("nothing", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    group.nodes.new("NodeGroupOutput")
    obj.modifiers.new("nothing", "NODES").node_group = group
    bpy.context.view_layer.update()
    assert visible_sets(bpy, lodgs) == []


def test_viewports_drop_harmonics_unless_they_are_needed(bpy, lodgs, two_levels):
    """Crops and rules need not copy them: LODGS draws the original splats.

    Modifiers of artists, exports of visible splats and renders have all coefficients.
    """
    root, splats = two_levels
    root.lodgs.single_level = 2
    obj, count = root.lodgs.levels[1].object, splats[1].sh.shape[1] - 1
    sh_names = lodgs("attributes").sh_names

    def evaluated_count():
        bpy.context.view_layer.update()
        return len(sh_names(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data))

    assert count > 0 and evaluated_count() == 0 and len(sh_names(obj.data)) == count
    visible = lodgs("data.scenes").visible_splats(bpy.context, root)
    assert np.array_equal(visible.sh, splats[1].sh) and evaluated_count() == 0
    settings = bpy.context.scene.lodgs_viewport
    settings.splats = False  # Blender draws the cloud, from 5.3 on as plain points
    assert evaluated_count() == (0 if lodgs("compat").NATIVE_SPLATS else count)
    settings.splats = True
    viewport = obj.modifiers["LODGS Viewport"]
    assert not viewport.show_render and obj.modifiers.find(viewport.name) == 0
    obj.modifiers.new("mine", "NODES")
    evaluated_count()  # the next update has all attributes
    assert evaluated_count() == count and "LODGS Viewport" not in obj.modifiers
