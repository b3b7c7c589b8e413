"""Points triangulated with known cameras, compared with the surfaces that were photographed."""

import errno
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from training.__main__ import main
from training.scenes import triangulate
from training.scenes.cameras import look_at
from training.scenes.colmap import Scene, read_scene, scene_lenses
from training.scenes.images import write_png
from training.scenes.observations import observations
from training.scenes.sfm_known_poses import choose_pairs, epipolar_errors, match_descriptors, relative_pose
from training.scenes.triangulate import cached_points, triangulate_scene

from .walls import CAMERA_POSITIONS, FOCAL, HEIGHT, WIDTH, render_photo, wall_pose, write_walls

DISTORTION = 0.08


def distorted_rays() -> np.ndarray:
    """Rays (H, W, 2) of COLMAP's SIMPLE_RADIAL, inverted by fixed-point iterations."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    distorted = np.stack([x - WIDTH / 2, y - HEIGHT / 2], axis=-1) / FOCAL
    rays = distorted
    for _ in range(50):
        rays = distorted / (1 + DISTORTION * (rays**2).sum(axis=-1, keepdims=True))
    return rays


def surface_distance(points: np.ndarray) -> np.ndarray:
    """Distance (N,) to the floor z = 0 or the wall y = 1."""
    return np.minimum(np.abs(points[:, 2]), np.abs(points[:, 1] - 1))


@pytest.fixture(scope="module")
def walls(tmp_path_factory) -> Path:
    return write_walls(tmp_path_factory.mktemp("walls") / "scene")


@pytest.fixture(scope="module")
def result(walls, tmp_path_factory):
    """Return the scene with points and the reported messages."""
    reports = []
    scene = read_scene(walls)
    return triangulate_scene(
        scene, tmp_path_factory.mktemp("unused"), lambda *values: reports.append(values)
    ), reports


def triangulated_points(scene: Scene) -> np.ndarray:
    """Points (N, 3) with observations; the other ones are estimated."""
    observed = observations(scene, [camera.name for camera in scene.cameras])
    return scene.points[np.unique(np.concatenate(list(observed.values())))]


def test_points_lie_on_the_surfaces(result):
    scene, _ = result
    points = triangulated_points(scene)
    assert len(points) > 300 and scene.warnings == []
    errors = surface_distance(points)  # a pixel is 1 cm wide at the distance of 3
    assert np.median(errors) < 0.01 and np.quantile(errors, 0.9) < 0.05


def test_estimated_points_fill_the_photos(result):
    scene, (*_, (message, _, _)) = result
    count = int(message.split("estimated ")[1].split()[0].replace(",", ""))
    assert len(scene.points) - len(triangulated_points(scene)) == pytest.approx(count, abs=count // 100)
    for camera in scene.cameras:
        pixels = camera.project(scene.points[camera.sees(scene.points)])[0]
        assert len(np.unique(pixels // 20, axis=0)) == (WIDTH // 20) * (HEIGHT // 20)
    assert np.median(surface_distance(scene.points)) < 0.1


def test_observations_are_at_the_projections_of_the_points(result):
    scene, _ = result
    observed = observations(scene, [camera.name for camera in scene.cameras])
    assert sum(map(len, observed.values())) >= 2 * len(triangulated_points(scene))
    for camera in scene.cameras:
        assert camera.sees(scene.points[observed[camera.name]]).all()
        pixels, _ = camera.project(scene.points[observed[camera.name]])
        photo = render_photo(camera.center)
        x, y = pixels.astype(int).T
        difference = photo[y, x].astype(int) - scene.point_colors[observed[camera.name]]
        assert np.median(np.abs(difference)) < 20  # 70 for unrelated pixels


def test_progress_and_result_are_reported(result, walls):
    scene, reports = result
    *stages, (message, _, _) = reports
    assert list(dict.fromkeys(stage for stage, *_ in stages)) == list(triangulate.STAGES.values())
    count = len(triangulated_points(read_scene(walls, model=scene.point_model)))
    assert message.startswith(f"Triangulated {count:,} points from 6 photos, 0.")


def test_result_is_cached(result, walls, tmp_path, monkeypatch):
    scene, _ = result
    monkeypatch.setattr(triangulate.pycolmap_process, "run_program", None)
    repeated = triangulate_scene(read_scene(walls), tmp_path, lambda *values: None)
    for other in (repeated, cached_points(read_scene(walls))):
        assert np.array_equal(other.points, scene.points)
        assert np.array_equal(other.point_colors, scene.point_colors)
    assert len(cached_points(read_scene(shutil.copytree(walls / "..", tmp_path / "copy") / "scene")).points)


@pytest.mark.nightly
def test_repeated_triangulation_has_the_same_bits(result, walls, tmp_path):
    scene, _ = result
    copy = shutil.copytree(walls, tmp_path / "copy", ignore=shutil.ignore_patterns(".*"))
    repeated = triangulate_scene(read_scene(copy), tmp_path, lambda *values: None)
    for file in ("images.bin", "points3D.bin"):
        assert (repeated.point_model / file).read_bytes() == (scene.point_model / file).read_bytes()


def test_distorted_lens_and_masks(tmp_path):
    rays = distorted_rays()
    photos = [render_photo(position, rays) for position in CAMERA_POSITIONS]
    folder = write_walls(tmp_path / "scene", photos, DISTORTION)
    mask = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    mask[:, : WIDTH // 2] = 0
    (folder / "masks").mkdir()
    for number in range(len(photos)):
        write_png(folder / "masks" / f"{number}.png", mask)
    scene = triangulate_scene(read_scene(folder), tmp_path, lambda *values: None)
    points = triangulated_points(scene)
    assert len(points) > 100
    assert np.median(surface_distance(points)) < 0.01
    for camera in scene.cameras:
        rows = observations(scene, [camera.name])[camera.name]
        assert camera.project(scene.points[rows])[0][:, 0].min() > WIDTH / 2 - 3


def test_nothing_can_be_matched(tmp_path):
    folder = write_walls(tmp_path / "scene", [np.full((HEIGHT, WIDTH, 3), 90, np.uint8)] * 6)
    reports = []
    scene = triangulate_scene(read_scene(folder), tmp_path, lambda *values: reports.append(values))
    assert len(scene.points) == triangulate.RANDOM_POINTS
    assert reports[-1][0] == "Added 30,000 random points"
    (warning,) = scene.warnings
    assert "only 0 points match between 6 photos" in warning and "Export the points too" in warning


def test_time_limit(walls, tmp_path, monkeypatch):
    monkeypatch.setattr(triangulate, "MAX_SECONDS", 0.0)
    copy = shutil.copytree(walls, tmp_path / "copy", ignore=shutil.ignore_patterns(".*"))
    scene = triangulate_scene(read_scene(copy), tmp_path, lambda *values: None)
    assert len(scene.points) == triangulate.RANDOM_POINTS
    assert any("stopped after 0 s, with features of 0 of 6" in warning for warning in scene.warnings)


def test_interruption_leaves_nothing(walls, tmp_path):
    copy = shutil.copytree(walls, tmp_path / "copy", ignore=shutil.ignore_patterns(".*"))

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        triangulate_scene(read_scene(copy), tmp_path, interrupt)
    assert list((copy / triangulate.CACHE_FOLDER).iterdir()) == []


def test_command_writes_points(walls, tmp_path, capsys):
    shutil.copytree(walls / "images", tmp_path / "images")
    frames = []
    for number, position in enumerate(CAMERA_POSITIONS):
        pose = np.linalg.inv(wall_pose(position)) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{number}.png", "transform_matrix": pose.tolist()})
    document = {"fl_x": FOCAL, "w": WIDTH, "h": HEIGHT, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert main(["scene", "--from", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    scene = read_scene(tmp_path)
    assert f"6 views, {len(scene.points):,} points" in printed.out and "Triangulated" in printed.err
    assert np.median(surface_distance(triangulated_points(scene))) < 0.01 and scene.warnings == []
    assert observations(scene, ["0.png"]) and [p.name for p in (tmp_path / "sparse").iterdir()] == ["0"]


@pytest.mark.nightly
def test_command_can_be_repeated_after_a_full_disk(walls, tmp_path, capsys, monkeypatch):
    source = Path(shutil.copytree(walls, tmp_path / "scene", ignore=shutil.ignore_patterns(".*")))
    words = ["scene", "--from", str(source), "--out", str(tmp_path / "out")]

    def fill_disk(stage, done, total):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("training.cli.scene._print_progress", fill_disk)
        assert main(words) == 2
    output = capsys.readouterr().err
    assert f"Cannot write COLMAP scene {tmp_path / 'out'}: No space left" in output
    assert "Free some space" in output
    assert not any((tmp_path / "out" / "sparse").iterdir())
    assert main(words) == 0 and len(read_scene(tmp_path / "out").points)


def test_command_adds_points_to_a_colmap_scene(walls, tmp_path, capsys):
    source = Path(shutil.copytree(walls, tmp_path / "scene", ignore=shutil.ignore_patterns(".*")))
    model = {path.name: path.read_bytes() for path in (source / "sparse" / "0").iterdir()}
    assert main(["scene", "--from", str(source), "--out", str(tmp_path / "out")]) == 0
    scene = read_scene(tmp_path / "out")
    printed = capsys.readouterr()
    assert f"out: 6 views, {len(scene.points):,} points, from COLMAP" in printed.out
    assert "no points" not in printed.err
    assert np.median(surface_distance(triangulated_points(scene))) < 0.01 and scene.warnings == []
    assert main(["scene", "--from", str(source)]) == 0
    assert {path.name: path.read_bytes() for path in (source / "sparse" / "0").iterdir()} == model
    np.testing.assert_array_equal(cached_points(read_scene(source)).points, scene.points)
    assert main(["scene", "--from", str(tmp_path / "out")]) == 2
    assert "already is a COLMAP scene" in capsys.readouterr().err


def test_lens_is_kept_if_nothing_can_be_matched(tmp_path):
    photos = [np.full((HEIGHT, WIDTH, 3), 90, np.uint8)] * 6
    write_walls(tmp_path / "scene", photos, DISTORTION)
    assert main(["scene", "--from", str(tmp_path / "scene"), "--out", str(tmp_path / "out")]) == 0
    scene = read_scene(tmp_path / "out")
    assert len(scene.distorted) == 6 and len(scene.points) == triangulate.RANDOM_POINTS


def test_lens_of_a_turned_photo_is_that_of_its_camera(tmp_path):
    walls = write_walls(tmp_path / "scene", [np.zeros((WIDTH, HEIGHT, 3), np.uint8)] * 6)  # stored upright
    for path in (walls / "images").iterdir():
        exif = Image.Exif()
        exif[274] = 6
        Image.new("RGB", (HEIGHT, WIDTH)).save(path, "JPEG", exif=exif)
    scene = read_scene(walls)
    (camera, lens), *_ = zip(scene.cameras, scene_lenses(scene), strict=True)
    assert (lens.width, lens.height) == (HEIGHT, WIDTH)
    assert (
        lens.pinhole == (FOCAL, FOCAL, HEIGHT / 2, WIDTH / 2) == (camera.fx, camera.fy, camera.cx, camera.cy)
    )


def test_pairs_are_close_and_look_the_same_way():
    angles = np.radians(np.arange(0, 360, 10))
    directions = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    pairs = np.array(choose_pairs(-5 * directions, directions))
    steps = np.abs(pairs[:, 0] - pairs[:, 1])
    steps = np.minimum(steps, 36 - steps)
    assert steps.max() <= 6 and (np.bincount(pairs.ravel(), minlength=36) >= 10).all()
    assert (steps[:36] == 1).all() and len(np.unique(pairs, axis=0)) == len(pairs)


def test_epipolar_errors_of_a_shifted_pixel():
    first, second = (look_at(np.array(p), np.zeros(3), (0, 0, 1)) for p in ((0.0, -4, 0), (1.0, -4, 0)))
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    views = [points @ pose[:3, :3].T + pose[:3, 3] for pose in (first, second)]
    rays, other_rays = (view[:, :2] / view[:, 2:] for view in views)
    relative = relative_pose(first[:3], second[:3])
    assert epipolar_errors(rays, other_rays, relative).max() < 1e-12
    shifted = epipolar_errors(rays, other_rays + np.array([0, 0.01]), relative)  # across the epipolar lines
    np.testing.assert_allclose(shifted, 0.01 / np.sqrt(2), rtol=0.1)  # half of the correction in each photo


def test_ambiguous_descriptors_do_not_match():
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 2, (50, 128)) * rng.integers(1, 200, (50, 128))
    descriptors = (512 * descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.uint8)
    order = rng.permutation(50)
    assert (match_descriptors(descriptors[order], descriptors) == np.stack([np.arange(50), order], 1)).all()
    repeated = np.concatenate([descriptors, descriptors[:10]])
    assert set(match_descriptors(descriptors, repeated)[:, 0]) == set(range(10, 50))
    assert match_descriptors(descriptors[:1], descriptors).shape == (0, 2)
