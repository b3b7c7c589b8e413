"""Evaluation reports of a run, against images rendered and compared here."""

import errno
import json
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.training.lod.tree.trees import tree_of
from training.__main__ import main
from training.errors import LodgsError
from training.evaluate.views import reduce_view
from training.lod import on_disk
from training.optimize.merging import merge
from training.rasterize import Gaussians, Target, rasterize
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.runs.measure import evaluate_run
from training.runs.report_text import format_report, size_lines
from training.scenes.cameras import Camera, write_camera
from training.scenes.colmap import read_scene
from training.splats.bundle import write_bundle
from training.splats.gaussians import Splats
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply


@pytest.fixture(scope="module")
def scene(tiny_scene, tmp_path_factory):
    """A copy of the tiny scene that tests may modify."""
    return shutil.copytree(tiny_scene, tmp_path_factory.mktemp("measured") / "scene")


@pytest.fixture
def finished(scene, splats, tmp_path):
    """``finished(test_every=4)`` returns a finished run of two levels, the finer one complete."""

    def make(**keys):
        run = RunFolder(tmp_path / "run")
        run.create()
        values = {"scene": str(scene), "out": str(run.path), "image_scale": 1.0, "backend": "cpu"}
        Job.from_dict(values | keys).write(run.job)
        levels = [Level(1, splats.select(slice(0, 20)), {"s_min": 0.1}), Level(2, splats, {"s_min": 0.0})]
        write_bundle(run.bundle, Bundle("flod", levels, "bands"))
        return run.path

    return make


def test_only_the_finest_level_of_a_tree_is_measured(finished, splats, tmp_path):
    run = finished(test_every=4)
    write_bundle(RunFolder(run).bundle, tree_of(splats))
    report = evaluate_run(run, {"pixels": 2.0}, image=tmp_path / "levels.png")
    (row,) = report["levels"]
    assert (row["level"], row["splats"]) == (2, len(splats)) and row["veil"] == report["veil"]
    assert [row["pixels"] for row in report["curve"]] == [0.5, 1, 2, 4, 8, 16]
    assert all(0 < row["merged"] < 60 for row in report["curve"])
    assert "level 1" not in format_report(report)


def test_rows_of_earlier_evaluations_with_other_controls_are_kept(finished):
    run = finished(test_every=4)
    first = evaluate_run(run, {"gamma": 2.0})["selective"]
    second = evaluate_run(run, {"gamma": 50.0})
    assert [row["gamma"] for row in second["selective"]] == [50, 50, 2, 2]
    assert second["selective"][2:] == first
    assert format_report(second).count("(gamma 2, ") == 1
    again = evaluate_run(run, {"gamma": 2.0})["selective"]
    assert [row["gamma"] for row in again] == [2, 2, 50, 50]
    RunFolder(run).metrics.write_text('{"selective": [{"set": "per view"}, 3]}')
    assert len(evaluate_run(run, {"gamma": 2.0})["selective"]) == 2
    bundle = RunFolder(run).bundle
    os.utime(bundle, (bundle.stat().st_atime, RunFolder(run).metrics.stat().st_mtime + 10))
    assert len(evaluate_run(run, {"gamma": 50.0})["selective"]) == 2  # rows of an older bundle are dropped


def test_large_tree_measured_in_parts_gives_the_same_report(finished, splats, tmp_path, monkeypatch):
    run = finished(test_every=4)
    write_bundle(RunFolder(run).bundle, tree_of(splats))
    expected = evaluate_run(run, far=True)
    monkeypatch.setattr(on_disk, "MAX_IN_MEMORY", 100)
    report = evaluate_run(run, image=tmp_path / "levels.png", far=True)
    assert (tmp_path / "levels.png").is_file()
    assert [row["set"] for row in report["selective"]] == ["per view"]
    assert report["levels"][0]["splats"] == len(splats)
    for name in ("train_psnr", "veil", "worst", "oversized", "jumps", "flight"):
        assert report[name] == expected[name]
    for row, expected_row in zip(report["farther"], expected["farther"], strict=True):
        assert {**row, "frame_s": 0} == {**expected_row, "frame_s": 0}
    for name in ("levels", "curve"):
        for row, expected_row in zip(report[name], expected[name], strict=True):
            assert [row[key] for key in ("drawn", "psnr", "ssim")] == [
                expected_row[key] for key in ("drawn", "psnr", "ssim")
            ]


def quality(splats: Splats, camera, reduction: int = 1) -> float:
    """PSNR of all splats against the 8-bit photo, reduced by a box filter, computed with numpy and Pillow."""
    near = 0.01 * 4  # the tiny scene has nothing closer
    view = camera.scaled(1 / reduction)
    assert (view.width * reduction, view.height * reduction) == (camera.width, camera.height)
    image = rasterize(Gaussians.of(splats), view, near=near, backend="reference").image.numpy()
    photo = np.asarray(Image.open(camera.image).convert("RGB").reduce(reduction), float)
    error = (image.clip(0, 1) * 255).round() - photo
    return float(20 * np.log10(255) - 10 * np.log10((error**2).mean()))


