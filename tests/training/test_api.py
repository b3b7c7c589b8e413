"""The Python interface: examples of docstrings, and each function."""

import doctest
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import training as lodgs
from training import api, plugins
from training.errors import LodgsError
from training.lod.selection import resolve_controls, select_levels
from training.scenes.colmap import read_scene
from training.splats.bundle import read_bundle, write_bundle
from training.splats.gaussians import Splats
from training.splats.level_folder import write_folder
from training.splats.levels import Bundle, Level
from training.splats.ply import write_ply

ROOT = Path(__file__).resolve().parents[2]


def splats(count: int, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return rng.normal(0, 0.5, (count, *shape)).astype(np.float32)

    return Splats(normal(3), normal(4), normal(3) - 2, normal(), normal(1, 3))


@pytest.fixture
def bundle() -> Bundle:
    levels = [Level(1, splats(20), {"s_min": 0.3}), Level(2, splats(90, 1), {"s_min": 0.0})]
    return Bundle("flod", levels, rule="bands")


@pytest.fixture
def camera(tiny_scene):
    return read_scene(tiny_scene).cameras[4]


@pytest.mark.parametrize(
    "name",
    ["load_scene", "load_bundle", "select", "render_image", pytest.param("train", marks=pytest.mark.slow)],
)
def test_docstring_example(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "meta_path", [plugins._Alias(), *sys.meta_path])  # it imports lodgs
    before = set(sys.modules)
    (example,) = doctest.DocTestFinder(recurse=False).find(getattr(lodgs, name), name, api)
    report: list[str] = []
    result = doctest.DocTestRunner().run(example, out=report.append)
    for module in [module for module in set(sys.modules) - before if module.split(".")[0] == "lodgs"]:
        del sys.modules[module]
    assert result.attempted > 2 and result.failed == 0, "".join(report)


def test_import_is_lazy_and_reading_needs_no_torch():
    code = """
import sys, training
assert "numpy" not in sys.modules
assert callable(training.load_bundle) and callable(training.select)
assert "torch" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
    assert {*lodgs.__all__} - {"VERSION"} == {*api.__all__} - {"FinishedRun"}
    stub = (ROOT / "training" / "__init__.pyi").read_text()
    assert all(name in stub for name in lodgs.__all__)
    with pytest.raises(AttributeError, match="no_such_name"):
        lodgs.no_such_name  # noqa: B018


def test_load_scene(tiny_scene, tmp_path):
    scene = lodgs.load_scene(str(tiny_scene))
    assert len(scene.cameras) == 9 and scene.points.shape == (60, 3)
    explicit = lodgs.load_scene(tiny_scene, model=tiny_scene / "sparse" / "0", images=tiny_scene / "images")
    assert [camera.name for camera in explicit.cameras] == [camera.name for camera in scene.cameras]
    with pytest.raises(LodgsError, match=r"no_scene"):
        lodgs.load_scene(tmp_path / "no_scene")


def test_load_scene_converts_an_export(tmp_path):
    Image.new("RGB", (8, 6)).save(tmp_path / "a.png")
    (tmp_path / "transforms.json").write_text(
        '{"fl_x": 8, "w": 8, "h": 6, "frames": [{"file_path": "a.png", "transform_matrix":'
        " [[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}]}"
    )
    with pytest.warns(UserWarning, match="The scene has no points"):
        scene = lodgs.load_scene(tmp_path)
    assert [camera.name for camera in scene.cameras] == ["a.png"]


def test_load_bundle_reads_files_and_folders(bundle, tmp_path):
    write_bundle(tmp_path / "bundle.ply", bundle)
    write_folder(tmp_path / "levels", bundle)
    write_ply(tmp_path / "plain.ply", bundle.levels[1].splats)
    for name in ("bundle.ply", "levels"):
        result = lodgs.load_bundle(tmp_path / name)
        assert [len(level.splats) for level in result.levels] == [20, 90] and result.rule == "bands"
    assert len(lodgs.load_bundle(str(tmp_path / "plain.ply")).levels) == 1
    (tmp_path / "job.toml").touch()
    assert lodgs.load_bundle(tmp_path).method == "flod"
    (tmp_path / "bundle.ply").unlink()
    with pytest.raises(LodgsError, match="not finished"):
        lodgs.load_bundle(tmp_path)
    with pytest.raises(LodgsError, match="no_file"):
        lodgs.load_bundle(tmp_path / "no_file.ply")


def test_select_agrees_with_the_rule(bundle):
    center = np.array([0.0, 0.5, 30.0])
    result = lodgs.select(bundle, center, 60.0)
    expected = select_levels(bundle, center, 60.0, resolve_controls(bundle, {}))
    assert list(result) == [1, 2]
    for level, full in zip(expected, bundle.levels, strict=True):
        rows, weights = result[level.number]
        assert rows.dtype == np.int64 and weights.dtype == np.float32 and len(rows) == len(weights)
        np.testing.assert_array_equal(full.splats.means[rows], level.splats.means)
        assert (weights > 0).all()
    with pytest.raises(LodgsError, match="no_control"):
        lodgs.select(bundle, center, 60.0, {"no_control": 1})
    with pytest.raises(LodgsError):
        lodgs.select(replace(bundle, rule=""), center, 60.0)


def test_render_image(bundle, camera):
    finest = lodgs.render_image(bundle, camera, backend="cpu")
    assert finest.shape == (48, 64, 3) and finest.dtype == np.float32 and finest.max() > 0.1
    coarse = lodgs.render_image(bundle, camera, level=1, backend="cpu")
    by_distance = lodgs.render_image(bundle, camera, controls={}, backend="cpu")
    assert not np.array_equal(coarse, finest) and by_distance.shape == finest.shape
    straight = lodgs.render_image(bundle, camera, background=None, backend="cpu")
    assert straight.shape == (48, 64, 4)
    np.testing.assert_allclose(straight[..., :3] * straight[..., 3:], finest, atol=1e-5)
    with pytest.raises(LodgsError, match="level 5"):
        lodgs.render_image(bundle, camera, level=5, backend="cpu")


KEYS = {
    "method": "3dgs", "image_scale": 1.0, "test_every": 4, "backend": "cpu", "parameters": {"steps": 3},
}  # fmt: skip


@pytest.mark.slow
def test_train_reports_events_and_resumes(tiny_scene, tmp_path):
    events = []

    def stop(event):
        if event["event"] == "status":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lodgs.train(tiny_scene, tmp_path / "run", progress=stop, **KEYS)
    run = lodgs.train(tiny_scene, tmp_path / "run", progress=events.append, **KEYS)
    assert run.folder == tmp_path / "run" and run.metrics["train_psnr"] > 0
    assert events[0]["event"] == "hello" and events[-1]["event"] == "done"
    assert len(read_bundle(run.bundle).levels) == 1
    repeated = lodgs.train(tiny_scene, tmp_path / "run", **KEYS)
    assert repeated.metrics["train_psnr"] == run.metrics["train_psnr"]


@pytest.mark.slow
def test_errors_of_the_callback_reach_the_caller(tiny_scene, tmp_path):
    def fail(event):
        raise ValueError("of the callback")

    with pytest.raises(ValueError, match="of the callback"):
        lodgs.train(tiny_scene, tmp_path / "run", progress=fail, **KEYS)


def test_invalid_jobs_raise(tiny_scene, tmp_path):
    with pytest.raises(LodgsError, match="no_key"):
        lodgs.train(tiny_scene, tmp_path / "run", no_key=1)
    with pytest.raises(LodgsError, match="no_scene"):
        lodgs.train(tmp_path / "no_scene", tmp_path / "run", **KEYS)


def test_train_converts_an_export(tmp_path, monkeypatch):
    folder = shutil.copytree(ROOT / "tests/data/cases/transforms_width_height/export", tmp_path / "export")
    (folder / "images").mkdir()
    Image.new("RGB", (60, 40)).save(folder / "images" / "a.jpg")
    views = []

    def run(job, stream):
        views.extend(camera.name for camera in read_scene(Path(job.scene)).cameras)
        stream.write('{"event": "done"}')
        return 0

    monkeypatch.setattr("training.runs.train.train", run)
    api.train(folder, tmp_path / "run", method="3dgs")
    assert views == ["a.jpg"]
