"""The render command: images of views, and its errors."""

import json
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from tests.training.conftest import write_tiny_scene
from tests.training.lod.tree.trees import tree_of
from training.__main__ import main
from training.lod.blocks import BLOCKS, block_table
from training.lod.rule import rules
from training.lod.rules.chunks import member_columns
from training.lod.selection import select
from training.rasterize import Gaussians, render
from training.runs.job import Job
from training.scenes.cameras import camera_to_dict, read_camera, write_camera
from training.splats.bundle import write_bundle
from training.splats.formats.splat import SplatFile, write_splat
from training.splats.levels import Bundle, Level
from training.splats.morton import spatial_order
from training.splats.ply import write_ply
from training.splats.streamed_levels import write_streamed_levels


@pytest.fixture
def bundle(make_splats, tmp_path):
    levels = [Level(1, make_splats(30), {"s_min": 0.2}), Level(2, make_splats(60, seed=1), {"s_min": 0.0})]
    path = tmp_path / "bundle.ply"
    write_bundle(path, Bundle("flod", levels, "bands"))
    return path, levels


def pixels(path):
    with Image.open(path) as file:
        return np.asarray(file)


def expected(splats, camera, near=0.01, **options):
    return next(render(Gaussians.of(splats), [camera], near=near, dtype="uint8", **options))[..., :3]


def test_camera_file_round_trips(camera, tmp_path):
    write_camera(tmp_path / "camera.json", camera, 0.25)
    restored, near = read_camera(tmp_path / "camera.json")
    assert near == 0.25 and camera_to_dict(restored, near) == camera_to_dict(camera, near)


def test_levels_are_rendered(bundle, camera, tmp_path):
    path, levels = bundle
    write_camera(tmp_path / "camera.json", camera, 0.01)
    common = ["render", str(path), "--camera", str(tmp_path / "camera.json"), "--out"]
    assert main([*common, str(tmp_path / "fine.png")]) == 0
    assert main([*common, str(tmp_path / "coarse.png"), "--level", "1"]) == 0
    assert main([*common, str(tmp_path / "far.png"), "--first", "1", "--last", "2", "--gamma", "0.01"]) == 0
    fine, coarse = (expected(level.splats, camera) for level in reversed(levels))
    assert np.abs(fine.astype(int) - coarse).max() > 20
    np.testing.assert_array_equal(pixels(tmp_path / "fine.png"), fine)
    np.testing.assert_array_equal(pixels(tmp_path / "coarse.png"), coarse)
    np.testing.assert_array_equal(
        pixels(tmp_path / "far.png"), fine
    )  # gamma requests more detail than exists


def test_coarser_level_of_a_tree_is_refused(camera, make_splats, tmp_path, capsys):
    splats = make_splats(60)
    splats.means, splats.log_scales = splats.means * np.float32(0.05), splats.log_scales - 3
    tree = tree_of(splats)
    write_bundle(tmp_path / "tree.ply", tree)
    write_camera(tmp_path / "camera.json", camera, 0.01)
    command = ["render", str(tmp_path / "tree.ply"), "--camera", str(tmp_path / "camera.json"), "--out"]
    assert main([*command, str(tmp_path / "full.png")]) == 0
    np.testing.assert_array_equal(pixels(tmp_path / "full.png"), expected(tree.levels[1].splats, camera))
    assert main([*command, str(tmp_path / "cut.png"), "--pixels", "4"]) == 0
    splats, _ = select(tree, camera.center, camera.focal, {"pixels": 4.0})
    assert 0 < len(splats) < 60
    np.testing.assert_array_equal(pixels(tmp_path / "cut.png"), expected(splats, camera))
    capsys.readouterr()
    assert main([*command, str(tmp_path / "none.png"), "--level", "1"]) == 2
    message = capsys.readouterr().err
    assert "level 1" in message and "Choose level 2" in message
    assert not (tmp_path / "none.png").exists()


