"""Tests of the image cache: reading ahead, memory limit, and identical training results."""

import time
import tracemalloc
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.training.conftest import write_tiny_scene
from training.errors import LodgsError
from training.methods import METHODS, create
from training.optimize import image_cache as image_cache_module
from training.optimize import memory as memory_module
from training.optimize.image_cache import TARGET_BYTES, ImageCache, default_budget
from training.optimize.parameters import override
from training.optimize.training_data import TrainingData
from training.rasterize import Target, photometric_loss
from training.scenes.cameras import Camera
from training.scenes.colmap import read_scene
from training.scenes.images import load_image

SIDE = 10
IMAGE_BYTES = TARGET_BYTES * SIDE * SIDE
"""Bytes of an image of SIDE x SIDE pixels."""


def view(index: int, side: int = SIDE) -> Camera:
    return Camera(f"{index}", side, side, side, side, side / 2, side / 2, np.eye(4), Path(f"{index}.jpg"))


class Disk:
    """Images whose pixels are their number. Counts the reads of each."""

    def __init__(self, pause: float = 0.0) -> None:
        self.reads, self.pause = Counter(), pause

    def __call__(self, camera: Camera) -> Target:
        if self.pause:
            time.sleep(np.random.default_rng(int(camera.name)).random() * self.pause)
        self.reads[camera.name] += 1
        return Target(torch.full((camera.height, camera.width, 3), float(camera.name)))


def shuffles(views: int, epochs: int) -> list[int]:
    return np.concatenate([np.random.default_rng(e).permutation(views) for e in range(epochs)]).tolist()


def run(targets: ImageCache, order: list[int], plan=None) -> None:
    plan = plan or (lambda step: view(order[step]) if step < len(order) else None)
    for step, index in enumerate(order):
        targets.prefetch(step, plan)
        assert (targets.target(view(index)).image == index).all()


@pytest.mark.parametrize("room", [0, 1, 2, 5, 19, 20, 1000])
def test_cache_stays_within_the_budget(room):
    disk, order = Disk(0.002), shuffles(20, 5)
    targets = ImageCache(disk, room * IMAGE_BYTES + 7)
    peak, prefetch = 0, targets.prefetch

    def monitored(step, plan):
        nonlocal peak
        prefetch(step, plan)
        peak = max(peak, targets.held_bytes)

    targets.prefetch = monitored  # type: ignore[method-assign]
    run(targets, order)
    cached = sum(len(reading.result().image) for reading in targets._cached.values()) // SIDE
    assert (
        targets.held_bytes == cached * IMAGE_BYTES <= max(peak, targets.held_bytes) <= room * IMAGE_BYTES + 7
    )
    assert sum(disk.reads.values()) >= 20
    if room >= 20:
        assert set(disk.reads.values()) == {1}
    if room == 0:
        assert sum(disk.reads.values()) == len(order)


def test_images_needed_soonest_are_kept():
    """The number of reads is minimal: each epoch reads the images that were not cached at its start."""
    views, room, epochs = 40, 20, 10
    disk, order = Disk(), shuffles(views, epochs)
    targets = ImageCache(disk, room * IMAGE_BYTES)
    for step, index in enumerate(order):
        targets.prefetch(step, lambda step: view(order[step]) if step < len(order) else None)
        targets.target(view(index))
        for reading in list(targets._cached.values()):
            reading.result()  # images being read cannot be evicted
    minimum = views + (epochs - 1) * (views - room)
    assert minimum <= sum(disk.reads.values()) <= 1.05 * minimum


def test_images_are_read_ahead():
    """Images of the next steps are read during a step, in order."""
    disk, order = Disk(), list(range(30))
    targets = ImageCache(disk, 5 * IMAGE_BYTES)

    def plan(step: int) -> Camera | None:
        return view(order[step]) if step < len(order) else None

    for step, index in enumerate(order):
        targets.prefetch(step, plan)
        targets.target(view(index))
        for reading in list(targets._cached.values()):
            reading.result()
        assert {f"{i}" for i in order[step : step + 5]} <= disk.reads.keys()
        assert len(disk.reads) <= step + 5
    assert set(disk.reads.values()) == {1}


