"""Photographs are read ahead and kept within a budget; what is trained does not depend on either."""

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
from training.optimize import image_cache as targets_module
from training.optimize import memory as memory_module
from training.optimize.image_cache import TARGET_BYTES, ImageCache, default_budget
from training.optimize.parameters import override
from training.optimize.training_data import TrainingData
from training.rasterize import Target, photometric_loss
from training.scenes.cameras import Camera
from training.scenes.colmap import read_scene
from training.scenes.images import load_image

SIDE = 10
ONE = TARGET_BYTES * SIDE * SIDE
"""Bytes of a photograph of SIDE x SIDE pixels."""


def view(index: int, side: int = SIDE) -> Camera:
    return Camera(f"{index}", side, side, side, side, side / 2, side / 2, np.eye(4), Path(f"{index}.jpg"))


class Disk:
    """Photographs whose pixels are their number; counts how often each was read."""

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
def test_never_more_than_the_budget_is_held(room):
    disk, order = Disk(0.002), shuffles(20, 5)
    targets = ImageCache(disk, room * ONE + 7)
    most, follow = 0, targets.prefetch

    def watched(step, plan):
        nonlocal most
        follow(step, plan)
        most = max(most, targets.held_bytes)

    targets.prefetch = watched  # type: ignore[method-assign]
    run(targets, order)
    kept = sum(len(reading.result().image) for reading in targets._cached.values()) // SIDE
    assert targets.held_bytes == kept * ONE <= max(most, targets.held_bytes) <= room * ONE + 7
    assert sum(disk.reads.values()) >= 20
    if room >= 20:
        assert set(disk.reads.values()) == {1}
    if room == 0:
        assert sum(disk.reads.values()) == len(order)


def test_what_is_needed_soonest_stays():
    """No way to keep them reads fewer: each epoch shows as many as have no room when it begins."""
    views, room, epochs = 40, 20, 10
    disk = Disk()
    run(ImageCache(disk, room * ONE), shuffles(views, epochs))
    fewest = views + (epochs - 1) * (views - room)
    assert fewest <= sum(disk.reads.values()) <= 1.05 * fewest  # one that is being read cannot be dropped


def test_photographs_are_there_before_they_are_needed():
    """While a step goes on, those of the next ones are read, in their order."""
    disk, order = Disk(), list(range(30))
    targets = ImageCache(disk, 5 * ONE)

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


