"""Choice of the backend that trains a job."""

from dataclasses import replace

import pytest

from training.errors import LodgsError
from training.methods import METHODS, create
from training.rasterize import trial
from training.rasterize.gpu.device import Adapter
from training.runs import backend
from training.runs.job import Job
from training.scenes.colmap import read_scene


@pytest.fixture
def fast_card(monkeypatch):
    """Simulate a computer whose graphics card is fastest, without CUDA."""
    monkeypatch.setattr(backend, "fastest_backend", lambda: "gpu")


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"method": "3dgs"}, "gpu"),
        ({"method": "flod"}, "gpu"),
        ({"method": "octree"}, "gpu"),
        ({"method": "octree", "parameters": {"volume_weight": 0.01}}, "cpu"),
        ({"method": "lodge"}, "cpu"),
        ({"method": "octree_neural"}, "cpu"),
        ({"method": "3dgs", "parameters": {"lr_exposure": 1e-3}}, "cpu"),
        ({"method": "3dgs", "parameters": {"depth_weight": 1.0}}, "cpu"),
        ({"method": "3dgs", "region": "0 0 0 1 1 1"}, "cpu"),
        ({"method": "3dgs", "backend": "cpu"}, "cpu"),
        ({"method": "3dgs", "backend": "reference"}, "reference"),
    ],
)
def test_auto_uses_a_card_that_makes_all_steps(fast_card, tiny_scene, tmp_path, keys, expected):
    scene = read_scene(tiny_scene)
    job = Job(scene=str(tiny_scene), out=str(tmp_path), **keys)
    assert backend.choose_backend(job, scene) == expected


def test_auto_trains_masked_and_transparent_photos_on_the_cpu(fast_card, tiny_scene, tmp_path):
    scene = read_scene(tiny_scene)
    job = Job(scene=str(tiny_scene), out=str(tmp_path), method="3dgs")
    assert backend.choose_backend(job, scene, lambda: False) == "gpu"
    assert backend.choose_backend(job, scene, lambda: True) == "cpu"
    masked = replace(scene.cameras[0], mask=tmp_path / "mask.png")
    assert backend.choose_backend(job, replace(scene, cameras=[masked, *scene.cameras[1:]])) == "cpu"


@pytest.mark.parametrize(("method", "reported"), [("3dgs", True), ("lodge", False)])
def test_auto_reports_a_card_that_fails_its_self_test(tiny_scene, tmp_path, monkeypatch, method, reported):
    """Only jobs that the card could train alone look at it."""
    card = Adapter("Radeon 780M", "integrated", "Vulkan", "radv 24.1")
    for module in ("training.rasterize.gpu.default_device", "training.rasterize.trial"):
        monkeypatch.setattr(f"{module}.default_adapter", lambda: card)
    monkeypatch.setattr("training.rasterize.self_test.find_failure", lambda adapter: "its images are 3% off")
    scene, messages = read_scene(tiny_scene), []
    job = Job(scene=str(tiny_scene), out=str(tmp_path), method=method)
    chosen = backend.choose_backend(job, scene)
    backend.report_backend(job, scene, chosen, lambda kind, **values: messages.append(values["message"]))
    problem = (
        "Radeon 780M is not used: its images are 3% off. The CPU is used instead; a newer driver may help."
    )
    assert chosen == "cpu" and messages == [problem] * reported + ["Training on the CPU"]


def test_auto_reports_a_card_that_was_lost_in_its_self_test(monkeypatch):
    def lost(adapter):
        raise LodgsError("Radeon 780M stopped responding: lost.", "Install a newer driver.")

    card = Adapter("Radeon 780M", "integrated", "Vulkan", "radv 24.1")
    for module in ("training.rasterize.gpu.default_device", "training.rasterize.trial"):
        monkeypatch.setattr(f"{module}.default_adapter", lambda: card)
    monkeypatch.setattr("training.rasterize.self_test.find_failure", lost)
    assert trial.card_problem() == (
        "Radeon 780M is not used. Radeon 780M stopped responding: lost. Install a newer driver."
    )


@pytest.mark.parametrize("name", METHODS)
def test_declared_methods_make_all_steps_on_the_device(data, name):
    info = METHODS[name]
    for parameters in info.presets.values():
        if info.trains_on_device(parameters):
            method = create(name, data, parameters, seed=0, backend="cpu")
            assert method.device_steps >= method.steps