def test_forecast_may_be_wrong_change_and_end():
    disk, order = Disk(0.001), shuffles(12, 4)
    run(ImageCache(disk, 4 * IMAGE_BYTES), order, plan=lambda step: view((7 * step) % 12))
    run(ImageCache(disk, 4 * IMAGE_BYTES), order, plan=lambda step: None)
    targets = ImageCache(disk, 4 * IMAGE_BYTES)
    plans = [lambda step, side=side: view(order[step % 48], side) for side in (SIDE // 2, SIDE)]
    for half, plan in enumerate(plans):  # smaller images first, which are not needed later
        for step in range(24 * half, 24 * half + 24):
            side = plan(step).width
            targets.prefetch(step, plan)
            assert targets.target(view(order[step], side)).image.shape == (side, side, 3)
            assert targets.held_bytes <= 4 * IMAGE_BYTES
    for reading in targets._cached.values():
        assert len(reading.result().image) == SIDE


def test_evaluation_does_not_evict_training_images():
    """Images of an evaluation during a run do not fit and are not cached."""
    disk = Disk()
    targets = ImageCache(disk, 10 * IMAGE_BYTES)

    def plan(step: int) -> Camera:
        return view(step % 10)

    run(targets, list(range(10)), plan)
    for index in range(100, 130):
        targets.target(view(index))
    assert targets.held_bytes == 10 * IMAGE_BYTES
    for step in range(10, 30):
        targets.prefetch(step, plan)
        targets.target(view(step % 10))
    assert all(disk.reads[f"{index}"] == 1 for index in range(10))


def test_step_reports_its_unreadable_image(tmp_path):
    scene = read_scene(write_tiny_scene(tmp_path / "scene"))
    data = TrainingData(scene, 1.0, 0)
    paths = [camera.image for camera in data.train]
    assert all(paths)
    content = paths[4].read_bytes()  # type: ignore[union-attr]
    for path in (paths[4], paths[6]):
        path.write_bytes(b"no image")  # type: ignore[union-attr]

    def planned(step: int) -> tuple[int, float] | None:
        return step % 9, 1

    for step in range(4):
        data.view_at(step, planned)
    for reading in list(data.images._cached.values()):
        reading.exception()  # images 4 and 6 have failed
    paths[4].write_bytes(content)  # type: ignore[union-attr]
    assert data.view_at(4, planned).index == 4, "an image that is readable again is no error"
    data.view_at(5, planned)
    with pytest.raises(LodgsError, match="as an image"):
        data.view_at(6, planned)


@pytest.fixture(scope="module")
def scene(tiny_scene):
    return read_scene(tiny_scene)


def train(scene, name: str, steps: range, memory: int, state: dict | None = None, overrides=()) -> dict:
    parameters = override(METHODS[name].presets["draft"], dict(overrides))
    method = create(name, TrainingData(scene, 1.0, 4, photo_memory=memory), parameters, 0, "cpu")
    if state is not None:
        method.load_state_dict(state)
    for step in steps:
        method.train_step(step)
    return method.state_dict()


def equal(first, second) -> bool:
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(equal(first[key], second[key]) for key in first)
    if isinstance(first, torch.Tensor):
        return torch.equal(first, second)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(equal, first, second))
    return first == second


@pytest.mark.parametrize(
    "name", ["flod", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("3dgs", "octree"))]
)
def test_training_is_bit_identical_for_any_cache_size_and_timing(scene, name, monkeypatch):
    """Includes runs that resume with another budget, and steps with reduced images."""
    image_bytes = TARGET_BYTES * 64 * 48
    overrides = {} if name == "octree" else {"first_resolution": 0.5, "full_resolution": 0.01}
    truth = train(scene, name, range(16), 1 << 30, overrides=overrides)
    read = TrainingData._read

    def slow_read(self, camera):
        time.sleep(0.02 * np.random.default_rng().random())
        return read(self, camera)

    monkeypatch.setattr(TrainingData, "_read", slow_read)
    for memory in (0, image_bytes, 3 * image_bytes, 1 << 30):
        assert equal(train(scene, name, range(16), memory, overrides=overrides), truth)
    partial = train(scene, name, range(7), 2 * image_bytes, overrides=overrides)
    assert equal(train(scene, name, range(7, 16), image_bytes, partial, overrides=overrides), truth)