def test_report_of_training_views_and_the_worst_held_out_view(finished, scene, splats):
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


def test_merge_of_the_finest_level_is_the_baseline_of_a_level(finished, scene, splats):
    report = evaluate_run(finished(test_every=4))
    held_out = read_scene(scene).cameras[::4]
    merged = merge(splats, 20)
    coarse, finest = report["levels"]
    for row, name, drawn in ((coarse, "merged", merged), (finest, "by_size", splats)):
        expected = [np.mean([quality(drawn, camera, size) for camera in held_out]) for size in (1, 2, 4, 8)]
        assert row[name] == pytest.approx(expected, abs=0.03)
    assert "merged" not in finest and finest["by_size"][0] == finest["psnr"]
    assert size_lines([coarse])[1].endswith(f"{coarse['by_size'][3]:.2f} ({coarse['merged'][3]:.2f})")
    assert size_lines([coarse])[1] in format_report(report)


def test_perceptual_measures_stand_beside_psnr(finished, monkeypatch, tmp_path):
    """A measure in place of the networks, whose weights are a download."""
    folders = []

    def load(folder, device):
        folders.append(folder)
        return {"lpips_vgg": lambda image, target, mask: float((image - target).abs().mean() / 4)}

    monkeypatch.setattr("training.runs.finished.load_lpips", load)
    report = evaluate_run(finished(test_every=4), lpips=tmp_path)
    coarse, fine = report["levels"]
    assert folders == [tmp_path] and 0 < fine["lpips_vgg"] < coarse["lpips_vgg"] < 0.25
    assert report["selective"][0]["lpips_vgg"] > 0
    head, *lines = format_report(report).splitlines()
    assert head.split() == ["splats", "PSNR", "SSIM", "LPIPS-V", "ms/frame", "veiled"]
    assert f" {fine['lpips_vgg']:.4f} " in next(line for line in lines if line.startswith("level 2"))


def test_curve_has_no_perceptual_measures(finished, splats, monkeypatch):
    monkeypatch.setattr("training.runs.finished.load_lpips", lambda *_: {"lpips_vgg": lambda *_: 0.125})
    run = finished(test_every=4)
    write_bundle(RunFolder(run).bundle, tree_of(splats))
    report = evaluate_run(run)
    assert report["selective"][0]["lpips_vgg"] == 0.125
    assert all("lpips_vgg" not in row for row in report["curve"])
    line = next(line for line in format_report(report).splitlines() if line.startswith("pixels = 16"))
    assert "0.1250" not in line


