"""Splats in 3D viewports, drawn offscreen, against the trainer's rasterizer and by hand."""

import os
import subprocess
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from training.splats import sh as harmonics

SIZE = 512


def make_splats(lodgs, count=3000, degree=0, seed=0, size=-3.0):
    rng = np.random.default_rng(seed)
    sh = rng.normal(0, 0.25, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(-1.5, 1.5, (count, 3))
    return lodgs("training.splats.gaussians").Splats(
        means=rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        log_scales=rng.normal(size, 0.6, (count, 3)).astype(np.float32),
        opacity_logits=rng.normal(0.5, 2, count).astype(np.float32),
        sh=sh.astype(np.float32),
    )


@pytest.fixture
def camera(bpy):
    """The scene's camera, some units off, looking at the origin from a slant."""
    from mathutils import Vector

    data = bpy.data.cameras.new("camera")
    data.clip_start, data.clip_end, data.lens = 0.01, 100, 40
    data.shift_x = 0.05
    obj = bpy.data.objects.new("camera", data)
    bpy.context.scene.collection.objects.link(obj)
    obj.location = (2.0, -3.0, 1.0)
    obj.rotation_euler = Vector((-2.0, 3.0, -1.0)).to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.camera = obj
    bpy.context.scene.render.resolution_x = bpy.context.scene.render.resolution_y = SIZE
    bpy.context.view_layer.update()
    return obj


@pytest.fixture
def add(bpy, lodgs):
    """``add(splats, matrix)``: an object of splats in the scene."""

    def added(splats, matrix=None):
        obj = lodgs("data.objects").new_splats("splats", splats)
        bpy.context.scene.collection.objects.link(obj)
        if matrix is not None:
            obj.matrix_world = matrix
        bpy.context.view_layer.update()
        return obj

    return added


@pytest.fixture
def picture(bpy, lodgs, frame, camera):
    """``picture(**options)``: what the camera sees of all splats, (SIZE, SIZE, 4) linear, row 0 above.

    ``before`` is called to draw into the framebuffer first; ``view`` is what a viewport keeps; ``coded`` is
    what the framebuffer holds before; with ``zoom`` the camera's picture fills that share of what is seen.
    """
    from mathutils import Matrix

    views = lodgs("viewport.views")
    views.clear()

    def drawn(before=None, view=None, budget=10**6, under_overlays=False, wait=True, coded=None, zoom=None):
        depsgraph = bpy.context.evaluated_depsgraph_get()
        matrix = camera.matrix_world.inverted()
        projection = camera.calc_matrix_camera(depsgraph, x=SIZE, y=SIZE)
        sets, given = lodgs("data.shown").splat_instances(depsgraph), {}
        if zoom is not None:
            projection = Matrix.Diagonal((zoom, zoom, 1, 1)) @ projection
            given["frame"] = lodgs("viewport.eye").frame(camera, bpy.context.scene, projection @ matrix)

        def draw():
            if before is not None:
                before(projection @ matrix)
            views.draw_splats(
                view or views.ViewState(), sets, depsgraph, matrix, projection, budget,
                under_overlays=under_overlays, wait=wait, **given,
            )  # fmt: skip

        return frame(SIZE, draw, coded)[::-1]

    yield drawn
    views.clear()


def displayed(linear):
    """As Blender shows what lies in its overlays' buffer, over black."""
    return np.clip(linear[..., :3], 0, 1) ** (1 / 2.2)


def psnr(one, other):
    return -10 * np.log10(np.mean((np.clip(one, 0, 1) - np.clip(other, 0, 1)) ** 2, dtype=np.float64))


@pytest.fixture
def truth(bpy, camera, tmp_path):
    """``truth([(splats, matrix), ...])``: the trainer's picture of splats in the world, (SIZE, SIZE, 3).

    ``antialias`` says of each set whether it is. ``size`` is another one in pixels.
    """
    python = os.environ.get("LODGS_TRAINER_PYTHON")
    if not python:
        pytest.skip("LODGS_TRAINER_PYTHON names no Python that has the trainer")

    def rendered(sets, keep=None, antialias=(), size=SIZE):
        projection = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=size, y=size)
        flip = np.diag([1.0, -1.0, -1.0, 1.0])
        world_to_camera = flip @ np.linalg.inv(np.array(camera.matrix_world, float))
        parts = [_in_world(splats, np.array(matrix, float), world_to_camera) for splats, matrix in sets]
        arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        if keep is not None:
            arrays["weights"] = keep(arrays["means"]).astype(float)
        if antialias:
            arrays["antialias"] = np.repeat(antialias, [len(splats) for splats, _ in sets])
        intrinsics = (
            projection[0][0] * size / 2, projection[1][1] * size / 2,
            size / 2 * (1 - projection[0][2]), size / 2 * (1 + projection[1][2]),
        )  # fmt: skip
        np.savez(
            tmp_path / "in.npz", **arrays, size=(size, size), intrinsics=intrinsics,
            world_to_camera=world_to_camera, near=0.01,
        )  # fmt: skip
        program = Path(__file__).parents[1] / "render_splats.py"
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"LODGS_THREADS": "1"}
        subprocess.run(
            [python, program, tmp_path / "in.npz", tmp_path / "out.npy"], check=True, env=environment
        )
        return np.load(tmp_path / "out.npy")

    return rendered


