"""Modifiers of cumulative levels of Octree-GS, compared with the rule in numpy."""

import numpy as np
import pytest

from training.lod.rules.octree import fade_weights, target_level

LEVELS, COUNT, D_MAX, FOCAL = 4, 5_000, 16.0, 700.0


@pytest.fixture
def root(bpy, lodgs, tmp_path):
    """Import four levels of points within 40 units of the scene camera."""
    scene, rng = bpy.context.scene, np.random.default_rng(7)
    scene.lodgs_viewport.splats = False  # points keep their radius
    bundles = lodgs("training.splats.bundle")
    levels = []
    for number in range(1, LEVELS + 1):
        direction = rng.standard_normal((COUNT, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        splats = lodgs("training.splats.gaussians").Splats(
            means=(direction * rng.uniform(0, 40, (COUNT, 1))).astype(np.float32),
            quats=np.tile(np.float32([1, 0, 0, 0]), (COUNT, 1)),
            log_scales=np.full((COUNT, 3), -5, np.float32),
            opacity_logits=rng.normal(size=COUNT).astype(np.float32),
            sh=np.zeros((COUNT, 1, 3), np.float32),
            extras={"lod_bias": rng.uniform(0, 0.5, COUNT).astype(np.float32)},
        )
        levels.append(bundles.Level(number, splats))
    facts = {"d_max": D_MAX, "d_max_focal": FOCAL}
    bundle = bundles.Bundle("octree", levels, "octree", facts, cumulative=True)
    bundles.write_bundle(tmp_path / "b.ply", bundle)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "b.ply")
    root.lodgs.mode = "SELECTIVE"
    return root


def expected_weights(root, camera_center, focal, offset=0.0):
    """Return the weights of each level according to the rule."""
    weights = []
    for item in root.lodgs.levels:
        cloud = item.object.data
        means, bias = np.empty(3 * COUNT, np.float32), np.empty(COUNT, np.float32)
        cloud.attributes["position"].data.foreach_get("vector", means)
        cloud.attributes["lod_bias"].data.foreach_get("value", bias)
        distances = np.linalg.norm(means.reshape(-1, 3) - np.float32(camera_center), axis=1) * (FOCAL / focal)
        weights.append(fade_weights(target_level(distances, bias + offset, D_MAX, LEVELS), item.number))
    return weights


def evaluated_points(bpy, root):
    """Return weights and radii of the remaining points of each level."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    points_of_levels = []
    for item in root.lodgs.levels:
        cloud = item.object.evaluated_get(depsgraph).data
        weights, radii = np.empty(len(cloud.points), np.float32), np.empty(len(cloud.points), np.float32)
        if len(weights):
            cloud.attributes["lod_weight"].data.foreach_get("value", weights)
            cloud.attributes["radius"].data.foreach_get("value", radii)
        points_of_levels.append((weights, radii))
    return points_of_levels


@pytest.mark.parametrize("offset", [0.0, -1.3, 0.7])
def test_levels_fade_in_according_to_the_rule(bpy, root, offset):
    settings = root.lodgs
    settings.octree.offset = offset
    bpy.context.scene.camera.location = (3, -2, 1)
    bpy.context.scene.camera.data.lens = 35
    bpy.context.view_layer.update()
    center = root.lodgs.axes.matrix_world.inverted() @ bpy.context.scene.camera.matrix_world.translation
    expected = expected_weights(root, center, settings.focal_px, offset)
    counts = []
    for item, level_weights, (weights, radii) in zip(
        settings.levels, expected, evaluated_points(bpy, root), strict=True
    ):
        visible = level_weights > 1e-5
        assert abs(len(weights) - visible.sum()) <= 2  # the last bits of the logarithm at weight 0
        if len(weights) == visible.sum():
            assert np.abs(weights - level_weights[visible]).max(initial=0) < 1e-4
            original_radii = np.empty(COUNT, np.float32)
            item.object.data.attributes["radius"].data.foreach_get("value", original_radii)
            assert np.allclose(radii, original_radii[visible] * weights, rtol=1e-5)
        counts.append(int(visible.sum()))
    assert counts[0] == COUNT  # level 1 is always visible
    assert counts == sorted(counts, reverse=True)
    assert any(0 < n < COUNT for n in counts)


def test_single_cumulative_level_shows_coarser_levels(bpy, root):
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", 2
    bpy.context.view_layer.update()
    assert [item.object.visible_get() for item in root.lodgs.levels] == [True, True, False, False]
    root.lodgs.mode = "SELECTIVE"
    bpy.context.view_layer.update()
    assert all(item.object.visible_get() for item in root.lodgs.levels)


def test_solo_shows_a_hidden_level(bpy, lodgs, root):
    root.lodgs.levels[0].show = root.lodgs.levels[2].show = False
    bpy.ops.lodgs.show_only_level(level=2)
    bpy.context.view_layer.update()
    assert [item.object.visible_get() for item in root.lodgs.levels] == [True, True, False, False]


def test_cumulative_level_is_exported_with_coarser_levels(bpy, lodgs, root):
    splats = lodgs("data.scenes").read_level(root, 3)
    assert len(splats) == 3 * COUNT
    means = np.empty(3 * COUNT, np.float32)
    root.lodgs.levels[1].object.data.attributes["position"].data.foreach_get("vector", means)
    assert (splats.means[COUNT : 2 * COUNT] == means.reshape(-1, 3)).all()


def is_display(name):
    """Return True for a modifier or driver path that every splat object has."""
    return any(own in name for own in ("LODGS Display", "LODGS Native Splats", "LODGS Viewport"))


def names_of(obj):
    return [modifier.name for modifier in obj.modifiers if not is_display(modifier.name)]


def test_changing_the_method_replaces_modifiers_and_drivers(bpy, lodgs, root):
    """After FLoD and octree in turn, each level has one modifier, with the drivers of its rule only."""
    Bundle = lodgs("training.splats.levels").Bundle
    for item in root.lodgs.levels:
        item.facts = '{"s_min": 0.5}'
    obj = root.lodgs.levels[0].object
    obj.modifiers.new("mine", "NODES")
    for rule, facts, name in (
        ("bands", {}, "LODGS Bands"),
        ("octree", {"d_max": 2.0, "d_max_focal": FOCAL}, "LODGS Octree"),
    ):
        bundle = Bundle("", [], rule, facts, cumulative=rule == "octree")
        lodgs("data.scenes").set_bundle_facts(root, bundle)
        for item in root.lodgs.levels:
            assert [modifier for modifier in names_of(item.object) if modifier != "mine"] == [name]
            drivers = item.object.animation_data.drivers
            paths = [driver.data_path for driver in drivers]
            assert len(paths) == len({(driver.data_path, driver.array_index) for driver in drivers})
            rule_paths = [path for path in paths if path.startswith("modifiers") and not is_display(path)]
            assert rule_paths and all(name in path for path in rule_paths)
            assert all(driver.driver.is_valid for driver in item.object.animation_data.drivers)
        assert names_of(obj) == [name, "mine"], "order of modifiers"
    bpy.context.view_layer.update()
    assert sum(len(weights) for weights, _ in evaluated_points(bpy, root)) > COUNT


def test_visible_export_keeps_fading(bpy, lodgs, root):
    bpy.context.scene.camera.location = (3, -2, 1)
    bpy.context.view_layer.update()
    splats = lodgs("data.scenes").visible_splats(bpy.context, root)
    center = root.lodgs.axes.matrix_world.inverted() @ bpy.context.scene.camera.matrix_world.translation
    opacities = []
    for item, weights in zip(
        root.lodgs.levels, expected_weights(root, center, root.lodgs.focal_px), strict=True
    ):
        logits = np.empty(COUNT, np.float32)
        item.object.data.attributes["opacity_logit"].data.foreach_get("value", logits)
        opacities.append((weights / (1 + np.exp(-logits)))[weights > 0])
    opacities = np.concatenate(opacities)
    assert abs(len(splats) - len(opacities)) <= 4
    assert "lod_weight" not in splats.extras
    if len(splats) == len(opacities):
        assert np.allclose(1 / (1 + np.exp(-splats.opacity_logits)), opacities, atol=1e-4)