def test_only_needed_splats_are_read(make_splats, camera, tmp_path, capsys):
    """A level reads its own splats; by distance, a file with chunks and blocks reads those of the chunk."""
    rule, levels = rules()["chunks"], []
    for number, count in ((1, 600), (2, 9000)):
        splats = make_splats(count, 1, number)
        splats = splats.select(spatial_order(splats.means))
        sides = np.stack([splats.means[:, 0] < -0.3, splats.means[:, 0] > 2])
        extras = member_columns(sides)
        levels.append(Level(number, replace(splats, extras=extras), {"d_l": 2.0 * (number < 2)}))
    centers = np.float32([-1, 3])
    chunks = {"x": centers, "y": 0 * centers, "z": 0 * centers, "radius": np.float32([9, 9])}
    blocks = block_table(rule.block_bounds, ((level.number, level.splats.extras) for level in levels))
    bundle = Bundle("lodge", levels, "chunks", tables={"chunks": chunks, BLOCKS: blocks})
    write_bundle(tmp_path / "blocks.ply", bundle)
    write_bundle(tmp_path / "plain.ply", replace(bundle, tables={"chunks": chunks}))
    write_camera(tmp_path / "camera.json", camera, 0.01)
    summaries, images = {}, {}
    for name in ("blocks", "plain"):
        for level in ("--level=1", "--fade=0"):
            out = tmp_path / f"{name}{level}.png"
            command = ["render", str(tmp_path / f"{name}.ply"), "--camera", str(tmp_path / "camera.json")]
            assert main([*command, "--out", str(out), level]) == 0
            summaries[name, level] = capsys.readouterr().out.splitlines()[-1].removeprefix(f"{out}: ")
            images[name, level] = pixels(out)
    inside = sum(int((level.splats.means[:, 0] < -0.3).sum()) for level in levels)
    assert (
        summaries["blocks", "--level=1"] == summaries["plain", "--level=1"] == "600 splats loaded of 0.1 MB"
    )
    assert summaries["plain", "--fade=0"] == "9,600 splats loaded of 1.0 MB"
    loaded, _, size = summaries["blocks", "--fade=0"].partition(" splats loaded of ")
    assert loaded == f"{inside:,}" and float(size.removesuffix(" MB")) < 0.8
    for level in ("--level=1", "--fade=0"):
        np.testing.assert_array_equal(images["blocks", level], images["plain", level])
    assert np.ptp(images["plain", "--fade=0"]) > 100


def test_antialiased_splats_are_filtered(make_splats, camera, tmp_path):
    """A bundle stores the filter in its meta, a plain PLY in a comment."""
    splats = make_splats(60)
    splats.log_scales -= 2
    write_bundle(tmp_path / "b.ply", Bundle("3dgs", [Level(1, splats)], meta={"antialias": True}))
    write_ply(tmp_path / "p.ply", splats, ["SplatRenderMode: mip"])
    write_camera(tmp_path / "camera.json", camera, 0.01)
    filtered = expected(splats, camera, antialias=True)
    assert np.abs(filtered.astype(int) - expected(splats, camera)).max() > 20
    for name in ("b.ply", "p.ply"):
        command = ["render", str(tmp_path / name), "--camera", str(tmp_path / "camera.json")]
        assert main([*command, "--out", str(tmp_path / "out.png")]) == 0
        np.testing.assert_array_equal(pixels(tmp_path / "out.png"), filtered)


