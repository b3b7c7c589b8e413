"""What the gpu backend is made of, against numpy: its sums and sorts, its limits, and what it says."""

import numpy as np
import pytest
import torch

from tests.training.rasterize.comparison import contributed, drawn_and_differentiated
from training.errors import LodgsError
from training.rasterize import Target, gpu, photometric_loss, render
from training.rasterize.gpu import bin, device
from training.rasterize.gpu.device import Adapter, Device, adapters, open_device

SIZES = [0, 1, 63, 64, 1024, 1025, 16_384, 16_385, 70_000]


@pytest.fixture
def narrow(graphics, monkeypatch) -> Device:
    """The same, to which work is given in pieces of no more than seven workgroups."""
    monkeypatch.setattr(graphics, "max_groups", 7)
    return graphics


@pytest.mark.parametrize("count", SIZES)
def test_sums_are_numpys(graphics, count):
    values = np.random.default_rng(count).integers(0, 50, count).astype(np.uint32)
    buffer = graphics.upload(values)
    bin.exclusive_scan(graphics, buffer)
    np.testing.assert_array_equal(graphics.read(buffer), np.cumsum(values) - values)


@pytest.mark.parametrize("count", SIZES)
def test_sorts_are_numpys_stable_ones(narrow, count):
    """Also in many pieces."""
    keys = np.random.default_rng(count).integers(0, 2**32, count, dtype=np.uint32)
    keys[::3] &= 255
    order = np.argsort(keys, kind="stable")
    found = bin.sort(narrow, narrow.upload(keys), narrow.upload(np.arange(count, dtype=np.uint32)), 32)
    for buffer, expected in zip(found, (keys[order], order), strict=True):
        np.testing.assert_array_equal(narrow.read(buffer), expected)


def test_a_picture_does_not_depend_on_the_pieces(graphics, make_splats, odd_camera, monkeypatch):
    """Twenty tiles, seven at a time: as an image of more tiles than a device takes at once."""
    found = []
    for most in (7, graphics.max_groups):
        monkeypatch.setattr(graphics, "max_groups", most)
        found.append(drawn_and_differentiated("degree 3", make_splats, odd_camera, "gpu", torch.float32))
    for name, one in found[0].items():
        assert torch.equal(one, found[1][name]), name


def test_the_least_that_a_device_can_do_is_enough(graphics, make_splats, odd_camera, monkeypatch):
    """WebGPU's limits, which every device keeps: nothing is compiled that needs more."""
    handle = device._found()[graphics.adapter]

    class Least:
        limits = {
            **handle.limits,
            "max-storage-buffers-per-shader-stage": 8,
            "max-compute-workgroup-storage-size": 16384,
            "max-compute-invocations-per-workgroup": 256,
            "max-storage-buffer-binding-size": 128 << 20,
            "max-buffer-size": 256 << 20,
        }
        request_device_sync = handle.request_device_sync

    least = Device(graphics.adapter, Least)
    assert least._device.limits["max-storage-buffers-per-shader-stage"] == 8
    found = []
    for each in (least, graphics):
        monkeypatch.setattr(gpu, "open_default_device", lambda each=each: each)
        drawn = drawn_and_differentiated("degree 3", make_splats, odd_camera, "gpu", torch.float32)
        share, _ = contributed("degree 3", make_splats, odd_camera, "gpu", torch.float32)
        loss = photometric_loss(drawn["image"].float(), Target(torch.zeros(50, 75, 3)), backend="gpu")
        found.append([*drawn.values(), *share.values(), loss])
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


def test_pictures_are_the_cpus_to_a_count(graphics, make_splats, odd_camera):
    """Of 256, in all but one value of a thousand."""
    splats = make_splats(2000).to(dtype=torch.float32)
    one, other = (next(render(splats, [odd_camera], dtype="uint8", backend=b)) for b in ("gpu", "cpu"))
    apart = np.abs(one.astype(int) - other)
    assert apart.max() <= 1 and (apart > 0).mean() <= 1e-3


def test_software_comes_last_and_a_part_of_a_name_is_enough(graphics):
    found = adapters()
    assert [a.software for a in found] == sorted(a.software for a in found)
    assert open_device(found[-1].name.upper()[:4]) is not None
    with pytest.raises(LodgsError, match=r'no graphics device "Voodoo 2".*There are: '):
        open_device("Voodoo 2")


