"""Compare the cuda backend with the float64 reference, with its kernels on the CPU and on a GPU if
available.
"""

import ctypes
import itertools
import re
import shutil
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from tests.training.rasterize.comparison import (
    CONTRIBUTING,
    SCENES,
    contributed,
    drawn_and_differentiated,
    exact_results,
)
from tests.training.rasterize.fake_card import cpu_kernels
from training import rasterize as rasterizer
from training.errors import LodgsError
from training.rasterize import (
    Target,
    contributions,
    cuda,
    photometric_loss,
    rasterize,
    resolve_backend,
    tensor_device,
)
from training.rasterize.cuda import driver
from training.rasterize.cuda.source import kernel_source
from training.rasterize.features import depths
from training.rasterize.reference import ellipses, tile_counts
from training.rasterize.rendering import KernelCamera, RasterSettings
from training.scenes.cameras import Camera


@pytest.fixture(
    params=[
        "cpu",
        pytest.param(
            "cuda",
            marks=[
                pytest.mark.gpu,
                pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU that torch can use"),
            ],
        ),
    ]
)
def device(request) -> str:
    """Device of the cuda backend: the CPU through ``fake_card``, and a GPU."""
    if request.param == "cpu":
        request.getfixturevalue("fake_card")
    elif problem := cuda.find_problem():
        pytest.skip(f"no NVIDIA GPU that works: {problem}")
    return request.param