def _in_world(splats, matrix, world_to_camera):
    """Splats of an object in Blender's world, in float64, with the colours that the camera sees of them.

    A transform that is no rotation makes other Gaussians: M Σ Mᵀ in place of Σ, by its own axes.
    """
    linear, count = matrix[:3, :3], len(splats)
    quats = splats.quats.astype(float)
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    turn = np.moveaxis(
        np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]), 2, 0,
    )  # fmt: skip
    half = linear @ turn * np.exp(splats.log_scales.astype(float))[:, None, :]
    axes, deviations, _ = np.linalg.svd(half)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    eye = np.linalg.inv(world_to_camera)[:3, 3]
    local = splats.means - (np.linalg.inv(matrix) @ np.append(eye, 1))[:3]
    values = np.empty((splats.sh.shape[1], count))
    harmonics.basis(*(local / np.linalg.norm(local, axis=1, keepdims=True)).T, splats.sh_degree, values)
    return {
        "means": splats.means.astype(float) @ linear.T + matrix[:3, 3],
        "quats": _quaternions(axes),
        "log_scales": np.log(deviations),
        "opacity_logits": splats.opacity_logits,
        "sh": np.maximum(0.5 + np.einsum("kn,nkc->nc", values, splats.sh), 0),
    }


def _quaternions(rotations):
    from mathutils import Matrix

    return np.array([tuple(Matrix(rotation.tolist()).to_quaternion()) for rotation in rotations])


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_one_set_is_what_the_rasterizer_draws(bpy, lodgs, add, picture, truth, degree):
    splats = make_splats(lodgs, degree=degree)
    add(splats)
    seen, expected = displayed(picture()), truth([(splats, np.eye(4))])
    assert expected.std() > 0.1
    assert psnr(seen, expected) > 45


@pytest.mark.parametrize("degree", [0, 4])
def test_two_overlapping_sets_turned_scaled_and_stretched(bpy, lodgs, add, picture, truth, degree):
    from mathutils import Euler, Matrix

    sets = []
    for seed, turn, scale, place in (
        (1, (0.4, -1.0, 2.0), (0.8, 0.8, 0.8), (0.3, 0.2, 0)),
        (2, (-2.0, 0.3, 0.9), (0.5, 1.2, 0.9), (-0.4, 0.1, 0.3)),
    ):
        matrix = Matrix.LocRotScale(place, Euler(turn), scale)
        splats = make_splats(lodgs, 2000, degree, seed)
        add(splats, matrix)
        sets.append((splats, matrix))

    assert psnr(displayed(picture()), truth(sets)) > 45


