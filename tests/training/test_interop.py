"""The check of other programs."""

import os
from types import SimpleNamespace

import numpy as np
import pytest

from tests.training.splats.test_formats import random_splats
from tools import interop
from tools.interop_cut import draw_with_cut
from tools.interop_usd import compare
from tools.interop_walk import Walk
from training.api import render_image
from training.scenes.cameras import Camera
from training.splats.gaussians import SH_C0, Splats
from training.splats.levels import Bundle, Level

pytestmark = pytest.mark.skipif(os.name == "nt", reason="fake programs are shell scripts")


@pytest.mark.parametrize(
    ("version", "problem"),
    [
        ("v20.20.2", "Node.js v20.20.2 is too old."),
        ("v22.0.0", ""),
        ("", "Node.js of unknown version is too old."),
        (None, "Node.js or npm is not installed."),
    ],
)
def test_old_node_is_refused(tmp_path, monkeypatch, capsys, version, problem):
    for name in ("npm", *(["node"] if version is not None else [])):
        (tmp_path / name).write_text(f"#!/bin/sh\necho {version}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(interop, "install", lambda name, version: False)
    assert interop.node_problem() == problem
    if problem:
        assert interop.main() == 2
        assert capsys.readouterr().out == (
            f"interop: {problem} Install Node.js 22 or newer with npm (nodejs.org) and repeat.\n"
        )


def test_newer_node_is_installed_next_to_an_old_one(tmp_path, monkeypatch):
    for name in ("npm", "node"):
        (tmp_path / name).write_text("#!/bin/sh\necho v20.20.2\n")
        (tmp_path / name).chmod(0o755)

    def install(name, version):
        program = tmp_path / "node_modules" / "node" / "bin" / "node"
        program.parent.mkdir(parents=True)
        program.write_text(f"#!/bin/sh\necho v{version}\n")
        program.chmod(0o755)
        return name == "node"

    monkeypatch.setenv("PATH", f"{tmp_path}")
    monkeypatch.setattr(interop, "FOLDER", tmp_path)
    monkeypatch.setattr(interop, "install", install)
    assert interop.node_problem() == "" and interop.node_problem() == ""


@pytest.fixture(scope="module")
def camera():
    pose = np.eye(4)
    pose[2, 3] = 4.0
    return Camera("", 64, 48, 60.0, 60.0, 32.0, 24.0, pose)


def test_cut_ends_splats_at_two_standard_deviations(camera):
    """A splat of 0.2 units at depth 4 has 60 · 0.2 / 4 = 3 pixels, and sqrt(9.3) with the added variance."""
    zero = np.zeros((1, 3), np.float32)
    splats = Splats(
        zero, np.float32([[1, 0, 0, 0]]), zero + np.log(0.2), zero[:, 0] + 9, zero[:, None] + 1.77
    )
    image = draw_with_cut(splats, camera, 0.01)
    offsets = np.hypot(np.arange(64) - 31.5, (np.arange(48) - 23.5)[:, None])
    np.testing.assert_array_equal(image[..., 0] > 0, offsets <= 2 * np.sqrt(9.3))
    expected = (9 / 9.3) / (1 + np.exp(-9)) * np.exp(-(0.5**2 + 0.5**2) / 9.3 / 2)
    np.testing.assert_allclose(image[23, 31], expected * np.clip(0.5 + SH_C0 * 1.77, 0, 1), rtol=1e-4)


def test_without_cut_the_image_is_that_of_the_renderer(camera):
    splats = random_splats(300, 2)
    bundle = Bundle("", [Level(1, splats)], meta={"antialias": True})
    expected = render_image(bundle, camera, backend="cpu").clip(0, 1)
    image = draw_with_cut(splats, camera, 0.01, cut=3.33, variance=0.1).clip(0, 1)
    assert -10 * np.log10(np.square(image - expected).mean()) > 40
    cut = draw_with_cut(splats, camera, 0.01, variance=0.1).clip(0, 1)
    assert -10 * np.log10(np.square(cut - expected).mean()) < 35


@pytest.fixture
def walk(tmp_path, camera):
    levels = [Level(number, random_splats(count)) for number, count in ((1, 100), (2, 300))]
    return lambda viewer: Walk(Bundle("flod", levels), camera, 0.01, viewer, tmp_path / viewer)


def record(*splats, hole=0.0, most=0):
    return [{"splats": count, "most": max(most, count), "hole": hole} for count in splats]


def test_walks_without_holes_and_within_the_budget_pass(walk):
    assert walk("playcanvas").judge(record(101, 100, 101)) == ""
    assert walk("page").judge(record(1100, 1050)) == ""
    assert walk("cesium").judge(record(100, 300)) == ""
    assert [walk(viewer).budget for viewer in ("playcanvas", "page", "cesium")] == [150, 1200, 300]


@pytest.mark.parametrize(
    ("viewer", "steps", "fault"),
    [
        ("cesium", record(100, 200, hole=0.01), "hole of 1.00%"),
        ("cesium", record(100, 150, most=301), "301 splats exceed the budget"),
        ("cesium", record(200, 200), "as at the farthest"),
        ("page", record(800, 800), "as at the farthest"),
    ],
)
def test_faults_of_walks_are_named(walk, viewer, steps, fault):
    assert fault in walk(viewer).judge(steps)


def test_walk_approaches_the_subject(walk):
    cameras = walk("cesium").cameras
    depths = [-camera.center[2] for camera in cameras]
    assert depths == sorted(depths, reverse=True)
    np.testing.assert_allclose(cameras[-1].center, (0, 0, -4), atol=1e-6)


class FakeAttribute:
    """An attribute of a splat cloud in Blender."""

    def __init__(self, values):
        self.values, self.data = values, self

    def foreach_get(self, _kind, target):
        target[:] = self.values.reshape(-1)


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("", ""),
        ("position", "position"),
        ("scale", "scale"),
        ("rotation", "rotation"),
        ("radiance:sh_2", "sh"),
    ],
)
def test_changed_values_of_a_splat_cloud_are_named(name, fault):
    splats = random_splats(9, 1)
    turns = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    expected = {"position": splats.means, "scale": np.exp(splats.log_scales), "rotation": turns}
    expected["sh"] = splats.sh
    values = {**expected, **{f"radiance:sh_{i}": splats.sh[:, 1 + i] for i in range(3)}, "rotation": -turns}
    if name:
        values[name] = 1.001 * values[name]
    attributes = {key: FakeAttribute(value) for key, value in values.items()}
    problems = compare(SimpleNamespace(points=range(9), attributes=attributes), expected, "Level_1")
    assert [problem.split()[1] for problem in problems] == ([fault] if fault else [])
