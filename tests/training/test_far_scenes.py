"""Scenes and splats far from 0, as in UTM coordinates: local origins in every reader and writer.

Expected values come from the same scene at 0, moved in float64.
"""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from tests.training.conftest import write_tiny_scene
from tests.training.scenes import export_helpers, test_formats, test_metashape
from training import api
from training.__main__ import main
from training.errors import LodgsError
from training.runs.base import read_base
from training.scenes.cameras import read_camera, write_camera
from training.scenes.check import check_folder
from training.scenes.colmap import read_scene
from training.scenes.colmap_model import read_points, read_poses
from training.splats.bundle import read_bundle, read_header, write_bundle
from training.splats.gaussians import Splats
from training.splats.level_folder import read_folder, read_origin, write_folder
from training.splats.levels import Bundle, Level
from training.splats.origin import choose_origin
from training.splats.ply import read_ply, write_ply

OFFSET = np.array([500_000.0, 4_200_000.0, 300.0])
TRAINING = {"method": "3dgs", "image_scale": 1.0, "backend": "cpu", "test_every": 3}


def move_scene(folder: Path, offset: np.ndarray) -> Path:
    """Move the text model of ``write_tiny_scene``; points become multiples of 1/1024, which stay exact."""
    model = folder / "sparse" / "0"
    points = [line.split() for line in (model / "points3D.txt").read_text().splitlines()]
    for point in points:
        moved = np.round(np.array(point[1:4], float) * 1024) / 1024 + offset
        point[1:4] = [f"{value:.17g}" for value in moved]
    (model / "points3D.txt").write_text("".join(" ".join(point) + "\n" for point in points))
    poses = {pose.name: pose.world_to_camera for pose in read_poses(model)}
    lines = []
    for line in filter(None, (model / "images.txt").read_text().splitlines()):
        number, *quaternion = line.split()[:5]
        pose = poses[line.split()[-1]]
        translation = pose[:3, 3] - pose[:3, :3] @ offset
        values = " ".join(f"{value:.17g}" for value in translation)
        lines.append(f"{number} {' '.join(quaternion)} {values} 1 {line.split()[-1]}\n\n")
    (model / "images.txt").write_text("".join(lines))
    return folder


def splats(count: int = 50, size: float = 1.0) -> Splats:
    rng = np.random.default_rng(5)
    return Splats(
        (size * np.round(rng.normal(size=(count, 3)) * 1024) / 1024).astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)), np.full((count, 3), -3, np.float32),
        np.full(count, 3, np.float32), rng.normal(size=(count, 1, 3)).astype(np.float32),
    )  # fmt: skip


@pytest.fixture(scope="module")
def near(tmp_path_factory) -> Path:
    return move_scene(write_tiny_scene(tmp_path_factory.mktemp("near") / "scene"), np.zeros(3))


@pytest.fixture(scope="module")
def far(near, tmp_path_factory) -> Path:
    return move_scene(Path(shutil.copytree(near, tmp_path_factory.mktemp("far") / "scene")), OFFSET)


