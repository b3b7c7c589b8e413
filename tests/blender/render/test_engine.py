"""Renders with the engine LODGS and the real renderer: pixels, passes, animations and errors."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level

ROOT = Path(__file__).resolve().parents[3]
TRAINER = os.environ.get("LODGS_TRAINER_PYTHON", "")
COMMANDS = """
import json, sys
from training.__main__ import main
for line in sys.stdin:
    print("exit code", main(json.loads(line)), flush=True)
"""
"""Program that runs commands of the trainer, one per line."""
NOTHING = 1e10
"""Depth of pixels without splats."""


pytestmark = pytest.mark.usefixtures("renderer")


def random_splats(count: int, degree: int = 3, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.uniform(-0.7, 0.7, (count, 3)).astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        log_scales=rng.normal(-3, 0.6, (count, 3)).astype(np.float32),
        opacity_logits=rng.normal(1, 1.5, count).astype(np.float32),
        sh=(rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3).astype(np.float32),
    )


@pytest.fixture
def bundle(tmp_path) -> Path:
    path = tmp_path / "bundle.ply"
    levels = [
        Level(1, random_splats(150), {"s_min": 0.05}),
        Level(2, random_splats(1500, seed=1), {"s_min": 0.0}),
    ]
    write_bundle(path, Bundle("flod", levels, "bands"))
    return path


@pytest.fixture
def scene(bpy, lodgs, bundle):
    """A scene with a rotated, moved and scaled bundle and a camera, rendered by LODGS as PNG."""
    scene = bpy.context.scene
    root = lodgs("data.importing").import_splats(bpy.context, bundle, upright=False)
    root.location, root.scale = (1, 2, -0.5), (1.7,) * 3
    root.rotation_euler = (-1.2, 0.3, 0.4)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (1.3, -5.5, 0.2), (1.45, 0, 0.02)
    camera.data.shift_x = 0.03
    scene.camera = camera
    lodgs("render.engine").use(scene)
    scene.render.dither_intensity = 0
    scene.render.resolution_x, scene.render.resolution_y = 640, 480
    return scene


def render_file(bpy, tmp_path, name="render.png") -> np.ndarray:
    """Render to a file; return its values (H, W, 4), rows from the top."""
    path = tmp_path / name
    bpy.context.scene.render.filepath = str(path)
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    return read_pixels(bpy, path)


def read_pixels(bpy, path: Path) -> np.ndarray:
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    image.alpha_mode = "CHANNEL_PACKED"
    values = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(values)
    values = values.reshape(image.size[1], image.size[0], 4)[::-1]
    bpy.data.images.remove(image)
    return values


def to_bytes(values: np.ndarray) -> np.ndarray:
    return np.round(values * 255).astype(np.uint8)


@pytest.fixture(scope="module")
def render_command():
    """``render_command(bundle, camera, out, *options)``: run ``lodgs render`` with a camera file.

    The calls share a process, because it takes seconds to start.
    """
    command = [TRAINER, "-c", COMMANDS]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:

        def render(bundle: Path, camera: Path, out: Path, *options: str) -> None:
            words = ["render", str(bundle), "--camera", str(camera), "--out", str(out), *options]
            process.stdin.write(json.dumps(words) + "\n")
            process.stdin.flush()
            while not (answer := process.stdout.readline()).startswith("exit code"):
                assert answer, "the program ended"
            assert answer == "exit code 0\n"

        yield render


def render_passes(bpy, lodgs, **settings):
    """Return the passes of the current scene by name; None if the render is cancelled."""
    engine, scene = lodgs("render.engine"), bpy.context.scene
    scene.view_layers[0].use_pass_z = scene.lodgs_render.use_pass_levels = True
    width, height = engine.render_size(scene.render)
    with lodgs("nodes.display").with_all_attributes(bpy.context, scene.objects):  # as when Blender renders
        depsgraph = bpy.context.evaluated_depsgraph_get()
        drawn = engine.render_frame(
            depsgraph, width, height, engine.render_border(scene.render, width, height), **settings
        )
    return drawn and drawn.planes


@pytest.mark.parametrize("transparent", [False, True])
def test_render_matches_the_render_command_to_the_bit(
    bpy, scene, bundle, tmp_path, transparent, render_command
):
    scene.render.film_transparent = transparent
    scene.render.image_settings.color_mode = "RGBA"
    image = render_file(bpy, tmp_path)
    camera = tmp_path / "camera.json"
    assert bpy.ops.lodgs.export_camera(filepath=str(camera)) == {"FINISHED"}
    options = ["--background", "transparent"] if transparent else []
    render_command(bundle, camera, tmp_path / "trainer.png", *options)
    expected = read_pixels(bpy, tmp_path / "trainer.png")
    assert image.shape == (480, 640, 4) and to_bytes(image[..., :3]).max() > 200
    np.testing.assert_array_equal(to_bytes(image), to_bytes(expected))


def test_antialiased_render_matches_the_render_command(bpy, lodgs, scene, bundle, tmp_path, render_command):
    """The scene's setting is exported with the bundle."""
    root = lodgs("data.roots").roots(scene)[0]
    for item in root.lodgs.levels:
        for value in item.object.data.attributes["scale"].data:
            value.vector = [x / 10 for x in value.vector]
    before = render_file(bpy, tmp_path)
    root.lodgs.antialias = True
    image, camera = render_file(bpy, tmp_path), tmp_path / "camera.json"
    assert np.abs(to_bytes(before).astype(int) - to_bytes(image)).max() > 20
    bpy.ops.lodgs.export_camera(filepath=str(camera))
    bpy.context.view_layer.objects.active = root
    assert bpy.ops.lodgs.export_bundle(filepath=str(tmp_path / "small.ply")) == {"FINISHED"}
    render_command(tmp_path / "small.ply", camera, tmp_path / "trainer.png")
    difference = np.abs(to_bytes(image).astype(int) - to_bytes(read_pixels(bpy, tmp_path / "trainer.png")))
    assert difference.max() <= 1 and (difference > 0).mean() < 0.01  # scales are rounded to float32