def test_missing_weights_are_stated_in_a_sentence(finished, tmp_path, capsys):
    assert main(["evaluate", str(finished(test_every=4)), "--lpips", str(tmp_path / "none")]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith(f"LPIPS is not measured: {tmp_path / 'none'} does not exist.")


def test_file_size_and_memory_to_draw_are_reported(finished):
    run = finished(test_every=4)
    report = evaluate_run(run)
    assert report["bytes"] == (run / "bundle.ply").stat().st_size
    assert report["frame_memory"].keys() == {"by_distance", "full"}
    if sys.platform == "linux":
        assert all(0 <= size < 10**9 for size in report["frame_memory"].values())
        assert "Memory to draw: " in format_report(report)
    assert "File of all levels: " in format_report(report)


def test_incomplete_blocks_and_masked_pixels_of_a_reduced_view_do_not_count():
    rows = torch.arange(5.0)[:, None, None].expand(5, 7, 3)
    mask = torch.ones(5, 7)
    mask[0, 0] = 0
    camera = Camera("a", 7, 5, 8.0, 6.0, 3.0, 2.0, np.eye(4))
    small, target = reduce_view(camera, Target(rows, mask), 2)
    assert (small.width, small.height, small.fx, small.fy, small.cx, small.cy) == (3, 2, 4, 3, 1.5, 1)
    assert target.image[:, 0, 0].tolist() == [0.5, 2.5]
    assert target.mask.tolist() == [[0, 1, 1], [1, 1, 1]]


def test_quality_without_held_out_views_is_reported_for_training_views(finished, scene, splats, tmp_path):
    report = evaluate_run(finished(test_every=0), image=tmp_path / "levels.png")
    assert report["test_views"] == [] and not {"worst", "fitted_psnr"} & report.keys()
    mean = np.mean([quality(splats, camera) for camera in read_scene(scene).cameras])
    assert report["train_psnr"] == pytest.approx(mean, abs=0.02)
    assert report["levels"][1]["train_psnr"] == report["train_psnr"]
    for row in (*report["levels"], *report["selective"]):
        assert "psnr" not in row and row["train_ssim"] > 0
    lines = format_report(report).splitlines()
    assert "No held-out views: quality is measured on training views." in lines
    assert (tmp_path / "levels.png").is_file()


def test_views_off_the_path_are_measured(finished, scene, splats, capsys):
    run = finished(test_every=4, image_scale=0.5)
    folder = scene / "aside"
    folder.mkdir()
    cameras = read_scene(scene).cameras[2:4]
    for name, camera in zip(("b", "a"), cameras, strict=True):
        shutil.copy(camera.image, folder / f"{name}.jpg")
        double = replace(camera.scaled(2), name=f"{name}.jpg")  # scaled to the size of its image
        write_camera(folder / f"{name}.json", double, near=0.01)
    report = evaluate_run(run)
    offset_views = report["aside"]
    assert offset_views["views"] == ["a.jpg", "b.jpg"]
    assert "Offset views:" in format_report(report)
    full_size = evaluate_run(finished(test_every=4))["aside"]
    assert full_size["psnr"] == pytest.approx(
        np.mean([quality(splats, camera) for camera in cameras]), abs=0.02
    )
    assert offset_views["psnr"] != full_size["psnr"]
    (folder / "a.jpg").unlink()
    with pytest.raises(LodgsError, match=r"a\.jpg"):
        evaluate_run(run)
    assert main(["evaluate", str(run)]) == 2
    assert "Traceback" not in capsys.readouterr().err
    shutil.rmtree(folder)


def test_runs_on_captured_views_have_no_views_off_the_path(finished, scene, splats, tmp_path, monkeypatch):
    """They have no scene; the current folder is not theirs."""
    write_ply(tmp_path / "base.ply", splats)
    keys = {"scene": "", "capture": "dome", "base": str(tmp_path / "base.ply"), "method": "lodge"}
    run = finished(test_every=4, **keys)
    shutil.copytree(scene, RunFolder(run).captured)
    (tmp_path / "aside").mkdir()
    (tmp_path / "aside" / "notes.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    assert "aside" not in evaluate_run(run)


def test_missing_photos_are_reported_and_do_not_change_the_held_out_views(finished, scene, tmp_path):
    copy = shutil.copytree(scene, tmp_path / "scene")
    run = finished(test_every=4, scene=str(copy))
    views = evaluate_run(run)["test_views"]
    warnings = []
    (copy / "images" / views[0]).unlink()
    (copy / "images" / "01.jpg").write_bytes(b"nothing")
    assert evaluate_run(run, warn=warnings.append)["test_views"] == views[1:]
    assert len(warnings) == 2 and views[0] in "".join(warnings) and "01.jpg" in "".join(warnings)
    shutil.rmtree(copy)
    with pytest.raises(LodgsError, match=r"does not exist.*job\.toml"):
        evaluate_run(run)


def test_read_only_run_folder_is_named(finished, monkeypatch, capsys):
    """Denied as by the system; root may write anywhere."""
    run = finished(test_every=4)
    write = Path.write_text

    def deny(path, *arguments, **options):
        if path.parent == run:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return write(path, *arguments, **options)

    monkeypatch.setattr(Path, "write_text", deny)
    assert main(["evaluate", str(run)]) == 2
    expected = (
        f"error: Cannot write {run / 'metrics.json'}: Permission denied. Choose another name or folder.\n"
    )
    assert capsys.readouterr().err.endswith(expected)


def test_metrics_remain_if_the_picture_cannot_be_written(finished, tmp_path):
    run = finished(test_every=4)
    with pytest.raises(LodgsError, match=r"Cannot write .*levels\.png"):
        evaluate_run(run, image=run / "job.toml" / "levels.png")
    assert RunFolder(run).read_metrics()["levels"]


def test_unfinished_run_is_rejected(tmp_path):
    with pytest.raises(LodgsError, match=r"not a finished run"):
        evaluate_run(tmp_path)


def test_metrics_are_valid_json_with_undefined_values(finished, monkeypatch):
    """NaN becomes null; the PSNR of identical distant images is finite."""
    run = finished(test_every=4)
    report = evaluate_run(run, far=True)
    assert all(np.isfinite(row["psnr"]) for row in report["farther"])
    monkeypatch.setattr("training.runs.finished.ssim", lambda *_: float("nan"))
    report = evaluate_run(run)
    assert np.isnan(report["levels"][0]["ssim"]) and "nan" in format_report(report)

    def reject(constant):
        raise ValueError(f"{constant} is not JSON")

    written = json.loads((run / "metrics.json").read_text(), parse_constant=reject)
    assert written["levels"][0]["ssim"] is None
    assert written["levels"][0]["psnr"] == report["levels"][0]["psnr"]
