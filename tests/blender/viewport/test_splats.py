"""Splats in 3D viewports, drawn offscreen and compared with the trainer's rasterizer or analytic values."""

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
    """Create the scene camera, which looks at the origin from an oblique direction."""
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
    """``add(splats, matrix)``: add an object with splats to the scene."""

    def add_object(splats, matrix=None):
        obj = lodgs("data.objects").new_splats("splats", splats)
        bpy.context.scene.collection.objects.link(obj)
        if matrix is not None:
            obj.matrix_world = matrix
        bpy.context.view_layer.update()
        return obj

    return add_object


@pytest.fixture
def draw_view(bpy, lodgs, frame, camera):
    """``draw_view(**options)``: linear image (SIZE, SIZE, 4) of all splats from the camera, top row first.

    ``draw_first`` draws into the framebuffer before; ``view`` is a viewport's state; ``coded`` is the initial
    content of an sRGB framebuffer; ``zoom`` is the size of the camera frame relative to the viewport.
    """
    from mathutils import Matrix

    views, splats = lodgs("viewport.views"), lodgs("viewport.splats")
    views.clear()

    def draw_splats(
        draw_first=None, view=None, budget=10**6, under_overlays=False, wait=True, coded=None, zoom=None
    ):
        depsgraph = bpy.context.evaluated_depsgraph_get()
        matrix = camera.matrix_world.inverted()
        projection = camera.calc_matrix_camera(depsgraph, x=SIZE, y=SIZE)
        instances, options = lodgs("data.shown").splat_instances(depsgraph), {}
        if zoom is not None:
            projection = Matrix.Diagonal((zoom, zoom, 1, 1)) @ projection
            options["frame"] = lodgs("viewport.view_camera").camera_frame(
                camera, bpy.context.scene, projection
            )

        def draw():
            if draw_first is not None:
                draw_first(projection @ matrix)
            target = splats.DrawTarget(matrix, projection, under_overlays, **options)
            views.draw_splats(view or views.ViewState(), instances, depsgraph, target, budget, wait=wait)

        return frame(SIZE, draw, coded)[::-1]

    yield draw_splats
    views.clear()


def displayed(linear):
    """Return displayed colours of the overlay buffer over black."""
    return np.clip(linear[..., :3], 0, 1) ** (1 / 2.2)


def psnr(image, reference):
    return -10 * np.log10(np.mean((np.clip(image, 0, 1) - np.clip(reference, 0, 1)) ** 2, dtype=np.float64))


@pytest.fixture(scope="module")
def rasterizer():
    """Start the trainer's rasterizer, which takes seconds: a process that the tests share."""
    python = os.environ.get("LODGS_TRAINER_PYTHON")
    if not python:
        pytest.skip("no trainer; set LODGS_TRAINER_PYTHON")
    program = Path(__file__).parents[1] / "render_splats.py"
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"LODGS_THREADS": "1"}
    with subprocess.Popen(
        [python, program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        yield process


@pytest.fixture
def truth(bpy, camera, rasterizer, tmp_path):
    """``truth([(splats, matrix), ...])``: the trainer's image (SIZE, SIZE, 3) of splats in the world.

    ``antialias`` has a flag for each set; ``size`` is the image size in pixels.
    """

    def render(sets, keep=None, antialias=(), size=SIZE):
        projection = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=size, y=size)
        flip = np.diag([1.0, -1.0, -1.0, 1.0])
        world_to_camera = flip @ np.linalg.inv(np.array(camera.matrix_world, float))
        parts = [_to_world(splats, np.array(matrix, float), world_to_camera) for splats, matrix in sets]
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
        rasterizer.stdin.write(f"{tmp_path / 'in.npz'}\t{tmp_path / 'out.npy'}\n")
        rasterizer.stdin.flush()
        assert rasterizer.stdout.readline() == "done\n"
        return np.load(tmp_path / "out.npy")

    return render


def _to_world(splats, matrix, world_to_camera):
    """Return an object's splats in Blender's world in float64, with their colours from the camera.

    General transforms change the covariance to M Σ Mᵀ, which has other principal axes.
    """
    linear, count = matrix[:3, :3], len(splats)
    quats = splats.quats.astype(float)
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rotations = np.moveaxis(
        np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]), 2, 0,
    )  # fmt: skip
    half = linear @ rotations * np.exp(splats.log_scales.astype(float))[:, None, :]
    axes, deviations, _ = np.linalg.svd(half)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    position = np.linalg.inv(world_to_camera)[:3, 3]
    local = splats.means - (np.linalg.inv(matrix) @ np.append(position, 1))[:3]
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
def test_single_set_matches_the_rasterizer(bpy, lodgs, add, draw_view, truth, degree):
    splats = make_splats(lodgs, degree=degree)
    add(splats)
    image, expected = displayed(draw_view()), truth([(splats, np.eye(4))])
    assert expected.std() > 0.1
    assert psnr(image, expected) > 45