def test_levels_by_distance_match_the_render_command(bpy, lodgs, scene, bundle, tmp_path, render_command):
    root = lodgs("data.roots").roots(scene)[0]
    root.lodgs.mode, root.lodgs.bands.gamma = "SELECTIVE", 10
    image = render_file(bpy, tmp_path)
    camera = tmp_path / "camera.json"
    bpy.ops.lodgs.export_camera(filepath=str(camera))
    render_command(bundle, camera, tmp_path / "trainer.png", "--gamma", "10", "--first", "1", "--last", "2")
    np.testing.assert_array_equal(to_bytes(image), to_bytes(read_pixels(bpy, tmp_path / "trainer.png")))
    levels = render_passes(bpy, lodgs)["Level.X"]
    assert {1, 2} <= set(np.unique(levels))  # both levels are visible


def test_imported_view_matches_the_camera_of_its_photo(bpy, lodgs, bundle, tmp_path, render_command):
    """Images from Blender's camera and from COLMAP's camera differ only by float32 rounding."""
    from training.scenes.cameras import write_camera
    from training.scenes.colmap import read_scene

    folder = ROOT / "examples" / "lantern_garden"
    scene_root = lodgs("data.importing").import_colmap(bpy.context, folder, photographs=False)
    scene_root.lodgs.points.hide_render = True
    root = lodgs("data.importing").import_splats(bpy.context, bundle, upright=False)
    bpy.context.view_layer.update()
    root.lodgs.axes.matrix_world = scene_root.lodgs.axes.matrix_world
    bpy.context.scene.render.dither_intensity = 0
    lodgs("render.engine").use(bpy.context.scene)
    image = render_file(bpy, tmp_path)
    view = next(c for c in read_scene(folder).cameras if c.name == bpy.context.scene.camera.name)
    write_camera(tmp_path / "camera.json", view, bpy.context.scene.camera.data.clip_start)
    render_command(bundle, tmp_path / "camera.json", tmp_path / "trainer.png")
    difference = np.abs(to_bytes(image).astype(int) - to_bytes(read_pixels(bpy, tmp_path / "trainer.png")))
    assert difference.max() <= 1 and (difference > 0).mean() < 0.01


def test_depth_and_level_passes_cover_the_splats(bpy, lodgs, scene):
    planes = render_passes(bpy, lodgs)
    covered = planes["Level.X"] > 0
    assert 0.1 < covered.mean() < 0.9
    depth = planes["Depth.Z"]
    assert (depth[~covered] == NOTHING).all()
    assert depth[covered].min() > 1 and depth[covered].max() < 15  # splats are at 7.5 +- 2.5
    np.testing.assert_array_equal(planes["Level.X"][covered], 2)
    assert planes["Level 2.X"].max() > 0.9
    assert planes["Combined.A"].min() == 1


def test_border_and_percentage_match_the_full_image(bpy, scene, tmp_path):
    full = render_file(bpy, tmp_path)
    scene.render.use_border = scene.render.use_crop_to_border = True
    scene.render.border_min_x, scene.render.border_max_x = 0.31, 0.66
    scene.render.border_min_y, scene.render.border_max_y = 0.2, 0.81
    cropped = render_file(bpy, tmp_path)
    expected = full[480 - 388 : 480 - 96, 198:422]
    assert cropped.shape == expected.shape == (292, 224, 4)
    assert np.abs(cropped - expected).max() <= 1.001 / 255
    scene.render.use_crop_to_border = False
    with_border = render_file(bpy, tmp_path)
    assert with_border.shape == full.shape
    np.testing.assert_array_equal(with_border[480 - 388 : 480 - 96, 198:422], cropped)
    scene.render.use_border, scene.render.resolution_percentage = False, 50
    half_size = render_file(bpy, tmp_path)
    assert half_size.shape == (240, 320, 4)
    assert np.abs(half_size - full.reshape(240, 2, 320, 2, 4).mean((1, 3))).mean() < 0.02


def test_background_colour(bpy, scene, tmp_path):
    scene.lodgs_render.background = (1, 0.5, 0)
    assert to_bytes(render_file(bpy, tmp_path))[0, 0].tolist() == [255, 128, 0, 255]


def test_second_scene_and_its_instance_are_rendered(bpy, lodgs, scene, bundle, tmp_path):
    """The second scene is on the left of the image and its instance on the right."""
    before = render_passes(bpy, lodgs)["Level.X"] > 0
    left = lodgs("data.importing").import_splats(bpy.context, bundle)
    left.location = (-1.5, 2, 0)
    instance = bpy.data.objects.new("instance", None)
    instance.instance_type = "COLLECTION"
    instance.instance_collection = left.users_collection[0]
    instance.location = (5, 0, 0)
    scene.collection.objects.link(instance)
    bpy.context.view_layer.update()
    drawn = render_passes(bpy, lodgs)["Level.X"] > 0
    assert len(lodgs("render.engine").placed_splats(bpy.context.evaluated_depsgraph_get())) == 3
    assert drawn[:, :150].sum() > before[:, :150].sum() + 1000
    assert drawn[:, 500:].sum() > before[:, 500:].sum() + 1000


def test_instances_have_the_detail_of_their_own_distance(bpy, lodgs, scene, instance_of, tmp_path):
    """An instance looks like the original in the same place, although the original is far away."""
    root = lodgs("data.roots").roots(scene)[0]
    root.lodgs.mode, root.lodgs.bands.gamma = "SELECTIVE", 10
    root.lodgs.freeze = False
    expected = render_file(bpy, tmp_path)
    matrix = root.matrix_world.copy()
    instance = instance_of(root.users_collection[0])
    root.matrix_world = matrix.__class__.Translation((0, -40, 90)) @ matrix  # behind the camera, far away
    bpy.context.view_layer.update()
    instance.matrix_world = matrix @ root.matrix_world.inverted()
    bpy.context.view_layer.update()
    drawn = render_file(bpy, tmp_path)
    placed = lodgs("render.engine").placed_splats(bpy.context.evaluated_depsgraph_get())
    assert len({tuple(np.round(item.query.position, 2)) for item in placed}) == 2
    assert to_bytes(expected).max() > 200
    assert np.abs(to_bytes(drawn).astype(int) - to_bytes(expected)).max() <= 2


