"""Finished runs: baking their networks again with the appearance of photos."""

import io
import json
import shutil

import numpy as np
import pytest

from training.__main__ import main
from training.errors import LodgsError
from training.runs import train as training_loop
from training.runs.finished import bake_again
from training.runs.job import Job
from training.splats.bundle import read_bundle


def run_of(scene, out, **parameters):
    keys = {
        "scene": str(scene), "out": str(out), "image_scale": 1.0, "test_every": 4, "backend": "cpu",
        "method": "octree_neural",
        "parameters": {"steps": 8, "levels": 2, "offsets": 2, "max_splats": 200, "margin": 0.0, **parameters},
    }  # fmt: skip
    assert training_loop.train(Job.from_dict(keys), io.StringIO()) == 0
    return out


@pytest.fixture(scope="module")
def run(tiny_scene, tmp_path_factory):
    return run_of(tiny_scene, tmp_path_factory.mktemp("appearance") / "run", appearance=4)


def test_baking_again_changes_colours_alone(run, tmp_path):
    levels = read_bundle(run / "bundle.ply").levels
    photos = ["01.jpg", "02.jpg"]
    with bake_again(run, photos) as path:
        baked = read_bundle(path)
    assert baked.meta["appearance"] == photos
    for old, new in zip(levels, baked.levels, strict=True):
        for name in ("means", "log_scales", "quats", "opacity_logits"):
            np.testing.assert_array_equal(getattr(old.splats, name), getattr(new.splats, name))
        assert not np.array_equal(old.splats.sh, new.splats.sh)
    out = tmp_path / "edited.ply"
    assert main(["edit", str(run), "--appearance", *photos, "--out", str(out)]) == 0
    for new, edited in zip(baked.levels, read_bundle(out).levels, strict=True):
        np.testing.assert_allclose(new.splats.sh, edited.splats.sh, atol=1e-6)


def test_unknown_photos_and_other_runs_raise(run, tmp_path):
    with pytest.raises(LodgsError, match=r"appearance of .none\.jpg.: no training photo"):
        bake_again(run, ["none.jpg"]).__enter__()
    without = shutil.copytree(run, tmp_path / "run")
    (without / "model.npz").unlink()
    with pytest.raises(LodgsError, match=r"has no networks\. Choose a run of the method octree_neural"):
        bake_again(without, []).__enter__()


def test_report_counts_the_splats_of_the_networks(run, capsys):
    assert main(["evaluate", str(run)]) == 0
    [line] = [line for line in capsys.readouterr().out.splitlines() if line.startswith("with networks")]
    measured = json.loads((run / "metrics.json").read_text())["networks"]
    assert int(line.split()[2].replace(",", "")) == measured["splats"] > 0
