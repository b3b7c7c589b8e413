"""Test selection, self-test and description of graphics devices."""

import json
import os
import subprocess
import sys
from functools import cache

import pytest
import torch

from training import __main__ as command
from training.errors import LodgsError
from training.rasterize import cpu, cpu_fallback_reason, cuda, gpu, resolve_backend, self_test, trial
from training.rasterize.devices import Devices, describe
from training.rasterize.gpu import default_device
from training.rasterize.gpu.device import Adapter

CARD = Adapter("GeForce RTX 4070 Laptop", "discrete", "Vulkan", "555.1")
DESKTOP = Adapter("GeForce RTX 4070", "discrete", "Vulkan", "555.1")
INTEGRATED = Adapter("Radeon 780M", "integrated", "Vulkan", "radv 24.1")
SOFTWARE = Adapter("llvmpipe (LLVM 15)", "software", "Vulkan", "Mesa")


@pytest.fixture
def set_adapters(monkeypatch, tmp_path):
    """Function that simulates a computer with the given adapters, whose results are the cpu backend's.

    The cache folder is empty, and torch detects no GPU.
    """

    def simulate(*available: Adapter) -> None:
        def adapters() -> list[Adapter]:
            if not available:
                raise LodgsError("Cannot detect a graphics device.")
            return list(available)

        monkeypatch.setattr(default_device, "adapters", adapters)
        monkeypatch.setattr("training.rasterize.devices.adapters", adapters)

    class OpenedDevice:
        binding_bytes = 2 << 30

    monkeypatch.delenv(default_device.VARIABLE, raising=False)
    for module in (self_test, trial):
        monkeypatch.setattr(module, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(trial, "default_adapter", lambda: default_device.default_adapter())
    monkeypatch.setattr("training.rasterize.devices.open_device", lambda name: OpenedDevice())
    for name in ("rasterize", "contributions", "photometric_loss"):
        monkeypatch.setattr(gpu, name, getattr(cpu, name), raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    self_test.find_failure.cache_clear()
    cuda.find_problem.cache_clear()
    yield simulate
    self_test.find_failure.cache_clear()
    cuda.find_problem.cache_clear()


@pytest.fixture
def set_times(monkeypatch):
    """Function that sets the milliseconds of a training step by backend, and counts measurements."""

    def set_times(**times: float) -> list[str]:
        measured: list[str] = []

        def step_seconds(backend: str, seconds: float = 0) -> float:
            measured.append(backend)
            return times[backend] / 1e3

        monkeypatch.setattr(trial, "step_seconds", step_seconds)
        return measured

    return set_times


@pytest.fixture
def wrong_images(monkeypatch):
    """Make the device render wrong images."""

    def darker(*arguments):
        drawn = cpu.rasterize(*arguments)
        return drawn._replace(image=drawn.image * 0.98)

    monkeypatch.setattr(gpu, "rasterize", darker, raising=False)


def test_best_hardware_device_is_the_default(set_adapters, monkeypatch):
    set_adapters(CARD, INTEGRATED, SOFTWARE)
    assert default_device.default_adapter() == CARD
    set_adapters(INTEGRATED, SOFTWARE)
    assert default_device.default_adapter() == INTEGRATED
    set_adapters(SOFTWARE)
    with pytest.raises(LodgsError, match=r"llvmpipe .* runs on the CPU"):
        resolve_backend("gpu")
    set_adapters()
    with pytest.raises(LodgsError, match="Cannot detect"):
        resolve_backend("gpu")


@pytest.mark.parametrize(
    ("name", "expected"),
    [("radeon", INTEGRATED), ("software", SOFTWARE), ("LLVM", SOFTWARE), ("geforce rtx 4070", DESKTOP)],
)
def test_environment_variable_selects_by_part_of_name(set_adapters, monkeypatch, name, expected):
    set_adapters(CARD, DESKTOP, INTEGRATED, SOFTWARE)
    monkeypatch.setenv(default_device.VARIABLE, name)
    assert default_device.default_adapter() == expected
    monkeypatch.setenv(default_device.VARIABLE, "voodoo")
    with pytest.raises(LodgsError, match=r'"voodoo".*LODGS_GPU.*Choose from: GeForce'):
        default_device.default_adapter()


def test_working_device_is_used_and_tested_once(set_adapters, monkeypatch):
    set_adapters(CARD)
    assert resolve_backend("gpu") == "gpu" and cpu_fallback_reason("gpu") == ""
    self_test.find_failure.cache_clear()  # simulate a new process

    def refuse(*_):
        raise AssertionError("tested again")

    monkeypatch.setattr(self_test, "run_self_test", refuse)
    assert resolve_backend("gpu") == "gpu"
    set_adapters(CARD._replace(driver="556.0"))
    with pytest.raises(AssertionError, match="tested again"):
        resolve_backend("gpu")


def test_wrong_images_disable_the_device(set_adapters, wrong_images):
    set_adapters(CARD)
    assert resolve_backend("gpu") == "cpu"
    assert cpu_fallback_reason("gpu").startswith(
        "GeForce RTX 4070 Laptop is not used: its images are 2% off."
    )
    self_test.find_failure.cache_clear()
    assert resolve_backend("gpu") == "cpu", "the stored result"


@pytest.mark.parametrize("name", ["means", "weights"])
def test_wrong_gradients_disable_the_device(set_adapters, monkeypatch, name):
    set_adapters(CARD)
    index = ["means", "quats", "log_scales", "opacity_logits", "sh"].index(name) if name == "means" else None

    class WrongGradient(torch.autograd.Function):
        @staticmethod
        def forward(ctx, tensor):
            return tensor.clone()

        @staticmethod
        def backward(ctx, gradient):  # type: ignore[override]
            return gradient * 1.02

    def wrong(gaussians, weights, features, settings):
        if index is None:
            weights = WrongGradient.apply(weights)
        else:
            tensors = list(vars(gaussians).values())
            tensors[index] = WrongGradient.apply(tensors[index])
            gaussians = type(gaussians)(*tensors)
        return cpu.rasterize(gaussians, weights, features, settings)

    monkeypatch.setattr(gpu, "rasterize", wrong, raising=False)
    assert self_test.find_failure(CARD) == f"its gradients of {name} are 2% off"


def test_unstable_or_nan_results_disable_the_device(set_adapters, monkeypatch):
    set_adapters(CARD)
    noise = iter([0.0, 0.0, 1e-6, 1e-6, *[float("nan")] * 4])

    def unstable(*arguments):
        drawn = cpu.rasterize(*arguments)
        return drawn._replace(image=drawn.image + next(noise))

    monkeypatch.setattr(gpu, "rasterize", unstable, raising=False)
    assert self_test.run_self_test(CARD) == "its images change from run to run"
    assert "off" in self_test.run_self_test(CARD)


def test_shader_compilation_error_disables_the_device(set_adapters, monkeypatch):
    set_adapters(CARD)

    def refuse(*_):
        raise RuntimeError("Validation Error\n\n  error X3663: thread sync" + " and more" * 100)

    monkeypatch.setattr(gpu, "rasterize", refuse, raising=False)
    assert resolve_backend("gpu") == "cpu"
    reason = cpu_fallback_reason("gpu")
    assert (
        "is not used: it failed (RuntimeError: Validation Error error X3663: thread sync and more" in reason
    )
    assert len(reason) < 600 and reason.endswith("The CPU is used instead; a newer driver may help.")


@pytest.mark.parametrize(("cpu_ms", "gpu_ms", "expected"), [(48, 6, "gpu"), (48, 80, "cpu"), (7, 7, "cpu")])
def test_auto_trains_on_the_fastest_device(set_adapters, set_times, cpu_ms, gpu_ms, expected):
    """Each machine and driver is measured once."""
    set_adapters(CARD, SOFTWARE)
    measured = set_times(cpu=cpu_ms, gpu=gpu_ms)
    assert trial.fastest_backend() == trial.fastest_backend() == expected
    assert measured == ["cpu", "gpu"]
    self_test.find_failure.cache_clear()
    set_adapters(CARD._replace(driver="556.0"))
    trial.fastest_backend()
    assert measured == ["cpu", "gpu"] * 2


def test_auto_never_trains_on_software_or_a_wrong_device(set_adapters, set_times, monkeypatch):
    measured = set_times(cpu=48, gpu=6)
    for available in ((SOFTWARE,), ()):
        set_adapters(*available)
        assert trial.fastest_backend() == "cpu"
    set_adapters(SOFTWARE)
    monkeypatch.setenv(default_device.VARIABLE, "software")
    assert trial.fastest_backend() == "cpu"
    monkeypatch.delenv(default_device.VARIABLE)
    set_adapters(CARD)
    monkeypatch.setattr(trial, "resolve_backend", lambda name: "cpu")  # the self-test failed
    assert trial.fastest_backend() == "cpu" and not measured


@pytest.mark.parametrize(
    "error",
    [
        LodgsError("GeForce RTX 4070 Laptop is out of memory."),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB."),
    ],
)
def test_device_that_fails_its_trial_is_not_used(set_adapters, monkeypatch, error):
    set_adapters(CARD)

    def step_seconds(backend: str) -> float:
        if backend == "gpu":
            raise error
        return 0.05

    monkeypatch.setattr(trial, "step_seconds", step_seconds)
    assert trial.fastest_backend() == "cpu"


def test_corrupt_cache_is_ignored(set_adapters, tmp_path):
    set_adapters(CARD)
    (tmp_path / self_test.RESULTS).write_text("{no json")
    assert resolve_backend("gpu") == "gpu"
    self_test.find_failure.cache_clear()
    (tmp_path / self_test.RESULTS).write_text('{"x": 5}')
    assert resolve_backend("gpu") == "gpu"


def test_description_of_devices(set_adapters, set_times, monkeypatch, wrong_images):
    set_adapters(INTEGRATED, SOFTWARE)
    set_times(cpu=48, gpu=6)
    assert (
        "Radeon 780M: integrated, Vulkan, radv 24.1, 2048 MB in one buffer, not used, because its"
        in describe()
    )
    assert describe().endswith("Radeon 780M is not used: its images are 2% off.")
    monkeypatch.setattr(gpu, "rasterize", cpu.rasterize, raising=False)
    self_test.find_failure.cache_clear()  # simulate a new process
    lines = describe().splitlines()
    assert [line.split()[0] for line in lines[:5]] == ["cpu", "cuda", "gpu", "gpu", "auto"]
    assert lines[2].endswith("2048 MB in one buffer, selected, passed the self-test")
    assert lines[3].startswith(
        "gpu   llvmpipe (LLVM 15): software, Vulkan, Mesa, not selected: set LODGS_GPU"
    )
    assert lines[4] == "auto  gpu"
    assert lines[-1].startswith("Automatic trains on Radeon 780M. A training step takes Radeon 780M: 6.0 ms,")


def test_summary_names_training_device_and_faster_ones(set_adapters, set_times, monkeypatch):
    set_times(cpu=5, gpu=6)
    set_adapters()
    summary = Devices.detect().summary
    assert "Automatic trains on the CPU (" in summary and "Cannot detect" in summary
    set_adapters(SOFTWARE)
    assert Devices.detect().summary.endswith("but none was detected.")
    set_adapters(CARD)
    devices = Devices("NVIDIA GeForce RTX 4070 Laptop GPU", [CARD], CARD, "")
    problem = LodgsError("Cannot use the cuda backend: NVRTC is not installed.", "Install torch.")
    monkeypatch.setattr(cuda, "find_problem", cache(lambda: problem))
    assert devices.summary.endswith("NVRTC is not installed. Install torch.")
    assert "Laptop: 6.0 ms (50,000 splats" in devices.summary and "trains on the CPU" in devices.summary
    monkeypatch.setattr(trial, "step_times", lambda: {"cpu": 5.0, "cuda": 2.0, "gpu": 3.0})
    assert devices.summary.startswith(
        "Automatic trains on NVIDIA GeForce RTX 4070 Laptop GPU (CUDA). A training step takes "
        "NVIDIA GeForce RTX 4070 Laptop GPU (CUDA): 2.0 ms, "
    )


def test_command_prints_json(set_adapters, set_times, capsys):
    set_adapters(CARD)
    set_times(cpu=48, gpu=6)
    assert command.main(["devices", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["graphics"] == CARD.name and CARD.name in answer["sentence"]


def test_lost_device_is_reported_and_tested_again(set_adapters, monkeypatch):
    set_adapters(CARD)

    def lost(*_):
        raise LodgsError("GeForce RTX 4070 Laptop stopped responding: lost.")

    monkeypatch.setattr(gpu, "rasterize", lost, raising=False)
    with pytest.raises(LodgsError, match="stopped responding"):
        resolve_backend("gpu")
    assert "stopped responding" in describe()
    monkeypatch.setattr(gpu, "rasterize", cpu.rasterize, raising=False)
    assert resolve_backend("gpu") == "gpu"


@pytest.mark.skipif(sys.platform != "linux", reason="a variable of Linux")
def test_listing_devices_prints_nothing_without_a_window_system(graphics):
    """Mesa's drivers print errors if XDG_RUNTIME_DIR is not set, as on servers."""
    code = "from training.rasterize.gpu.device import adapters; adapters()"
    environment = {name: value for name, value in os.environ.items() if name != "XDG_RUNTIME_DIR"}
    ended = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert ended.stderr == ended.stdout == ""
