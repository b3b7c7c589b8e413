"""Regions trained in detail: text form, storage in the job, and the initial points of a run."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from training.cli.job_options import options_of
from training.errors import LodgsError
from training.lod.crop import Crop
from training.runs.data import thin_outside_region, training_data
from training.runs.failures import BAD_INPUT
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.runs.train import train
from training.scenes.colmap import read_scene
from training.splats.bundle import read_bundle

HALF = "box -9 -9 -1.5 0 9 9"  # the half with x < 0 of the points near the origin of the tiny scene
TURNED = Crop.from_matrix(
    "BOX", np.array([[0.6, -0.8, 0, 0.1], [0.8, 0.6, 0, 2], [0, 0, 3, 1], [0, 0, 0, 1.0]])
)


@pytest.mark.parametrize("crop", [TURNED, Crop.box((0, 0, 0), (1, 2, 3)), Crop.sphere((1, 0, -2), 0.3)])
def test_text_form_round_trips_exactly(crop):
    assert Crop.from_text(crop.as_text()) == crop


def test_text_form_with_corners_in_any_order():
    box = Crop.from_text("box 1 0 2 -1 4 3")
    points = np.array([[0, 2, 2.5], [0.99, 3.9, 2.1], [1.1, 2, 2.5], [0, -0.1, 2.5], [0, 2, 1.9]])
    assert box.contains(points).tolist() == [True, True, False, False, False]
    assert Crop.from_text("SPHERE 0 0 1 2").contains(np.array([[0, 0, 2.9], [0, 2.1, 1]])).tolist() == [
        True,
        False,
    ]


@pytest.mark.parametrize(
    "text",
    ["box", "box 1 2 3", "sphere 0 0 0", "sphere 0 0 0 0", "box 0 0 0 0 1 1", "box a b c d e f",
     "sphere 0 0 0 nan", "box 1 2 3 4 5 6 7 8 9 10 11 inf"],
)  # fmt: skip
def test_invalid_regions_are_rejected_with_a_remedy(text, tmp_path):
    with pytest.raises(LodgsError) as error:
        Job.from_dict({"scene": str(tmp_path), "out": str(tmp_path / "run"), "region": text})
    assert error.value.remedy


def test_job_stores_the_region(tmp_path):
    job = Job.from_dict({"scene": str(tmp_path), "out": str(tmp_path / "run"), "region": HALF})
    (tmp_path / "run").mkdir()
    job.write(tmp_path / "run" / "job.toml")
    reread = Job.from_file(tmp_path / "run" / "job.toml")
    assert reread.region == HALF and reread.crop == Crop.from_text(HALF) and reread.cell == ""
    assert options_of(job)[-2:] == ["--region", HALF]
    file = Job.from_dict({"scene": str(tmp_path), "out": str(tmp_path / "run"), "region": "region.json"})
    assert file.crop is None and file.cell.endswith("region.json")
    with pytest.raises(LodgsError, match="both 'cells' and 'region'"):
        Job.from_dict({"scene": str(tmp_path), "out": str(tmp_path), "region": HALF, "cells": "2x1"})


def test_points_outside_the_region_are_thinned_evenly(tiny_scene):
    scene, region = read_scene(tiny_scene), Crop.from_text(HALF)
    inside = region.contains(scene.points)
    assert 10 < inside.sum() < 40
    thinned = thin_outside_region(scene, region, 8)
    kept_inside = region.contains(thinned.points)
    np.testing.assert_array_equal(thinned.points[kept_inside], scene.points[inside])
    np.testing.assert_array_equal(thinned.point_ids[kept_inside], scene.point_ids[inside])
    assert 4 <= (~kept_inside).sum() <= 8
    everything = thin_outside_region(scene, region, 60)
    np.testing.assert_array_equal(everything.points, scene.points)
    with pytest.raises(LodgsError, match="none of the scene's points"):
        thin_outside_region(scene, Crop.sphere((500, 0, 0), 1), 8)


def test_run_trains_a_region(tiny_scene, tmp_path, capsys):
    keys = {
        "scene": str(tiny_scene), "out": str(tmp_path / "run"), "method": "3dgs", "backend": "cpu",
        "test_every": 4, "region": HALF,
        "parameters": {"steps": 130, "max_splats": 60, "margin": 0.0, "grad_threshold": 0.0},
    }  # fmt: skip
    job = Job.from_dict(keys)
    data = training_data(job, RunFolder(tmp_path / "run"))
    assert data.region == job.crop and (~data.region.contains(data.scene.points)).sum() <= 6
    assert data.median_depth == read_scene(tiny_scene).median_depth()  # units come from the full scene
    assert train(job, sys.stdout) == 0
    means = read_bundle(tmp_path / "run" / "bundle.ply").levels[0].splats.means
    assert len(means) > 45  # of 60 at most
    keys |= {"out": str(tmp_path / "other"), "region": "sphere 900 0 0 1"}
    assert train(Job.from_dict(keys), sys.stdout) == BAD_INPUT
    assert "contains none of the scene's points" in capsys.readouterr().out
