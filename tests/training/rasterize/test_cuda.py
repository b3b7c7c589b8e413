"""Compare the cuda backend with the float64 reference, with a fake gsplat on the CPU and on a GPU if
available.

gsplat caps alpha at 0.999. For comparisons of images and gradients, the reference's cap is raised to this
value.
"""

import inspect
import sys
from types import SimpleNamespace

import pytest
import torch

from tests.training.rasterize import fake_gsplat
from tests.training.rasterize.comparison import (
    CONTRIBUTING,
    SCENES,
    contributed,
    drawn_and_differentiated,
    exact_results,
)
from training import rasterize as rasterizer
from training.errors import LodgsError
from training.files import try_lock
from training.rasterize import (
    Target,
    cuda,
    photometric_loss,
    rasterize,
    reference,
    resolve_backend,
    tensor_device,
)
from training.rasterize.features import depths
from training.rasterize.reference import ellipses, squared_reach
from training.rasterize.rendering import KernelCamera, RasterSettings
from training.scenes.cameras import Camera

GSPLAT_CAP = 0.999


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
    """Device of the cuda backend: the CPU through ``fake_card``, and a GPU with gsplat."""
    if request.param == "cpu":
        request.getfixturevalue("fake_card")
    elif problem := cuda.find_problem():
        pytest.skip(f"no NVIDIA GPU that gsplat works on: {problem}")
    return request.param


