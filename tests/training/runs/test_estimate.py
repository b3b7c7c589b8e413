"""Estimate of a training: counts, costs measured by real steps, and suggested settings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.training.conftest import write_tiny_scene
from training.optimize.initialize import from_points, to_splats
from training.runs import estimate as module
from training.runs.capture import capture
from training.runs.estimate import Estimate, estimate, estimate_findings, suggest_settings
from training.runs.job import Job
from training.scenes.cameras import write_camera
from training.scenes.colmap import read_scene
from training.scenes.viewpoints import opaque_means, surrounding_views
from training.splats.gaussians import Splats
from training.splats.ply import read_ply, write_ply

COSTS = Estimate(600, 10**9, 8 * 10**9, 10**9, 50 * 10**9, 60_000, 1000, 42, (960, 640))


@pytest.fixture
def job(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MEASURED_SECONDS", 0.0)
    scene = write_tiny_scene(tmp_path / "scene")
    parameters = {"max_splats": 90, "levels": 2, "steps": 40, "densify_interval": [1, 1]}
    return Job(
        scene=str(scene), out=str(tmp_path / "run"), backend="cpu", image_scale=1.0, parameters=parameters
    )


def test_estimate_measures_real_steps_at_the_final_size(job, tmp_path, monkeypatch):
    """Steps take 0.1 s with the scene's points and 0.3 s at the end: their mean is 0.25 s."""
    counts = []

    def time_steps(method, first, end):
        counts.append(method.splats)
        method.train_step(first)
        return 0.3 if len(counts) == 2 else 0.1

    monkeypatch.setattr(module, "_time_steps", time_steps)
    costs = estimate(job, tmp_path)
    points = len(read_scene(Path(job.scene)).points)
    assert counts == [points, 90] and costs.splats == 90
    assert module.START_SECONDS < costs.seconds - 0.25 * costs.steps < module.START_SECONDS + 60
    assert costs.steps == job.resolved_parameters().total_steps
    assert 10**8 < costs.memory < 10**10 and costs.free_memory > 0
    bytes_per_splat = 4 * (3 + 3 + 4 + 1 + 3 * 16)
    assert costs.disk > 90 * 2 * bytes_per_splat and costs.free_disk > 0
    assert not (tmp_path / "run").exists()


def test_coarse_levels_before_the_finest_one_count_as_growth(job, tmp_path, monkeypatch):
    """Levels of 30 and 10 steps, of which the first has 0.1 s and the last 0.3 s a step."""
    firsts = []

    def time_steps(method, first, end):
        firsts.append((first, end))
        method.train_step(first)
        return 0.3 if first else 0.1

    monkeypatch.setattr(module, "_time_steps", time_steps)
    parameters = {
        "max_splats": 90,
        "levels": 2,
        "steps": [30, 10],
        "levels_from": "trained",
        "finish_share": 0,
    }
    parameters |= {"densify_interval": [1, 1]}
    costs = estimate(replace(job, parameters=parameters), tmp_path)
    assert firsts == [(0, 40), (30, 40)] and costs.steps == 40
    expected = 40 * (0.75 * 0.2 + 0.25 * 0.3)
    assert module.START_SECONDS < costs.seconds - expected < module.START_SECONDS + 60


def test_single_splats_have_an_estimate(job, tmp_path):
    parameters = {"max_splats": 1, "steps": 4}
    assert estimate(replace(job, method="3dgs", parameters=parameters), tmp_path).splats == 1


def test_estimate_of_a_tree_measures_its_leaves(job, tmp_path):
    """Steps on cuts need the tree, which later steps build."""
    parameters = {"max_splats": 90, "steps": 40, "tune_steps": 400}
    assert estimate(replace(job, method="tree", parameters=parameters), tmp_path).steps == 441


@pytest.mark.parametrize(
    ("method", "parameters", "count"),
    [
        ("3dgs", {"steps": 300, "max_splats": 5000}, 1300),  # 3 rounds of 10 %
        ("3dgs", {"steps": 300, "max_splats": 1200}, 1200),
        ("flod", {"steps": [100] * 5, "refine_steps": 100, "densify_interval": [20] * 5}, 1630),  # 252 steps
        ("octree", {"max_splats": 5000}, 5000),
    ],
)
def test_splats_grow_with_densifications(job, method, parameters, count):
    parameters = replace(job, method=method, parameters=parameters).resolved().resolved_parameters()
    assert module._expected_splats(parameters, 1000) == pytest.approx(count, abs=1)


def test_points_of_the_final_size_are_near_the_scene(job):
    scene = read_scene(Path(job.scene))
    dense = module._with_points(scene, 5000)
    assert len(dense.points) == len(dense.point_colors) == 5000
    low, high = np.percentile(scene.points, (1, 99), axis=0)
    margin = 0.5 * (high - low).max()
    inside = ((dense.points > low - margin) & (dense.points < high + margin)).all(axis=1)
    assert inside.mean() > 0.95