@pytest.mark.one_blender
def test_animation_starts_the_renderer_once(bpy, lodgs, scene, tmp_path, monkeypatch):
    renderer, started = lodgs("render.renderer"), []
    renderer.close()
    spawn_piped = lodgs("runs.processes").spawn_piped
    monkeypatch.setattr(
        lodgs("runs.processes"), "spawn_piped", lambda *a: started.append(spawn_piped(*a)) or started[-1]
    )
    written = []
    write_set = renderer.wire.write_set
    monkeypatch.setattr(renderer.wire, "write_set", lambda *a: written.append(a) or write_set(*a))
    scene.frame_end = 24
    scene.render.resolution_percentage = 20
    camera = scene.camera
    for frame, x in ((1, 0.3), (24, 2.3)):
        camera.location.x = x
        camera.keyframe_insert("location", frame=frame)
    scene.render.filepath = str(tmp_path / "frame_")
    assert bpy.ops.render.render(animation=True) == {"FINISHED"}
    frames = sorted(tmp_path.glob("frame_*.png"))
    assert len(frames) == 24 and len(started) == 1 and len(written) == 1
    first, middle, last = (read_pixels(bpy, frames[i]) for i in (0, 12, 23))
    assert np.abs(first - middle).max() > 0.2 and np.abs(middle - last).max() > 0.2
    assert started[0].poll() is None


def test_changed_attributes_are_sent_to_the_renderer(bpy, lodgs, scene, tmp_path):
    before = render_file(bpy, tmp_path)
    cloud = lodgs("data.roots").roots(scene)[0].lodgs.levels[1].object.data
    base = lodgs("attributes").read_attribute(cloud, "radiance:base")
    base[:, :3] = 0
    lodgs("attributes").write_attribute(
        cloud, "radiance:base", cloud.attributes["radiance:base"].data_type, base
    )
    cloud.update_tag()
    after = render_file(bpy, tmp_path)
    assert np.abs(before - after).mean() > 0.01


@pytest.fixture
def sent_sets(lodgs, monkeypatch):
    """Record the calls that send splats to the renderer."""
    renderer, calls = lodgs("render.renderer"), []
    write_set = renderer.wire.write_set
    monkeypatch.setattr(renderer.wire, "write_set", lambda *a: calls.append(a) or write_set(*a))
    return calls


@pytest.fixture
def by_distance(bpy, lodgs, scene, tmp_path):
    """``by_distance(rule)``: import levels of a rule that selects about half of their splats."""

    def make(name):
        scene.render.resolution_percentage = 25
        bpy.context.view_layer.update()
        before = lodgs("data.roots").roots(scene)[0]
        distance = (before.lodgs.axes.matrix_world.inverted() @ scene.camera.matrix_world.translation).length
        focal = before.lodgs.focal_px
        scene_facts, coarse, fine = {
            "bands": ({}, {"s_min": distance / focal}, {"s_min": 0.0}),
            "octree": ({"d_max": 2**-0.25 * distance, "d_max_focal": focal}, {}, {}),
            "chunks": ({}, {"d_l": distance}, {"d_l": 0.0}),
            "decay": ({"reference": 2 * distance, "tau": 0.01}, {}, {}),
            "cut": ({}, {}, {}),
        }[name]
        levels = [Level(1, random_splats(400, 1), coarse), Level(2, random_splats(1500, 1, 1), fine)]
        for level in levels:
            rng = np.random.default_rng(level.number)
            size = 2 * distance / max(focal, 32)
            for column, upper in (
                ("lod_bias", 1),
                ("sigma_d", 0.6),
                ("node_size", size),
                ("parent_size", size),
            ):
                level.splats.extras[column] = rng.uniform(0, upper, len(level.splats)).astype(np.float32)
        bundle = Bundle("any", levels, name, facts=scene_facts, cumulative=name == "octree")
        write_bundle(tmp_path / "levels.ply", bundle)
        bpy.data.batch_remove([obj for obj in bpy.data.objects if obj.type == "POINTCLOUD"])
        root = lodgs("data.importing").import_splats(bpy.context, tmp_path / "levels.ply")
        root.lodgs.axes.matrix_world = before.lodgs.axes.matrix_world
        root.lodgs.mode = "SELECTIVE"
        bpy.context.view_layer.update()
        return root

    return make


@pytest.mark.parametrize("rule", ["bands", "octree", "chunks", "decay", "cut"])
def test_renderer_selects_like_node_groups(bpy, lodgs, scene, by_distance, sent_sets, monkeypatch, rule):
    """The renderer receives each level once, and a query with each frame.

    Its images match those of splats that Blender selects and sends with each frame. Rounding may move a splat
    on a border.
    """
    root, engine = by_distance(rule), lodgs("render.engine")
    counts_sent, images = [], {}
    for by_renderer in (True, False):
        sent_sets.clear()
        if not by_renderer:
            monkeypatch.setattr(engine, "_is_selected_by_rule", lambda *args: False)
        for x in (1.3, 2.0, 0.4):
            scene.camera.location.x = x
            bpy.context.view_layer.update()
            planes = render_passes(bpy, lodgs)
            images.setdefault(x, []).append([planes[f"Combined.{channel}"] for channel in "RGBA"])
        counts_sent.append(len(sent_sets))
    assert counts_sent[0] <= 2 < counts_sent[1]
    for image, expected in images.values():
        assert np.abs(np.float32(image) - np.float32(expected)).max() <= 1 / 255
        assert np.ptp(image[:3]) > 0.1
    first, last = images[1.3][0], images[0.4][0]
    assert np.abs(np.float32(first) - np.float32(last)).max() > 0.1
    counts = [len(item.object.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.points)
              for item in root.lodgs.levels]  # fmt: skip
    assert 0 < sum(counts) < 1900