@pytest.mark.parametrize("zoom", [0.5, 1.5])
def test_what_is_beside_a_cameras_picture_reaches_into_it_as_in_a_render(lodgs, add, picture, truth, zoom):
    """Looking through a camera there is more to be seen than its picture, or less."""
    from mathutils import Matrix

    splats, matrix = make_splats(lodgs, size=-1.5), Matrix.Diagonal((3, 3, 3, 1))
    add(splats, matrix)
    size = round(SIZE * zoom)
    expected = truth([(splats, matrix)], size=size)
    both = min(size, SIZE)
    seen, expected = (_middle(image, both) for image in (displayed(picture(zoom=zoom)), expected))
    assert psnr(seen, expected) > 45


def _middle(image, size):
    border = (len(image) - size) // 2
    return image[border : border + size, border : border + size]


def test_antialiased_splats_beside_others(bpy, lodgs, picture, truth):
    """Each set through its own filter: splats of a pixel and less, two scenes that reach into each other."""
    scenes, bundle = lodgs("data.scenes"), lodgs("training.splats.bundle")
    sets = [(make_splats(lodgs, 6000, 1, seed, size=-5.5), np.eye(4)) for seed in range(2)]
    for (splats, _), meta in zip(sets, ({"antialias": True}, {}), strict=True):
        with scenes.new_scene(bpy.context, "scene") as root:
            scenes.set_level(root, bundle.Level(1, splats))
            scenes.set_bundle_facts(root, bundle.Bundle("", [], meta=meta))
    bpy.context.view_layer.update()
    expected = truth(sets, antialias=[True, False])
    assert psnr(expected, truth(sets)) < 35
    assert psnr(displayed(picture()), expected) > 45


def test_a_copy_and_an_instance_are_antialiased_too(bpy, lodgs, picture):
    """Whatever shows the splats of a scene draws them as the scene says, as soon as it says so."""
    from mathutils import Matrix

    scenes, bundle = lodgs("data.scenes"), lodgs("training.splats.bundle")
    with scenes.new_scene(bpy.context, "scene") as root:
        level = scenes.set_level(root, bundle.Level(1, make_splats(lodgs, 20)))
        scenes.set_bundle_facts(root, bundle.Bundle("", []))
    copy, instance = level.copy(), bpy.data.objects.new("instance", None)
    root.users_collection[0].objects.link(copy)
    instance.instance_type, instance.instance_collection = "COLLECTION", root.users_collection[0]
    instance.matrix_world = Matrix.Translation((3, 0, 0))
    bpy.context.scene.collection.objects.link(instance)
    alone = bpy.data.objects.new("alone", level.data)
    bpy.context.scene.collection.objects.link(alone)
    shown = lodgs("data.shown")

    def flags():
        bpy.context.view_layer.update()
        sets = shown.splat_instances(bpy.context.evaluated_depsgraph_get())
        assert len(sets) == 5
        return sorted((each.object.name, each.antialias) for each in sets)

    assert not any(antialias for _, antialias in flags())
    before = picture()
    root.lodgs.antialias = True
    assert scenes.read_levels(root).meta == {"antialias": True}
    assert [name for name, antialias in flags() if not antialias] == ["alone"]
    assert np.abs(picture() - before).max() > 0.01
    root.lodgs.antialias = False
    assert scenes.read_levels(root).meta == {}
    assert not any(antialias for _, antialias in flags())