def test_a_plan_may_be_wrong_change_and_end():
    disk, order = Disk(0.001), shuffles(12, 4)
    run(ImageCache(disk, 4 * ONE), order, plan=lambda step: view((7 * step) % 12))
    run(ImageCache(disk, 4 * ONE), order, plan=lambda step: None)
    targets = ImageCache(disk, 4 * ONE)
    plans = [lambda step, side=side: view(order[step % 48], side) for side in (SIDE // 2, SIDE)]
    for half, plan in enumerate(plans):  # smaller ones at first, which then are of no more use
        for step in range(24 * half, 24 * half + 24):
            side = plan(step).width
            targets.prefetch(step, plan)
            assert targets.target(view(order[step], side)).image.shape == (side, side, 3)
            assert targets.held_bytes <= 4 * ONE
    for reading in targets._cached.values():
        assert len(reading.result().image) == SIDE


def test_steps_that_need_what_is_kept_are_not_robbed_by_pictures_between_them():
    """Evaluation in the middle of a run reads what has no room, and does not keep it."""
    disk = Disk()
    targets = ImageCache(disk, 10 * ONE)

    def plan(step: int) -> Camera:
        return view(step % 10)

    run(targets, list(range(10)), plan)
    for index in range(100, 130):
        targets.target(view(index))
    assert targets.held_bytes == 10 * ONE
    for step in range(10, 30):
        targets.prefetch(step, plan)
        targets.target(view(step % 10))
    assert all(disk.reads[f"{index}"] == 1 for index in range(10))


def test_an_unreadable_photograph_is_told_by_the_step_that_needs_it(tmp_path):
    scene = read_scene(write_tiny_scene(tmp_path / "scene"))
    data = TrainingData(scene, 1.0, 0)
    places = [camera.image for camera in data.train]
    assert all(places)
    whole = places[4].read_bytes()  # type: ignore[union-attr]
    for place in (places[4], places[6]):
        place.write_bytes(b"no image")  # type: ignore[union-attr]

    def planned(step: int) -> tuple[int, float] | None:
        return step % 9, 1

    for step in range(4):
        data.view_at(step, planned)
    for reading in list(data.images._cached.values()):
        reading.exception()  # by now 4 and 6 were tried
    places[4].write_bytes(whole)  # type: ignore[union-attr]
    assert data.view_at(4, planned).index == 4, "what is there again when it is needed is no error"
    data.view_at(5, planned)
    with pytest.raises(LodgsError, match="as an image"):
        data.view_at(6, planned)


@pytest.fixture(scope="module")
def scene(tiny_scene):
    return read_scene(tiny_scene)


def trained(scene, name: str, steps: range, memory: int, state: dict | None = None, about=()) -> dict:
    parameters = override(METHODS[name].presets["draft"], dict(about))
    method = create(name, TrainingData(scene, 1.0, 4, photo_memory=memory), parameters, 0, "cpu")
    if state is not None:
        method.load_state_dict(state)
    for step in steps:
        method.train_step(step)
    return method.state_dict()


def same(one, other) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


@pytest.mark.parametrize("name", ["3dgs", "octree", "flod"])
def test_the_same_bits_whatever_the_budget_and_whenever_photographs_arrive(scene, name, monkeypatch):
    """Also where a run goes on with another budget; some steps see smaller photographs."""
    photograph = TARGET_BYTES * 64 * 48
    about = {} if name == "octree" else {"first_resolution": 0.5, "full_resolution": 0.01}
    truth = trained(scene, name, range(16), 1 << 30, about=about)
    read = TrainingData._read

    def slowly(self, camera):
        time.sleep(0.02 * np.random.default_rng().random())
        return read(self, camera)

    monkeypatch.setattr(TrainingData, "_read", slowly)
    for memory in (0, photograph, 3 * photograph, 1 << 30):
        assert same(trained(scene, name, range(16), memory, about=about), truth)
    half = trained(scene, name, range(7), 2 * photograph, about=about)
    assert same(trained(scene, name, range(7, 16), photograph, half, about=about), truth)


@pytest.mark.parametrize("name", sorted(METHODS))
def test_every_method_plans_what_it_then_sees(scene, name):
    """At least as far ahead as its state stays as it is; and no photograph is read twice for it."""
    data = TrainingData(scene, 1.0, 4)
    method = create(name, data, METHODS[name].presets["draft"], 0, "cpu")
    ahead = [method.planned_view(step) for step in range(3, 9)]
    seen = [method.choose_view(step) for step in range(3, 9)]
    assert ahead == [(view.index, view.shrink) for view in seen]
    assert method.planned_view(method.steps) is None


def test_memory_stays_within_the_budget(tmp_path):
    """By the interpreter's own count of numpy's arrays, losses' moments included."""
    side, views = 320, 24
    rng = np.random.default_rng(0)
    cameras = []
    for index in range(views):
        path = tmp_path / f"{index}.png"
        Image.fromarray(rng.integers(0, 255, (side, side, 3), np.uint8)).save(path)
        cameras.append(replace(view(index, side), image=path))
    one = TARGET_BYTES * side * side
    picture = torch.rand(side, side, 3)

    def peak(budget: int) -> int:
        data = TrainingData.__new__(TrainingData)
        data.exposure, data.transparent, data.depths, data._gains = 0.0, False, None, {}
        targets = ImageCache(data._read, budget)
        tracemalloc.start()
        for step in range(2 * views):
            targets.prefetch(step, lambda step: cameras[step % views] if step < 2 * views else None)
            target = targets.target(cameras[step % views])
            photometric_loss(picture, target, 0.2, backend="cpu")
            del target
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    photometric_loss(picture, Target(picture), 0.2, backend="cpu")  # what kernels take once
    reading = 2 * 4 * one  # threads at work: what they decode, and what they make of it
    assert peak(3 * one) < 3 * one + one + reading
    assert peak(views * one) > 0.9 * views * one, "it is counted at all"


def test_a_target_holds_what_it_is_counted_for(scene):
    data = TrainingData(scene, 1.0, 4)
    target = data.target(0)
    photometric_loss(torch.zeros_like(target.image), target, 0.2, backend="cpu")
    truth, moments = target.cache["cpu"]
    assert np.shares_memory(truth, target.image.numpy())
    arrays = [truth, *moments] if isinstance(moments, tuple) else [truth, moments]
    assert sum(array.nbytes for array in arrays) == TARGET_BYTES * 64 * 48
    camera = data.train[0]
    assert camera.image is not None
    np.testing.assert_array_equal(target.image, load_image(camera.image, camera.width, camera.height))


def test_if_nothing_is_said_a_quarter_of_what_is_free(monkeypatch, tmp_path):
    monkeypatch.setattr(targets_module, "free_memory", lambda: 1000)
    assert default_budget() == 250
    monkeypatch.setattr(targets_module, "free_memory", lambda: 1 << 40)
    assert default_budget() == 2 << 30
    assert 1 << 24 < memory_module.free_memory() < 1 << 48
    for name, text in {"max": "1000", "current": "900", "stat": "anon 5\ninactive_file 300\n"}.items():
        (tmp_path / f"memory.{name}").write_text(text)
    assert memory_module._container_memory(tmp_path) == 400
    (tmp_path / "memory.max").write_text("max\n")
    assert memory_module._container_memory(tmp_path) > 1 << 60