RARE = ("degree 1", "degree 2", "one", "antialiased some", "screen-filling", "crowd")
"""Scenes that are compared nightly."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] * (name in RARE)) for name in SCENES]
)
def test_results_match_reference(name, device, make_splats, odd_camera, monkeypatch):
    """Relative L2 errors of all outputs and gradients are at most 5e-4, on GPUs with fast exp 2e-3."""
    actual = drawn_and_differentiated(name, make_splats, odd_camera, "cuda", torch.float32, device)
    monkeypatch.setattr(reference, "ALPHA_MAX", GSPLAT_CAP)
    exact = exact_results(name, make_splats, odd_camera)
    assert exact["grad2d"].norm() > 0 and exact["absgrad2d"].norm() > exact["grad2d"].norm()
    bound = 5e-4 if device == "cpu" else 2e-3
    for output, expected in exact.items():
        error = (actual[output] - expected).norm() / expected.norm().clamp_min(1e-12)
        # rounding decides if an ellipse just touches a tile
        assert error <= (5e-3 if output == "tile_counts" else bound), f"{output}: {error:.1e}"


def test_alpha_cap_is_the_only_difference(device, make_splats, odd_camera):
    """An opaque splat changes a pixel by at most 0.999 - 0.99; below 0.99 there is no difference."""
    splats = make_splats(1)
    splats.means[:] = torch.tensor([0.1, -0.2, 3.0])
    splats.log_scales[:] = -0.5
    for logit, limit in ((12.0, GSPLAT_CAP - 0.99), (4.0, 0.0)):
        splats.opacity_logits[:] = logit
        actual, exact = (
            rasterize(splats.to(on, kind), odd_camera, backend=backend).alpha.cpu()
            for backend, kind, on in (
                ("cuda", torch.float32, device),
                ("reference", torch.float64, "cpu"),
            )
        )
        difference = (actual - exact).abs().max().item()
        assert difference <= limit + 1e-4 and (limit == 0 or difference > 0.5 * limit)


@pytest.mark.parametrize("name", CONTRIBUTING)
def test_contributions_match_reference(name, device, make_splats, odd_camera, monkeypatch):
    """Contributions use the reference's cap of 0.99. Small chunks give the same results."""
    exact, alpha = contributed(name, make_splats, odd_camera, "reference", torch.float64)
    for pairs in (1 << 24, 20 * 256 * 3):
        monkeypatch.setattr(cuda, "CHUNK_PAIRS", pairs)
        actual, _ = contributed(name, make_splats, odd_camera, "cuda", torch.float32, device)
        torch.testing.assert_close(actual["largest"], exact["largest"], rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(actual["total"], exact["total"], rtol=1e-3, atol=2e-2)
        assert (actual["pixels"] - exact["pixels"]).abs().sum() <= 1e-3 * exact["pixels"].sum()
        assert torch.equal(actual["views"], exact["views"])
        assert actual["total"].sum().item() == pytest.approx(alpha, rel=1e-4)


def test_median_depth_matches_reference(device, make_splats, odd_camera, monkeypatch):
    """Pixels may differ if rounding decides which splat reaches the median."""
    monkeypatch.setattr(cuda, "CHUNK_PAIRS", 20 * 256 * 4)
    splats = make_splats(300)
    actual, exact = (
        rasterize(
            splats.to(on, kind), odd_camera, outputs=["median_depth"], backend=backend
        ).median_depth.cpu()
        for backend, kind, on in (("cuda", torch.float32, device), ("reference", torch.float64, "cpu"))
    )
    assert ((actual - exact).abs() < 1e-4).float().mean() > 0.999
    assert 0.2 < (exact > 0).float().mean() < 1


def test_tiles_list_all_touching_splats_once_front_to_back(device, make_splats, odd_camera):
    """Compare with a test of all pixels in float64."""
    splats, view = make_splats(400, seed=2), KernelCamera.of(odd_camera, 0.2)
    settings = RasterSettings(view, min_scale=0.01, antialias=False)
    visible = cuda.VisibleSplats.of(splats.to(device, torch.float32), None, settings)
    tiles = cuda.TileLists.of(visible, view)
    exact = ellipses(splats, None, settings)

    (xx, xy, yy), mean = (v[:, None, None] for v in exact.covariance), exact.mean2d[:, :, None, None]
    dx, dy = torch.arange(80) + 0.5 - mean[:, 0], (torch.arange(64) + 0.5)[:, None] - mean[:, 1]
    distance = (yy * dx**2 - 2 * xy * dx * dy + xx * dy**2) / (xx * yy - xy**2)
    touched = (distance <= squared_reach(exact.opacity)[:, None, None]) & exact.inside[:, None, None]
    touched = touched.reshape(-1, 4, 16, 5, 16).any(4).any(2)
    expected = torch.zeros(400, 4, 5, dtype=torch.bool)
    expected[exact.drawn] = touched

    listed = torch.zeros(400, 4, 5, dtype=torch.int64)
    for tile, (start, count) in enumerate(zip(tiles.start.flatten(), tiles.counts.flatten(), strict=True)):
        rows = tiles.splat[start : start + count].long()
        assert (rows.diff() > 0).all()  # rows are front to back, so increasing rows are unique and ordered
        listed[visible.index[rows].cpu(), tile // 5, tile % 5] += 1
    assert tiles.counts.sum() == len(tiles.splat) and listed.max() == 1
    depth = depths(splats.means[visible.index.cpu()], view)
    torch.testing.assert_close(depth, exact.depth[exact.inside].sort().values)
    assert (listed[expected] == 1).float().mean() > 0.999
    assert listed.sum() <= 1.15 * expected.sum()


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
    assert target.cache["cuda"][0].device.type == device


def test_repeated_backward_is_consistent_and_frees_memory(device, make_splats, odd_camera):
    """Deleting a rendering frees its tensors; a reference cycle through autograd's graph would leak."""
    import gc
    import weakref

    leaves = make_splats(50).map(lambda t: t.to(device, torch.float32).requires_grad_())
    drawn = rasterize(leaves, odd_camera, outputs=["absgrad2d"], backend="cuda")
    loss = drawn.image.sum()
    loss.backward(retain_graph=True)
    first = [leaf.grad.clone() for leaf in vars(leaves).values()] + [
        drawn.grad2d.clone(),
        drawn.absgrad2d.clone(),
    ]
    for leaf in vars(leaves).values():
        leaf.grad = None
    loss.backward()
    second = [leaf.grad for leaf in vars(leaves).values()] + [drawn.grad2d, drawn.absgrad2d]
    rounding = {} if device == "cpu" else {"rtol": 1e-4, "atol": 1e-4}  # a GPU sums in arbitrary order
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(a, b, **rounding)

    node = loss.grad_fn
    while type(node).__name__ != "_BlendBackward":
        node = node.next_functions[0][0]
    inputs = [weakref.ref(tensor) for tensor in node.inner[0]]
    gc.disable()
    try:
        del node, drawn, loss
        assert all(ref() is None for ref in inputs)
    finally:
        gc.enable()


def test_other_dtypes_and_devices_raise(device, make_splats, odd_camera):
    splats = make_splats(5).to(device, torch.float32)
    with pytest.raises(ValueError, match=r"float32 on a GPU, not torch\.float64"):
        rasterize(splats.to(dtype=torch.float64), odd_camera, backend="cuda")
    with pytest.raises(ValueError, match="on meta"):
        rasterize(splats.to("meta"), odd_camera, backend="cuda")


# -- selection of the backend ----------------------------------------------------------


@pytest.fixture
def card(monkeypatch):
    """Simulate a computer with an NVIDIA GPU and gsplat; the GPU computes on the CPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.setitem(sys.modules, "gsplat", fake_gsplat)
    cuda.find_problem.cache_clear()
    yield
    cuda.find_problem.cache_clear()


def test_auto_uses_cuda_with_gpu_and_gsplat(card, monkeypatch):
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


def test_missing_requirements_are_reported_with_remedy(card, monkeypatch):
    def problem_with(gsplat) -> str:
        monkeypatch.setitem(sys.modules, "gsplat", gsplat)
        cuda.find_problem.cache_clear()
        assert resolve_backend("auto") == "cpu"
        with pytest.raises(LodgsError) as caught:
            resolve_backend("cuda")
        return str(caught.value)

    message = problem_with(None)
    assert "package gsplat is not installed" in message and "pip install gsplat" in message

    def uncompiled(*_):
        return getattr(None, "spherical_harmonics_fwd")  # noqa: B009, like gsplat without nvcc

    def failing(*_):
        print("setting up CUDA")
        raise RuntimeError("Error building extension 'gsplat_cuda': [1/30] nvcc, its options\nand more")

    assert "nvcc is not installed" in problem_with(SimpleNamespace(spherical_harmonics=uncompiled))
    message = problem_with(SimpleNamespace(spherical_harmonics=failing))
    assert "Error building extension 'gsplat_cuda'." in message and "nvcc" not in message


def test_compilation_does_not_print_to_standard_output(card, monkeypatch, capsys):
    def loud(*args):
        print("setting up CUDA")
        return fake_gsplat.spherical_harmonics(*args)

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(spherical_harmonics=loud))
    assert cuda.find_problem() is None
    printed = capsys.readouterr()
    assert printed.out == "" and "setting up" in printed.err


def test_compilation_holds_a_lock(card, monkeypatch, tmp_path):
    monkeypatch.setattr("training.files.cache_folder", lambda: tmp_path)
    locked = []

    def compiling(*args):
        with (tmp_path / "gsplat.lock").open("rb") as lock:
            locked.append(not try_lock(lock))
        return fake_gsplat.spherical_harmonics(*args)

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(spherical_harmonics=compiling))
    assert cuda.find_problem() is None and locked == [True]


@pytest.mark.parametrize("name", ["rasterize_to_pixels", "spherical_harmonics"])
def test_fake_signatures_match_gsplat(name):
    gsplat = pytest.importorskip("gsplat", reason="gsplat is not installed")
    real, fake = (inspect.signature(getattr(module, name)) for module in (gsplat, fake_gsplat))
    assert [(p.name, p.default) for p in real.parameters.values()] == [
        (p.name, p.default) for p in fake.parameters.values()
    ]


def test_warm_up_makes_one_step(fake_card, monkeypatch):
    called = []
    original = cuda.rasterize
    monkeypatch.setattr(cuda, "rasterize", lambda *a, **k: called.append(1) or original(*a, **k))
    rasterizer.warm_up("cuda")
    assert called == [1]


def test_empty_view_renders_background(device, make_splats):
    """Without visible splats, gsplat is not called and gradients are zero."""
    import numpy as np

    camera = Camera("away", 20, 10, 10.0, 10.0, 5.0, 5.0, np.diag([-1.0, 1.0, -1.0, 1.0]))
    leaves = make_splats(5).map(lambda t: t.to(device, torch.float32).requires_grad_())
    drawn = rasterize(leaves, camera, background=(0.2, 0.4, 0.6), outputs=["depth"], backend="cuda")
    (drawn.image.sum() + drawn.depth.sum()).backward()
    assert torch.equal(drawn.image.detach().cpu(), torch.tensor([0.2, 0.4, 0.6]).expand(10, 20, 3))
    assert all(leaf.grad is not None and leaf.grad.abs().max() == 0 for leaf in vars(leaves).values())
