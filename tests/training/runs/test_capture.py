"""Capture of splats as a COLMAP scene: its images and points match the splats, and LODGE trains from it."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest

from training.__main__ import main
from training.errors import LodgsError
from training.evaluate.costs import cost_curves
from training.rasterize import Gaussians, rasterize
from training.runs import capture
from training.runs.capture import write_scene
from training.runs.data import training_data
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.scenes.cameras import read_camera_folder, write_camera
from training.scenes.colmap import read_scene
from training.scenes.images import load_image
from training.scenes.overview import central_ball
from training.scenes.view_tables import make_view_tables
from training.scenes.viewpoints import (
    aerial_views,
    close_views,
    dome_views_around,
    opaque_means,
    surrounding_views,
    walk_views,
)
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply


@pytest.fixture(scope="module")
def ball() -> Splats:
    """Opaque splats on a sphere of radius 2 around (5, -1, 3), and one outlier far away."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(600, 3))
    means = 2 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + [5, -1, 3]
    means[0] = [900, 0, 0]
    return Splats(
        means.astype(np.float32), np.tile(np.float32([1, 0, 0, 0]), (600, 1)),
        np.full((600, 3), np.log(0.12), np.float32), np.full(600, 4.0, np.float32),
        rng.normal(0, 1, (600, 1, 3)).astype(np.float32),
    )  # fmt: skip


def dome_views(splats: Splats, count: int, width: int = 960, height: int = 640):
    return dome_views_around(central_ball(opaque_means(splats)), count, width, height)


def test_dome_views_surround_all_splats_except_outliers(ball):
    views, near = dome_views(ball, 24, 96, 64)
    centers = np.array([view.center for view in views]) - [5, -1, 3]
    assert np.linalg.norm(centers.mean(axis=0)) < 0.25 * np.linalg.norm(centers, axis=1).mean()
    for view in views:
        assert view.sees(ball.means[1:], near=near).all()
    assert 0 < near < np.linalg.norm(centers, axis=1).min() - 2


def test_far_background_does_not_push_views_away():
    """A subject of radius 2 within a fifth of the splats at 100 to 200 units, as a sky or hills."""
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(5000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = directions * np.where(np.arange(5000) % 5, 2, rng.uniform(100, 200, 5000))[:, None]
    views, _ = surrounding_views(points, 20)
    distances = np.linalg.norm([view.center for view in views], axis=1)
    assert distances.max() < 30
    assert all(view.sees(2 * np.eye(3)).all() for view in views if view.name.startswith("dome"))


def test_close_views_see_free_surfaces_at_their_distances():
    """A room with walls of 4 x 4 x 4 units and a ball in the middle; walls hide no target."""
    rng = np.random.default_rng(2)
    walls = rng.uniform(-2, 2, (6000, 3))
    walls[np.arange(6000), rng.integers(3, size=6000)] = rng.choice([-2, 2], 6000)
    ball = rng.normal(size=(3000, 3))
    ball *= 0.5 / np.linalg.norm(ball, axis=1, keepdims=True)
    points = np.concatenate([walls, ball])
    views = close_views(points, 24)
    diameter = 2 * np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.9)
    inside = hidden = 0
    for number, view in enumerate(views):
        distance = diameter * (0.25, 0.5, 1.0)[number % 3]
        target = view.center + distance * view.world_to_camera[2, :3]
        assert np.linalg.norm(points - target, axis=1).min() < 1e-6
        inside += bool((np.abs(view.center) < 2).all())
        if number % 3 == 0:
            offsets = points - view.center
            along = offsets @ view.world_to_camera[2, :3]
            aside = np.linalg.norm(offsets - along[:, None] * view.world_to_camera[2, :3], axis=1)
            hidden += ((along > 0.1 * distance) & (along < 0.85 * distance) & (aside < 0.05)).any()
    assert inside >= 6 and hidden <= 1
    views, _ = surrounding_views(points, 9)
    assert [view.name.split("_")[0] for view in views] == ["dome"] * 5 + ["close"] * 4


@pytest.mark.parametrize("count", [4, 0])
def test_own_cameras_of_a_bundle_are_used(ball, tmp_path, count):
    views, near = dome_views(ball, count or 2, 96, 64)
    views = [replace(view, name=f"view_{number}.jpg") for number, view in enumerate(views)]
    tables = make_view_tables(views, near) if count else {}
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, ball)], tables=tables))
    number = 2 if count else 12
    count, _ = capture.capture(tmp_path / "b.ply", tmp_path / "scene", "auto", number, 48, backend="cpu")
    scene = read_scene(tmp_path / "scene")
    assert count == len(scene.cameras) == number and {camera.width for camera in scene.cameras} == {48}
    if tables:
        placed = [view.center for view in views]
        assert all(np.isclose(camera.center, placed, atol=1e-6).all(axis=1).any() for camera in scene.cameras)
    else:
        assert [camera.name.split("_")[0] for camera in scene.cameras] == ["close"] * 6 + ["dome"] * 6


