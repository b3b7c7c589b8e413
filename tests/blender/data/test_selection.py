"""Splats that modifiers keep, compared with the rule in numpy for all camera choices."""

from math import inf

import numpy as np
import pytest

S_MIN = [0.012, 0.003, 0.00075, 0.0001875, 0.0]
COUNT = 20_000


def flod_bands(s_min, f, gamma, first, last):
    """Return near and far of each level by FLoD's Eq. 7 and 8; (inf, inf) for unused levels."""
    d_proj = [size / gamma * f for size in s_min]
    return [
        (d_proj[n - 1] if n < last else 0.0, d_proj[n - 2] if n > first else inf)
        if first <= n <= last
        else (inf, inf)
        for n in range(1, len(s_min) + 1)
    ]


@pytest.fixture
def root(bpy, lodgs):
    """A scene with five levels of points within 40 units of its camera."""
    scene, rng = bpy.context.scene, np.random.default_rng(7)
    bundle = lodgs("training.splats.bundle")
    levels = []
    for number, s_min in enumerate(S_MIN, 1):
        direction = rng.standard_normal((COUNT, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        splats = lodgs("training.splats.gaussians").Splats(
            means=(direction * rng.uniform(0, 40, (COUNT, 1))).astype(np.float32),
            quats=np.tile(np.float32([1, 0, 0, 0]), (COUNT, 1)),
            log_scales=np.full((COUNT, 3), -5, np.float32),
            opacity_logits=np.zeros(COUNT, np.float32),
            sh=np.zeros((COUNT, 1, 3), np.float32),
        )
        levels.append(bundle.Level(number, splats, {"s_min": s_min}))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
        lodgs("data.scenes").set_bundle_facts(root, bundle.Bundle("flod", [], "bands"))
        for level in levels:
            lodgs("data.scenes").set_level(root, level)
    root.lodgs.mode, root.lodgs.bands.first = "SELECTIVE", 1
    return root


def focal(bpy) -> float:
    """Return the smaller of fx and fy in pixels from Blender's projection matrix."""
    scene = bpy.context.scene
    render, depsgraph = scene.render, bpy.context.evaluated_depsgraph_get()
    scale = render.resolution_percentage / 100
    width, height = int(render.resolution_x * scale), int(render.resolution_y * scale)
    matrix = scene.camera.calc_matrix_camera(
        depsgraph, x=width, y=height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    return min(matrix[0][0] * width / 2, matrix[1][1] * height / 2)


def visible_positions(bpy, root) -> list[np.ndarray | None]:
    """Return the positions that the modifiers of each level keep; None for hidden levels."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    visible_names = {i.object.original.name for i in depsgraph.object_instances if not i.is_instance}
    levels = []
    for item in root.lodgs.levels:
        cloud = item.object.evaluated_get(depsgraph).data
        positions = np.empty(len(cloud.points) * 3, np.float32)
        if len(positions):
            cloud.attributes["position"].data.foreach_get("vector", positions)
        levels.append(positions.reshape(-1, 3) if item.object.name in visible_names else None)
    return levels


def check(bpy, root, center=None, f=None) -> list[int]:
    """Compare the visible splats of every level with the rule; return their counts."""
    bpy.context.view_layer.update()
    settings = root.lodgs
    if f is None:
        f = focal(bpy)
    assert settings.focal_px == pytest.approx(f, rel=1e-6)
    if center is None:
        world = np.array(bpy.context.scene.camera.matrix_world, np.float64)[:, 3]
        center = np.linalg.solve(np.array(root.lodgs.axes.matrix_world, np.float64), world)[:3]
    bands = flod_bands(S_MIN, f, settings.bands.gamma, settings.bands.first, settings.bands.last)
    counts = []
    for item, shown, (near, far) in zip(settings.levels, visible_positions(bpy, root), bands, strict=True):
        all_positions = np.empty(COUNT * 3, np.float32)
        item.object.data.attributes["position"].data.foreach_get("vector", all_positions)
        all_positions = all_positions.reshape(-1, 3)
        difference = all_positions - np.float32(center)
        x, y, z = (difference**2).T
        distances = np.sqrt(x + y + z)
        expected = all_positions[(distances >= np.float32(near)) & (distances < np.float32(far))]
        if near == inf:
            assert shown is None and len(expected) == 0
        else:
            assert np.array_equal(shown, expected)
        counts.append(len(expected))
    return counts


def test_all_settings_change_the_bands(bpy, root):
    scene, camera, settings = bpy.context.scene, bpy.context.scene.camera, root.lodgs
    first = check(bpy, root)
    assert all(first)
    counts = [first]

    def check_change():
        counts.append(check(bpy, root))
        assert counts[-1] != counts[-2]

    camera.location = (3, -2, 1)
    check_change()
    settings.bands.gamma = 2.5
    check_change()
    settings.bands.first, settings.bands.last = 3, 5
    check_change()
    settings.bands.first, settings.bands.last = 2, 4
    check_change()
    camera.data.lens = 85
    check_change()
    camera.data.sensor_width = 22.3
    check_change()
    scene.render.resolution_x, scene.render.resolution_y = 640, 1001
    check_change()
    camera.data.sensor_fit = "VERTICAL"
    check_change()
    camera.data.sensor_height = 18
    check_change()
    camera.data.sensor_fit = "HORIZONTAL"
    check_change()
    scene.render.resolution_percentage = 33
    check_change()
    camera.data.sensor_fit = "AUTO"
    scene.render.pixel_aspect_y = 1.6
    check_change()
    before = root.lodgs.focal_px
    scene.render.pixel_aspect_y = 2.0
    check(bpy, root)
    assert root.lodgs.focal_px == before  # taller pixels increase fx only, and fy is smaller
    scene.render.pixel_aspect_x = 2.6
    check_change()


def test_transforming_root_and_camera_together_keeps_the_selection(bpy, root):
    """Distances are in scene units, not world units."""
    bpy.context.scene.camera.parent = root
    bpy.context.scene.camera.location = (1, 2, 3)
    before = check(bpy, root, center=(1, 2, 3))
    root.location, root.rotation_euler, root.scale = (0.5, 0.25, -2), (0, 0, np.pi / 2), (4, 4, 4)
    bpy.context.view_layer.update()
    after = [len(p) for p in visible_positions(bpy, root)]
    # Rounding in Blender's transforms may move a splat on the border of a band.
    assert np.abs(np.subtract(after, before)).max() <= 1


def test_camera_choices_select_splats(bpy, root):
    chosen = bpy.data.objects.new("chosen", None)
    bpy.context.scene.collection.objects.link(chosen)
    chosen.location = (10, 0, 0)
    bpy.context.scene.camera.location = (0, 5, 0)
    counts_of_choices = [check(bpy, root, center=(0, 5, 0))]
    root.lodgs.camera_choice = "OBJECT"
    root.lodgs.camera_object = chosen
    counts_of_choices.append(check(bpy, root, center=(10, 0, 0)))
    chosen.location.x = 5
    counts_of_choices.append(check(bpy, root, center=(5, 0, 0)))
    root.lodgs.camera_choice = "TRAINING"
    root.lodgs.camera_center = (0, 0, 20)
    counts_of_choices.append(check(bpy, root, center=(0, 0, 20)))
    bpy.context.scene.camera.location = (0, 0, 0)
    assert check(bpy, root, center=(0, 0, 20)) == counts_of_choices[-1]
    root.lodgs.camera_choice = "CAMERA"
    counts_of_choices.append(check(bpy, root, center=(0, 0, 0)))
    assert len({tuple(counts) for counts in counts_of_choices}) == len(counts_of_choices)


def test_selection_follows_animated_and_switched_cameras(bpy, root):
    scene, camera = bpy.context.scene, bpy.context.scene.camera
    carrier, follower = bpy.data.objects.new("carrier", None), bpy.data.cameras.new("follower")
    follower.lens = 24
    second = bpy.data.objects.new("second", follower)
    for obj in (carrier, second):
        scene.collection.objects.link(obj)
    camera.parent, camera.location = carrier, (0, 0, 2)
    for frame, x in ((1, 0.0), (21, 30.0)):
        carrier.location.x = x
        carrier.keyframe_insert("location", index=0, frame=frame)
    root.lodgs.bands.gamma = 1.0
    root.lodgs.bands.keyframe_insert("gamma", frame=1)
    root.lodgs.bands.gamma = 3.0
    root.lodgs.bands.keyframe_insert("gamma", frame=21)
    constraint = second.constraints.new("COPY_LOCATION")
    constraint.target = carrier
    scene.timeline_markers.new("a", frame=1).camera = camera
    scene.timeline_markers.new("b", frame=11).camera = second

    counts = []
    for frame in (1, 6, 10, 11, 16, 21, 3):
        scene.frame_set(frame)
        assert scene.camera == (camera if frame < 11 else second)
        counts.append(tuple(check(bpy, root)))
    assert len(set(counts)) == len(counts)


def test_single_level_hides_other_levels(bpy, root):
    root.lodgs.mode = "SINGLE"
    for number in (1, 4):
        root.lodgs.single_level = number
        bpy.context.view_layer.update()
        positions = visible_positions(bpy, root)
        assert [None if p is None else len(p) for p in positions] == [
            COUNT if n == number else None for n in range(1, 6)
        ]
    root.lodgs.levels[3].show = False
    bpy.context.view_layer.update()
    assert all(p is None for p in visible_positions(bpy, root))


def test_levels_beyond_the_finest_are_clamped(bpy, root):
    bands = root.lodgs.bands
    root.lodgs.single_level = bands.last = bands.first = 9
    assert (root.lodgs.single_level, bands.first, bands.last) == (5, 5, 5)
    bands.last = 2
    assert (bands.first, bands.last) == (2, 2)


def test_unused_levels_are_not_evaluated(bpy, root):
    root.lodgs.bands.first, root.lodgs.bands.last = 3, 4
    bpy.context.view_layer.update()
    for item in root.lodgs.levels:
        used = item.number in (3, 4)
        assert (item.object.hide_viewport, item.object.hide_render) == (not used, not used)
    root.lodgs.mode = "SINGLE"
    bpy.context.view_layer.update()
    modifier = root.lodgs.levels[3].object.modifiers["LODGS Bands"]
    assert not modifier.show_viewport and not modifier.show_render


def test_hidden_roots_hide_their_levels(bpy, root):
    """Levels have drivers, so that artists key the visibility of the root."""
    for frame, hidden in ((1, True), (2, False)):
        root.hide_render = hidden
        root.keyframe_insert("hide_render", frame=frame)
    for frame, hidden in ((1, True), (2, False)):
        bpy.context.scene.frame_set(frame)
        levels = [item.object for item in root.lodgs.levels]
        assert all(level.hide_render for level in levels) is hidden
        assert not all(level.hide_viewport for level in levels)
    root.hide_viewport = True
    bpy.context.view_layer.update()
    assert all(item.object.hide_viewport for item in root.lodgs.levels)


def test_drivers_need_no_scripts(bpy, lodgs, root):
    """Blender evaluates simple expressions even if Auto Run Python Scripts is off."""
    compat = lodgs("compat")
    drivers = [
        c.driver
        for t in [root, *root.children_recursive]
        if t.animation_data
        for c in t.animation_data.drivers
    ]
    drivers_per_level = 21 if compat.NATIVE_SPLATS else 18
    assert len(drivers) == 1 + drivers_per_level * len(S_MIN)
    assert all(driver.is_simple_expression and driver.is_valid for driver in drivers)


def test_selection_survives_saving(bpy, root, tmp_path):
    before = check(bpy, root)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    (reopened,) = [o for o in bpy.data.objects if o.lodgs.is_root]
    assert check(bpy, reopened) == before
    reopened.lodgs.bands.gamma = 2
    assert check(bpy, reopened) != before


def test_replaced_level_keeps_its_position_in_the_list(bpy, lodgs, root):
    """Drivers refer to levels by their index in the list."""
    settings = root.lodgs
    bundle, objects = lodgs("training.splats.bundle"), lodgs("data.objects")
    item = settings.levels[2]
    obj, splats = item.object, objects.read_splats(item.object)
    clouds = len(bpy.data.pointclouds)
    replaced = lodgs("data.scenes").set_level(root, bundle.Level(3, splats, {"s_min": S_MIN[2]}))
    assert replaced == obj and len(settings.levels) == 5 and len(bpy.data.pointclouds) == clouds
    assert [entry.number for entry in settings.levels] == [1, 2, 3, 4, 5]
    check(bpy, root)


def test_new_level_keeps_mode_and_selection(bpy, lodgs, root):
    """Training may add a level while the user edits another object."""
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.object
    bpy.ops.object.mode_set(mode="EDIT")
    splats = lodgs("data.objects").read_splats(root.lodgs.levels[0].object)
    scenes = len(bpy.data.scenes)
    lodgs("data.scenes").set_level(root, lodgs("training.splats.levels").Level(6, splats, {"s_min": 0.0}))
    assert bpy.context.mode == "EDIT_MESH" and bpy.context.object == cube
    assert bpy.context.selected_objects == [cube] and len(bpy.data.scenes) == scenes
    assert root.lodgs.bands.last == 6


def test_removed_levels_leave_no_gap(bpy, lodgs, root):
    """After a training with fewer levels, its finest level extends to the camera."""
    for item in list(root.lodgs.levels)[3:]:
        bpy.data.objects.remove(item.object)
    lodgs("data.scenes").set_bundle_facts(root, lodgs("training.splats.levels").Bundle("flod", [], "bands"))
    assert [item.number for item in root.lodgs.levels] == [1, 2, 3]
    assert (root.lodgs.bands.last, root.lodgs.single_level) == (3, 3)
    bpy.context.view_layer.update()
    nearest = visible_positions(bpy, root)[2]
    assert np.linalg.norm(nearest, axis=1).min() < 0.1


def test_levels_keep_their_material(bpy, root):
    """Also a material of the user, on the data or on the object."""

    def evaluated_materials():
        bpy.context.view_layer.update()
        bpy.context.view_layer.update()  # updates caused by the first
        evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
        assert 0 < len(evaluated.data.points) < COUNT
        return [material.name for material in evaluated.data.materials]

    obj = root.lodgs.levels[1].object
    assert evaluated_materials() == ["LODGS Points"]
    obj.data.materials.clear()
    obj.data.materials.append(bpy.data.materials.new("mine"))
    assert evaluated_materials() == ["mine"]
    obj.material_slots[0].link = "OBJECT"
    obj.material_slots[0].material = bpy.data.materials.new("of the object")
    assert evaluated_materials() == ["of the object"]

    updates = []
    bpy.app.handlers.depsgraph_update_post.append(lambda *_: updates.append(1))
    for _ in range(3):
        bpy.context.view_layer.update()
    bpy.app.handlers.depsgraph_update_post.pop()
    assert not updates  # no endless updates


def test_level_deleted_by_the_user_leaves_no_gap(bpy, lodgs, root):
    """The other levels cover its distances; undo restores it."""
    settings = root.lodgs
    before = check(bpy, root)
    bpy.ops.ed.undo_push(message="before")
    for obj in bpy.context.selected_objects:
        obj.select_set(False)
    with bpy.context.temp_override(selected_objects=[settings.levels[2].object]):
        bpy.ops.object.delete("EXEC_DEFAULT", True)
    bpy.context.view_layer.update()
    assert [item.number for item in settings.levels] == [1, 2, 4, 5]
    bpy.context.view_layer.update()
    bands = flod_bands([S_MIN[0], S_MIN[1], S_MIN[3], S_MIN[4]], focal(bpy), settings.bands.gamma, 1, 4)
    for positions, (near, far) in zip(visible_positions(bpy, root), bands, strict=True):
        distances = np.linalg.norm(positions.astype(np.float64), axis=1)
        assert distances.min() >= near * 0.9999 and distances.max() < min(far, 40.01) * 1.0001
        assert abs(len(positions) / COUNT - (min(far, 40) - near) / 40) < 0.02  # uniform in the distance
    settings.bands.first, settings.bands.last = 1, 3  # level 3 is deleted
    bpy.context.view_layer.update()
    assert np.linalg.norm(visible_positions(bpy, root)[1], axis=1).min() < 0.1
    settings.bands.first, settings.bands.last = 3, 5
    bpy.context.view_layer.update()
    assert np.linalg.norm(visible_positions(bpy, root)[2], axis=1).max() > 39
    bpy.ops.ed.undo()
    (root,) = [obj for obj in bpy.data.objects if obj.lodgs.is_root]
    assert [item.number for item in root.lodgs.levels] == [1, 2, 3, 4, 5]
    assert check(bpy, root) == before


def test_scene_without_a_camera_uses_the_default_lens(bpy, root):
    bpy.context.scene.camera = None
    check(bpy, root, center=(0, 0, 0), f=50 / 36 * 1920)


@pytest.mark.parametrize("text", ["{", "[]", "null", '{"s_min": "a"}', '{"s_min": NaN}', "[" * 5000])
def test_edited_facts_are_ignored(bpy, lodgs, root, text):
    """Other add-ons and scripts can write into any property."""
    root.lodgs.facts = root.lodgs.meta = root.lodgs.levels[1].facts = text
    lodgs("data.selection").attach(root)
    lodgs("data.older_files").upgrade_scene(root)
    bundle = lodgs("data.scenes").read_levels(root)
    assert bundle.facts.keys() <= {"s_min"} and "s_min" not in bundle.levels[1].facts
    rule = lodgs("nodes.rules").rule_of_group
    has_rule = [
        any(rule(getattr(modifier, "node_group", None)) for modifier in item.object.modifiers)
        for item in root.lodgs.levels
    ]
    assert has_rule == [True, False, False, True, True]  # level 3 needs the facts of level 2


def test_level_with_a_mesh_is_removed_from_the_list(bpy, lodgs, root):
    mesh = bpy.data.objects.new("mesh", bpy.data.meshes.new("mesh"))
    bpy.context.scene.collection.objects.link(mesh)
    root.lodgs.levels[0].object = mesh
    lodgs("data.selection").attach(root)
    scenes = lodgs("data.scenes")
    assert [level.number for level in scenes.read_levels(root).levels] == [2, 3, 4, 5]
    assert scenes.count_visible(bpy.context, root)[1] == 4 * COUNT and not mesh.modifiers
