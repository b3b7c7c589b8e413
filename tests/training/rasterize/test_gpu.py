"""Compare scans and sorts of the gpu backend with numpy, and test its limits and error messages."""

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
    """The device, limited to seven workgroups per dispatch."""
    monkeypatch.setattr(graphics, "max_groups", 7)
    return graphics


@pytest.mark.parametrize("most", [50, 2**32])
@pytest.mark.parametrize("count", SIZES)
def test_exclusive_scan_matches_numpy(graphics, count, most):
    """Sums of more than 32 bits are the largest number."""
    values = np.random.default_rng(count).integers(0, most, count, np.uint32)
    buffer = graphics.upload(values)
    bin.exclusive_scan(graphics, buffer)
    sums = np.cumsum(values, dtype=np.uint64) - values
    np.testing.assert_array_equal(graphics.read(buffer), sums.clip(max=2**32 - 1))


@pytest.mark.parametrize("count", [*SIZES, 600_000])
def test_sort_matches_stable_numpy_sort(narrow, count):
    keys = np.random.default_rng(count).integers(0, 2**32, count, dtype=np.uint32)
    keys[::3] &= 255
    order = np.argsort(keys, kind="stable")
    result = bin.sort(narrow, narrow.upload(keys), narrow.upload(np.arange(count, dtype=np.uint32)), 32)
    for buffer, expected in zip(result, (keys[order], order), strict=True):
        np.testing.assert_array_equal(narrow.read(buffer), expected)


def test_results_do_not_depend_on_dispatch_size(graphics, make_splats, odd_camera, monkeypatch):
    """Render twenty tiles with at most seven per dispatch."""
    results = []
    for max_groups in (7, graphics.max_groups):
        monkeypatch.setattr(graphics, "max_groups", max_groups)
        results.append(drawn_and_differentiated("degree 3", make_splats, odd_camera, "gpu", torch.float32))
    for name, value in results[0].items():
        assert torch.equal(value, results[1][name]), name


def test_minimum_webgpu_limits_suffice(graphics, make_splats, odd_camera, monkeypatch):
    """Shaders compile with WebGPU's default limits, which every device supports."""
    handle = device._enumerate()[graphics.adapter]

    class MinimumAdapter:
        limits = {
            **handle.limits,
            "max-storage-buffers-per-shader-stage": 8,
            "max-compute-workgroup-storage-size": 16384,
            "max-compute-invocations-per-workgroup": 256,
            "max-storage-buffer-binding-size": 128 << 20,
            "max-buffer-size": 256 << 20,
        }
        request_device_sync = handle.request_device_sync

    minimum = Device(graphics.adapter, MinimumAdapter)
    assert minimum._device.limits["max-storage-buffers-per-shader-stage"] == 8
    results = []
    for opened in (minimum, graphics):
        monkeypatch.setattr(gpu, "open_default_device", lambda opened=opened: opened)
        drawn = drawn_and_differentiated("degree 3", make_splats, odd_camera, "gpu", torch.float32)
        share, _ = contributed("degree 3", make_splats, odd_camera, "gpu", torch.float32)
        loss = photometric_loss(drawn["image"].float(), Target(torch.zeros(50, 75, 3)), backend="gpu")
        results.append([*drawn.values(), *share.values(), loss])
    for actual, expected in zip(*results, strict=True):
        assert torch.equal(actual, expected)


def test_images_match_cpu_backend(graphics, make_splats, odd_camera):
    """8-bit values differ by at most 1, in at most one of a thousand."""
    splats = make_splats(2000).to(dtype=torch.float32)
    images = (next(render(splats, [odd_camera], dtype="uint8", backend=b)) for b in ("gpu", "cpu"))
    gpu_image, cpu_image = images
    difference = np.abs(gpu_image.astype(int) - cpu_image)
    assert difference.max() <= 1 and (difference > 0).mean() <= 1e-3


def test_adapters_are_sorted_and_opened_by_part_of_their_name(graphics):
    available = adapters()
    assert [a.software for a in available] == sorted(a.software for a in available)
    assert open_device(available[-1].name.upper()[:4]) is not None
    with pytest.raises(LodgsError, match=r'"Voodoo 2".*Choose from: '):
        open_device("Voodoo 2")


