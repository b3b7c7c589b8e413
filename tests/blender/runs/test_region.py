"""Region objects become the region of a job, for any transform of scene and region."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

GARDEN = Path(__file__).resolve().parents[3] / "examples" / "lantern_garden"


@pytest.fixture
def root(bpy, lodgs):
    """A scene of points with a transform."""
    from mathutils import Matrix

    root = lodgs("data.importing").import_colmap(bpy.context, GARDEN, photographs=False)
    root.matrix_world = Matrix.Translation((3, -2, 1)) @ Matrix.Rotation(0.7, 4, "Z") @ Matrix.Scale(2.5, 4)
    bpy.context.view_layer.update()
    return root


def make_job(lodgs, root, tmp_path):
    return lodgs("runs.job_settings").make_job(root, tmp_path / "run", {})


def test_region_of_the_job_is_the_region_object(bpy, lodgs, root, tmp_path):
    from mathutils import Matrix

    assert make_job(lodgs, root, tmp_path).region == ""
    assert bpy.ops.lodgs.add_region() == {"FINISHED"}
    box = root.lodgs.training.region
    assert box == bpy.context.active_object and box.lodgs_crop.keep == "ALL"
    box.matrix_world = box.matrix_world @ Matrix.Rotation(0.4, 4, "X") @ Matrix.Diagonal((1, 2, 0.7, 1))
    bpy.context.view_layer.update()
    job = make_job(lodgs, root, tmp_path)
    points = root.lodgs.points
    means = np.empty((len(points.data.points), 3), np.float32)
    points.data.attributes["position"].data.foreach_get("vector", means.reshape(-1))
    to_box = np.array(box.matrix_world.inverted() @ points.matrix_world)
    in_box = means @ to_box[:3, :3].T + to_box[:3, 3]
    expected = np.abs(in_box).max(1) <= 1
    inside = job.crop.contains(means)
    assert 0.02 < expected.mean() < 0.9 and np.mean(inside != expected) < 1e-3
    box.empty_display_type = "SPHERE"
    assert make_job(lodgs, root, tmp_path).region.startswith("sphere ")
    (tmp_path / "run").mkdir()
    job.write(tmp_path / "run" / "job.toml")
    assert lodgs("training.runs.job").Job.from_file(tmp_path / "run" / "job.toml").crop == job.crop


@pytest.mark.parametrize("region", ["box -1 0 2 1 2 3", "sphere 1 2 3 0.5"])
def test_apply_job_sets_the_region(bpy, lodgs, root, tmp_path, region):
    """As ``blender --command lodgs train --region`` stores it in the .blend file."""
    job = replace(make_job(lodgs, root, tmp_path), region=region)
    settings = root.lodgs.training
    lodgs("runs.job_settings").apply_job(settings, job)
    bpy.context.view_layer.update()
    crop = make_job(lodgs, root, tmp_path).crop
    assert crop.shape == job.crop.shape and settings.region.name.startswith("Region")
    np.testing.assert_allclose(crop.to_local, job.crop.to_local, atol=1e-4)
    lodgs("runs.job_settings").apply_job(settings, replace(job, region=""))
    assert settings.region is None


def test_deleted_or_unrelated_region_is_ignored(bpy, lodgs, root, tmp_path):
    bpy.ops.lodgs.add_region()
    bpy.data.objects.remove(root.lodgs.training.region)
    assert make_job(lodgs, root, tmp_path).region == ""
    unrelated = bpy.data.objects.new("an empty", None)
    bpy.context.scene.collection.objects.link(unrelated)
    root.lodgs.training.region = unrelated
    assert make_job(lodgs, root, tmp_path).region == ""


def test_cells_with_a_region_are_rejected(bpy, lodgs, root, tmp_path):
    bpy.context.view_layer.objects.active = root
    bpy.ops.lodgs.add_region()
    root.lodgs.training.columns = 2
    with pytest.raises(lodgs("training.errors").LodgsError, match="both 'cells' and 'region'"):
        make_job(lodgs, root, tmp_path)


def test_region_needs_points_or_splats(bpy, lodgs, root):
    bpy.data.objects.remove(root.lodgs.points)
    bpy.context.view_layer.objects.active = root
    with pytest.raises(RuntimeError, match="neither splats nor points"):
        bpy.ops.lodgs.add_region()