def test_splats_of_several_textures_match_the_rasterizer(lodgs, add, draw_view, truth, monkeypatch):
    splats = make_splats(lodgs, degree=3)
    monkeypatch.setattr(lodgs("viewport.resident"), "TEXTURE_BYTES", 16 * 17 * 1100)
    add(splats)
    view = lodgs("viewport.views").ViewState()
    image, expected = displayed(draw_view(view=view)), truth([(splats, np.eye(4))])
    assert len(view.store.textures) == 3
    assert psnr(image, expected) > 45


@pytest.mark.parametrize("degree", [0, 4])
def test_overlapping_transformed_sets_match_the_rasterizer(bpy, lodgs, add, draw_view, truth, degree):
    from mathutils import Euler, Matrix

    sets = []
    for seed, rotation, scale, location in (
        (1, (0.4, -1.0, 2.0), (0.8, 0.8, 0.8), (0.3, 0.2, 0)),
        (2, (-2.0, 0.3, 0.9), (0.5, 1.2, 0.9), (-0.4, 0.1, 0.3)),
    ):
        matrix = Matrix.LocRotScale(location, Euler(rotation), scale)
        splats = make_splats(lodgs, 2000, degree, seed)
        add(splats, matrix)
        sets.append((splats, matrix))

    assert psnr(displayed(draw_view()), truth(sets)) > 45


@pytest.mark.parametrize("zoom", [0.5, 1.5])
def test_splats_outside_the_camera_frame_are_drawn_as_in_a_render(lodgs, add, draw_view, truth, zoom):
    """A viewport in camera view is larger or smaller than the camera frame."""
    from mathutils import Matrix

    splats, matrix = make_splats(lodgs, size=-1.5), Matrix.Diagonal((3, 3, 3, 1))
    add(splats, matrix)
    size = round(SIZE * zoom)
    expected = truth([(splats, matrix)], size=size)
    common = min(size, SIZE)
    image, expected = (_crop_center(image, common) for image in (displayed(draw_view(zoom=zoom)), expected))
    assert psnr(image, expected) > 45


def test_camera_frame_needs_no_world_matrix(bpy, lodgs, camera):
    """Blender does not update ``matrix_world`` of hidden cameras after an undo."""
    projection = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=SIZE, y=SIZE)
    frame = lodgs("viewport.view_camera").camera_frame(camera, bpy.context.scene, projection)
    assert frame == pytest.approx((-1, -1, 1, 1), abs=1e-5)


def _crop_center(image, size):
    border = (len(image) - size) // 2
    return image[border : border + size, border : border + size]


def test_antialiased_and_other_sets_match_the_rasterizer(bpy, lodgs, draw_view, truth):
    """Each of two overlapping scenes with subpixel splats has its own filter."""
    scenes, bundle = lodgs("data.scenes"), lodgs("training.splats.bundle")
    sets = [(make_splats(lodgs, 6000, 1, seed, size=-5.5), np.eye(4)) for seed in range(2)]
    for (splats, _), meta in zip(sets, ({"antialias": True}, {}), strict=True):
        with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
            scenes.set_level(root, bundle.Level(1, splats))
            scenes.set_bundle_facts(root, bundle.Bundle("", [], meta=meta))
    bpy.context.view_layer.update()
    expected = truth(sets, antialias=[True, False])
    assert psnr(expected, truth(sets)) < 35
    assert psnr(displayed(draw_view()), expected) > 45


