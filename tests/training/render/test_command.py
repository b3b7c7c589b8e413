"""The command line: a view of a bundle as a picture, and a sentence for what cannot be."""

import json
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from tests.training.conftest import write_tiny_scene
from tests.training.lod.tree.trees import tree_of
from training.__main__ import main
from training.lod.blocks import spatial_order
from training.lod.partial_read import BLOCKS, block_table
from training.lod.rule import rules
from training.lod.rules.chunks import member_columns
from training.lod.selection import select
from training.rasterize import Gaussians, render
from training.runs.job import Job
from training.scenes.cameras import camera_to_dict, read_camera, write_camera
from training.splats.bundle import write_bundle
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply


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


def test_a_camera_survives_its_file(camera, tmp_path):
    write_camera(tmp_path / "camera.json", camera, 0.25)
    again, near = read_camera(tmp_path / "camera.json")
    assert near == 0.25 and camera_to_dict(again, near) == camera_to_dict(camera, near)


def test_levels_of_a_bundle(bundle, camera, tmp_path):
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
    np.testing.assert_array_equal(pixels(tmp_path / "far.png"), fine)  # finer details than any are wanted


def test_a_trees_coarser_level_is_not_drawn_alone(camera, make_splats, tmp_path, capsys):
    splats = make_splats(60)
    splats.means, splats.log_scales = splats.means * np.float32(0.05), splats.log_scales - 3
    tree = tree_of(splats)
    write_bundle(tmp_path / "tree.ply", tree)
    write_camera(tmp_path / "camera.json", camera, 0.01)
    command = ["render", str(tmp_path / "tree.ply"), "--camera", str(tmp_path / "camera.json"), "--out"]
    assert main([*command, str(tmp_path / "full.png")]) == 0
    np.testing.assert_array_equal(
        pixels(tmp_path / "full.png"), expected(tree.levels[1].splats, camera)
    )  # fmt: skip
    assert main([*command, str(tmp_path / "cut.png"), "--pixels", "4"]) == 0
    splats, _ = select(tree, camera.center, camera.focal, {"pixels": 4.0})
    assert 0 < len(splats) < 60
    np.testing.assert_array_equal(pixels(tmp_path / "cut.png"), expected(splats, camera))
    capsys.readouterr()
    assert main([*command, str(tmp_path / "none.png"), "--level", "1"]) == 2
    said = capsys.readouterr().err
    assert "Level 1 is no scene by itself" in said and "Take level 2, or choose by distance" in said
    assert not (tmp_path / "none.png").exists()


def test_only_what_the_view_needs_is_read(make_splats, camera, tmp_path, capsys):
    """Of a level its own splats; by distance, where the file tells chunks and blocks, those of its chunk."""
    rule, levels = rules()["chunks"], []
    for number, count in ((1, 600), (2, 9000)):
        splats = make_splats(count, 1, number)
        splats = splats.select(spatial_order(splats.means))
        sides = np.stack([splats.means[:, 0] < -0.3, splats.means[:, 0] > 2])
        extras = member_columns(sides)
        levels.append(Level(number, replace(splats, extras=extras), {"d_l": 2.0 * (number < 2)}))
    apart = np.float32([-1, 3])
    chunks = {"x": apart, "y": 0 * apart, "z": 0 * apart, "radius": np.float32([9, 9])}
    blocks = block_table(rule, {level.number: level.splats for level in levels})
    bundle = Bundle("lodge", levels, "chunks", tables={"chunks": chunks, BLOCKS: blocks})
    write_bundle(tmp_path / "blocks.ply", bundle)
    write_bundle(tmp_path / "plain.ply", replace(bundle, tables={"chunks": chunks}))
    write_camera(tmp_path / "camera.json", camera, 0.01)
    said, pictures = {}, {}
    for name in ("blocks", "plain"):
        for level in ("--level=1", "--fade=0"):
            out = tmp_path / f"{name}{level}.png"
            command = ["render", str(tmp_path / f"{name}.ply"), "--camera", str(tmp_path / "camera.json")]
            assert main([*command, "--out", str(out), level]) == 0
            said[name, level] = capsys.readouterr().out.splitlines()[-1].removeprefix(f"{out}: ")
            pictures[name, level] = pixels(out)
    inside = sum(int((level.splats.means[:, 0] < -0.3).sum()) for level in levels)
    assert said["blocks", "--level=1"] == said["plain", "--level=1"] == "600 splats loaded of 0.1 MB"
    assert said["plain", "--fade=0"] == "9,600 splats loaded of 1.0 MB"
    loaded, _, size = said["blocks", "--fade=0"].partition(" splats loaded of ")
    assert loaded == f"{inside:,}" and float(size.removesuffix(" MB")) < 0.8
    for level in ("--level=1", "--fade=0"):
        np.testing.assert_array_equal(pictures["blocks", level], pictures["plain", level])
    assert np.ptp(pictures["plain", "--fade=0"]) > 100