def test_finding_has_the_costs_in_one_sentence(job):
    first = estimate_findings(job)[0]
    assert first.severity == "estimate"
    assert str(COSTS) == (
        "About 10 min, 1.0 of 8.0 GB memory, 1.0 of 50.0 GB disk, about 60,000 splats (1,000 steps on 42 "
        "views of 960x640 pixels)."
    )


def test_scenes_without_points_have_no_estimate(job):
    Path(job.scene, "sparse", "0", "points3D.txt").write_text("")
    (finding,) = estimate_findings(job)
    assert str(finding) == "No estimate: the scene has no points yet. Training makes them first."


@pytest.fixture
def ball(tmp_path):
    """Return the file of 300 opaque splats on a sphere."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(300, 3))
    means = 2 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    splats = Splats(
        means.astype(np.float32), np.tile(np.float32([1, 0, 0, 0]), (300, 1)),
        np.full((300, 3), np.log(0.2), np.float32), np.full(300, 4.0, np.float32),
        np.zeros((300, 1, 3), np.float32),
    )  # fmt: skip
    write_ply(tmp_path / "ball.ply", splats)
    return tmp_path / "ball.ply"


def test_training_without_photos_has_an_estimate_from_some_of_its_views(job, ball, tmp_path, monkeypatch):
    """40 steps of 0.2 s, and 14 more views of 0.5 s each: the clock advances at each view."""
    monkeypatch.setattr(module, "_time_steps", lambda method, first, end: 0.2)
    rendered, clock = [], iter(np.arange(0, 100, 0.5))

    def render(base, scene, source, views, width, *, backend, report):
        rendered.append((source, views, width))
        with monkeypatch.context() as patch:
            patch.setattr(module.time, "monotonic", lambda: next(clock))
            return capture(base, scene, source, views, width, backend=backend, report=report)

    monkeypatch.setattr(module, "capture", render)
    parameters = {"levels": 3, "tune_steps": 10, "levels_from": "merged"}
    job = replace(
        job, scene="", method="lodge", base=str(ball), capture="dome", views=20, view_width=48,
        parameters=parameters,
    )  # fmt: skip
    costs = estimate(job, tmp_path)
    assert rendered == [("dome", module.SAMPLE_VIEWS, 48)]
    assert (costs.splats, costs.views, costs.size) == (300, 20, (48, 32))
    assert costs.steps == job.resolved().resolved_parameters().base_steps
    assert str(costs).startswith("At least ")
    expected = 0.2 * costs.steps + 14 * 0.5
    assert module.START_SECONDS < costs.seconds - expected < module.START_SECONDS + 60


def test_estimate_renders_some_of_the_views_of_a_folder(job, ball, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_time_steps", lambda method, first, end: 0.2)
    cameras, near = surrounding_views(opaque_means(read_ply(ball)), 9, 48, 32)
    (tmp_path / "views").mkdir()
    for number, camera in enumerate(cameras):
        write_camera(tmp_path / "views" / f"{number}.json", camera, near)
    job = replace(
        job, scene="", base=str(ball), capture=str(tmp_path / "views"), method="3dgs", parameters={}
    )
    assert estimate(job, tmp_path).views == 9
    assert len(list((tmp_path / "cameras").glob("*.json"))) == module.SAMPLE_VIEWS


def test_training_of_photos_from_splats_has_an_estimate(job, tmp_path, monkeypatch):
    counts = []
    monkeypatch.setattr(module, "_time_steps", lambda method, *_: counts.append(method.splats) or 0.1)
    scene = read_scene(Path(job.scene))
    base = to_splats(from_points(scene.points, scene.point_colors, 0))
    write_ply(tmp_path / "base.ply", base)
    job = replace(job, method="3dgs", base=str(tmp_path / "base.ply"), parameters={"steps": 40})
    costs = estimate(job, tmp_path)
    assert counts == [len(base)] and costs.splats == len(base) and costs.steps == 40


def test_cells_have_no_estimate(job):
    (finding,) = estimate_findings(replace(job, cells="2x1"))
    assert finding.severity == "estimate" and "in cells" in finding.what


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, ""),
        ({"memory": 7 * 10**9}, "more than 80% of the free memory"),
        ({"disk": 45 * 10**9}, "more than 80% of the free disk space"),
        ({"size": (3200, 2400)}, "Set the image scale to 0.25"),
        ({"size": (320, 200)}, "only 320 pixels, which loses details. Set the image scale to 1."),
        ({"seconds": 9000}, "more than 2 hours on this computer. Train the preset draft first"),
    ],
)
def test_settings_are_suggested_with_their_reason(job, changes, text):
    job = replace(job, preset="standard", image_scale=0.5, parameters={}).resolved()
    texts = " ".join(map(str, suggest_settings(job, replace(COSTS, **changes))))
    assert text in texts if text else not texts


def test_cells_are_offered_if_memory_is_short(job, monkeypatch):
    monkeypatch.setattr(module, "choose_cells", lambda job, memory: f"2x{memory // 10**9}")
    (finding,) = suggest_settings(replace(job, image_scale=1.0), replace(COSTS, memory=20 * 10**9))
    assert finding.remedy.startswith("Train in 2x6 cells")