@pytest.mark.nightly
def test_small_bindings_do_not_change_results(graphics, make_splats, odd_camera, monkeypatch):
    """2600 splats touch 20 tiles; bindings of 140 KB hold 3258 pairs and the harmonics of 704 splats."""
    results = []
    bands = []
    run = graphics.run

    def record_bands(shader, entry, groups, *arguments, **buffers):
        if (shader, entry) == ("blend", "forward"):
            bands.append(groups)
        run(shader, entry, groups, *arguments, **buffers)

    monkeypatch.setattr(graphics, "run", record_bands)
    for binding_bytes in (graphics.binding_bytes, 140 << 10):
        monkeypatch.setattr(graphics, "binding_bytes", binding_bytes)
        drawn = drawn_and_differentiated("crowd", make_splats, odd_camera, "gpu", torch.float32)
        share, _ = contributed("crowd", make_splats, odd_camera, "gpu", torch.float32)
        results.append(drawn | share)
    assert bands[0] == 20 and min(bands) < 4, bands
    for name, value in results[0].items():
        assert torch.equal(value, results[1][name]), name
    truth = drawn_and_differentiated("crowd", make_splats, odd_camera, "cpu", torch.float32)
    for name, expected in truth.items():
        assert (results[1][name] - expected).norm() <= 5e-4 * expected.norm(), name


def test_too_large_buffers_raise(graphics, make_splats, odd_camera, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(graphics, "buffer_bytes", 1 << 20)
        with pytest.raises(LodgsError, match=r"buffer of 4 MB, the limit is 1 MB"):
            graphics.empty(np.float32, 1 << 20)
    monkeypatch.setattr(graphics, "binding_bytes", 1 << 16)
    with pytest.raises(LodgsError, match=r"of 1 MB, the limit is 0 MB\..* cpu backend, fewer splats"):
        drawn_and_differentiated("crowd", make_splats, odd_camera, "gpu", torch.float32)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (MemoryError("Not enough memory left"), "is out of memory"),
        (RuntimeError("a long trace\n    Parent device is lost"), "stopped responding: Parent device"),
    ],
)
def test_device_errors_are_translated(graphics, monkeypatch, error, message):
    def fail(**_):
        raise error

    monkeypatch.setattr(graphics._device, "create_buffer", fail)
    monkeypatch.setattr(graphics, "lost", False)
    with pytest.raises(LodgsError, match=message) as caught:
        graphics.empty(np.float32, 4)
    assert "trace" not in str(caught.value) and graphics.lost == ("lost" in str(error))


def test_lost_device_is_reported_and_reopened(graphics, monkeypatch):
    lost = Device(graphics.adapter, device._enumerate()[graphics.adapter])
    buffer = lost.upload(np.arange(5, dtype=np.uint32))
    lost._device.destroy()
    with pytest.raises(LodgsError, match=r"stopped responding: .*lost\. Resume the run"):
        lost.read(buffer)
    assert lost.lost and open_device(graphics.adapter.name) is graphics
    monkeypatch.setattr(graphics, "lost", True)
    reopened = open_device(graphics.adapter.name)
    assert reopened is not graphics and not reopened.lost


def test_programming_errors_are_not_translated(graphics):
    with pytest.raises(KeyError):
        graphics.run("scan", "scan_all", 1, (1,), no_such_buffer=graphics.empty(np.uint32, 1))


def test_missing_wgpu_or_driver_is_reported(monkeypatch):
    device._wgpu.cache_clear()
    device._enumerate.cache_clear()
    try:
        with monkeypatch.context() as patch:
            patch.setitem(__import__("sys").modules, "wgpu", None)
            with pytest.raises(LodgsError, match=r"import wgpu.*pip install wgpu"):
                adapters()

        class WithoutAdapters:
            gpu = type("", (), {"enumerate_adapters_sync": staticmethod(list)})

        with monkeypatch.context() as patch:
            patch.setattr(device, "_wgpu", WithoutAdapters)
            with pytest.raises(LodgsError, match="graphics device with Vulkan, Metal or D3D12"):
                adapters()
    finally:
        device._wgpu.cache_clear()
        device._enumerate.cache_clear()


def test_software_adapters_are_recognised():
    assert Adapter("llvmpipe", "software", "Vulkan", "").software
    assert not Adapter("Radeon", "discrete", "Vulkan", "").software