def test_copies_and_instances_are_antialiased(bpy, lodgs, draw_view, instance_of):
    """All copies of a scene's splats follow its antialiasing setting."""
    scenes, bundle = lodgs("data.scenes"), lodgs("training.splats.bundle")
    with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
        level = scenes.set_level(root, bundle.Level(1, make_splats(lodgs, 20)))
        scenes.set_bundle_facts(root, bundle.Bundle("", []))
    copy = level.copy()
    root.users_collection[0].objects.link(copy)
    instance_of(root.users_collection[0], (3, 0, 0))
    standalone = bpy.data.objects.new("standalone", level.data)
    bpy.context.scene.collection.objects.link(standalone)
    shown = lodgs("data.shown")

    def flags():
        bpy.context.view_layer.update()
        instances = shown.splat_instances(bpy.context.evaluated_depsgraph_get())
        assert len(instances) == 5
        return sorted((instance.object.name, instance.antialias) for instance in instances)

    assert not any(antialias for _, antialias in flags())
    before = draw_view()
    root.lodgs.antialias = True
    assert scenes.read_levels(root).meta == {"antialias": True}
    assert [name for name, antialias in flags() if not antialias] == ["standalone"]
    assert np.abs(draw_view() - before).max() > 0.01
    root.lodgs.antialias = False
    assert scenes.read_levels(root).meta == {}
    assert not any(antialias for _, antialias in flags())


def make_move_group(bpy, offset):
    """Create an artist's node group that moves all points."""
    group = bpy.data.node_groups.new("move", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    source, move, end = (
        group.nodes.new(k) for k in ("NodeGroupInput", "GeometryNodeSetPosition", "NodeGroupOutput")
    )
    group.links.new(source.outputs[0], move.inputs["Geometry"])
    group.links.new(move.outputs[0], end.inputs[0])
    move.inputs["Offset"].default_value = offset
    return group


@pytest.fixture
def fading(bpy, lodgs, camera, truth):
    """Create a root with two fading Octree levels, and the trainer's image with the weights of the rule."""
    from training.lod.rules.octree import fade_weights, target_level

    scenes, bundle = lodgs("data.scenes"), lodgs("training.splats.bundle")
    levels = [make_splats(lodgs, 1500, 1, seed) for seed in range(2)]
    with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
        for number, splats in enumerate(levels, 1):
            scenes.set_level(root, bundle.Level(number, splats))
        facts = {"d_max": 6.0, "d_max_focal": 500.0}
        scenes.set_bundle_facts(root, bundle.Bundle("", [], "octree", facts, cumulative=True))
    root.lodgs.mode = "SELECTIVE"
    bpy.context.view_layer.update()
    d_max = 6.0 * root.lodgs.focal_px / 500.0
    position = np.array(bpy.context.scene.camera.location)

    def weights(means):
        distances = np.linalg.norm(means - position, axis=1)
        levels_at = target_level(distances, 0.0, d_max, 2)
        return fade_weights(levels_at, np.repeat([1, 2], 1500))

    return root, truth([(splats, np.eye(4)) for splats in levels], keep=weights)


def test_weights_scale_opacities(add, draw_view, fading):
    """Fading Octree levels match the rasterizer with the weights of the rule."""
    _, expected = fading
    assert psnr(displayed(draw_view()), expected) > 45


@pytest.mark.parametrize("first", [False, True])
def test_levels_fade_with_modifiers_of_artists(bpy, draw_view, fading, first):
    root, expected = fading
    for item in root.lodgs.levels:
        obj = item.object
        obj.modifiers.new("move", "NODES").node_group = make_move_group(bpy, (0, 0, 0))
        if first:
            obj.modifiers.move(len(obj.modifiers) - 1, 0)
    bpy.context.view_layer.update()
    assert psnr(displayed(draw_view()), expected) > 45


def _plane(color, corners):
    """Return a function that draws two triangles with depth."""
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


@pytest.mark.parametrize(("resolution", "border"), [(1.0, 1), (0.5, 4)])
def test_mesh_occludes_with_pixel_accuracy(bpy, lodgs, add, draw_view, camera, resolution, border):
    """Left of a projected oblique edge the mesh is visible, right of it all splats."""
    add(make_splats(lodgs, degree=0))
    view = lodgs("viewport.views").ViewState(resolution=resolution)
    inverse = np.array(camera.matrix_world, float)
    # in camera space, in front of all splats
    corners = np.array([(-3, -3), (-0.15, -3), (0.15, 3), (-3, 3)], float)
    corners = np.c_[corners, np.full(4, -1.2), np.ones(4)] @ inverse.T
    no_mesh = draw_view(view=view)
    mesh = _plane((0, 0, 1, 1), [tuple(corner) for corner in corners[:, :3]])
    image = draw_view(view=view, draw_first=mesh)
    projection = np.array(
        camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=SIZE, y=SIZE), float
    )
    edge = np.array([(-0.15, -3, -1.2, 1), (0.15, 3, -1.2, 1)]) @ projection.T
    edge = (edge[:, :2] / edge[:, 3:] * (1, -1) + 1) * SIZE / 2
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    edge_x = edge[0, 0] + (y - edge[0, 1]) / (edge[1, 1] - edge[0, 1]) * (edge[1, 0] - edge[0, 0])
    occluded, visible = x < edge_x - border, x > edge_x + border
    assert occluded.mean() > 0.3 and visible.mean() > 0.3
    assert (image[occluded] == (0, 0, 1, 1)).all()
    assert np.array_equal(image[visible], no_mesh[visible])
    assert not np.array_equal(image[occluded], no_mesh[occluded])


