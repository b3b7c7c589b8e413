"""Runs on a graphics device: change of backends, lost devices, and devices that render incorrectly."""

from dataclasses import replace

import pytest

from training.rasterize import self_test
from training.rasterize.gpu import default_device
from training.runs import train as training_loop
from training.runs.finished import open_evaluation
from training.runs.folder import RunFolder
from training.runs.job import Job
from training.runs.measure import evaluate_run

from .test_train import TINY, method_of, run_in_process


@pytest.fixture
def keys(tiny_scene, tmp_path) -> dict:
    """A job of 9 steps on the graphics device."""
    parameters = {**TINY["flod"], "steps": [3, 3, 3], "finish_share": 0.0}
    return {
        "scene": str(tiny_scene), "out": str(tmp_path / "run"), "image_scale": 1.0, "test_every": 4,
        "method": "flod", "parameters": parameters, "backend": "gpu",
    }  # fmt: skip


def train_until(keys: dict, last: int, monkeypatch) -> list[dict]:
    """Train until the run is cancelled at a step; return the events."""
    train_step = method_of(keys).train_step

    def cancelling_step(self, step):
        if step == last:
            RunFolder(keys["out"]).request_cancel()
        return train_step(self, step)

    with monkeypatch.context() as patch:
        patch.setattr(method_of(keys), "train_step", cancelling_step)
        code, events = run_in_process(keys)
    assert code == training_loop.CANCELLED, events[-1]
    return events


def test_run_changes_between_backends(graphics, fake_card, keys, monkeypatch):
    """From the device to cuda (simulated on the CPU), back to the device, and to the cpu."""
    for last, backend in ((1, "gpu"), (3, "cuda"), (6, "gpu")):
        train_until({**keys, "backend": backend}, last, monkeypatch)
    code, events = run_in_process({**keys, "backend": "cpu"})
    assert code == 0 and {event["level"] for event in RunFolder(keys["out"]).levels()} == {1, 2, 3}
    assert [event["backend"] for event in events if "backend" in event] == ["gpu", "cuda", "gpu", "cpu"]
    assert f"Training on {graphics.adapter.name}" in [event.get("message") for event in events]
    resumed = [event["message"] for event in events if "Resuming at step" in event.get("message", "")]
    assert [message.split()[3] for message in resumed] == ["2", "4", "7"]


@pytest.mark.nightly
def test_stopped_run_on_a_device_gives_the_same_bits_and_measures(graphics, keys, monkeypatch, tmp_path):
    code, _ = run_in_process(keys)
    assert code == 0
    stopped = {**keys, "out": str(tmp_path / "stopped")}
    train_until(stopped, 4, monkeypatch)
    assert run_in_process(stopped)[0] == 0
    first, second = (RunFolder(job["out"]) for job in (keys, stopped))
    assert first.bundle.read_bytes() == second.bundle.read_bytes()
    replace(Job.from_file(second.job), backend="cpu").write(second.job)
    gpu_report, cpu_report = (evaluate_run(folder.path) for folder in (first, second))
    for gpu_level, cpu_level in zip(gpu_report["levels"], cpu_report["levels"], strict=True):
        assert gpu_level["psnr"] == pytest.approx(cpu_level["psnr"], abs=1e-3)
        assert gpu_level["drawn"] == cpu_level["drawn"]


@pytest.mark.parametrize(
    ("error", "problem", "remedy"),
    [
        (
            RuntimeError("Validation Error: Parent device is lost"),
            "stopped responding",
            "Resume the run",
        ),
        pytest.param(
            RuntimeError("Not enough memory left."),
            "is out of memory",
            "on the cpu",
            marks=pytest.mark.nightly,
        ),
    ],
)
def test_lost_device_or_low_memory_is_reported_and_the_run_can_be_resumed(
    graphics, keys, monkeypatch, error, problem, remedy
):
    monkeypatch.setattr(training_loop, "CHECKPOINT_SECONDS", 0.0)
    train_step = method_of(keys).train_step

    def losing_step(self, step):
        if step == 4:
            device = default_device.open_default_device()._device

            def fail(**_):
                raise error

            patch.setattr(device, "create_buffer", fail)
        return train_step(self, step)

    with monkeypatch.context() as patch:
        patch.setattr(method_of(keys), "train_step", losing_step)
        code, events = run_in_process(keys)
    assert code == 2 and events[-1]["event"] == "error"
    assert problem in events[-1]["what"] and remedy in events[-1]["remedy"]
    assert RunFolder(keys["out"]).state() == "failed"
    code, events = run_in_process(keys)  # the device works again
    assert code == 0 and Job.from_file(RunFolder(keys["out"]).job).backend == "gpu"
    assert any("Resuming at step 4 of 9" in event.get("message", "") for event in events)


def test_cpu_replaces_a_device_that_renders_incorrectly(graphics, keys, monkeypatch):
    monkeypatch.setattr(self_test, "find_failure", lambda adapter: "its images are 3% off")
    keys["parameters"]["steps"] = [1, 1, 1]
    code, events = run_in_process(keys)
    assert code == 0
    assert [event["backend"] for event in events if "backend" in event] == ["cpu"]
    warnings = [event["message"] for event in events if event["event"] == "warning"]
    (warning,) = [message for message in warnings if "is not used" in message]
    assert warning.startswith(f"{graphics.adapter.name} is not used: its images are 3% off. The CPU")
    warnings = []
    open_evaluation(RunFolder(keys["out"]).path, warnings.append)
    assert warning in warnings


@pytest.mark.slow
@pytest.mark.nightly
def test_levels_on_a_device_are_as_good_as_on_the_cpu(graphics, keys, tmp_path):
    """Each level has the same PSNR within 0.25 dB, and about the same number of splats.

    Training is that sensitive: on the cpu, changing lr_means by 0.002 % changes level 2 by 0.2 dB.
    """
    keys["parameters"] |= {"steps": [20, 25, 30], "finish_share": 0.2}
    levels = []
    for backend in ("cpu", "gpu"):
        out = tmp_path / backend
        assert run_in_process({**keys, "backend": backend, "out": str(out)})[0] == 0
        levels.append({level["level"]: level for level in RunFolder(out).levels()})
    assert levels[0].keys() == levels[1].keys() == {1, 2, 3}
    for number, level in levels[0].items():
        assert levels[1][number]["psnr"] == pytest.approx(level["psnr"], abs=0.25), number
        assert levels[1][number]["splats"] == pytest.approx(level["splats"], rel=0.05), number
    assert levels[0][3]["psnr"] > 12