@pytest.mark.parametrize("name", sorted(METHODS))
def test_planned_views_match_chosen_views(scene, name):
    """True as long as the method's state does not change."""
    data = TrainingData(scene, 1.0, 4)
    method = create(name, data, METHODS[name].presets["draft"], 0, "cpu")
    planned = [method.planned_view(step) for step in range(3, 9)]
    views = [method.choose_view(step) for step in range(3, 9)]
    assert planned == [(view.index, view.shrink) for view in views]
    assert method.planned_view(method.steps) is None


@pytest.mark.nightly
def test_memory_stays_within_the_budget(tmp_path):
    """Measured by tracemalloc, including moments of losses."""
    side, views = 320, 24
    rng = np.random.default_rng(0)
    cameras = []
    for index in range(views):
        path = tmp_path / f"{index}.png"
        Image.fromarray(rng.integers(0, 255, (side, side, 3), np.uint8)).save(path)
        cameras.append(replace(view(index, side), image=path))
    image_bytes = TARGET_BYTES * side * side
    rendered = torch.rand(side, side, 3)

    def peak(budget: int) -> int:
        data = TrainingData.__new__(TrainingData)
        data.exposure, data.transparent, data.depths, data._gains = 0.0, False, None, {}
        data._sizes = {}
        targets = ImageCache(data._read, budget)
        tracemalloc.start()
        for step in range(2 * views):
            targets.prefetch(step, lambda step: cameras[step % views] if step < 2 * views else None)
            target = targets.target(cameras[step % views])
            photometric_loss(rendered, target, 0.2, backend="cpu")
            del target
        peak_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak_bytes

    photometric_loss(rendered, Target(rendered), 0.2, backend="cpu")  # allocates memory of kernels once
    reading = 2 * 4 * image_bytes  # decoded and converted images of two threads
    assert peak(3 * image_bytes) < 3 * image_bytes + image_bytes + reading
    assert peak(views * image_bytes) > 0.9 * views * image_bytes


def test_target_has_the_size_that_the_cache_assumes(scene):
    data = TrainingData(scene, 1.0, 4)
    target = data.target(0)
    photometric_loss(torch.zeros_like(target.image), target, 0.2, backend="cpu")
    truth = target.cache["cpu"]
    assert np.shares_memory(truth, target.image.numpy())
    assert truth.nbytes == TARGET_BYTES * 64 * 48
    camera = data.train[0]
    assert camera.image is not None
    np.testing.assert_array_equal(target.image, load_image(camera.image, camera.width, camera.height))


def test_default_budget_is_a_quarter_of_the_free_memory(monkeypatch, tmp_path):
    monkeypatch.setattr(image_cache_module, "free_memory", lambda: 1000)
    assert default_budget() == 250
    monkeypatch.setattr(image_cache_module, "free_memory", lambda: 1 << 40)
    assert default_budget() == 2 << 30
    assert 1 << 24 < memory_module.free_memory() < 1 << 48
    for name, text in {"max": "1000", "current": "900", "stat": "anon 5\ninactive_file 300\n"}.items():
        (tmp_path / f"memory.{name}").write_text(text)
    assert memory_module._container_memory(tmp_path) == 400
    (tmp_path / "memory.max").write_text("max\n")
    assert memory_module._container_memory(tmp_path) > 1 << 60