def test_modifiers_of_the_user_are_rendered(bpy, lodgs, scene, by_distance, sent_sets):
    """After removing the modifier, the renderer selects splats of the level again."""
    root = by_distance("bands")
    original = render_passes(bpy, lodgs)["Combined.R"]
    level = root.lodgs.levels[1].object
    group = bpy.data.node_groups.new("shift", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    source, move = group.nodes.new("NodeGroupInput"), group.nodes.new("GeometryNodeSetPosition")
    move.inputs["Offset"].default_value = (0.3, 0, 0)
    group.links.new(source.outputs[0], move.inputs[0])
    group.links.new(move.outputs[0], group.nodes.new("NodeGroupOutput").inputs[0])
    modifier = level.modifiers.new("shift", "NODES")
    modifier.node_group = group
    bpy.context.view_layer.update()
    assert np.abs(render_passes(bpy, lodgs)["Combined.R"] - original).max() > 0.1
    level.modifiers.remove(modifier)
    bpy.context.view_layer.update()
    np.testing.assert_array_equal(render_passes(bpy, lodgs)["Combined.R"], original)


def test_splats_hidden_in_viewports_are_read_at_every_frame(bpy, lodgs, scene, tmp_path, sent_sets):
    """Blender does not report changes of hidden objects."""
    level = lodgs("data.roots").roots(scene)[0].lodgs.levels[1].object
    level.driver_remove("hide_viewport")
    level.hide_viewport = True
    before = render_file(bpy, tmp_path)
    cloud, attributes = level.data, lodgs("attributes")
    base = attributes.read_attribute(cloud, "radiance:base")
    base[:, :3] = 0
    attributes.write_attribute(cloud, "radiance:base", cloud.attributes["radiance:base"].data_type, base)
    cloud.update_tag()
    assert np.abs(render_file(bpy, tmp_path) - before).mean() > 0.01 and len(sent_sets) == 2


def test_splats_of_a_scene_in_no_window_are_read_at_every_frame(bpy, lodgs, scene, sent_sets):
    [root] = lodgs("data.roots").roots(scene)
    cloud, attributes = root.lodgs.levels[1].object.data, lodgs("attributes")
    bpy.context.window.scene = bpy.data.scenes.new("other")
    for brightness in (1, 0):
        base = attributes.read_attribute(cloud, "radiance:base")
        base[:, :3] *= brightness
        attributes.write_attribute(cloud, "radiance:base", cloud.attributes["radiance:base"].data_type, base)
        cloud.update_tag()
        assert bpy.ops.render.render(scene=scene.name) == {"FINISHED"}
    assert len(sent_sets) == 2


def test_undo_does_not_send_unchanged_splats_again(bpy, lodgs, scene, sent_sets):
    before = render_passes(bpy, lodgs)["Combined.R"]
    count = len(sent_sets)
    lodgs("data.changes")._on_load()
    np.testing.assert_array_equal(render_passes(bpy, lodgs)["Combined.R"], before)
    assert len(sent_sets) == count == 1


def test_cancelled_render_gives_no_image_and_keeps_the_renderer(bpy, lodgs, scene, monkeypatch):
    render_passes(bpy, lodgs)
    process = lodgs("render.renderer")._renderer.process
    scene.render.resolution_x, scene.render.resolution_y = 6000, 4500
    fractions = []

    def on_progress(fraction, text):
        fractions.append(fraction)
        return not fraction > 0

    assert render_passes(bpy, lodgs, on_progress=on_progress) is None
    assert fractions[-1] < 0.5, "rendering stops soon"
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    assert render_passes(bpy, lodgs)["Combined.R"].shape == (48, 64)
    assert lodgs("render.renderer")._renderer.process is process


@pytest.mark.one_blender
def test_renderer_restarts_after_a_kill(bpy, lodgs, scene, tmp_path, capsys):
    before = render_file(bpy, tmp_path)
    process = lodgs("render.renderer")._renderer.process
    folder = lodgs("render.renderer")._renderer._folder
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    np.testing.assert_array_equal(render_file(bpy, tmp_path), before)
    assert lodgs("render.renderer")._renderer.process is not process
    assert not folder.exists()
    assert "The renderer was killed (signal 9)" in capsys.readouterr().out


@pytest.mark.one_blender
def test_renderer_that_fails_twice_is_reported(bpy, lodgs, scene, tmp_path, monkeypatch):
    lodgs("render.renderer").close()
    program = tmp_path / "dies"
    program.write_text(
        f'#!/bin/sh\n[ "$3" = serve ] && {{ echo "no luck today" >&2; exit 7; }}\nexec "{TRAINER}" "$@"\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("LODGS_TRAINER_PYTHON", str(program))
    scene.render.filepath = str(tmp_path / "none.png")
    with pytest.raises(RuntimeError, match=r"exit code 7\. no luck today"):
        bpy.ops.render.render(write_still=True)
    assert not (tmp_path / "none.png").exists()
    assert lodgs("render.renderer")._renderer is None


def test_render_without_a_trainer_is_reported(bpy, lodgs, scene, tmp_path, monkeypatch):
    lodgs("render.renderer").close()
    monkeypatch.delenv("LODGS_TRAINER_PYTHON")
    scene.render.filepath = str(tmp_path / "none.png")
    with pytest.raises(RuntimeError, match="Cannot start the trainer: it is not installed"):
        bpy.ops.render.render(write_still=True)
    assert not (tmp_path / "none.png").exists()


def test_other_objects_as_camera_are_rejected(bpy, lodgs, scene, monkeypatch):
    monkeypatch.setattr(lodgs("render.viewport_quality"), "_require_graphics", lambda: None)
    scene.camera = bpy.data.objects.new("empty", None)
    scene.collection.objects.link(scene.camera)
    for render in (bpy.ops.render.render, bpy.ops.lodgs.render_quick):
        with pytest.raises(RuntimeError, match="the scene's camera 'empty' is not a camera"):
            render()


def test_other_colour_configurations_keep_their_view_transform(lodgs):
    class Settings:
        look = view_transform = "ACES"

        def __setattr__(self, name, value):
            if (name, value) == ("view_transform", "Standard"):
                raise TypeError("enum not found")

    scene = SimpleNamespace(render=SimpleNamespace(), view_settings=Settings())
    lodgs("render.engine").use(scene)
    assert scene.render.engine == "LODGS"


def test_unsupported_lenses_are_rejected(bpy, scene):
    scene.camera.data.type, scene.camera.data.panorama_type = "PANO", "FISHEYE_EQUISOLID"
    with pytest.raises(RuntimeError, match="'camera' is a panoramic camera of the type Fisheye Equisolid"):
        bpy.ops.render.render()


def test_scene_without_visible_splats_renders_the_background(bpy, lodgs, scene, tmp_path):
    for obj in bpy.data.objects:
        obj.hide_render = obj.type != "CAMERA"
    lodgs("data.roots").roots(scene)[0].lodgs.levels[1].show = False
    assert render_file(bpy, tmp_path)[..., :3].max() == 0


@pytest.mark.nightly
def test_renderer_ends_after_blender_is_killed(bundle, tmp_path):
    """The renderer also removes its files."""
    script = tmp_path / "script.py"
    script.write_text(f"""
import importlib, os, signal, sys, tempfile
sys.path.insert(0, {str(ROOT)!r})
from tools.blender_module import EXTENSION, start_blender
bpy = start_blender()
bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
load = lambda name: importlib.import_module(EXTENSION + ".blender_lodgs." + name)
load("data.importing").import_splats(bpy.context, {str(bundle)!r})
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
bpy.context.scene.collection.objects.link(camera)
bpy.context.scene.camera = camera
load("render.engine").use(bpy.context.scene)
bpy.context.scene.render.resolution_percentage = 5
bpy.ops.render.render()
renderer = load("render.renderer")._renderer
print("RENDERER", renderer.process.pid, renderer._folder, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
""")
    process = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=600)
    line = next(line for line in process.stdout.splitlines() if line.startswith("RENDERER"))
    _, pid, folder = line.split(" ", 2)
    for _ in range(2000):
        if not Path(folder).exists() and not Path(f"/proc/{pid}").exists():
            break
        time.sleep(0.1)
    assert not Path(folder).exists()
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid), 0)