def test_views_of_a_bundle_are_captured_into_one_folder(ball, tmp_path):
    """Bundles name views like photos, in subfolders; a foreign bundle's names may leave the folder."""
    names = ["left/a.jpg", "right/a.jpg", "3_right_A.jpg", "right\\A.jpg", "../../out", ""]
    names.append(str(tmp_path / "absolute"))
    views, near = dome_views(ball, len(names), 48, 32)
    views = [replace(view, name=name) for view, name in zip(views, names, strict=True)]
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, ball)], tables=make_view_tables(views, near)))
    capture.capture(tmp_path / "b.ply", tmp_path / "a" / "scene", "auto", 8, 48, backend="cpu")
    images = sorted(path.name for path in (tmp_path / "a" / "scene" / "images").iterdir())
    assert len(images) == len(names) and {"left_a.jpg.jpg", "right_a.jpg.jpg"} < set(images)
    assert capture.is_complete(tmp_path / "a" / "scene")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b.ply"]


def test_captured_images_and_points_match_the_splats(ball, tmp_path):
    views, near = dome_views(ball, 12, 96, 64)
    count = write_scene(tmp_path / "scene", ball, views, near, points=2000)
    scene = read_scene(tmp_path / "scene")
    assert len(scene.points) == count > 100 and len(scene.cameras) == 12
    radii = np.linalg.norm(scene.points - [5, -1, 3], axis=1)
    assert np.quantile(np.abs(radii - 2), 0.95) < 0.25
    for view, camera in zip(views, scene.cameras, strict=True):
        np.testing.assert_allclose(camera.world_to_camera, view.world_to_camera, atol=1e-9)
        rendering = rasterize(Gaussians.of(ball), view, near=near, backend="reference")
        photo = load_image(camera.image, 96, 64)
        error = np.abs(photo - rendering.image.numpy().clip(0, 1)).mean()
        assert error < 0.02  # the photo is a JPEG


def test_captured_images_of_antialiased_splats_are_antialiased(ball, tmp_path):
    views, near = dome_views(ball, 6, 96, 64)
    small = replace(ball, log_scales=ball.log_scales - np.float32(1))
    for view in views:
        write_camera(tmp_path / "cameras" / f"{view.name}.json", view, near)
    write_ply(tmp_path / "small.ply", small, ["SplatRenderMode: mip"])
    command = ["capture", str(tmp_path / "small.ply"), "--cameras", str(tmp_path / "cameras")]
    assert main([*command, "--out", str(tmp_path / "scene")]) == 0
    for view, camera in zip(views, read_scene(tmp_path / "scene").cameras, strict=True):
        photo = load_image(camera.image, 96, 64)
        errors = [
            np.abs(
                rasterize(Gaussians.of(small), view, near=near, antialias=flag, backend="reference")
                .image.numpy()
                .clip(0, 1)
                - photo
            ).mean()
            for flag in (True, False)
        ]
        assert errors[0] < 0.02 and errors[0] < errors[1] / 2


def test_capture_overwrites_nothing_and_leaves_no_partial_scene(ball, tmp_path):
    views, near = dome_views(ball, 4, 48, 32)
    (tmp_path / "existing").mkdir()
    with pytest.raises(LodgsError, match="already exists"):
        write_scene(tmp_path / "existing", ball, views, near)
    unseen = Splats(**{**vars(ball), "means": ball.means + np.float32(1e4)})
    with pytest.raises(LodgsError, match="no two views"):
        write_scene(tmp_path / "new", unseen, views, near)
    assert [path.name for path in tmp_path.iterdir()] == ["existing"] and not any(
        (tmp_path / "existing").iterdir()
    )
    faint = Splats(**{**vars(ball), "opacity_logits": np.full(600, -3, np.float32)})
    with pytest.raises(LodgsError, match="no opaque splat"):
        dome_views(faint, 4)


@pytest.mark.parametrize("damaged", ["sparse/0/images.bin", "sparse/0/points3D.bin", "images/dome_0001.jpg"])
def test_damaged_captured_views_are_rendered_again(ball, tmp_path, damaged):
    run = RunFolder(tmp_path / "run")
    run.create()
    write_ply(run.base, ball)
    keys = {"scene": "", "base": str(run.base), "out": str(run.path), "method": "lodge", "capture": "dome"}
    job = Job.from_dict({**keys, "views": 4, "view_width": 48, "image_scale": 1.0})
    training_data(job, run)
    files = sorted(path for path in run.captured.rglob("*") if path.is_file())
    before = [path.read_bytes() for path in files]
    path = run.captured / damaged
    path.write_bytes(path.read_bytes()[:-20])
    reports = []
    training_data(job, run, lambda kind, **values: reports.append(f"{kind}: {values['message']}"))
    assert [path.read_bytes() for path in files] == before
    assert reports[0].startswith("warning: ") and "damaged. They are rendered again" in reports[0]