RARE = ("degree 1", "degree 2", "one", "antialiased some", "screen-filling", "crowd")
"""Scenes that are compared nightly."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] * (name in RARE)) for name in SCENES]
)
def test_results_match_reference(name, device, make_splats, odd_camera):
    """Relative L2 errors of all outputs and gradients are at most 5e-4."""
    actual = drawn_and_differentiated(name, make_splats, odd_camera, "cuda", torch.float32, device)
    exact = exact_results(name, make_splats, odd_camera)
    assert exact["grad2d"].norm() > 0 and exact["absgrad2d"].norm() > exact["grad2d"].norm()
    for output, expected in exact.items():
        error = (actual[output] - expected).norm() / expected.norm().clamp_min(1e-12)
        # rounding decides if an ellipse just touches a tile
        assert error <= (5e-3 if output == "tile_counts" else 5e-4), f"{output}: {error:.1e}"


@pytest.mark.parametrize("name", CONTRIBUTING)
def test_contributions_match_reference(name, device, make_splats, odd_camera):
    exact, alpha = contributed(name, make_splats, odd_camera, "reference", torch.float64)
    actual, _ = contributed(name, make_splats, odd_camera, "cuda", torch.float32, device)
    torch.testing.assert_close(actual["largest"], exact["largest"], rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(actual["total"], exact["total"], rtol=1e-3, atol=2e-2)
    assert (actual["pixels"] - exact["pixels"]).abs().sum() <= 1e-3 * exact["pixels"].sum()
    assert torch.equal(actual["views"], exact["views"])
    assert actual["total"].sum().item() == pytest.approx(alpha, rel=1e-4)


def test_strided_tensors_give_the_same_results(device, make_splats, odd_camera):
    """Networks return columns of one tensor as several tensors."""
    splats = make_splats(60).to(device, torch.float32)
    weights = torch.linspace(0, 1, 60, device=device)
    strided = splats.map(lambda t: torch.stack([t, t], -1)[..., 0])
    assert not strided.means.is_contiguous()
    results = []
    for leaves, factors in ((splats, weights), (strided, torch.stack([weights, weights], 1)[:, 0])):
        leaves = leaves.map(lambda t: t.detach().requires_grad_())
        options = {"weights": factors, "backend": "cuda"}
        drawn = rasterize(leaves, odd_camera, features=leaves.quats, outputs=["depth"], **options)
        (drawn.image.mT.sum() + drawn.features.mT.square().sum()).backward()
        measured = contributions(leaves, [odd_camera], **options)
        gradients = [leaf.grad for leaf in vars(leaves).values()]
        results.append([drawn.image, drawn.features, *gradients, *vars(measured).values()])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b)


def test_median_depth_matches_reference(device, make_splats, odd_camera):
    """Pixels may differ if rounding decides which splat reaches the median."""
    splats = make_splats(300)
    actual, exact = (
        rasterize(
            splats.to(on, kind), odd_camera, outputs=["median_depth"], backend=backend
        ).median_depth.cpu()
        for backend, kind, on in (("cuda", torch.float32, device), ("reference", torch.float64, "cpu"))
    )
    assert ((actual - exact).abs() < 1e-4).float().mean() > 0.999
    assert 0.2 < (exact > 0).float().mean() < 1


@pytest.mark.parametrize("size", [(75, 50), (4000, 2200)])
def test_tiles_list_all_touching_splats_once_front_to_back(device, make_splats, odd_camera, size):
    """Compare with the reference's test of all tiles; the second image has more tiles than a short counts."""
    across, down = (-(-length // 16) for length in size)
    camera = replace(odd_camera, width=size[0], height=size[1])
    splats, view = make_splats(400, seed=2), KernelCamera.of(camera, 0.2)
    settings = RasterSettings(view, min_scale=0.01, antialias=False)
    projected = cuda.Projected.of(splats.to(device, torch.float32).select(slice(None)), None, settings)
    tiles = cuda.TileLists.of(projected, view)
    starts, pairs = tiles.starts.tolist(), tiles.pairs.cpu().long()
    assert len(starts) == across * down + 1 and starts[0] == 0 and starts[-1] == len(pairs)
    depth = depths(splats.means, view)
    listed = torch.zeros(400, dtype=torch.int64)
    for start, end in itertools.pairwise(starts):
        assert (depth[pairs[start:end]].diff() > 0).all()  # so no splat is listed twice
        listed[pairs[start:end]] += 1
    exact = ellipses(splats, None, settings)
    counts = tile_counts(exact, view).flatten()
    assert (torch.tensor(starts).diff() - counts).abs().sum() <= 1e-3 * counts.sum()
    torch.testing.assert_close(projected.radii.cpu() > 0, exact.radii > 0)


def test_loss_and_gradient_match_reference(device):
    random = torch.Generator().manual_seed(0)
    truth = torch.rand(50, 75, 3, generator=random)
    start, mask = (truth + 0.1 * torch.randn(truth.shape, generator=random)).clamp(0, 1), truth[..., 0]
    target = Target(truth, mask)
    for _ in range(2):  # the second time from the target's cache
        losses, gradients = [], []
        for backend, kind, on in (("cuda", torch.float32, device), ("reference", torch.float64, "cpu")):
            image = start.to(on, kind, copy=True).requires_grad_()
            loss = photometric_loss(image, target, backend=backend)
            loss.backward()
            losses.append(loss.item())
            gradients.append(image.grad.cpu().double())
        assert losses[0] == pytest.approx(losses[1], rel=2e-5)
        assert (gradients[0] - gradients[1]).norm() <= 1e-4 * gradients[1].norm()
    assert target.cache["cuda"].device.type == device


def test_repeated_backward_is_consistent(device, make_splats, odd_camera):
    leaves = make_splats(50).map(lambda t: t.to(device, torch.float32).requires_grad_())
    drawn = rasterize(leaves, odd_camera, outputs=["absgrad2d"], backend="cuda")
    loss = drawn.image.sum()
    results = []
    for _ in range(2):
        loss.backward(retain_graph=True)
        gradients = [leaf.grad for leaf in vars(leaves).values()]
        results.append([tensor.clone() for tensor in (*gradients, drawn.grad2d, drawn.absgrad2d)])
        for leaf in vars(leaves).values():
            leaf.grad = None
    rounding = {} if device == "cpu" else {"rtol": 1e-4, "atol": 1e-4}  # a GPU sums in arbitrary order
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, **rounding)


def test_other_dtypes_and_devices_raise(device, make_splats, odd_camera):
    splats = make_splats(5).to(device, torch.float32)
    with pytest.raises(ValueError, match=r"float32 on a GPU, not torch\.float64"):
        rasterize(splats.to(dtype=torch.float64), odd_camera, backend="cuda")
    with pytest.raises(ValueError, match="on meta"):
        rasterize(splats.to("meta"), odd_camera, backend="cuda")


# -- selection of the backend ----------------------------------------------------------


@pytest.fixture
def card(monkeypatch, fake_card):
    """Simulate a computer with an NVIDIA GPU, whose kernels run on the CPU."""
    monkeypatch.undo()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.setattr(driver, "kernels", cpu_kernels)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a card")
    cuda.find_problem.cache_clear()
    yield
    cuda.find_problem.cache_clear()


def test_auto_uses_cuda_with_gpu(card, monkeypatch):
    assert resolve_backend("auto") == resolve_backend("cuda") == "cuda"
    monkeypatch.setattr(cuda, "DEVICE", "cuda")
    assert tensor_device("auto") == torch.device("cuda")
    assert resolve_backend("cpu") == "cpu" and tensor_device("reference") == torch.device("cpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this computer has a GPU")
def test_auto_uses_cpu_without_gpu():
    assert resolve_backend("auto") == "cpu" and tensor_device("auto") == torch.device("cpu")
    with pytest.raises(LodgsError, match=r"torch detects no NVIDIA GPU\..*auto or cpu"):
        resolve_backend("cuda")


def test_auto_follows_the_device_of_tensors(card, monkeypatch, make_splats, odd_camera):
    def refuse(*_, **__):
        raise AssertionError("tensors on the CPU went to the GPU")

    monkeypatch.setattr(cuda, "rasterize", refuse)
    assert rasterize(make_splats(5).to(dtype=torch.float32), odd_camera).image.shape == (50, 75, 3)
    assert rasterizer._backend("auto", SimpleNamespace(is_cuda=True)) is cuda  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError("NVRTC is not installed"), r"backend: NVRTC is not installed\..*built for CUDA"),
        (
            RuntimeError("cuModuleLoadData: device kernel image is invalid\nmore"),
            r"is invalid\..*newer driver",
        ),
    ],
)
def test_problems_are_reported_with_remedy(card, monkeypatch, error, message):
    def fail():
        raise error

    monkeypatch.setattr(driver, "kernels", fail)
    assert resolve_backend("auto") == "cpu"
    with pytest.raises(LodgsError, match=message):
        resolve_backend("cuda")


