"""Check of a scene before training."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from training.__main__ import main
from training.scenes.check import MAX_REPROJECTION, check_folder, check_scene
from training.scenes.colmap import read_scene, scene_lenses
from training.scenes.lenses import make_intrinsics
from training.scenes.observations import observed_pixels, reprojection_errors
from training.scenes.write_colmap import write_model

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


@pytest.fixture(autouse=True)
def no_estimate(monkeypatch):
    """Leave out the estimate, which takes seconds; ``runs/test_estimate.py`` tests it."""
    monkeypatch.setattr("training.cli.train.estimate_lines", lambda job: [])


@pytest.fixture
def copy(tmp_path):
    return Path(shutil.copytree(GARDEN, tmp_path / "scene"))


def texts(findings):
    return "\n".join(f"{finding.severity}: {finding}" for finding in findings)


def test_good_scene_has_no_findings(capsys):
    (coverage,) = check_folder(GARDEN)
    assert coverage.severity == "info" and "half of the scene is seen by" in coverage.what
    assert main(["train", str(GARDEN), "--check"]) == 0
    assert capsys.readouterr().out == f"info: {coverage}\nNothing found that lowers the quality.\n"


def test_missing_photos_are_counted(copy, capsys):
    for file in sorted((copy / "images").iterdir())[:3]:
        file.unlink()
    assert main(["train", "--scene", str(copy), "--check"]) == 0
    printed = capsys.readouterr().out
    assert "warning: 3 of " in printed and f"Copy their photos to {copy / 'images'}" in printed


def test_scene_that_cannot_be_read_is_an_error(tmp_path, capsys):
    assert main(["train", str(tmp_path), "--check"]) == 2
    assert capsys.readouterr().out.startswith("error: Cannot read scene: ")
    assert list(tmp_path.iterdir()) == []


def test_few_and_tiny_photos():
    scene = read_scene(GARDEN)
    side = max(scene.cameras[0].width, scene.cameras[0].height)
    few = replace(scene, cameras=scene.cameras[:5], names=scene.names[:5])
    assert "only 5 views" in texts(check_scene(few))
    assert check_scene(replace(scene, cameras=scene.cameras[:1]))[0].severity == "error"
    findings = texts(check_scene(scene, image_scale=100 / side))
    assert (
        f"{len(scene.cameras)} of {len(scene.cameras)} photos have fewer" in findings and "100)" in findings
    )


def test_scene_without_points(copy):
    (copy / "sparse" / "0" / "points3D.bin").unlink()
    (finding,) = [finding for finding in check_folder(copy) if "no points" in finding.what]
    assert finding.severity == "warning" and finding.remedy.startswith("Export the points")


def test_views_without_overlap(monkeypatch):
    scene = read_scene(GARDEN)
    names = [camera.name for camera in scene.cameras]
    half, remaining = len(names) // 2, len(names) - len(names) // 2 - 1
    rows = {name: np.arange(100) + 200 * (number >= half) for number, name in enumerate(names)}
    rows[names[-1]] = np.arange(19)
    monkeypatch.setattr("training.scenes.check.observations", lambda scene, names: rows)
    isolated, groups = [finding for finding in check_scene(scene) if "views" in finding.what]
    assert f"1 of {len(names)} views share fewer" in isolated.what and names[-1] in isolated.what
    assert f"2 groups without common points, the largest of {half} and {remaining} views" in groups.what


def test_photos_of_other_exposure(copy):
    file = sorted((copy / "images").iterdir())[4]
    pixels = np.asarray(Image.open(file).convert("RGB"))
    Image.fromarray((pixels * 0.6).astype(np.uint8)).save(file, quality=97)
    findings = texts(check_folder(copy))
    assert (
        "Exposure or white balance differs" in findings
        and file.name in findings
        and "match_exposure" in findings
    )


def test_parts_that_few_photos_see(monkeypatch):
    scene = read_scene(GARDEN)
    names = [camera.name for camera in scene.cameras]
    count = len(scene.points)
    rows = {name: np.arange(count // 2) for name in names}
    rows[names[0]] = rows[names[-1]] = np.arange(count)  # two photos see the second half
    monkeypatch.setattr("training.scenes.check.observations", lambda scene, names: rows)
    coverage, weak = check_scene(scene)
    assert "a tenth by 2 or fewer" in coverage.what and coverage.severity == "info"
    assert "seen by fewer than 3 photos" in weak.what and weak.severity == "warning"
    close = {name: np.arange(count) for name in names[:3]}
    monkeypatch.setattr("training.scenes.check.observations", lambda scene, names: close)
    assert "within 5° only" in texts(check_scene(scene))


def rewrite(folder, pose=np.array, pixels=np.array, lens=None, tracks=True):
    """Write the garden again with other poses, 2D points or lenses, as faulty exports; return the scene."""
    scene = read_scene(GARDEN)
    names = [camera.name for camera in scene.cameras]
    observed = observed_pixels(scene, names)
    shutil.rmtree(folder / "sparse", ignore_errors=True)
    write_model(
        folder / "sparse" / "0",
        [lens] * len(names) if lens else scene_lenses(scene),
        [(camera.name, pose(camera.world_to_camera)) for camera in scene.cameras],
        scene.points,
        scene.point_colors,
        [(observed[name][0], pixels(observed[name][1])) for name in names] if tracks else None,
    )
    return read_scene(folder)


def center_as_translation(pose):
    pose = pose.copy()
    pose[:3, 3] = np.linalg.inv(pose)[:3, 3]
    return pose


def inverse_rotation(pose):
    pose = pose.copy()
    pose[:3, :3] = pose[:3, :3].T
    return pose


@pytest.mark.parametrize("pose", [center_as_translation, inverse_rotation, np.linalg.inv])
def test_poses_that_contradict_observations(copy, pose):
    (finding,) = [finding for finding in check_scene(rewrite(copy, pose)) if "poses" in finding.what]
    assert finding.severity == "warning" and "48 of 48 tested views have a median repr" in finding.what
    assert "camera-to-world" in finding.remedy


def test_poses_that_see_no_points(copy):
    assert "poses" not in texts(check_scene(rewrite(copy, tracks=False)))
    findings = texts(check_scene(rewrite(copy, np.linalg.inv, tracks=False)))
    assert "48 of 48 tested views have no points in front of the camera" in findings


def test_distortion_is_no_wrong_pose(copy):
    (lens, *_), radial = scene_lenses(read_scene(GARDEN)), -0.5
    fx, _, cx, cy = lens.pinhole
    center = np.array([cx, cy])

    def distort(pixels):
        rays = (pixels - center) / fx
        return fx * rays * (1 + radial * np.square(rays).sum(axis=1, keepdims=True)) + center

    distorted = make_intrinsics("SIMPLE_RADIAL", lens.width, lens.height, np.array([fx, cx, cy, radial]))
    scene = rewrite(copy, pixels=distort, lens=distorted)
    errors = reprojection_errors(scene, scene.names)
    assert len(errors) == 48 and max(errors.values()) < MAX_REPROJECTION


@pytest.mark.parametrize("size", [1, 2])
def test_lenses_for_another_image_size(copy, size):
    (lens, *_) = scene_lenses(read_scene(GARDEN))
    other = make_intrinsics("PINHOLE", size * lens.width, size * lens.height, np.array(lens.pinhole))
    findings = texts(check_scene(rewrite(copy, lens=other, tracks=False)))
    expected = "48 of 48 views are far from the image centre, at 25% of the width and 25% of the height."
    assert (expected in findings) == (size == 2)


@pytest.mark.parametrize("factor", [0, 0.5, 4])
def test_observations_at_other_pixels_are_ignored(copy, factor):
    """Programs write zeros, or scale photos and lenses but not the 2D points."""
    scene = rewrite(copy, pixels=lambda pixels: factor * pixels)
    assert not reprojection_errors(scene, scene.names) and "poses" not in texts(check_scene(scene))


def test_text_models_have_the_same_errors(copy):
    scene = rewrite(copy, center_as_translation)
    pycolmap.Reconstruction(scene.model).write_text(scene.model)
    expected = reprojection_errors(scene, scene.names)
    for file in scene.model.glob("*.bin"):
        file.unlink()
    assert reprojection_errors(read_scene(copy), scene.names) == pytest.approx(expected, rel=1e-6)