def test_exposures_of_renders_are_not_compared(ball, tmp_path, monkeypatch):
    """They are equal; colours that depend on the view would look like differences."""
    compared = []
    monkeypatch.setattr("training.runs.data.exposure_gains", lambda *_: compared.append(1) or {})
    run = RunFolder(tmp_path / "run")
    run.create()
    write_ply(run.base, ball)
    keys = {"scene": "", "base": str(run.base), "out": str(run.path), "method": "lodge", "capture": "dome"}
    training_data(Job.from_dict({**keys, "views": 4, "view_width": 48, "image_scale": 1.0}), run)
    assert not compared
    photos = RunFolder(tmp_path / "photos")
    training_data(Job(str(run.captured), str(photos.path), image_scale=1.0), photos)
    assert compared


def test_views_along_a_path_are_level_and_look_in_all_directions(ball):
    path = np.array([[0, 0, 0], [3, 0, 0], [3, 0, 0], [3, 0.6, 9]], float)  # -y is up: it descends slightly
    views, near = walk_views(ball, path, np.array([0.0, -2, 0]), 24, 96, 64)
    centers = np.array([view.center for view in views])
    on_first = centers[:, 2] < 1e-9
    np.testing.assert_allclose(centers[on_first, 1:], 0, atol=1e-9)
    np.testing.assert_allclose(centers[~on_first, 0], 3, atol=1e-9)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert np.median(steps) == pytest.approx((3 + np.hypot(0.6, 9)) / 24)
    _, down, ahead = np.array([view.world_to_camera[:3, :3] for view in views]).transpose(1, 0, 2)
    np.testing.assert_allclose(ahead[:, 1], 0, atol=1e-9)
    np.testing.assert_allclose(down, np.tile([0, 1, 0], (24, 1)), atol=1e-9)
    np.testing.assert_allclose(ahead[0], [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(ahead[-6], [0, 0, 1], atol=1e-9)
    headings = np.sort(np.degrees(np.arctan2(ahead[-6:, 0], ahead[-6:, 2])) % 360)
    np.testing.assert_allclose(np.diff(headings), 60, atol=1e-9)
    turned = np.cross(ahead[-6], ahead[-5])  # views turn to the left first, with -y up
    assert turned[1] < 0 < near < 1
    for invalid in (path[:1], np.array([[0, 0, 0], [0, 5, 0]], float)):
        with pytest.raises(LodgsError, match="no length or is vertical"):
            walk_views(ball, invalid, np.array([0.0, -1, 0]), 6)


def test_aerial_views_show_an_area_from_all_directions():
    ground = np.array([(x, y, z) for x in (-30, 30) for y in (5, 35) for z in (1, 4)], float)
    views, near = aerial_views(ground, 200, 96, 64)
    centers = np.array([view.center for view in views])
    raised = centers[0, 2] - 4
    np.testing.assert_allclose(centers[:, 2], 4 + raised)
    assert raised == pytest.approx(2 * 3) and 0 < near < 0.1 * raised, "a grid of 20 x 10 views, 3 m apart"
    looks = np.array([view.world_to_camera[2, :3] for view in views])
    targets = centers + looks * (raised / -looks[:, 2:])  # intersections of the optical axes with the top
    for axis, (low, high, count) in enumerate([(-30, 30, 20), (5, 35, 10)]):
        middles = low + (np.arange(count) + 0.5) / count * (high - low)
        np.testing.assert_allclose(np.unique(targets[:, axis].round(6)), middles)
    kinds, counts = np.unique(looks.round(6), axis=0, return_counts=True)
    assert len(kinds) == 5 and (counts == 40).all()
    np.testing.assert_allclose(np.abs(looks[:, 2]), np.where(np.abs(looks[:, 2]) > 0.9, 1, np.sqrt(0.5)))
    positions = np.random.default_rng(0).uniform((-30, 5, 1), (30, 35, 4), (300, 3))
    assert np.sum([view.sees(positions) for view in views], axis=0).min() >= 4
    assert aerial_views(ground, 200, altitude=11.0)[0][7].center[2] == pytest.approx(15)
    line, _ = aerial_views(np.array([[0, 0, 0], [0, 9, 0]], float), 9)
    np.testing.assert_allclose(np.ptp([view.center[2] for view in line]), 0, atol=1e-9)
    for invalid, message in ((ground[:0], "no opaque"), (ground[:1], "no extent")):
        with pytest.raises(LodgsError, match=message):
            aerial_views(invalid, 9)


@pytest.fixture
def cameras(ball, tmp_path):
    """Folder of camera files with two different lenses."""
    views, near = dome_views(ball, 8, 96, 64)
    for number, view in enumerate(views):
        write_camera(
            tmp_path / "cameras" / f"{view.name}.json", view.resized(48, 32) if number % 2 else view, near
        )
    return tmp_path / "cameras"


def test_captured_views_may_have_different_lenses(ball, cameras, tmp_path):
    views, near = read_camera_folder(cameras)
    assert near > 0 and len({view.focal for view in views}) == 2
    assert write_scene(tmp_path / "scene", ball, views, near, points=2000) > 10
    for view, camera in zip(views, read_scene(tmp_path / "scene").cameras, strict=True):
        assert camera.name == f"{view.name}.jpg"
        assert (camera.width, camera.fx, camera.cy) == (view.width, view.fx, view.cy)
        np.testing.assert_allclose(camera.world_to_camera, view.world_to_camera, atol=1e-9)


QUICK = ["--set", "tune_steps=4", "--set", "levels=2", "--image-scale", "1"]


@pytest.mark.slow
def test_train_levels_from_a_ply_without_photos(ball, cameras, tmp_path, capsys):
    """With separate capture and train commands, and with one: the same views give the same levels."""
    write_ply(tmp_path / "ball.ply", ball)
    source, scene = str(tmp_path / "ball.ply"), str(tmp_path / "scene")
    assert main(["capture", source, "--out", scene, "--cameras", str(cameras)]) == 0
    assert "8 views" in capsys.readouterr().out
    training = ["train", *QUICK, "--method", "lodge", "--base", source]
    for name, source_options in (("two", ["--scene", scene]), ("one", ["--capture", str(cameras)])):
        assert main([*training, *source_options, "--out", str(tmp_path / name)]) == 0
        assert json.loads(capsys.readouterr().out.splitlines()[-1])["event"] == "done"
    two, one = (read_bundle(RunFolder(tmp_path / name).bundle) for name in ("two", "one"))
    assert [level.number for level in one.levels] == [1, 2] and one.rule == "chunks"
    finest = one.levels[-1].splats
    finest, base = (splats.select(np.lexsort(splats.means.T)) for splats in (finest, ball))
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        np.testing.assert_array_equal(getattr(finest, name), getattr(base, name))
    np.testing.assert_array_equal(finest.sh[:, :1], base.sh)
    np.testing.assert_array_equal(one.levels[0].splats.means, two.levels[0].splats.means)
    assert len(cost_curves(one.meta)) == 1 and (tmp_path / "one" / "costs.png").stat().st_size > 1000
    messages = [event.get("message", "") for event in RunFolder(tmp_path / "one").events()[0]]
    views = [message for message in messages if message.startswith("Rendering view")]
    assert views == [f"Rendering view {number} of 8" for number in range(1, 9)]


@pytest.mark.slow
def test_cancelled_capture_leaves_no_files_and_resumes_after_the_run_was_moved(
    ball, tmp_path, capsys, monkeypatch
):
    run = RunFolder(tmp_path / "run")
    run.create()
    write_ply(run.base, ball)
    words = [
        "--base",
        str(run.base),
        "--capture",
        "dome",
        "--views",
        "6",
        "--view-width",
        "48",
        "--seed",
        "1",
    ]
    original = capture.rasterize

    def cancelled(*arguments, **options):
        run.request_cancel()
        time.sleep(1000)
        raise AssertionError("not interrupted")

    monkeypatch.setattr(capture, "rasterize", cancelled)
    assert main(["train", *QUICK, "--method", "lodge", *words, "--out", str(run.path)]) == 3
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["event"] == "cancelled"
    assert not run.captured.exists() and not list(run.path.glob(".captured*"))
    monkeypatch.setattr(capture, "rasterize", original)
    moved = RunFolder(run.path.rename(tmp_path / "moved"))
    assert main(["train", str(moved.job)]) == 0
    assert len(list((moved.captured / "images").iterdir())) == 6 and read_bundle(moved.bundle).levels
    assert main(["evaluate", str(moved.path)]) == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--cameras", "."], "camera files"), (["--views", "1"], "views = 1")],
)
def test_capture_reports_missing_views(ball, tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "ball.ply", ball)
    assert main(["capture", "ball.ply", "--out", "scene", *words]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "scene").exists()