def test_wrong_results_are_reported(card, monkeypatch, tmp_path):
    """A kernel that does nothing makes gradients wrong. Only a passed test is stored, per GPU."""
    launch = driver.Kernels.launch

    def skip(self, name, *arguments):
        if name != "blend_backward":
            launch(self, name, *arguments)

    monkeypatch.setattr("training.rasterize.self_test.cache_folder", lambda: tmp_path)
    monkeypatch.setattr(driver.Kernels, "launch", skip)
    problem = cuda.find_problem()
    assert problem and "its gradients of means are" in str(problem)
    monkeypatch.setattr(driver.Kernels, "launch", launch)  # by a newer driver
    cuda.find_problem.cache_clear()
    assert cuda.find_problem() is None
    monkeypatch.setattr(driver.Kernels, "launch", skip)
    cuda.find_problem.cache_clear()
    assert cuda.find_problem() is None
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "another card")
    cuda.find_problem.cache_clear()
    assert str(cuda.find_problem()) == str(problem)


# -- compilation and launch --------------------------------------------------------------


@pytest.mark.parametrize("architecture", ["sm_75", "sm_90", "sm_120"])
def test_nvrtc_compiles_kernels(architecture):
    """Compile for the oldest and newest cards of torch's CUDA; this needs no GPU."""
    try:
        driver.load_nvrtc()
    except OSError:
        pytest.skip("NVRTC is not installed")
    assert driver.compile_kernels(architecture)[:4] == b"\x7fELF"


