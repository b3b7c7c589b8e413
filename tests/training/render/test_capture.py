"""Splats alone become a scene: its pictures are theirs, its points lie on them, and LODGE trains from it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from training.__main__ import main
from training.errors import LodgsError
from training.rasterize import Gaussians, rasterize
from training.render.capture import dome, write_scene
from training.runs.folder import RunFolder
from training.scenes.cameras import write_camera
from training.scenes.colmap import read_scene
from training.scenes.images import load_image
from training.splats.bundle import read_bundle
from training.splats.gaussians import Splats
from training.splats.ply import write_ply


@pytest.fixture(scope="module")
def ball() -> Splats:
    """Opaque splats on a sphere of radius 2 about (5, -1, 3), and one astray far away."""
    rng = np.random.default_rng(1)
    out = rng.normal(size=(600, 3))
    means = 2 * out / np.linalg.norm(out, axis=1, keepdims=True) + [5, -1, 3]
    means[0] = [900, 0, 0]
    return Splats(
        means.astype(np.float32), np.tile(np.float32([1, 0, 0, 0]), (600, 1)),
        np.full((600, 3), np.log(0.12), np.float32), np.full(600, 4.0, np.float32),
        rng.normal(0, 1, (600, 1, 3)).astype(np.float32),
    )  # fmt: skip


def test_a_dome_shows_all_that_is_not_astray_from_all_sides(ball):
    views, near = dome(ball, 24, 96, 64)
    eyes = np.array([view.center for view in views]) - [5, -1, 3]
    assert np.linalg.norm(eyes.mean(axis=0)) < 0.25 * np.linalg.norm(eyes, axis=1).mean()
    for view in views:
        assert view.sees(ball.means[1:], near=near).all()
    assert 0 < near < np.linalg.norm(eyes, axis=1).min() - 2


def test_the_scene_has_the_splats_own_pictures_and_points_on_them(ball, tmp_path):
    views, near = dome(ball, 12, 96, 64)
    count = write_scene(tmp_path / "scene", ball, views, near, points=2000)
    scene = read_scene(tmp_path / "scene")
    assert len(scene.points) == count > 100 and len(scene.cameras) == 12
    away = np.linalg.norm(scene.points - [5, -1, 3], axis=1)
    assert np.quantile(np.abs(away - 2), 0.95) < 0.25
    for view, camera in zip(views, scene.cameras, strict=True):
        np.testing.assert_allclose(camera.world_to_camera, view.world_to_camera, atol=1e-9)
        drawn = rasterize(Gaussians.of(ball), view, near=near, backend="reference").image.numpy().clip(0, 1)
        photograph = load_image(camera.image, 96, 64)
        assert np.abs(photograph - drawn).mean() < 0.02  # it is a JPEG


def test_pictures_of_antialiased_splats_are_so(ball, tmp_path):
    views, near = dome(ball, 6, 96, 64)
    small = replace(ball, log_scales=ball.log_scales - np.float32(1))
    for view in views:
        write_camera(tmp_path / "cameras" / f"{view.name}.json", view, near)
    write_ply(tmp_path / "small.ply", small, ["SplatRenderMode: mip"])
    command = ["capture", str(tmp_path / "small.ply"), "--cameras", str(tmp_path / "cameras")]
    assert main([*command, "--out", str(tmp_path / "scene")]) == 0
    for view, camera in zip(views, read_scene(tmp_path / "scene").cameras, strict=True):
        photograph = load_image(camera.image, 96, 64)
        errors = [
            np.abs(
                rasterize(Gaussians.of(small), view, near=near, antialias=flag, backend="reference")
                .image.numpy()
                .clip(0, 1)
                - photograph
            ).mean()
            for flag in (True, False)
        ]
        assert errors[0] < 0.02 and errors[0] < errors[1] / 2


def test_nothing_is_overwritten_and_nothing_half_is_left(ball, tmp_path):
    views, near = dome(ball, 4, 48, 32)
    (tmp_path / "there").mkdir()
    with pytest.raises(LodgsError, match="exists already"):
        write_scene(tmp_path / "there", ball, views, near)
    unseen = Splats(**{**vars(ball), "means": ball.means + np.float32(1e4)})
    with pytest.raises(LodgsError, match="No two views"):
        write_scene(tmp_path / "new", unseen, views, near)
    assert [path.name for path in tmp_path.iterdir()] == ["there"] and not any((tmp_path / "there").iterdir())
    faint = Splats(**{**vars(ball), "opacity_logits": np.full(600, -3, np.float32)})
    with pytest.raises(LodgsError, match="no opaque splat"):
        dome(faint, 4)


@pytest.mark.slow
def test_from_a_ply_alone_to_levels_in_a_shell(ball, tmp_path, capsys):
    write_ply(tmp_path / "ball.ply", ball)
    views, near = dome(ball, 8, 96, 64)
    for view in views:
        write_camera(tmp_path / "cameras" / f"{view.name}.json", view, near)
    source, scene, run = (str(tmp_path / name) for name in ("ball.ply", "scene", "run"))
    assert main(["capture", source, "--out", scene, "--cameras", str(tmp_path / "cameras")]) == 0
    assert "8 views" in capsys.readouterr().out
    training = ["train", "--scene", scene, "--out", run, "--method", "lodge", "--base", source]
    assert main([*training, "--set", "tune_steps=4", "--set", "levels=2"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["event"] == "done"
    bundle = read_bundle(RunFolder(run).bundle)
    assert [level.number for level in bundle.levels] == [1, 2] and bundle.rule == "chunks"
    np.testing.assert_array_equal(bundle.levels[-1].splats.means, ball.means)


@pytest.mark.parametrize(
    ("words", "what"),
    [(["--cameras", "."], "no two camera files"), (["--views", "1"], "two views or more")],
)
def test_a_capture_says_what_it_lacks(ball, tmp_path, capsys, monkeypatch, words, what):
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "ball.ply", ball)
    assert main(["capture", "ball.ply", "--out", "scene", *words]) == 2
    assert what in capsys.readouterr().err and not (tmp_path / "scene").exists()