def test_lines_do_not_hide_pixels_of_a_lower_resolution(bpy, lodgs, add, draw_view, camera):
    """A line in front of all splats is one pixel wide, as those of Blender's grid."""
    add(make_splats(lodgs, degree=0))
    view = lodgs("viewport.views").ViewState()
    depth = 1.2
    half_width = (
        depth / camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=SIZE, y=SIZE)[0][0]
    )
    column = SIZE // 2 + 1
    left, right = (2 * np.array([column, column + 1]) / SIZE - 1) * half_width
    corners = np.array([(left, -3), (right, -3), (right, 3), (left, 3)], float)
    corners = np.c_[corners, np.full(4, -depth), np.ones(4)] @ np.array(camera.matrix_world, float).T
    line = _plane((0, 0, 1, 1), [tuple(corner) for corner in corners[:, :3]])
    resting = draw_view(view=view, draw_first=line)
    (column,) = np.unique(np.nonzero((resting == (0, 0, 1, 1)).all(axis=2))[1])
    assert column % 2 == 1  # the middle of a pixel of half the resolution is there
    view.resolution = 0.5
    moving, without_line = (draw_view(view=view, draw_first=first) for first in (line, None))
    opaque = without_line[:, column, 3] > 0.9
    assert opaque.mean() > 0.1
    assert np.abs(moving - without_line)[opaque, column].max() < 0.1


