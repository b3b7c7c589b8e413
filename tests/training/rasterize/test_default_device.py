"""Which graphics device is taken, what becomes of one that draws otherwise, and what is said of it all."""

import pytest
import torch

from training import __main__ as command
from training.errors import LodgsError
from training.rasterize import cpu, cpu_fallback_reason, cuda, gpu, resolve_backend, self_test
from training.rasterize.devices import Devices, describe
from training.rasterize.gpu import default_device
from training.rasterize.gpu.device import Adapter

CARD = Adapter("GeForce RTX 4070 Laptop", "discrete", "Vulkan", "555.1")
LARGER = Adapter("GeForce RTX 4070", "discrete", "Vulkan", "555.1")
WITHIN = Adapter("Radeon 780M", "integrated", "Vulkan", "radv 24.1")
SOFTWARE = Adapter("llvmpipe (LLVM 15)", "software", "Vulkan", "Mesa")


@pytest.fixture
def there(monkeypatch, tmp_path):
    """A computer with these devices, which draw as the cpu backend does, and an empty cache folder.

    None of them is one that torch sees.
    """

    def are(*found: Adapter) -> None:
        def adapters() -> list[Adapter]:
            if not found:
                raise LodgsError("Cannot detect a graphics device.")
            return list(found)

        monkeypatch.setattr(default_device, "adapters", adapters)
        monkeypatch.setattr("training.rasterize.devices.adapters", adapters)

    class Opened:
        binding_bytes = 2 << 30

    monkeypatch.delenv(default_device.VARIABLE, raising=False)
    monkeypatch.setattr(self_test, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr("training.rasterize.devices.open_device", lambda name: Opened())
    for name in ("rasterize", "contributions", "photometric_loss"):
        monkeypatch.setattr(gpu, name, getattr(cpu, name), raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    self_test.failure.cache_clear()
    cuda.problem.cache_clear()
    yield are
    self_test.failure.cache_clear()
    cuda.problem.cache_clear()


@pytest.fixture
def spoiled(monkeypatch):
    """The device draws otherwise than it should."""

    def otherwise(*what):
        drawn = cpu.rasterize(*what)
        return drawn._replace(image=drawn.image * 0.98)

    monkeypatch.setattr(gpu, "rasterize", otherwise, raising=False)


def test_the_best_device_is_taken_and_software_never_by_itself(there, monkeypatch):
    there(CARD, WITHIN, SOFTWARE)
    assert default_device.default_adapter() == CARD
    there(WITHIN, SOFTWARE)
    assert default_device.default_adapter() == WITHIN
    there(SOFTWARE)
    with pytest.raises(LodgsError, match=r"llvmpipe .* runs on the CPU"):
        resolve_backend("gpu")
    there()
    with pytest.raises(LodgsError, match="Cannot detect"):
        resolve_backend("gpu")


@pytest.mark.parametrize(
    ("name", "expected"),
    [("radeon", WITHIN), ("software", SOFTWARE), ("LLVM", SOFTWARE), ("geforce rtx 4070", LARGER)],
)
def test_a_name_or_a_part_of_it_takes_another(there, monkeypatch, name, expected):
    there(CARD, LARGER, WITHIN, SOFTWARE)
    monkeypatch.setenv(default_device.VARIABLE, name)
    assert default_device.default_adapter() == expected
    monkeypatch.setenv(default_device.VARIABLE, "voodoo")
    with pytest.raises(LodgsError, match=r'"voodoo".*LODGS_GPU.*Choose from: GeForce'):
        default_device.default_adapter()


def test_a_device_that_draws_as_it_should_is_used_and_tested_once(there, monkeypatch):
    there(CARD)
    assert resolve_backend("gpu") == "gpu" and cpu_fallback_reason("gpu") == ""
    self_test.failure.cache_clear()  # as another process

    def refuse(*_):
        raise AssertionError("tested again")

    monkeypatch.setattr(self_test, "run_self_test", refuse)
    assert resolve_backend("gpu") == "gpu"
    there(CARD._replace(driver="556.0"))
    with pytest.raises(AssertionError, match="tested again"):
        resolve_backend("gpu")


def test_a_device_that_draws_otherwise_is_not_used_and_it_is_said(there, spoiled):
    there(CARD)
    assert resolve_backend("gpu") == "cpu"
    assert cpu_fallback_reason("gpu").startswith(
        "GeForce RTX 4070 Laptop is not used: its images are 2% off."
    )
    self_test.failure.cache_clear()
    assert resolve_backend("gpu") == "cpu", "remembered"


@pytest.mark.parametrize("name", ["means", "weights"])
def test_wrong_gradients_are_found(there, monkeypatch, name):
    there(CARD)
    place = ["means", "quats", "log_scales", "opacity_logits", "sh"].index(name) if name == "means" else None

    class Off(torch.autograd.Function):
        @staticmethod
        def forward(ctx, tensor):
            return tensor.clone()

        @staticmethod
        def backward(ctx, gradient):  # type: ignore[override]
            return gradient * 1.02

    def otherwise(gaussians, weights, features, settings):
        if place is None:
            weights = Off.apply(weights)
        else:
            tensors = list(vars(gaussians).values())
            tensors[place] = Off.apply(tensors[place])
            gaussians = type(gaussians)(*tensors)
        return cpu.rasterize(gaussians, weights, features, settings)

    monkeypatch.setattr(gpu, "rasterize", otherwise, raising=False)
    assert self_test.failure(CARD) == f"its gradients of {name} are 2% off"


def test_what_is_not_the_same_twice_or_no_number_is_found(there, monkeypatch):
    there(CARD)
    noise = iter([0.0, 0.0, 1e-6, 1e-6, *[float("nan")] * 4])

    def restless(*what):
        drawn = cpu.rasterize(*what)
        return drawn._replace(image=drawn.image + next(noise))

    monkeypatch.setattr(gpu, "rasterize", restless, raising=False)
    assert self_test.run_self_test(CARD) == "its images change from run to run"
    assert "off" in self_test.run_self_test(CARD)


def test_a_driver_that_refuses_a_shader_is_not_used(there, monkeypatch):
    there(CARD)

    def refuse(*_):
        raise RuntimeError("Validation Error\n\n  error X3663: thread sync" + " and more" * 100)

    monkeypatch.setattr(gpu, "rasterize", refuse, raising=False)
    assert resolve_backend("gpu") == "cpu"
    said = cpu_fallback_reason("gpu")
    assert "is not used: it failed (RuntimeError: Validation Error error X3663: thread sync and more" in said
    assert len(said) < 600 and said.endswith("The CPU is used instead; a newer driver may help.")


def test_a_spoiled_cache_is_as_none(there, tmp_path):
    there(CARD)
    (tmp_path / self_test.RESULTS).write_text("{no json")
    assert resolve_backend("gpu") == "gpu"
    self_test.failure.cache_clear()
    (tmp_path / self_test.RESULTS).write_text('{"x": 5}')
    assert resolve_backend("gpu") == "gpu"


def test_devices_are_described(there, monkeypatch, spoiled):
    there(WITHIN, SOFTWARE)
    assert "Radeon 780M: integrated, Vulkan, radv 24.1, 2048 MB in one buffer, not used, as its" in describe()
    monkeypatch.setattr(gpu, "rasterize", cpu.rasterize, raising=False)
    said = describe().splitlines()
    assert [line.split()[0] for line in said[:5]] == ["cpu", "cuda", "gpu", "gpu", "auto"]
    assert said[2].endswith("2048 MB in one buffer, chosen, draws what the reference draws")
    assert said[3] == "gpu   llvmpipe (LLVM 15): software, Vulkan, Mesa, not chosen: LODGS_GPU may name it"
    assert said[4] == "auto  cpu"
    assert said[-1].endswith("The graphics card may be faster: choose it to try Radeon 780M.")


def test_what_trains_is_a_sentence(there, monkeypatch):
    there()
    sentence = Devices.detect().sentence
    assert "Automatic trains on the processor (" in sentence and sentence.endswith("was found.")
    there(SOFTWARE)
    assert Devices.detect().sentence.endswith("A graphics card might be faster, and none was found.")
    there(CARD)
    found = Devices("NVIDIA GeForce RTX 4070 Laptop GPU", [CARD], CARD, "")
    monkeypatch.setattr("training.rasterize.devices.find_spec", lambda name: None)
    assert found.sentence.endswith(
        "So may NVIDIA GeForce RTX 4070 Laptop GPU be with CUDA, once gsplat is installed."
    )
    monkeypatch.setattr("training.rasterize.devices.find_spec", lambda name: name)
    assert "trains on NVIDIA GeForce RTX 4070 Laptop GPU if gsplat works there" in found.sentence


def test_the_command_speaks_json(there, capsys):
    import json

    there(CARD)
    assert command.main(["devices", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["graphics"] == CARD.name


def test_lost_devices_are_a_sentence_and_are_tested_again(there, monkeypatch):
    there(CARD)

    def lost(*_):
        raise LodgsError("GeForce RTX 4070 Laptop stopped responding: lost.")

    monkeypatch.setattr(gpu, "rasterize", lost, raising=False)
    with pytest.raises(LodgsError, match="stopped responding"):
        resolve_backend("gpu")
    assert "stopped responding" in describe()
    monkeypatch.setattr(gpu, "rasterize", cpu.rasterize, raising=False)
    assert resolve_backend("gpu") == "gpu"