def test_antialiased_splats_are_drawn_so(make_splats, camera, tmp_path):
    """A bundle's, by its meta, and those of a plain PLY, by its comment."""
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


def test_a_run_knows_its_views(make_splats, tmp_path):
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


def test_transparency(bundle, camera, tmp_path):
    write_camera(tmp_path / "camera.json", camera, 0.01)
    command = ["render", str(bundle[0]), "--camera", str(tmp_path / "camera.json"), "--out"]
    assert main([*command, str(tmp_path / "a.png"), "--background", "transparent"]) == 0
    assert main([*command, str(tmp_path / "b.png"), "--background", "1,0,0"]) == 0
    clear, red = pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png")
    assert clear.shape[2] == 4 and clear[..., 3].min() == 0
    assert red[clear[..., 3] == 0].tolist()[0] == [255, 0, 0]


def test_a_holdout(bundle, camera, tmp_path):
    """Nothing is drawn before the left half's depth of 0.5, all before the right half's."""
    write_camera(tmp_path / "camera.json", camera, 0.01)
    depth = np.full((48, 64), 1e10, np.float32)
    depth[:, :32] = 0.5
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"View.Depth.Z": depth}).write(str(tmp_path / "depth.exr"))
    common = ["render", str(bundle[0]), "--camera", str(tmp_path / "camera.json"), "--out"]
    assert main([*common, str(tmp_path / "a.png")]) == 0
    assert main([*common, str(tmp_path / "b.png"), "--holdout", str(tmp_path / "depth.exr")]) == 0
    free, held = pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png")
    assert free[:, :32].max() > 100 and held[:, :32].max() == 0
    np.testing.assert_array_equal(held[:, 32:, :3], free[:, 32:])
    assert (held[:, 32:, 3] == 255).all()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            ["--level", "7"],
            "Cannot draw level 7: the bundle has no such level. Choose a level from 1 (coarsest) to 2.",
        ),
        (["--first", "2", "--last", "1"], "Levels 2 to 1 cannot be shown."),
        (["--gamma", "0"], "gamma = 0.0 is not possible. Give a number from 0.01 to 1000."),
        (["--offset", "1"], "The rule 'bands' has no option 'offset'. It has: gamma, first, last."),
        (["--gamma", "1", "--level", "1"], "Choose one."),
        (["--out", "a.gif"], "neither .png nor .exr"),
        (["--holdout", "gone.exr"], "There is no mesh depth gone.exr."),
        (["--size", "99999999x9"], "A picture of 99999999x9 pixels is not drawn."),
        (["--size", "32768x32768"], "A picture of 32768x32768 pixels is not drawn."),
        (["--size", "1" + 400 * "0" + "x9"], "is not drawn."),
        (["--backend", "magic"], 'Unknown rasterizer backend "magic".'),
    ],
)
def test_mistakes_are_told(bundle, camera, tmp_path, monkeypatch, capsys, options, sentence):
    monkeypatch.chdir(tmp_path)
    write_camera(tmp_path / "camera.json", camera, 0.01)
    common = ["render", str(bundle[0]), "--camera", "camera.json", "--out", "a.png"]
    assert main([*common, *options]) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.glob("a.*"))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"fx": None}, "The camera is not valid"),
        ({"width": 0}, "0x48 pixels cannot be drawn"),
        ({"width": 10**6}, "cannot be drawn"),
        ({"world_to_camera": np.zeros((4, 4)).tolist()}, "pose is no rotation"),
        ({"world_to_camera": [[1, 0], [0, 1]]}, "no 4x4 matrix"),
        ({"width": 10**400}, "too many digits"),
        ({"fx": 10**30}, "too many digits"),
        ({"fx": 1e-300}, "focal length of 1e-300, 62 pixels is impossible"),
        ({"cx": 1e300}, "principal point"),
        ({"near": -1}, "near depth"),
        ({"world_to_camera": (1e300 * np.eye(4)).tolist()}, "beyond 1e+12"),
        ({"world_to_camera": json.loads("[" * 900 + "]" * 900)}, "nests"),
        ({"near": float("nan")}, "near = nan is not a finite number"),
    ],
)
def test_impossible_cameras_are_told(bundle, camera, tmp_path, capsys, change, sentence):
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(camera_to_dict(camera, 0.01) | change))
    assert main(["render", str(bundle[0]), "--camera", str(file), "--out", str(tmp_path / "a.png")]) == 2
    assert sentence in capsys.readouterr().err
    file.write_text(json.dumps({"width": 3}))
    assert main(["render", str(bundle[0]), "--camera", str(file), "--out", str(tmp_path / "a.png")]) == 2
    assert "lacks 'height'" in capsys.readouterr().err


