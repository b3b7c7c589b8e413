"""A box of the scene becomes the region of a job, wherever scene and box stand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


@pytest.fixture
def root(bpy, lodgs):
    """Points alone, moved, turned and scaled."""
    from mathutils import Matrix

    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    root.matrix_world = Matrix.Translation((3, -2, 1)) @ Matrix.Rotation(0.7, 4, "Z") @ Matrix.Scale(2.5, 4)
    bpy.context.view_layer.update()
    return root


def job_of(lodgs, root, tmp_path):
    return lodgs("runs.job_settings").make_job(root, tmp_path / "run", {})


def test_what_lies_in_the_box_is_what_the_job_says(bpy, lodgs, root, tmp_path):
    from mathutils import Matrix

    assert job_of(lodgs, root, tmp_path).region == ""
    assert bpy.ops.lodgs.add_region() == {"FINISHED"}
    box = root.lodgs.training.region
    assert box == bpy.context.active_object and box.lodgs_crop.keep == "ALL"
    box.matrix_world = box.matrix_world @ Matrix.Rotation(0.4, 4, "X") @ Matrix.Diagonal((1, 2, 0.7, 1))
    bpy.context.view_layer.update()
    job = job_of(lodgs, root, tmp_path)
    points = root.lodgs.points
    means = np.empty((len(points.data.points), 3), np.float32)
    points.data.attributes["position"].data.foreach_get("vector", means.reshape(-1))
    to_box = np.array(box.matrix_world.inverted() @ points.matrix_world)
    own = means @ to_box[:3, :3].T + to_box[:3, 3]
    inside, found = np.abs(own).max(1) <= 1, job.crop.holds(means)
    assert 0.02 < inside.mean() < 0.9 and np.mean(inside != found) < 1e-3
    box.empty_display_type = "SPHERE"
    assert job_of(lodgs, root, tmp_path).region.startswith("sphere ")
    again = lodgs("training.runs.job").Job
    (tmp_path / "run").mkdir()
    job.write(tmp_path / "run" / "job.toml")
    assert again.from_file(tmp_path / "run" / "job.toml").crop == job.crop


@pytest.mark.parametrize("region", ["box -1 0 2 1 2 3", "sphere 1 2 3 0.5"])
def test_the_panel_shows_a_jobs_region(bpy, lodgs, root, tmp_path, region):
    """As ``blender --command lodgs train --region`` leaves it in the .blend."""
    job, settings = replace(job_of(lodgs, root, tmp_path), region=region), root.lodgs.training
    lodgs("runs.job_settings").apply_job(settings, job)
    bpy.context.view_layer.update()
    found = job_of(lodgs, root, tmp_path).crop
    assert found.shape == job.crop.shape and settings.region.name.startswith("Region")
    np.testing.assert_allclose(found.to_own, job.crop.to_own, atol=1e-4)
    lodgs("runs.job_settings").apply_job(settings, replace(job, region=""))
    assert settings.region is None


def test_one_that_is_gone_or_anothers_is_none(bpy, lodgs, root, tmp_path):
    bpy.ops.lodgs.add_region()
    bpy.data.objects.remove(root.lodgs.training.region)
    assert job_of(lodgs, root, tmp_path).region == ""
    other = bpy.data.objects.new("an empty", None)
    bpy.context.scene.collection.objects.link(other)
    root.lodgs.training.region = other
    assert job_of(lodgs, root, tmp_path).region == ""


def test_cells_and_a_region_are_refused_in_a_sentence(bpy, lodgs, root, tmp_path):
    bpy.context.view_layer.objects.active = root
    bpy.ops.lodgs.add_region()
    root.lodgs.training.columns = 2
    with pytest.raises(lodgs("training.errors").LodgsError, match="both 'cells' and 'region'"):
        job_of(lodgs, root, tmp_path)


def test_without_points_there_is_nothing_to_put_it_around(bpy, lodgs, root):
    bpy.data.objects.remove(root.lodgs.points)
    bpy.context.view_layer.objects.active = root
    with pytest.raises(RuntimeError, match="neither splats nor points"):
        bpy.ops.lodgs.add_region()