def flat_wall(y: float, color: tuple[float, float, float], logit: float = 10.0) -> Splats:
    """Return splats that form a wall in a plane of constant y, which is the depth."""
    x, z = np.meshgrid(np.linspace(-4, 4, 81), np.linspace(-4, 4, 81))
    means = np.stack([x.ravel(), np.full(x.size, y), z.ravel()], 1)
    return Splats(
        means=means.astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (x.size, 1)),
        log_scales=np.tile(np.log(np.float32([0.1, 0.001, 0.1])), (x.size, 1)),
        opacity_logits=np.full(x.size, logit, np.float32),
        sh=np.tile(((np.float32(color) - 0.5) / 0.28209479177387814), (x.size, 1, 1)).astype(np.float32),
    )


def import_wall(bpy, lodgs, path: Path, *wall):
    write_bundle(path, Bundle("", [Level(1, flat_wall(*wall))]))
    return lodgs("data.importing").import_splats(bpy.context, path, upright=False)


def add_red_cube(bpy):
    """Add a rotated red cube, and a camera of 320x240 pixels at a distance of 6."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location, camera.rotation_euler = (0, -6, 0), (np.pi / 2, 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    bpy.ops.mesh.primitive_cube_add(size=2, location=(0.3, 0.4, 0.2), rotation=(0.5, 0.3, 0.7))
    cube = bpy.context.object
    material = bpy.data.materials.new("red")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    emission, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    emission.inputs["Color"].default_value = (1, 0, 0, 1)
    material.node_tree.links.new(emission.outputs[0], output.inputs["Surface"])
    cube.data.materials.append(material)
    scene.render.resolution_x, scene.render.resolution_y = 320, 240
    scene.render.dither_intensity = 0
    scene.render.image_settings.color_mode = "RGBA"
    return cube


def ray_depths(cube, camera_center=(0, -6, 0)) -> tuple[np.ndarray, np.ndarray]:
    """Return the depths where rays through pixel centres enter and leave the cube.

    A ray hits the cube if it enters before it leaves.
    """
    focal = 320 * 50 / 36
    x, y = np.meshgrid((np.arange(320) + 0.5 - 160) / focal, (120 - np.arange(240) - 0.5) / focal)
    directions = np.stack([x, np.ones_like(x), y], 2)
    to_cube = np.linalg.inv(np.array(cube.matrix_world, float))
    origin = to_cube @ (*camera_center, 1)
    local = directions @ to_cube[:3, :3].T
    first, last = (np.sort([(s - origin[:3]) / local for s in (-1, 1)], axis=0)[i] for i in (0, 1))
    return first.max(2), last.min(2)


def test_splats_and_meshes_of_cycles_occlude_each_other(bpy, lodgs, tmp_path):
    """A red cube intersects a green wall of splats. Ray depths are the reference, except at outlines.

    There, pixels are mixtures of red and green: nothing is darker.
    """
    scene = bpy.context.scene
    import_wall(bpy, lodgs, tmp_path / "wall.ply", 0.0, (0.1, 0.8, 0.2))
    cube = add_red_cube(bpy)
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    meshes = scene.lodgs_render.meshes
    meshes.cycles.samples, meshes.cycles.device = 4, "CPU"
    meshes.cycles.use_denoising = False
    image = render_file(bpy, tmp_path)

    enters, leaves = ray_depths(cube)
    red = (enters < leaves) & (enters < 6)  # the wall is at 6
    assert 0.02 < red.mean() < 0.5
    assert ((enters < leaves) & (enters > 6)).sum() > 500  # parts of the cube are behind the wall
    clear = ~near_outline(red, 2)
    assert clear.mean() > 0.9
    is_red = image[..., 0] > 0.5
    np.testing.assert_array_equal(is_red[clear], red[clear])
    assert np.abs(image[clear & ~red][:, :3] - (0.1, 0.8, 0.2)).max() < 0.03
    linear, wall = srgb_to_linear(image), srgb_to_linear(np.float32([0.1, 0.8, 0.2]))
    share = (linear[..., 0] - wall[0]) / (1 - wall[0])
    assert ((share > 0.2) & (share < 0.8)).sum() > 50  # soft edges
    np.testing.assert_allclose(linear[..., 1], (1 - share) * wall[1], atol=0.03)
    # a second call copies a changed image size to the mesh scene
    scene.render.resolution_x = 200
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    assert meshes.render.resolution_x == 200 and len(bpy.data.scenes) == 2


def near_outline(mask: np.ndarray, reach: int) -> np.ndarray:
    """Return the pixels near the outline of a mask."""
    result = np.zeros_like(mask)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            result |= np.roll(mask, (dy, dx), (0, 1)) != mask
    return result


@pytest.fixture
def fog_and_wall(bpy, lodgs, tmp_path):
    """Blue fog at depth 3 in front of a red cube, and a green wall at 9 behind it. Return wall and cube."""
    cube = add_red_cube(bpy)
    import_wall(bpy, lodgs, tmp_path / "fog.ply", -3.0, (0.1, 0.2, 0.8), -3.0)
    wall = import_wall(bpy, lodgs, tmp_path / "wall.ply", 3.0, (0.1, 0.8, 0.2))
    lodgs("render.engine").use(bpy.context.scene)
    bpy.context.scene.render.film_transparent = True
    return wall, cube


def test_meshes_hold_out_splats_behind_them(bpy, lodgs, fog_and_wall, tmp_path):
    """Pixels of the cube contain only the fog with its alpha, others fog and wall.

    Combined with the meshes, the fog is in front of the cube.
    """
    scene, (wall, cube) = bpy.context.scene, fog_and_wall
    without_holdout = render_file(bpy, tmp_path, "without_holdout.png")
    wall.lodgs.levels[0].show = False
    fog = render_file(bpy, tmp_path, "fog.png")
    wall.lodgs.levels[0].show = True
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "garden.blend"))
    assert bpy.ops.lodgs.render_mesh_depth() == {"FINISHED"}
    assert scene.lodgs_render.holdout == "//garden_depth/Scene_####.exr" and len(bpy.data.scenes) == 1
    assert (tmp_path / "garden_depth" / "Scene_0001.exr").exists()
    with_holdout = render_file(bpy, tmp_path, "held.png")

    enters, leaves = ray_depths(cube)
    covered = enters < leaves
    assert 0.05 < covered.mean() < 0.5
    assert fog[..., 3].min() > 0.15 and fog[..., 3].max() < 0.45 and without_holdout[..., 3].min() > 0.95
    compare_masks(with_holdout[..., 3] < 0.5, covered)
    clear = ~near_outline(covered, 1)
    np.testing.assert_array_equal(with_holdout[covered & clear], fog[covered & clear])
    np.testing.assert_array_equal(with_holdout[~covered & clear], without_holdout[~covered & clear])
    planes = render_passes(bpy, lodgs)
    np.testing.assert_allclose(planes["Depth.Z"][covered & clear], 3, atol=1e-4)
    np.testing.assert_allclose(planes["Depth.Z"][~covered & clear], 9, atol=1e-4)

    scene.render.use_border = True  # depth is cropped like the image
    scene.render.border_min_x, scene.render.border_max_x = 0.25, 0.75
    scene.render.border_min_y, scene.render.border_max_y = 0.1, 0.6
    cropped = render_file(bpy, tmp_path, "part.png")
    assert np.abs(cropped[96:216, 80:240] - with_holdout[96:216, 80:240]).max() <= 1.001 / 255
    scene.render.use_border = False

    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    assert not combines_by_depth(lodgs, scene)
    meshes = scene.lodgs_render.meshes
    meshes.cycles.samples, meshes.cycles.use_denoising = 4, False
    combined = render_file(bpy, tmp_path, "both.png")
    inside = covered & ~near_outline(covered, 2)
    alpha = fog[..., 3:]
    expected = srgb_to_linear(fog[..., :3]) * alpha + (1 - alpha) * np.float32([1, 0, 0])
    difference = np.where(
        covered[..., None],
        srgb_to_linear(combined[..., :3]) - expected,
        combined[..., :3] - without_holdout[..., :3],
    )
    wrong = np.abs(difference).max(axis=2) > 0.02  # no dark seam
    assert wrong.sum() <= 3 and not (wrong & ~near_outline(covered, 1)).any()
    scene.lodgs_render.holdout = ""
    assert bpy.ops.lodgs.combine_with_meshes() == {"FINISHED"}
    assert combines_by_depth(lodgs, scene)
    wall.lodgs.levels[0].show = False
    by_depth = render_file(bpy, tmp_path, "nearer.png")
    np.testing.assert_allclose(srgb_to_linear(by_depth[inside][:, :3]), expected[inside], atol=0.02)
    assert bpy.ops.lodgs.render_mesh_depth() == {"FINISHED"}
    assert not combines_by_depth(lodgs, scene)
    assert bpy.data.scenes[:] == [scene, meshes]


def test_cancelled_mesh_depth_restores_the_scene(bpy, lodgs, fog_and_wall, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "garden.blend"))
    scene = bpy.context.scene
    work = lodgs("render.mesh_depth").render_mesh_depth(scene, range(1, 4))
    first = next(work)
    assert first.exists() and len(bpy.data.scenes) == 2
    work.close()
    assert bpy.data.scenes[:] == [scene] and scene.lodgs_render.holdout == ""


def compare_masks(mask: np.ndarray, expected: np.ndarray) -> None:
    """Compare masks; up to 3 pixels may differ at the outline."""
    differ = mask != expected
    assert differ.sum() <= 3 and not (differ & ~near_outline(expected, 1)).any()


def combines_by_depth(lodgs, scene) -> bool:
    """Return whether the compositor combines images by depth, not only by alpha."""
    nodes = lodgs("compat").compositor_tree(scene).nodes
    return any(node.bl_idname == lodgs("render.compositing").MIN_DEPTH for node in nodes)


def srgb_to_linear(coded: np.ndarray) -> np.ndarray:
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def test_animated_mesh_holds_out_splats_in_each_frame(bpy, lodgs, fog_and_wall, tmp_path):
    """Depth of an unsaved file is in the temporary folder. A frame without depth is an error."""
    scene, (_, cube) = bpy.context.scene, fog_and_wall
    for frame, x in ((1, -1.0), (3, 1.0)):
        cube.location.x = x
        cube.keyframe_insert("location", frame=frame)
    scene.frame_start, scene.frame_end, scene.frame_step = 1, 3, 2
    assert bpy.ops.lodgs.render_mesh_depth(animation=True) == {"FINISHED"}
    assert scene.frame_current == 1
    for frame in (1, 3):
        scene.frame_set(frame)
        enters, leaves = ray_depths(cube)
        with_holdout = render_file(bpy, tmp_path, f"{frame}.png")
        compare_masks(with_holdout[..., 3] < 0.5, enters < leaves)
    scene.frame_set(2)
    scene.render.filepath = str(tmp_path / "none.png")
    with pytest.raises(RuntimeError, match=r"depth file of frame 2 is missing: .*Scene_0002\.exr"):
        bpy.ops.render.render(write_still=True)
    assert not (tmp_path / "none.png").exists()
    scene.frame_set(3)
    scene.render.resolution_x = 100
    with pytest.raises(RuntimeError, match=r"320x240 pixels.* 100x240"):
        bpy.ops.render.render(write_still=True)
    assert not (tmp_path / "none.png").exists()
    scene.lodgs_render.holdout = ""
    assert render_file(bpy, tmp_path, "none.png")[..., 3].min() > 0.95


@pytest.mark.parametrize(
    ("pattern", "frame", "name"),
    [("/d/a_####.exr", 7, "a_0007.exr"), ("/d/##a#.exr", 12, "##a12.exr"), ("/d/a.exr", 3, "a.exr"),
     ("/d/a_####.exr", -7, "a_-0007.exr"), ("/d##/a_##.exr", 123, "a_123.exr")],
)  # fmt: skip
def test_path_of_a_frame_contains_its_number(bpy, lodgs, pattern, frame, name):
    scene = bpy.context.scene
    path = lodgs("render.engine").frame_path(pattern, scene, frame)
    assert path.name == name and str(path.parent) == pattern.rpartition("/")[0]


def test_repeated_progress_prints_no_line(bpy, lodgs, scene):
    """Blender prints a line for each update of the text."""
    updates = []

    def wait_for_frame(depsgraph, width, height, window, on_progress, *_):
        updates.clear()
        for text in ("Preparing", "Preparing", "Rendering", "Rendering"):
            on_progress(0.0, text)
            updates.append(text)

    def on_update(*_):
        updates.append("update")

    bpy.app.handlers.render_stats.append(on_update)
    with lodgs("render.engine").use_renderer(wait_for_frame):
        bpy.ops.render.render()
    bpy.app.handlers.render_stats.remove(on_update)
    assert updates[:6] == ["update", "Preparing", "Preparing", "update", "Rendering", "Rendering"]


def test_compositor_nodes_of_the_user_are_not_changed(bpy, lodgs, scene):
    tree = lodgs("compat").compositor_tree(scene)
    tree.nodes.new("CompositorNodeBlur")
    with pytest.raises(RuntimeError, match="has compositor nodes"):
        bpy.ops.lodgs.combine_with_meshes()
    assert len(bpy.data.scenes) == 1


@pytest.mark.parametrize("transparent", [False, True])
def test_viewport_quality_is_similar_to_a_render(bpy, lodgs, scene, tmp_path, frame, transparent, capfd):
    """``frame`` skips without graphics in background mode."""
    scene.render.resolution_percentage = 50
    scene.render.film_transparent = transparent
    scene.render.image_settings.color_mode = "RGBA"
    image = render_file(bpy, tmp_path)
    scene.frame_end = 2
    scene.render.filepath = str(tmp_path / "quick_")
    assert bpy.ops.lodgs.render_quick(animation=True) == {"FINISHED"}
    files = sorted(tmp_path.glob("quick_*.png"))
    assert len(files) == 2
    assert f"2 frames in {tmp_path}" in capfd.readouterr().out
    quick = read_pixels(bpy, files[1])
    covered = image[..., 3:] > 0
    error = (((quick - image)[..., :3] * covered).astype(float) ** 2).mean()
    assert -10 * np.log10(error) > 35
    np.testing.assert_allclose(quick[..., 3], image[..., 3], atol=0.03)


def render_quick(bpy, path: Path) -> np.ndarray:
    """Render in Viewport Quality, save the image and return it."""
    assert bpy.ops.lodgs.render_quick() == {"FINISHED"}
    bpy.data.images["Render Result"].save_render(str(path), scene=bpy.context.scene)
    return read_pixels(bpy, path)


def is_similar(image: np.ndarray, expected: np.ndarray) -> bool:
    """Return True if the PSNR is above 35 dB."""
    if image.shape != expected.shape:
        return False
    return ((image - expected).astype(float)[..., :3] ** 2).mean() < 10**-3.5


@pytest.fixture
def two_walls(bpy, lodgs, tmp_path, frame):
    """The roots of a green and a red wall side by side in front of the camera. Skip without graphics."""
    add_red_cube(bpy).hide_render = True
    lodgs("render.engine").use(bpy.context.scene)
    green = import_wall(bpy, lodgs, tmp_path / "green.ply", 1.0, (0.1, 0.8, 0.2))
    red = import_wall(bpy, lodgs, tmp_path / "red.ply", 0.0, (0.8, 0.2, 0.1))
    red.location.x = 4
    return green, red


@pytest.mark.parametrize("hidden", ["object", "collection", "view layer", "modifier"])
def test_viewport_quality_has_the_visibility_of_renders(bpy, two_walls, tmp_path, hidden):
    before = render_file(bpy, tmp_path)
    for root, viewport, render in zip(two_walls, (True, False), (False, True), strict=True):
        obj = root.lodgs.levels[0].object
        if hidden == "object":
            root.animation_data_clear()
            obj.animation_data_clear()
            obj.hide_viewport, obj.hide_render = viewport, render
        elif hidden == "collection":
            collection = root.users_collection[0]
            collection.hide_viewport, collection.hide_render = viewport, render
        elif hidden == "view layer":
            obj.hide_set(viewport)
        else:
            group = bpy.data.node_groups.get("nothing") or bpy.data.node_groups.new(
                "nothing", "GeometryNodeTree"
            )
            if not group.interface.items_tree:
                for direction in ("INPUT", "OUTPUT"):
                    group.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
            modifier = obj.modifiers.new("nothing", "NODES")
            modifier.node_group = group
            modifier.show_viewport, modifier.show_render = viewport, render
    image = render_file(bpy, tmp_path)
    assert is_similar(image, before) == (hidden == "view layer")
    assert is_similar(render_quick(bpy, tmp_path / "quick.png"), image)


def test_viewport_quality_draws_the_border(bpy, scene, frame, tmp_path):
    scene.render.resolution_percentage = 50
    scene.render.use_border = True
    scene.render.border_min_x, scene.render.border_max_x = 0.31, 0.66
    scene.render.border_min_y, scene.render.border_max_y = 0.2, 0.81
    for crop in (True, False):
        scene.render.use_crop_to_border = crop
        assert is_similar(render_quick(bpy, tmp_path / "quick.png"), render_file(bpy, tmp_path))


def test_viewport_quality_ignores_the_clip_end(bpy, scene, frame, tmp_path):
    scene.render.resolution_percentage = 50
    scene.camera.data.clip_end = 4
    image = render_file(bpy, tmp_path)
    assert image[..., :3].max() > 0.5
    assert is_similar(render_quick(bpy, tmp_path / "quick.png"), image)


def test_viewport_quality_restores_the_frame(bpy, lodgs, scene):
    scene.frame_set(3, subframe=0.5)
    list(lodgs("render.viewport_quality").render_animation(bpy.context, []))
    assert (scene.frame_current, scene.frame_subframe) == (3, 0.5)


def test_viewport_quality_rejects_holdout(bpy, scene, frame, tmp_path):
    scene.lodgs_render.holdout = str(tmp_path / "depth_####.exr")
    with pytest.raises(RuntimeError, match=r"Hold Out is set.*\s+Clear Hold Out"):
        bpy.ops.lodgs.render_quick()
    assert bpy.context.scene.render.engine == "LODGS" and bpy.context.scene.render.use_compositing


def test_panel_lists_limitations_of_renders(bpy, lodgs, scene):
    """Limitations concern lenses, blur with Hold Out or Viewport Quality, and a missing camera."""
    limitations, data = lodgs("render.engine").limitations, scene.camera.data
    assert limitations(scene) == []
    data.dof.use_dof, scene.lodgs_render.holdout = True, "//depth_####.exr"
    texts = limitations(scene)
    assert len(texts) == 2 and "without blur" in texts[0] and "Hold Out does not work: depth of" in texts[1]
    with pytest.raises(
        RuntimeError, match="Cannot hold out meshes: depth of field or motion blur is enabled"
    ):
        bpy.ops.render.render()
    data.type, data.panorama_type = "PANO", "EQUIRECTANGULAR"
    texts = " ".join(limitations(scene))
    assert "no depth of field" in texts and "no panoramas" in texts and "camera is panoramic" in texts
    data.longitude_min, data.longitude_max = 1, -1
    assert "inverted or too large range of angles, which LODGS cannot render" in limitations(scene)[0]
    with pytest.raises(RuntimeError, match="'camera' is a panoramic camera with an empty, inverted"):
        bpy.ops.render.render()
    data.panorama_type = "MIRRORBALL"
    assert "Mirrorball, which LODGS cannot render" in limitations(scene)[0]
    scene.camera = None
    assert limitations(scene) == ["The scene has no camera."]


def test_motion_blur_has_cameras_of_the_shutter_time(bpy, lodgs, scene, monkeypatch):
    """The depth pass is rendered at the time of the frame."""
    drawn, camera = [], scene.camera
    for frame, y in ((0, -6.0), (2, -5.0)):
        camera.location.y = y
        camera.keyframe_insert("location", frame=frame)
    scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 1.0
    scene.frame_set(1)
    draw_frame = lodgs("render.renderer").draw_frame

    def record(sets, view, on_progress):
        drawn.append((view.camera.center[1], [key.center[1] for key in view.lens.cameras]))
        return draw_frame(sets, view, on_progress)

    monkeypatch.setattr(lodgs("render.renderer"), "draw_frame", record)
    scene.render.resolution_percentage, scene.lodgs_render.samples = 10, 2
    bpy.ops.render.render()
    ((centre, keys),) = drawn
    assert centre == pytest.approx(-5.5, abs=1e-4) and len(keys) == 3
    assert keys[0] < -5.6 and keys[1] == pytest.approx(-5.5, abs=1e-4) and keys[2] > -5.4
    assert scene.frame_current == 1 and scene.frame_subframe == 0


def test_motion_blur_follows_time_remapping(bpy, lodgs, scene):
    """As in Cycles, shutter times are in frames of the video. Rendering does not change the frame."""
    scene.frame_set(5)
    scene.render.frame_map_old, scene.render.frame_map_new = 100, 50
    scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 1.0
    assert lodgs("render.engine").shutter_times(scene) == pytest.approx([4.5, 5, 5.5])
    scene.render.resolution_percentage, scene.lodgs_render.samples = 10, 2
    bpy.ops.render.render()
    assert scene.frame_current == 5 and scene.frame_subframe == 0