def test_run_finds_views_by_name(make_splats, tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    splats, run = make_splats(40), tmp_path / "run"
    Job(str(scene), str(run)).write(run / "job.toml")
    write_bundle(run / "bundle.ply", Bundle("3dgs", [Level(1, splats)]))
    for source in (run, run / "bundle.ply"):
        out = tmp_path / "view.png"
        assert main(["render", str(source), "--view", "03", "--out", str(out)]) == 0
        assert pixels(out).shape == (48, 64, 3)
        assert main(["render", str(source), "--view", "03.jpg", "--out", str(out), "--size", "32x24"]) == 0
        assert pixels(out).shape == (24, 32, 3)


def test_background_options(bundle, camera, tmp_path):
    write_camera(tmp_path / "camera.json", camera, 0.01)
    command = ["render", str(bundle[0]), "--camera", str(tmp_path / "camera.json"), "--out"]
    assert main([*command, str(tmp_path / "a.png"), "--background", "transparent"]) == 0
    assert main([*command, str(tmp_path / "b.png"), "--background", "1,0,0"]) == 0
    clear, red = pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png")
    assert clear.shape[2] == 4 and clear[..., 3].min() == 0
    assert red[clear[..., 3] == 0].tolist()[0] == [255, 0, 0]


def test_holdout_hides_splats_behind_meshes(bundle, camera, tmp_path):
    """All splats are behind the left half's depth of 0.5, and in front of the right half's."""
    write_camera(tmp_path / "camera.json", camera, 0.01)
    depth = np.full((48, 64), 1e10, np.float32)
    depth[:, :32] = 0.5
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"View.Depth.Z": depth}).write(str(tmp_path / "depth.exr"))
    common = ["render", str(bundle[0]), "--camera", str(tmp_path / "camera.json"), "--out"]
    assert main([*common, str(tmp_path / "a.png")]) == 0
    assert main([*common, str(tmp_path / "b.png"), "--holdout", str(tmp_path / "depth.exr")]) == 0
    unlimited, limited = pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png")
    assert unlimited[:, :32].max() > 100 and limited[:, :32].max() == 0
    np.testing.assert_array_equal(limited[:, 32:, :3], unlimited[:, 32:])
    assert (limited[:, 32:, 3] == 255).all()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            ["--level", "7"],
            "Cannot draw level 7: the bundle has no such level. Choose a level from 1 (coarsest) to 2.",
        ),
        (["--first", "2", "--last", "1"], "levels 2 to 1"),
        (["--gamma", "0"], "gamma = 0.0"),
        (
            ["--offset", "1"],
            "Cannot set 'offset': the rule 'bands' has no such control. Use one of: gamma, first, last.",
        ),
        (["--gamma", "1", "--level", "1"], "Cannot combine --level"),
        (["--scene", "scene"], "Cannot use --scene: it applies only to --view. Omit --scene."),
        (["--out", "a.gif"], "Cannot write a.gif: unsupported image format"),
        (["--holdout", "gone.exr"], "Cannot read the mesh depth gone.exr"),
        (["--size", "99999999x9"], "99999999x9 pixels"),
        (["--size", "32768x32768"], "32768x32768 pixels"),
        (["--size", "1" + 400 * "0" + "x9"], "x9 pixels"),
        (["--backend", "magic"], 'Unknown rasterizer backend "magic".'),
    ],
)
def test_invalid_options_raise_one_sentence(bundle, camera, tmp_path, monkeypatch, capsys, options, sentence):
    monkeypatch.chdir(tmp_path)
    write_camera(tmp_path / "camera.json", camera, 0.01)
    common = ["render", str(bundle[0]), "--camera", "camera.json", "--out", "a.png"]
    assert main([*common, *options]) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.glob("a.*"))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"fx": None}, "NoneType"),
        ({"width": 0}, "0x48 pixels"),
        ({"width": 10**6}, "1000000x48 pixels"),
        ({"world_to_camera": np.zeros((4, 4)).tolist()}, "rotation"),
        ({"world_to_camera": [[1, 0], [0, 1]]}, "4x4 matrix"),
        ({"width": 10**400}, "too many digits"),
        ({"fx": 10**30}, "too many digits"),
        ({"fx": 1e-300}, "focal length"),
        ({"cx": 1e300}, "principal point"),
        ({"near": -1}, "near depth"),
        ({"world_to_camera": (1e300 * np.eye(4)).tolist()}, "1e+12"),
        ({"world_to_camera": json.loads("[" * 900 + "]" * 900)}, "nests"),
        ({"near": float("nan")}, "near = nan is not a finite number"),
    ],
)
def test_invalid_cameras_raise_one_sentence(bundle, camera, tmp_path, capsys, change, sentence):
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(camera_to_dict(camera, 0.01) | change))
    assert main(["render", str(bundle[0]), "--camera", str(file), "--out", str(tmp_path / "a.png")]) == 2
    assert sentence in capsys.readouterr().err
    file.write_text(json.dumps({"width": 3}))
    assert main(["render", str(bundle[0]), "--camera", str(file), "--out", str(tmp_path / "a.png")]) == 2
    assert "'height'" in capsys.readouterr().err