def test_nvcc_compiles_kernels(tmp_path):
    if not (nvcc := shutil.which("nvcc")):
        pytest.skip("nvcc is not installed")
    (tmp_path / "kernels.cu").write_text(kernel_source())
    command = [nvcc, "-cubin", "-arch=sm_90", "-Xptxas=-v", "-o", "kernels.cubin", "kernels.cu"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    used = [int(count) for count in re.findall(r"Used (\d+) registers", ended.stderr)]
    assert len(used) == kernel_source().count("__global__") and max(used) <= 255


def test_errors_of_the_compiler_include_its_log(monkeypatch):
    try:
        driver.load_nvrtc()
    except OSError:
        pytest.skip("NVRTC is not installed")
    monkeypatch.setattr(driver, "kernel_source", lambda: "no kernel")
    with pytest.raises(RuntimeError, match=r"COMPILATION\n.*error"):
        driver.compile_kernels("sm_90")


def test_launches_check_their_arguments(fake_card):
    with pytest.raises(ValueError, match="contiguous"):
        driver.kernels().launch("adam", 1, 32, torch.zeros(4, 2).T)
    driver.kernels().launch("adam", 0, 32)  # nothing to do


def test_driver_calls(monkeypatch):
    """A fake driver gets the module, the kernel, its grid, torch's stream and pointers to the arguments."""
    calls = []

    class Driver:
        def __getattr__(self, name):
            def call(*arguments):
                calls.append((name, arguments))
                if name == "cuLaunchKernel":
                    number = ctypes.cast(arguments[9][1], ctypes.POINTER(ctypes.c_int)).contents.value
                    return 0 if number == 7 else 1
                if name == "cuGetErrorString":
                    ctypes.cast(arguments[1], ctypes.POINTER(ctypes.c_char_p))[0] = b"invalid argument"
                return 0

            return call

    monkeypatch.setattr(ctypes, "CDLL", lambda name: Driver())
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: SimpleNamespace(cuda_stream=5))
    zeros = torch.zeros
    monkeypatch.setattr(torch, "zeros", lambda *shape, device: zeros(*shape))
    monkeypatch.setattr(driver, "compile_kernels", lambda architecture: architecture.encode())
    kernels = driver.Kernels(driver._DeviceModule())
    kernels.launch("blend", 3, 64, zeros(1), 7)
    kernels.launch("blend", 3, 64, zeros(1), 7)
    names = [name for name, _ in calls]
    assert names[:3] == ["cuCtxGetCurrent", "cuModuleLoadData", "cuModuleGetFunction"]
    assert names[3:] == ["cuCtxSetCurrent", "cuLaunchKernel", "cuLaunchKernel"]
    assert calls[1][1][1] == b"sm_90" and calls[2][1][2] == b"blend"
    grid, stream = calls[4][1][1:8], calls[4][1][8]
    assert grid == (3, 1, 1, 64, 1, 1, 0) and stream.value == 5
    with pytest.raises(RuntimeError, match="cuLaunchKernel: invalid argument"):
        kernels.launch("blend", 3, 64, zeros(1), 8)


def test_warm_up_makes_one_step(fake_card, monkeypatch):
    called = []
    original = cuda.CardModel.step
    monkeypatch.setattr(cuda.CardModel, "step", lambda *a, **k: called.append(1) or original(*a, **k))
    rasterizer.warm_up("cuda")
    assert called == [1]


def test_empty_view_renders_background(device, make_splats):
    """Without visible splats, gradients are zero."""
    import numpy as np

    camera = Camera("away", 20, 10, 10.0, 10.0, 5.0, 5.0, np.diag([-1.0, 1.0, -1.0, 1.0]))
    leaves = make_splats(5).map(lambda t: t.to(device, torch.float32).requires_grad_())
    drawn = rasterize(leaves, camera, background=(0.2, 0.4, 0.6), outputs=["depth"], backend="cuda")
    (drawn.image.sum() + drawn.depth.sum()).backward()
    assert torch.equal(drawn.image.detach().cpu(), torch.tensor([0.2, 0.4, 0.6]).expand(10, 20, 3))
    assert all(leaf.grad is not None and leaf.grad.abs().max() == 0 for leaf in vars(leaves).values())