def test_a_device_that_binds_little_draws_the_same(graphics, make_splats, odd_camera, monkeypatch):
    """2600 splats touch 20 tiles, and a device takes 140 KB: 3258 pairs and the harmonics of 704."""
    found, bands = [], []
    run = graphics.run

    def spied(shader, entry, groups, *arguments, **buffers):
        if (shader, entry) == ("blend", "forward"):
            bands.append(groups)
        run(shader, entry, groups, *arguments, **buffers)

    monkeypatch.setattr(graphics, "run", spied)
    for most in (graphics.binding_bytes, 140 << 10):
        monkeypatch.setattr(graphics, "binding_bytes", most)
        drawn = drawn_and_differentiated("crowd", make_splats, odd_camera, "gpu", torch.float32)
        share, _ = contributed("crowd", make_splats, odd_camera, "gpu", torch.float32)
        found.append(drawn | share)
    assert bands[0] == 20 and min(bands) < 4, bands
    for name, one in found[0].items():
        assert torch.equal(one, found[1][name]), name
    truth = drawn_and_differentiated("crowd", make_splats, odd_camera, "cpu", torch.float32)
    for name, expected in truth.items():
        assert (found[1][name] - expected).norm() <= 5e-4 * expected.norm(), name


def test_what_is_too_large_for_a_device_is_said(graphics, make_splats, odd_camera, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(graphics, "largest", 1 << 20)
        with pytest.raises(LodgsError, match=r"takes 1 MB at a time, and this scene needs 4 MB"):
            graphics.empty(np.float32, 1 << 20)
    monkeypatch.setattr(graphics, "binding_bytes", 1 << 16)
    with pytest.raises(LodgsError, match=r"takes 0 MB at a time, and .* 1 MB\. .* cpu backend, fewer splats"):
        drawn_and_differentiated("crowd", make_splats, odd_camera, "gpu", torch.float32)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError("Not enough memory left"), "has no more memory"),
        (RuntimeError("a long trace\n    Parent device is lost"), "does not answer any more: Parent device"),
    ],
)
def test_what_goes_wrong_on_a_device_is_a_sentence(graphics, monkeypatch, error, said):
    def fail(**_):
        raise error

    monkeypatch.setattr(graphics._device, "create_buffer", fail)
    monkeypatch.setattr(graphics, "lost", False)
    with pytest.raises(LodgsError, match=said) as caught:
        graphics.empty(np.float32, 4)
    assert "trace" not in str(caught.value) and graphics.lost == ("lost" in str(error))


def test_a_lost_device_is_a_sentence_and_another_is_opened(graphics, monkeypatch):
    lost = Device(graphics.adapter, device._found()[graphics.adapter])
    buffer = lost.upload(np.arange(5, dtype=np.uint32))
    lost._device.destroy()
    with pytest.raises(LodgsError, match=r"does not answer any more: .*lost\. Resume the run"):
        lost.read(buffer)
    assert lost.lost and open_device(graphics.adapter.name) is graphics
    monkeypatch.setattr(graphics, "lost", True)
    other = open_device(graphics.adapter.name)
    assert other is not graphics and not other.lost


def test_mistakes_of_ours_stay_what_they_are(graphics):
    with pytest.raises(KeyError):
        graphics.run("scan", "scan_all", 1, (1,), no_such_buffer=graphics.empty(np.uint32, 1))


def test_without_wgpu_or_a_driver_there_is_a_sentence(monkeypatch):
    device._wgpu.cache_clear()
    device._found.cache_clear()
    try:
        with monkeypatch.context() as patch:
            patch.setitem(__import__("sys").modules, "wgpu", None)
            with pytest.raises(LodgsError, match=r"needs wgpu.*pip install wgpu"):
                adapters()

        class Nothing:
            gpu = type("", (), {"enumerate_adapters_sync": staticmethod(list)})

        with monkeypatch.context() as patch:
            patch.setattr(device, "_wgpu", Nothing)
            with pytest.raises(LodgsError, match="No graphics device with Vulkan, Metal or D3D12"):
                adapters()
    finally:
        device._wgpu.cache_clear()
        device._found.cache_clear()


def test_software_is_told_from_cards():
    assert Adapter("llvmpipe", "software", "Vulkan", "").software
    assert not Adapter("Radeon", "discrete", "Vulkan", "").software