def test_little_memory_is_a_sentence(bundle, camera, tmp_path, capsys, monkeypatch):
    """Wherever it runs out: before drawing, on the way, and as torch says it of its own."""
    write_camera(tmp_path / "camera.json", camera, 0.01)
    words = [
        "render",
        str(bundle[0]),
        "--camera",
        str(tmp_path / "camera.json"),
        "--out",
        str(tmp_path / "a.png"),
    ]
    torchs = RuntimeError("[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory: 9")
    for place in (
        "image.RenderedImage.empty",
        "image.RenderedImage.eight_bit",
        "scene.rasterize_strips",
        "command.ResidentBundle",
    ):
        for error in (MemoryError(), torchs):

            def fail(*_, error=error, **__):
                raise error

            with monkeypatch.context() as patched:
                patched.setattr(f"training.render.{place}", fail)
                assert main(words) == 2
            assert "There is not enough memory" in capsys.readouterr().err
    assert not (tmp_path / "a.png").exists()


def test_what_has_no_views_says_so(bundle, tmp_path, capsys):
    out = ["--out", str(tmp_path / "a.png")]
    assert main(["render", str(bundle[0]), "--view", "a.jpg", *out]) == 2
    assert "does not know the photographs" in capsys.readouterr().err
    scene = write_tiny_scene(tmp_path / "scene")
    assert main(["render", str(bundle[0]), "--view", "a.jpg", "--scene", str(scene), *out]) == 2
    assert "No photograph is called a.jpg. There are: 00.jpg" in capsys.readouterr().err
    assert main(["render", str(tmp_path / "no.ply"), "--view", "a.jpg", *out]) == 2
    assert "There is no" in capsys.readouterr().err


def test_what_is_drawn_otherwise_is_said(make_splats, camera, tmp_path, capsys):
    write_camera(tmp_path / "camera.json", camera, 0.01)
    odd = make_splats(5)
    odd.means[0] = np.nan
    write_ply(tmp_path / "odd.ply", odd)
    levels = [Level(1, make_splats(5)), Level(2, make_splats(9))]
    write_bundle(tmp_path / "foreign.ply", Bundle("sundial", levels, "shadow"))

    def said(*words):
        out = tmp_path / "a.png"
        assert (
            main(["render", *map(str, words), "--camera", str(tmp_path / "camera.json"), "--out", str(out)])
            == 0
        )
        return capsys.readouterr().err

    assert said(tmp_path / "odd.ply").startswith("warning: ")
    text = said(tmp_path / "foreign.ply")
    assert text.count("\n") == 1 and "the rule 'shadow'" in text and "the finest level is shown" in text
    assert said(tmp_path / "foreign.ply", "--level", 1) == ""


@pytest.mark.parametrize("options", [[], ["--gamma", "2"], ["--background", "transparent"]])
def test_a_graphics_device_draws_what_the_cpu_draws(graphics, bundle, camera, tmp_path, options):
    """To one count of 255, in a thousandth of the values at most."""
    path, _ = bundle
    write_camera(tmp_path / "camera.json", camera.resized(640, 480), 0.01)
    found = []
    for backend in ("cpu", "gpu"):
        out = tmp_path / f"{backend}.png"
        common = ["render", str(path), "--camera", str(tmp_path / "camera.json"), "--out", str(out)]
        assert main([*common, "--backend", backend, *options]) == 0
        found.append(pixels(out).astype(int))
    apart = np.abs(found[0] - found[1])
    assert apart.max() <= 1 and (apart > 0).mean() <= 1e-3
    assert found[0][..., :3].std() > 10, "there is something to see"