def test_out_of_memory_raises_one_sentence(bundle, camera, tmp_path, capsys, monkeypatch):
    """Memory can run out before, during and after drawing, in numpy or in torch."""
    write_camera(tmp_path / "camera.json", camera, 0.01)
    arguments = [
        "render",
        str(bundle[0]),
        "--camera",
        str(tmp_path / "camera.json"),
        "--out",
        str(tmp_path / "a.png"),
    ]
    torch_error = RuntimeError(
        "[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory: 9"
    )
    for function in (
        "image.RenderedImage.empty",
        "image.RenderedImage.eight_bit",
        "scene.rasterize_strips",
        "command.ResidentBundle",
    ):
        for error in (MemoryError(), torch_error):

            def fail(*_, error=error, **__):
                raise error

            with monkeypatch.context() as patched:
                patched.setattr(f"training.render.{function}", fail)
                assert main(arguments) == 2
            assert "not enough memory" in capsys.readouterr().err.lower()
    assert not (tmp_path / "a.png").exists()


def test_missing_views_raise_one_sentence(bundle, tmp_path, capsys):
    out = ["--out", str(tmp_path / "a.png")]
    assert main(["render", str(bundle[0]), "--view", "a.jpg", *out]) == 2
    assert "does not list its training photos" in capsys.readouterr().err
    scene = write_tiny_scene(tmp_path / "scene")
    assert main(["render", str(bundle[0]), "--view", "a.jpg", "--scene", str(scene), *out]) == 2
    assert "no photo is named a.jpg. Choose one of: 00.jpg" in capsys.readouterr().err
    assert main(["render", str(tmp_path / "no.ply"), "--view", "a.jpg", *out]) == 2
    assert "it does not exist" in capsys.readouterr().err


def test_changed_looks_are_reported(make_splats, camera, tmp_path, capsys):
    write_camera(tmp_path / "camera.json", camera, 0.01)
    corrupt = make_splats(5)
    corrupt.means[0] = np.nan
    write_ply(tmp_path / "corrupt.ply", corrupt)
    levels = [Level(1, make_splats(5)), Level(2, make_splats(9))]
    write_bundle(tmp_path / "foreign.ply", Bundle("sundial", levels, "shadow"))

    def render_errors(*arguments):
        out = tmp_path / "a.png"
        assert (
            main(
                ["render", *map(str, arguments), "--camera", str(tmp_path / "camera.json"), "--out", str(out)]
            )
            == 0
        )
        return capsys.readouterr().err

    assert render_errors(tmp_path / "corrupt.ply").startswith("warning: ")
    text = render_errors(tmp_path / "foreign.ply")
    assert text.count("\n") == 1 and "'shadow'" in text and "the finest level is shown" in text
    assert render_errors(tmp_path / "foreign.ply", "--level", 1) == ""


@pytest.mark.parametrize("options", [[], ["--gamma", "2"], ["--background", "transparent"]])
def test_graphics_device_matches_the_cpu(graphics, bundle, camera, tmp_path, options):
    """At most one value in 1000 differs, by at most 1 of 255."""
    path, _ = bundle
    write_camera(tmp_path / "camera.json", camera.resized(640, 480), 0.01)
    images = []
    for backend in ("cpu", "gpu"):
        out = tmp_path / f"{backend}.png"
        common = ["render", str(path), "--camera", str(tmp_path / "camera.json"), "--out", str(out)]
        assert main([*common, "--backend", backend, *options]) == 0
        images.append(pixels(out).astype(int))
    difference = np.abs(images[0] - images[1])
    assert difference.max() <= 1 and (difference > 0).mean() <= 1e-3
    assert images[0][..., :3].std() > 10, "the image is empty"


def test_other_formats_are_rendered(make_splats, camera, tmp_path):
    write_splat(tmp_path / "a.splat", make_splats(30), {})
    splats = SplatFile(tmp_path / "a.splat").select(slice(None))
    write_camera(tmp_path / "camera.json", camera, 0.01)
    source, out = str(tmp_path / "a.splat"), str(tmp_path / "a.png")
    assert main(["render", source, "--camera", str(tmp_path / "camera.json"), "--out", out]) == 0
    np.testing.assert_array_equal(pixels(tmp_path / "a.png"), expected(splats, camera))


def test_streamed_levels_in_a_folder_are_rendered(make_splats, camera, tmp_path):
    write_streamed_levels(tmp_path / "web", Bundle("", [Level(1, make_splats(30))]))
    write_camera(tmp_path / "camera.json", camera, 0.01)
    command = ["render", str(tmp_path / "web"), "--camera", str(tmp_path / "camera.json")]
    assert main([*command, "--out", str(tmp_path / "a.png")]) == 0