def moved_by(bpy, offset):
    """A node group as artists make them: it moves all points."""
    group = bpy.data.node_groups.new("move", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    source, move, end = (
        group.nodes.new(k) for k in ("NodeGroupInput", "GeometryNodeSetPosition", "NodeGroupOutput")
    )
    group.links.new(source.outputs[0], move.inputs["Geometry"])
    group.links.new(move.outputs[0], end.inputs[0])
    move.inputs["Offset"].default_value = offset
    return group


@pytest.fixture
def fading(bpy, lodgs, camera, truth):
    """The root of two Octree levels that fade among the splats, and the trainer's picture of them with the
    weights that the rule gives."""
    from training.lod.rules.octree import faded, wanted_at

    scenes, bundle = lodgs("data.scenes"), lodgs("training.splats.bundle")
    levels = [make_splats(lodgs, 1500, 1, seed) for seed in range(2)]
    with scenes.new_scene(bpy.context, "scene") as root:
        for number, splats in enumerate(levels, 1):
            scenes.set_level(root, bundle.Level(number, splats))
        facts = {"d_max": 6.0, "d_max_focal": 500.0}
        scenes.set_bundle_facts(root, bundle.Bundle("", [], "octree", facts, cumulative=True))
    root.lodgs.mode = "SELECTIVE"
    bpy.context.view_layer.update()
    farthest = 6.0 * root.lodgs.focal_px / 500.0
    eye = np.array(bpy.context.scene.camera.location)

    def weights(means):
        distances = np.linalg.norm(means - eye, axis=1)
        wanted = wanted_at(distances, 0.0, farthest, 2)
        return faded(wanted, np.repeat([1, 2], 1500))

    return root, truth([(splats, np.eye(4)) for splats in levels], keep=weights)


def test_weights_are_factors_on_opacities(add, picture, fading):
    """Octree levels as they fade, against the rasterizer with the weights that the rule gives."""
    _, expected = fading
    assert psnr(displayed(picture()), expected) > 45


@pytest.mark.parametrize("first", [False, True])
def test_levels_fade_among_artists_own_modifiers_too(bpy, picture, fading, first):
    root, expected = fading
    for item in root.lodgs.levels:
        obj = item.object
        obj.modifiers.new("move", "NODES").node_group = moved_by(bpy, (0, 0, 0))
        if first:
            obj.modifiers.move(len(obj.modifiers) - 1, 0)
    bpy.context.view_layer.update()
    assert psnr(displayed(picture()), expected) > 45


def _plane(color, corners):
    """Draws a mesh of two triangles, with depth."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    def draw(matrix):
        shader = gpu.shader.from_builtin("UNIFORM_COLOR")
        batch = batch_for_shader(shader, "TRIS", {"pos": corners}, indices=[(0, 1, 2), (0, 2, 3)])
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.depth_mask_set(True)
        with gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
            gpu.matrix.load_identity()
            gpu.matrix.load_projection_matrix(matrix)
            shader.bind()
            shader.uniform_float("color", color)
            batch.draw(shader)

    return draw


def test_a_mesh_half_in_front_hides_to_a_pixel(bpy, lodgs, add, picture, camera):
    """Its slanted edge, from the projection by hand: left of it the mesh, right of it all splats."""
    add(make_splats(lodgs, degree=0))
    inverse = np.array(camera.matrix_world, float)
    # in the camera's space, nearer than every splat; the edge goes from (0, -1) to (0.3, 1) at depth 1.5
    corners = np.array([(-3, -3), (-0.15, -3), (0.15, 3), (-3, 3)], float)
    corners = np.c_[corners, np.full(4, -1.2), np.ones(4)] @ inverse.T
    bare = picture()
    seen = picture(before=_plane((0, 0, 1, 1), [tuple(corner) for corner in corners[:, :3]]))
    projection = np.array(
        camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=SIZE, y=SIZE), float
    )
    edge = np.array([(-0.15, -3, -1.2, 1), (0.15, 3, -1.2, 1)]) @ projection.T
    edge = (edge[:, :2] / edge[:, 3:] * (1, -1) + 1) * SIZE / 2
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    at = edge[0, 0] + (y - edge[0, 1]) / (edge[1, 1] - edge[0, 1]) * (edge[1, 0] - edge[0, 0])
    hidden, open_ = x < at - 1, x > at + 1
    assert hidden.mean() > 0.3 and open_.mean() > 0.3
    assert (seen[hidden] == (0, 0, 1, 1)).all()
    assert np.array_equal(seen[open_], bare[open_])
    assert not np.array_equal(seen[hidden], bare[hidden])


def test_splats_before_a_mesh_hide_it_and_those_behind_are_hidden(bpy, lodgs, add, picture, truth, camera):
    splats = make_splats(lodgs, degree=0)
    add(splats)
    matrix = np.array(camera.matrix_world, float)
    depth = -np.linalg.norm(camera.location)  # across the middle of the splats
    corners = np.array([(-9, -9), (9, -9), (9, 9), (-9, 9)], float)
    corners = np.c_[corners, np.full(4, depth), np.ones(4)] @ matrix.T
    seen = displayed(picture(before=_plane((0, 0, 0, 0), [tuple(corner) for corner in corners[:, :3]])))

    def before(means):
        return (np.c_[means, np.ones(len(means))] @ np.linalg.inv(matrix).T)[:, 2] > depth

    assert 0.3 < before(splats.means).mean() < 0.7
    assert psnr(seen, truth([(splats, np.eye(4))], keep=before)) > 45


def test_overlays_stay_on_top_and_the_background_does_not(bpy, lodgs, add, picture, frame):
    """In a buffer like Blender's: a background of alpha 0, and over it bars that cover it or half of it."""
    import gpu

    add(make_splats(lodgs, degree=0))
    ground, line = np.array([0.2, 0.2, 0.2]), np.array([1.0, 0.5, 0.0])
    cover = np.zeros((SIZE, SIZE))
    cover[:, 100:102], cover[:, 260:264], cover[300:302] = 1.0, 0.5, 0.25
    before = np.zeros((SIZE, SIZE, 4), np.float32)
    before[..., :3] = cover[..., None] * line + (1 - cover[..., None]) * ground
    before[..., 3] = cover

    seen = picture(under_overlays=True, coded=before[::-1])
    plain = picture()
    alpha = plain[..., 3:]
    scene = plain[..., :3] + (1 - alpha) * ground
    expected = cover[..., None] * line + (1 - cover[..., None]) * scene
    assert alpha.max() > 0.99 and alpha.min() == 0
    assert np.abs(seen[..., :3] - expected).max() < 0.02
    assert np.abs(seen[cover == 1] - before[cover == 1]).max() < 0.01
    assert gpu.state.blend_get() == "NONE"


def test_over_white_and_black_the_picture_is_that_of_display_space(bpy, lodgs, add, picture):
    """One grey splat of opacity 1/2, in its middle: d = s + (1 - a) b, as displayed."""
    grey = make_splats(lodgs, 1)
    grey.means[:] = 0
    grey.log_scales[:] = 0
    grey.opacity_logits[:] = 0
    grey.sh[:] = (0.6 - 0.5) / 0.28209479177387814
    add(grey)
    seen = picture()
    y, x = np.unravel_index(seen[..., 3].argmax(), (SIZE, SIZE))
    color, alpha = seen[y, x, 0], seen[y, x, 3]
    assert color ** (1 / 2.2) == pytest.approx(0.3, abs=2e-3)
    assert (color + (1 - alpha)) ** (1 / 2.2) == pytest.approx(0.3 + 0.5, abs=2e-3)


def test_only_changed_splats_are_uploaded_again(bpy, lodgs, camera, picture, frame):
    """Not for time, views, selection by distance, levels seen before or moved objects."""
    scenes, bundle, views = lodgs("data.scenes"), lodgs("training.splats.bundle"), lodgs("viewport.views")
    scene = bpy.context.scene
    with scenes.new_scene(bpy.context, "scene") as root:
        for number, s_min in ((1, 0.003), (2, 0.0)):
            scenes.set_level(root, bundle.Level(number, make_splats(lodgs, 500, 3, number), {"s_min": s_min}))
        scenes.set_bundle_facts(root, bundle.Bundle("flod", [], "bands"))
    root.lodgs.mode = "SELECTIVE"
    root.lodgs.bands.gamma = 0.45  # the border lies among the splats
    for number, x in ((1, 2.0), (20, 4.0)):
        camera.location.x = x
        camera.keyframe_insert("location", frame=number)
    scene.frame_set(1)
    view = views.ViewState()
    counts = set()

    def drawn():
        seen = picture(view=view)
        counts.add(view.arrangement.count)
        return seen

    first = drawn()
    reads = views.reads
    pictures = [first]
    for number in (5, 10, 20):
        scene.frame_set(number)
        pictures.append(drawn())
    assert len(counts) > 2, "the selection follows the camera"
    root.location.z = 0.3
    bpy.context.view_layer.update()
    pictures.append(drawn())
    assert all(not np.array_equal(a, b) for a, b in pairwise(pictures))
    root.lodgs.mode = "SINGLE"
    for number in (1, 2, 1, 2):
        root.lodgs.single_level = number
        bpy.context.view_layer.update()
        drawn()
    assert views.reads == reads
    cloud = root.lodgs.levels[1].object.data
    cloud.attributes["position"].data.foreach_set("vector", np.zeros(1500, np.float32))
    cloud.update_tag()
    bpy.context.view_layer.update()
    last = pictures[-1]
    assert not np.array_equal(drawn(), last) and views.reads == reads + 1


def test_artists_own_modifiers_are_drawn(bpy, lodgs, add, picture):
    """What geometry nodes make of splats is uploaded, and again when they make something else of them."""
    views, view = lodgs("viewport.views"), lodgs("viewport.views").ViewState()
    obj = add(make_splats(lodgs, 500))
    before = picture(view=view)
    obj.modifiers.new("move", "NODES").node_group = moved_by(bpy, (0, 0, 0.5))
    bpy.context.view_layer.update()
    reads = views.reads
    after = picture(view=view)
    assert views.reads == reads + 1
    obj.modifiers.remove(obj.modifiers["move"])
    obj.location.z = 0.5
    bpy.context.view_layer.update()
    assert np.abs(after - picture(view=view)).max() < 0.02
    assert np.abs(after - before).max() > 0.2


def test_the_order_is_only_found_anew_when_the_view_turns(bpy, lodgs, add, picture, camera):
    add(make_splats(lodgs, 500))
    view = lodgs("viewport.views").ViewState()
    picture(view=view)
    first = view.arrangement
    camera.location.x += 0.5
    bpy.context.view_layer.update()
    picture(view=view)
    assert view.arrangement is first
    camera.rotation_euler.z += 0.1
    bpy.context.view_layer.update()
    picture(view=view)
    assert view.arrangement is not first


def test_drawing_does_not_wait_for_the_order(bpy, lodgs, add, picture, camera, monkeypatch):
    """With a thread that takes its time, the last order is drawn at once."""
    import threading

    views = lodgs("viewport.views")
    add(make_splats(lodgs, 500))
    view, go, arrange = views.ViewState(), threading.Event(), views.arrange
    first = picture(view=view)
    monkeypatch.setattr(views, "arrange", lambda *a: go.wait(20) and arrange(*a))
    camera.rotation_euler.z += 0.02
    bpy.context.view_layer.update()
    second = picture(view=view, wait=False)
    assert view.pending is not None and second[..., 3].max() > 0.9
    assert not np.array_equal(first, second), "the view itself is the new one"
    go.set()
    picture(view=view)
    assert view.pending is None


def test_points_are_hidden_in_viewports_and_there_in_renders(bpy, lodgs, add):
    obj = add(make_splats(lodgs, 50))
    scene = bpy.context.scene

    def radii():
        bpy.context.view_layer.update()
        cloud = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        return lodgs("attributes").read_attribute(cloud, "radius")

    assert (radii() == 0).all()
    assert not obj.modifiers["LODGS Display"].show_render
    scene.lodgs_viewport.splats = False
    assert (radii() > 0).all()