@pytest.fixture(scope="module")
def runs(near, far, tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("runs")
    for scene, name in ((near, "near"), (far, "far")):
        api.train(scene, folder / name, parameters={"steps": 20, "max_splats": 200}, **TRAINING)
    return folder / "near", folder / "far"


@pytest.mark.parametrize(
    ("offset", "expected"),
    [
        ((0, 0, 0), (0, 0, 0)),
        ((50, 20, 1), (0, 0, 0)),
        (OFFSET, OFFSET),
        ((456_789.5, 5_432_109.25, 312.5), (456_790, 5_432_110, 310)),  # to tens for a size of about 1.5
        ((3_980_000.0, 970_000.0, -4_870_000.0), (3_980_000, 970_000, -4_870_000)),
    ],
)
def test_origin_is_zero_near_0_and_a_round_number_far_from_it(offset, expected):
    positions = np.random.default_rng(0).normal(size=(2000, 3))
    origin = choose_origin(positions + offset)
    assert origin.tolist() == list(expected)
    outliers = np.array([[np.nan, 0, 0], [1e30, 0, 0], [np.inf, 1, 1]])
    assert choose_origin(np.concatenate([positions + offset, outliers])).tolist() == list(expected)


def test_origin_needs_a_size():
    assert not choose_origin(np.zeros((0, 3))).any()
    assert not choose_origin(np.tile(OFFSET, (5, 1))).any()
    one_place = np.tile(OFFSET, (5, 1))
    assert choose_origin(one_place, OFFSET + np.random.default_rng(0).normal(size=(99, 3))).any()


def test_far_scene_equals_the_near_one(near, far):
    expected, scene = read_scene(near), read_scene(far)
    assert not expected.origin.any() and scene.origin.tolist() == OFFSET.tolist()
    np.testing.assert_array_equal(scene.points, expected.points)
    for camera, truth in zip(scene.cameras, expected.cameras, strict=True):
        np.testing.assert_allclose(camera.world_to_camera, truth.world_to_camera, atol=1e-8)
    without_photos = [camera.name for camera in scene.cameras[:4]]
    copy = Path(shutil.copytree(far, far.parent / "fewer"))
    for name in without_photos:
        (copy / "images" / name).unlink()
    assert read_scene(copy).origin.tolist() == OFFSET.tolist()  # lost photos do not move a run


def test_far_scene_trains_as_the_near_one(runs):
    near, far = (read_bundle(run / "bundle.ply") for run in runs)
    assert not near.origin.any() and far.origin.tolist() == OFFSET.tolist()
    np.testing.assert_allclose(far.levels[0].splats.means, near.levels[0].splats.means, atol=1e-5)
    ends = [json.loads((run / "events.jsonl").read_text().splitlines()[-1]) for run in runs]
    quality = [end["train_psnr"] for end in ends]
    events = map(json.loads, (runs[1] / "events.jsonl").read_text().splitlines())
    assert {tuple(e["meta"]["origin"]) for e in events if e["event"] == "level"} == {tuple(OFFSET)}
    assert quality[1] == pytest.approx(quality[0], abs=0.05)
    assert read_header(runs[1] / "levels" / "level_1.ply").origin.tolist() == OFFSET.tolist()


def test_check_names_the_origin(near, far):
    (text,) = [finding for finding in check_folder(far) if "origin" in finding.what]
    assert text.severity == "info" and "(500000, 4200000, 300)" in text.what
    assert not any("origin" in finding.what for finding in check_folder(near))


def test_render_reads_cameras_at_the_original_place(runs, near, far, tmp_path):
    for run, scene in zip(runs, (near, far), strict=True):
        local = read_scene(scene)
        write_camera(tmp_path / f"{run.name}.json", local.cameras[4].moved(local.origin), local.near())
        camera, image = (str(tmp_path / f"{run.name}.{suffix}") for suffix in ("json", "png"))
        assert main(["render", str(run), "--backend", "cpu", "--camera", camera, "--out", image]) == 0
    position = read_camera(tmp_path / "far.json")[0].center
    np.testing.assert_allclose(position, read_scene(near).cameras[4].center + OFFSET, atol=1e-6)
    from training.scenes.images import load_image

    images = [load_image(tmp_path / f"{run.name}.png", 48, 36) for run in runs]
    assert images[0].std() > 0.05 and np.abs(images[0] - images[1]).max() < 0.02


def test_base_trains_at_its_origin(runs, far, tmp_path):
    run = api.train(far, tmp_path / "run", base=str(runs[1]), parameters={"steps": 2}, **TRAINING)
    assert read_bundle(run.bundle).origin.tolist() == OFFSET.tolist()
    lost = tmp_path / "local.ply"  # another program dropped the comment
    write_ply(lost, read_base(runs[1])[0])
    run = api.train(far, tmp_path / "run2", base=str(lost), parameters={"steps": 2}, **TRAINING)
    assert read_bundle(run.bundle).origin.tolist() == OFFSET.tolist()


def test_capture_is_written_at_the_original_place(tmp_path):
    bundle = Bundle("", [Level(1, splats(400))], meta={"origin": (OFFSET + 0.25).tolist()})
    write_bundle(tmp_path / "b.ply", bundle)
    arguments = ["--out", str(tmp_path / "scene"), "--views", "4", "--view-width", "60", "--backend", "cpu"]
    assert main(["capture", str(tmp_path / "b.ply"), *arguments]) == 0
    points, _, _ = read_points(tmp_path / "scene" / "sparse" / "0")
    assert len(points) and np.abs(points - OFFSET).max() < 10
    job: dict = {"method": "3dgs", "base": str(tmp_path / "b.ply"), "capture": "dome", "views": 4}
    run = api.train(
        "", tmp_path / "run", parameters={"steps": 2}, image_scale=1.0, backend="cpu", view_width=60, **job
    )
    assert read_bundle(run.bundle).origin.tolist() == (OFFSET + 0.25).tolist()  # not that of the capture


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
def test_third_party_ply_gets_a_local_origin(kind, tmp_path):
    truth = splats()
    write_ply(tmp_path / "a.ply", truth, origin=OFFSET)
    if kind == "<f4":
        write_ply(tmp_path / "a.ply", replace(truth, means=(truth.means + OFFSET).astype(np.float32)))
    bundle = read_bundle(tmp_path / "a.ply")
    assert bundle.origin.tolist() == read_origin(tmp_path / "a.ply").tolist() == OFFSET.tolist()
    tolerance = 0 if kind == "<f8" else 0.25  # float32 of the file
    np.testing.assert_allclose(bundle.levels[0].splats.means, truth.means, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(read_base(tmp_path / "a.ply")[0].means, bundle.levels[0].splats.means)
    shutil.copy(tmp_path / "a.ply", tmp_path / "lod0.ply")
    series = read_folder(tmp_path)
    assert series.origin.tolist() == read_origin(tmp_path).tolist() == OFFSET.tolist()
    np.testing.assert_array_equal(series.levels[0].splats.means, bundle.levels[0].splats.means)


def test_object_cut_out_of_a_scene_stays_at_its_place(tmp_path):
    small = splats(size=0.01)
    small.means += np.float32([3, 2, 1])
    write_ply(tmp_path / "a.ply", small)
    bundle = read_bundle(tmp_path / "a.ply")
    assert not bundle.origin.any() and "origin" not in bundle.meta
    np.testing.assert_array_equal(bundle.levels[0].splats.means, small.means)


def test_edits_name_the_origin_or_add_it(tmp_path, capsys):
    write_bundle(tmp_path / "b.ply", Bundle("", [Level(1, splats())], meta={"origin": OFFSET.tolist()}))
    write_folder(tmp_path / "folder", read_bundle(tmp_path / "b.ply"))
    assert read_origin(tmp_path / "folder").tolist() == OFFSET.tolist()
    local, original = tmp_path / "local.ply", tmp_path / "there.ply"
    assert main(["edit", str(tmp_path / "b.ply"), "--plain", str(local)]) == 0
    assert "relative to the local origin (500000, 4200000, 300)" in capsys.readouterr().out
    assert "lodgs origin 500000.0 4200000.0 300.0" in PlyData.read(local)["vertex"].comments
    assert read_bundle(local).origin.tolist() == OFFSET.tolist()  # and is not subtracted again
    np.testing.assert_array_equal(read_ply(local).means, splats().means)

    assert main(["edit", str(tmp_path / "b.ply"), "--plain", str(original), "--original-place"]) == 0
    assert "local origin" not in capsys.readouterr().out
    file = PlyData.read(original)
    assert not any("origin" in comment for comment in file["vertex"].comments)
    x, y, z = (file["vertex"][axis] for axis in "xyz")
    assert x.dtype == np.float64
    np.testing.assert_array_equal(np.stack([x, y, z], axis=1), splats().means + OFFSET)
    with pytest.raises(LodgsError, match="no double precision"):
        from training.editing.edit import Outputs, edit
        from training.editing.export import FileOptions

        outputs = Outputs(plain=[tmp_path / "a.splat"])
        edit(tmp_path / "b.ply", outputs, options=FileOptions(original_place=True))

    rotated = tmp_path / "turned.ply"  # other coordinates than the scene's
    assert main(["edit", str(tmp_path / "b.ply"), "--out", str(rotated), "--rotate=90,0,0"]) == 0
    assert not read_header(rotated).origin.any()
    assert "drops the local origin" in capsys.readouterr().out


def test_edit_against_photos_uses_the_origin_of_the_splats(far, tmp_path, capsys):
    bundle = Bundle("", [Level(1, splats())], meta={"origin": (OFFSET - 1).tolist()})
    write_bundle(tmp_path / "b.ply", bundle)
    arguments = ["--out", str(tmp_path / "out.ply"), "--scene", str(far), "--max-distance", "30"]
    assert main(["edit", str(tmp_path / "b.ply"), *arguments]) == 0
    assert "50 of 50 splats" in capsys.readouterr().out


@pytest.mark.parametrize(
    "export",
    [
        test_formats.test_nerfstudio_fisheye,
        test_formats.test_polycam,
        test_formats.test_record3d,
        test_formats.test_bundler,
        partial(test_formats.test_openmvg, lens="pinhole"),
        test_metashape.test_metashape,
    ],
)
def test_far_exports(export, tmp_path, monkeypatch):
    """The tests of the formats pass for the same views and points at another place."""

    def poses():
        move = np.eye(4)
        move[:3, 3] = OFFSET
        return [move @ pose for pose in export_helpers.poses()]

    points = export_helpers.POINTS + OFFSET
    monkeypatch.setattr(export_helpers, "POINTS", points)
    monkeypatch.setattr(export_helpers.project_with_colmap, "__defaults__", (points,))
    monkeypatch.setattr(test_formats, "POINTS", points)
    for module in (test_formats, test_metashape):
        monkeypatch.setattr(module, "poses", poses)
    export(tmp_path)
    scene = read_scene(tmp_path)
    np.testing.assert_allclose(scene.origin, OFFSET, atol=10)
    expected = sorted(pose[:3, 3].tolist() for pose in poses())
    centers = sorted((camera.center + scene.origin).tolist() for camera in scene.cameras)
    np.testing.assert_allclose(centers, expected, atol=1e-6)
    assert max(np.abs(camera.center).max() for camera in scene.cameras) < 20
