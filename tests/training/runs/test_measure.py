"""What ``evaluate`` reports of a run: against pictures that are drawn and compared here."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from tests.training.lod.tree.trees import tree_of
from training.__main__ import main
from training.errors import LodgsError
from training.lod import on_disk
from training.rasterize import Gaussians, rasterize
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.runs.measure import evaluate_run, format_report
from training.scenes.cameras import write_camera
from training.scenes.colmap import read_scene
from training.splats.bundle import Bundle, Level, write_bundle
from training.splats.gaussians import SH_C0, Splats


@pytest.fixture(scope="module")
def scene(tiny_scene, tmp_path_factory):
    """The tiny scene, that tests may add to."""
    return shutil.copytree(tiny_scene, tmp_path_factory.mktemp("measured") / "scene")


@pytest.fixture(scope="module")
def splats(scene) -> Splats:
    """The points of the tiny scene as opaque balls of the discs' size."""
    found = read_scene(scene)
    count = len(found.points)
    return Splats(
        means=found.points,
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 3), np.log(0.12), np.float32),
        opacity_logits=np.full(count, 3, np.float32),
        sh=((found.point_colors[:, None] / 255 - 0.5) / SH_C0).astype(np.float32),
    )


@pytest.fixture
def finished(scene, splats, tmp_path):
    """``finished(test_every=4)``: the folder of a finished run of two levels, the finer one complete."""

    def make(**keys):
        run = RunFolder(tmp_path / "run")
        run.create()
        values = {"scene": str(scene), "out": str(run.path), "image_scale": 1.0, "backend": "cpu"}
        Job.from_dict(values | keys).write(run.job)
        levels = [Level(1, splats.select(slice(0, 20)), {"s_min": 0.1}), Level(2, splats, {"s_min": 0.0})]
        write_bundle(run.bundle, Bundle("flod", levels, "bands"))
        return run.path

    return make


def test_of_a_tree_the_finest_level_alone_is_measured(finished, splats, tmp_path):
    run = finished(test_every=4)
    write_bundle(RunFolder(run).bundle, tree_of(splats))
    report = evaluate_run(run, {"pixels": 2.0}, image=tmp_path / "levels.png")
    (row,) = report["levels"]
    assert (row["level"], row["splats"]) == (2, len(splats)) and row["veil"] == report["veil"]
    assert [row["pixels"] for row in report["curve"]] == [0.5, 1, 2, 4, 8, 16]
    assert "level 1" not in format_report(report)


def test_of_a_large_tree_the_same_is_measured_in_parts(finished, splats, tmp_path, monkeypatch):
    run = finished(test_every=4)
    write_bundle(RunFolder(run).bundle, tree_of(splats))
    expected = evaluate_run(run, far=True)
    monkeypatch.setattr(on_disk, "IN_MEMORY", 100)
    report = evaluate_run(run, image=tmp_path / "levels.png", far=True)
    assert (tmp_path / "levels.png").is_file()
    assert [row["set"] for row in report["selective"]] == ["per view"]
    assert report["levels"][0]["splats"] == len(splats)
    for name in ("train_psnr", "veil", "worst", "farther", "oversized", "jumps"):
        assert report[name] == expected[name]
    for name in ("levels", "curve"):
        for row, other in zip(report[name], expected[name], strict=True):
            assert [row[key] for key in ("drawn", "psnr", "ssim")] == [
                other[key] for key in ("drawn", "psnr", "ssim")
            ]


def quality(splats: Splats, camera) -> float:
    """PSNR of all splats against the photograph in 8 bits, by numpy."""
    near = 0.01 * 4  # nothing of the tiny scene is nearer
    image = rasterize(Gaussians.of(splats), camera, near=near, backend="reference").image.numpy()
    photograph = np.asarray(Image.open(camera.image).convert("RGB"), float)
    error = (image.clip(0, 1) * 255).round() - photograph
    return float(20 * np.log10(255) - 10 * np.log10((error**2).mean()))