def test_splats_of_a_lower_resolution_end_sooner(lodgs, add, draw_view):
    """At r standard deviations, the opacity is 0.9 exp(-r^2 / 2), and in motion 0.9 (1 - r^2 / 6)^2."""
    grey = make_splats(lodgs, 1)
    grey.means[:], grey.log_scales[:], grey.opacity_logits[:] = 0, -1, np.log(9)
    grey.sh[:] = (0.6 - 0.5) / 0.28209479177387814
    add(grey)
    view = lodgs("viewport.views").ViewState()
    resting = displayed(draw_view(view=view))[..., 0] / 0.6
    assert view.canvas.size == (SIZE, SIZE)
    view.resolution = 0.5
    moving = displayed(draw_view(view=view))[..., 0] / 0.6
    assert view.canvas.size == (SIZE // 2, SIZE // 2)
    squared = -2 * np.log(np.maximum(resting, 0.02) / 0.9)
    inside = resting > 0.02
    assert inside.mean() > 0.05
    assert np.abs(moving - 0.9 * np.maximum(1 - squared / 6, 0) ** 2)[inside].max() < 0.01
    assert (moving[~inside] == 0).all() and (resting[~inside] > 0).any()


@pytest.mark.parametrize("antialias", [False, True])
def test_a_lower_resolution_keeps_the_brightness(bpy, lodgs, draw_view, antialias):
    """Splats smaller than a pixel cover as much as at rest, or the image changes when a motion ends."""
    scenes, bundle = lodgs("data.scenes"), lodgs("training.splats.bundle")
    with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
        scenes.set_level(root, bundle.Level(1, make_splats(lodgs, size=-6.5)))
        scenes.set_bundle_facts(root, bundle.Bundle("", [], meta={"antialias": antialias}))
    bpy.context.view_layer.update()
    view = lodgs("viewport.views").ViewState()
    resting = draw_view(view=view)[..., 3].mean()
    view.resolution = 0.5
    assert draw_view(view=view)[..., 3].mean() == pytest.approx(resting, rel=0.1)


def test_mesh_hides_splats_behind_it(bpy, lodgs, add, draw_view, truth, camera):
    splats = make_splats(lodgs, degree=0)
    add(splats)
    matrix = np.array(camera.matrix_world, float)
    depth = -np.linalg.norm(camera.location)  # through the centre of the splats
    corners = np.array([(-9, -9), (9, -9), (9, 9), (-9, 9)], float)
    corners = np.c_[corners, np.full(4, depth), np.ones(4)] @ matrix.T
    image = displayed(
        draw_view(draw_first=_plane((0, 0, 0, 0), [tuple(corner) for corner in corners[:, :3]]))
    )

    def is_in_front(means):
        return (np.c_[means, np.ones(len(means))] @ np.linalg.inv(matrix).T)[:, 2] > depth

    assert 0.3 < is_in_front(splats.means).mean() < 0.7
    assert psnr(image, truth([(splats, np.eye(4))], keep=is_in_front)) > 45


def test_overlays_stay_on_top_of_splats(bpy, lodgs, add, draw_view, frame):
    """The buffer is like Blender's: a background with alpha 0 below bars of several opacities."""
    import gpu

    add(make_splats(lodgs, degree=0))
    background, line = np.array([0.2, 0.2, 0.2]), np.array([1.0, 0.5, 0.0])
    cover = np.zeros((SIZE, SIZE))
    cover[:, 100:102], cover[:, 260:264], cover[300:302] = 1.0, 0.5, 0.25
    buffer = np.zeros((SIZE, SIZE, 4), np.float32)
    buffer[..., :3] = cover[..., None] * line + (1 - cover[..., None]) * background
    buffer[..., 3] = cover

    image = draw_view(under_overlays=True, coded=buffer[::-1])
    splats_only = draw_view()
    alpha = splats_only[..., 3:]
    scene = splats_only[..., :3] + (1 - alpha) * background
    expected = cover[..., None] * line + (1 - cover[..., None]) * scene
    assert alpha.max() > 0.99 and alpha.min() == 0
    assert np.abs(image[..., :3] - expected).max() < 0.02
    assert np.abs(image[cover == 1] - buffer[cover == 1]).max() < 0.01
    assert gpu.state.blend_get() == "NONE"


def test_compositing_over_white_and_black_matches_display_space(bpy, lodgs, add, draw_view):
    """The centre of a grey splat with opacity 1/2 displays d = s + (1 - a) b."""
    grey = make_splats(lodgs, 1)
    grey.means[:] = 0
    grey.log_scales[:] = 0
    grey.opacity_logits[:] = 0
    grey.sh[:] = (0.6 - 0.5) / 0.28209479177387814
    add(grey)
    image = draw_view()
    y, x = np.unravel_index(image[..., 3].argmax(), (SIZE, SIZE))
    color, alpha = image[y, x, 0], image[y, x, 3]
    assert color ** (1 / 2.2) == pytest.approx(0.3, abs=2e-3)
    assert (color + (1 - alpha)) ** (1 / 2.2) == pytest.approx(0.3 + 0.5, abs=2e-3)


def test_only_changed_splats_are_read_again(bpy, lodgs, camera, draw_view, frame):
    """Time, views, selection by distance, displayed levels and object motion do not repeat reads."""
    sources = lodgs("viewport.sources")
    scenes, bundle, views = lodgs("data.scenes"), lodgs("training.splats.bundle"), lodgs("viewport.views")
    scene = bpy.context.scene
    with lodgs("data.importing").new_scene(bpy.context, "scene") as root:
        for number, s_min in ((1, 0.003), (2, 0.0)):
            scenes.set_level(root, bundle.Level(number, make_splats(lodgs, 500, 3, number), {"s_min": s_min}))
        scenes.set_bundle_facts(root, bundle.Bundle("flod", [], "bands"))
    root.lodgs.mode = "SELECTIVE"
    root.lodgs.bands.gamma = 0.45  # puts the border between the splats
    for number, x in ((1, 2.0), (20, 4.0)):
        camera.location.x = x
        camera.keyframe_insert("location", frame=number)
    scene.frame_set(1)
    view = views.ViewState()
    counts = set()

    def draw():
        image = draw_view(view=view)
        counts.add(view.arrangement.count)
        return image

    first = draw()
    reads = sources.reads
    images = [first]
    for number in (5, 10, 20):
        scene.frame_set(number)
        images.append(draw())
    assert len(counts) > 2, "the selection follows the camera"
    root.location.z = 0.3
    bpy.context.view_layer.update()
    images.append(draw())
    assert all(not np.array_equal(a, b) for a, b in pairwise(images))
    root.lodgs.mode = "SINGLE"
    for number in (1, 2, 1, 2):
        root.lodgs.single_level = number
        bpy.context.view_layer.update()
        draw()
    assert sources.reads == reads
    cloud = root.lodgs.levels[1].object.data
    cloud.attributes["position"].data.foreach_set("vector", np.zeros(1500, np.float32))
    cloud.update_tag()
    bpy.context.view_layer.update()
    last = images[-1]
    assert not np.array_equal(draw(), last) and sources.reads == reads + 1


def test_modifiers_of_artists_are_drawn(bpy, lodgs, add, draw_view):
    """Splats are read again after a change of their geometry nodes."""
    sources, view = lodgs("viewport.sources"), lodgs("viewport.views").ViewState()
    obj = add(make_splats(lodgs, 500))
    before = draw_view(view=view)
    obj.modifiers.new("move", "NODES").node_group = make_move_group(bpy, (0, 0, 0.5))
    bpy.context.view_layer.update()
    reads = sources.reads
    after = draw_view(view=view)
    assert sources.reads == reads + 1
    obj.modifiers.remove(obj.modifiers["move"])
    obj.location.z = 0.5
    bpy.context.view_layer.update()
    assert np.abs(after - draw_view(view=view)).max() < 0.02
    assert np.abs(after - before).max() > 0.2


def test_only_rotation_sorts_again(bpy, lodgs, add, draw_view, camera):
    add(make_splats(lodgs, 500))
    view = lodgs("viewport.views").ViewState()
    draw_view(view=view)
    first = view.arrangement
    camera.location.x += 0.5
    bpy.context.view_layer.update()
    draw_view(view=view)
    assert view.arrangement is first
    camera.rotation_euler.z += 0.1
    bpy.context.view_layer.update()
    draw_view(view=view)
    assert view.arrangement is not first


def test_moving_views_draw_enlarged_splats_and_resting_views_all(lodgs, add, draw_view, monkeypatch):
    """A tenth of the splats of a dense ball looks like all of them; without enlarging, it has holes."""
    state, rng = lodgs("viewport.view_state"), np.random.default_rng(5)
    resident = lodgs("viewport.resident")
    splats = make_splats(lodgs, count=40_000, size=-4.8)
    splats.means /= np.linalg.norm(splats.means, axis=1, keepdims=True)
    splats.opacity_logits[:] = 3.0
    splats.sh[:, 0] = 1.2 * splats.means + rng.normal(0, 0.1, splats.means.shape)
    monkeypatch.setattr(state, "MIN_MOTION", 100)
    add(splats)
    view = state.ViewState()
    complete = draw_view(view=view)
    view.cost = 40_000, 10 * state.MOTION
    draw_view(view=view, wait=False)
    view.pending[2].result()
    resting = draw_view(view=view, wait=False)
    assert np.array_equal(resting, complete) and view.count == 40_000
    view.moving = True
    moving = draw_view(view=view, wait=False)
    assert view.count == pytest.approx(4000, rel=0.1)
    similar = psnr(displayed(moving), displayed(complete))
    view.pending[2].result()
    uploaded, drawn = resident.bytes_uploaded, view.arrangement
    assert np.array_equal(draw_view(view=view, wait=False), moving)
    assert view.arrangement is not drawn and view.arrangement.instances is view.arrangement.motion
    assert view.arrangement.splats is drawn.splats and resident.bytes_uploaded == uploaded
    view.arrangement.motion[:, 2] = 0.0
    view.list_instances()
    holes = psnr(displayed(draw_view(view=view, wait=False)), displayed(complete))
    assert similar > 22 and similar > holes + 3, (similar, holes)
    view.moving = False
    draw_view(view=view, wait=False)
    assert not view.is_cost_outdated(), "a few splats say nothing about the resting view"
    view.pending[2].result()
    assert np.array_equal(draw_view(view=view, wait=False), complete)


def test_drawing_does_not_wait_for_sorting(bpy, lodgs, add, draw_view, camera, monkeypatch):
    """While the worker thread is slow, splats are drawn in the previous order."""
    import threading

    views = lodgs("viewport.views")
    add(make_splats(lodgs, 500))
    view, resume, arrange = views.ViewState(), threading.Event(), views.arrange
    first = draw_view(view=view)
    monkeypatch.setattr(views, "arrange", lambda *a: resume.wait(20) and arrange(*a))
    camera.rotation_euler.z += 0.02
    bpy.context.view_layer.update()
    second = draw_view(view=view, wait=False)
    assert view.pending is not None and second[..., 3].max() > 0.9
    assert not np.array_equal(first, second), "the image shows the new view"
    resume.set()
    draw_view(view=view)
    assert view.pending is None


def test_points_are_hidden_in_viewports_only(bpy, lodgs, add):
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