def test_training_views_and_the_worst_held_out_one(finished, scene, splats):
    run = finished(test_every=4)
    report = evaluate_run(run)
    assert report == json.loads((run / "metrics.json").read_text())
    views = [quality(splats, camera) for camera in read_scene(scene).cameras]
    assert report["test_views"] == ["00.jpg", "04.jpg", "08.jpg"]
    held_out, training = views[::4], [view for i, view in enumerate(views) if i % 4]
    assert report["train_psnr"] == pytest.approx(np.mean(training), abs=0.02)
    assert report["levels"][1]["psnr"] == pytest.approx(np.mean(held_out), abs=0.02)
    worst = int(np.argmin(held_out))
    assert report["worst"]["view"] == report["test_views"][worst]
    assert report["worst"]["psnr"] == pytest.approx(held_out[worst], abs=0.02)
    assert held_out[worst] < report["levels"][1]["psnr"] < report["fitted_psnr"]
    assert report["oversized"] == 0 and report["veil"] == report["levels"][1]["veil"]
    assert "aside" not in report
    assert set(report["frame_s"]) == {"by_distance", "full"} and min(report["frame_s"].values()) > 0
    assert f"Training views: {report['train_psnr']:.1f} dB" in format_report(report).splitlines()


def test_without_held_out_views_quality_is_of_training_views_and_is_called_so(
    finished, scene, splats, tmp_path
):
    report = evaluate_run(finished(test_every=0), image=tmp_path / "levels.png")
    assert report["test_views"] == [] and not {"worst", "fitted_psnr"} & report.keys()
    mean = np.mean([quality(splats, camera) for camera in read_scene(scene).cameras])
    assert report["train_psnr"] == pytest.approx(mean, abs=0.02)
    assert report["levels"][1]["train_psnr"] == report["train_psnr"]
    for row in (*report["levels"], *report["selective"]):
        assert "psnr" not in row and row["train_ssim"] > 0
    said = format_report(report).splitlines()
    assert "No views were held out: quality is of training views." in said
    assert (tmp_path / "levels.png").is_file()


def test_views_off_the_path_are_measured_where_the_scene_has_some(finished, scene, splats, capsys):
    run = finished(test_every=4, image_scale=0.5)
    folder = scene / "aside"
    folder.mkdir()
    cameras = read_scene(scene).cameras[2:4]
    for name, camera in zip(("b", "a"), cameras, strict=True):
        shutil.copy(camera.image, folder / f"{name}.jpg")
        double = replace(camera.scaled(2), name=f"{name}.jpg")  # it is fitted to its picture
        write_camera(folder / f"{name}.json", double, near=0.01)
    report = evaluate_run(run)
    found = report["aside"]
    assert found["views"] == ["a.jpg", "b.jpg"]
    assert "Off the path:" in format_report(report)
    whole = evaluate_run(finished(test_every=4))["aside"]
    assert whole["psnr"] == pytest.approx(np.mean([quality(splats, camera) for camera in cameras]), abs=0.02)
    assert found["psnr"] != whole["psnr"]
    (folder / "a.jpg").unlink()
    with pytest.raises(LodgsError, match=r"a\.jpg cannot be read"):
        evaluate_run(run)
    assert main(["evaluate", str(run)]) == 2
    assert "Traceback" not in capsys.readouterr().err
    shutil.rmtree(folder)


def test_photographs_that_are_gone_since_are_told_and_no_other_views_are_held_out(finished, scene, tmp_path):
    copy = shutil.copytree(scene, tmp_path / "scene")
    run = finished(test_every=4, scene=str(copy))
    before, warned = evaluate_run(run)["test_views"], []
    (copy / "images" / before[0]).unlink()
    (copy / "images" / "01.jpg").write_bytes(b"nothing")
    assert evaluate_run(run, warn=warned.append)["test_views"] == before[1:]
    assert len(warned) == 2 and before[0] in "".join(warned) and "01.jpg" in "".join(warned)
    shutil.rmtree(copy)
    with pytest.raises(LodgsError, match=r"is gone.*job\.toml"):
        evaluate_run(run)


def test_a_run_that_is_not_finished_is_refused_in_a_sentence(tmp_path):
    with pytest.raises(LodgsError, match=r"not the folder of a finished run.*train it to the end"):
        evaluate_run(tmp_path)


def test_metrics_are_valid_json_whatever_was_measured(finished, monkeypatch):
    """A number that is none is null; equal pictures, from far away, are a number."""
    run = finished(test_every=4)
    report = evaluate_run(run, far=True)
    assert all(np.isfinite(row["psnr"]) for row in report["farther"])
    monkeypatch.setattr("training.evaluate.views.ssim", lambda *_: float("nan"))
    report = evaluate_run(run)
    assert np.isnan(report["levels"][0]["ssim"]) and "nan" in format_report(report)

    def refuse(constant):
        raise ValueError(f"{constant} is no JSON")

    written = json.loads((run / "metrics.json").read_text(), parse_constant=refuse)
    assert written["levels"][0]["ssim"] is None
    assert written["levels"][0]["psnr"] == report["levels"][0]["psnr"]
