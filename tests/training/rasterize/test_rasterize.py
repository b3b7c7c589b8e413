"""Compare every backend with analytic cases, and the kernels with the float64 reference."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.training.rasterize.comparison import (
    CONTRIBUTING,
    SCENES,
    contributed,
    drawn_and_differentiated,
    exact_results,
    isotropic,
    scene,
    squared_distance,
)
from training.errors import LodgsError
from training.rasterize import OUTPUTS, Gaussians, Target, contributions, photometric_loss, rasterize, render
from training.scenes.cameras import Camera


def test_isotropic_splat_on_axis(backend, axis_camera):
    """The variance is (f sigma / z)² + 0.3. The splat covers four tiles."""
    splats = isotropic([2.0], 0.2, [0.8], [[0.9, 0.6, 0.3]])
    drawn = rasterize(splats, axis_camera, background=(0.1, 0.2, 0.4), backend=backend)
    variance = (40 * 0.2 / 2) ** 2 + 0.3
    alpha = 0.8 * np.exp(-squared_distance() / (2 * variance))
    alpha[alpha < 1 / 255] = 0
    expected = alpha[..., None] * (0.9, 0.6, 0.3) + (1 - alpha[..., None]) * (0.1, 0.2, 0.4)
    np.testing.assert_allclose(drawn.image.detach(), expected, atol=5e-6)
    np.testing.assert_allclose(drawn.alpha.detach(), alpha, atol=5e-6)
    assert drawn.radii[0].item() == pytest.approx(3 * math.sqrt(variance), rel=1e-6)

    drawn.image[10, 20, 0].backward()  # d alpha / d mean = alpha (pixel - mean) / variance
    by_mean = (0.9 - 0.1) * alpha[10, 20] * np.array([4.5, -5.5]) / variance
    np.testing.assert_allclose(drawn.grad2d[0], 16 * by_mean, rtol=1e-4)


def test_plain_colours(backend, axis_camera):
    """The image is alpha times colour, and its gradient is Σ alpha. Negative colours have neither."""
    colours = torch.tensor([[0.9, 0.25, -0.1]], requires_grad=True)
    splats = replace(isotropic([2.0], 0.2, [0.8], [[0.0, 0.0, 0.0]]), sh=colours)
    drawn = rasterize(splats, axis_camera, backend=backend)
    alpha = drawn.alpha.detach()
    assert alpha.max() > 0.7
    torch.testing.assert_close(drawn.image.detach(), alpha[..., None] * torch.tensor([0.9, 0.25, 0.0]))
    drawn.image.sum().backward()
    assert colours.grad is not None
    total = alpha.sum().item()
    np.testing.assert_allclose(colours.grad, [[total, total, 0]], rtol=1e-5)
    (image,) = render(splats, [axis_camera], backend=backend)
    np.testing.assert_array_equal(image[..., :3], drawn.image.detach())
    with pytest.raises(ValueError, match=r"sh must be \(1, coefficients, 3\) or \(1, 3\)"):
        replace(splats, sh=colours[:, :2])
    with pytest.raises(ValueError, match="exceeds degree 0"):
        rasterize(splats, axis_camera, sh_degree=1, backend=backend)


def test_antialiased_splat_below_pixel_size_preserves_energy(backend, axis_camera):
    """Opacity times area, 0.8 · 2 pi sigma², is the same before and after the filter."""
    sigma = 0.004
    splats = isotropic([2.0], sigma, [0.8], [[1.0, 1.0, 1.0]])
    drawn = rasterize(splats, axis_camera, antialias=True, backend=backend)
    variance = (40 * sigma / 2) ** 2
    opacity = 0.8 * variance / (variance + 0.1)
    expected = opacity * np.exp(-squared_distance() / (2 * (variance + 0.1)))
    expected[expected < 1 / 255] = 0
    assert expected.max() > 0
    np.testing.assert_allclose(drawn.alpha.detach(), expected, atol=1e-6)


def test_splats_blend_front_to_back_in_any_input_order(backend, axis_camera):
    splats = isotropic([4.0, 2.0], 0.3, [0.9, 0.5], [[1.0, 0.0, 0.2], [0.0, 1.0, 0.2]])
    drawn = rasterize(splats, axis_camera, backend=backend).image.detach()
    far, near = (
        opacity * np.exp(-squared_distance() / (2 * ((40 * 0.3 / z) ** 2 + 0.3)))
        for opacity, z in ((0.9, 4), (0.5, 2))
    )
    far[far < 1 / 255] = 0
    near[near < 1 / 255] = 0
    np.testing.assert_allclose(drawn[..., 0], (1 - near) * far, atol=5e-6)
    np.testing.assert_allclose(drawn[..., 1], near, atol=5e-6)


def test_alpha_is_capped_and_opaque_pixels_are_finished(backend, axis_camera):
    """The first splat has alpha 0.99, the second reduces T to the limit of 1e-4, the third is invisible."""
    cap = 0.99
    splats = isotropic([2.0, 3.0, 4.0], 50.0, [0.9999] * 3, [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    pixel = rasterize(splats, axis_camera, backend=backend).image[16, 16].detach()
    # rounding decides if the second splat is within the limit
    assert pixel[0].item() == pytest.approx(cap, abs=1e-6)
    assert pixel[1].item() in (pytest.approx(cap * (1 - cap), abs=1e-6), 0.0)
    assert pixel[2].item() == 0


def test_depths_and_normals_of_two_discs(backend, axis_camera):
    """A tilted disc of opacity 0.4 in front of a disc of opacity 0.5 that faces the camera."""
    tilt = math.radians(30)
    means = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 2.0]], requires_grad=True)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0], [math.cos(tilt / 2), math.sin(tilt / 2), 0.0, 0.0]])
    log_scales = torch.tensor([[1.0, 1.0, 0.001], [1.0, 1.0, 0.001]]).mul(5).log()
    logits = torch.logit(torch.tensor([0.5, 0.4]))
    splats = Gaussians(means, quats, log_scales, logits, torch.zeros(2, 1, 3))
    drawn = rasterize(splats, axis_camera, outputs=OUTPUTS, backend=backend)
    front, back = 0.4, 0.6 * 0.5  # weights at the centre, with full opacity
    at = 15, 15
    assert drawn.alpha[at].item() == pytest.approx(front + back, rel=1e-3)
    assert drawn.depth[at].item() == pytest.approx((front * 2 + back * 4) / (front + back), rel=1e-3)
    normal = front * np.array([0, math.sin(tilt), -math.cos(tilt)]) + back * np.array([0, 0, -1])
    np.testing.assert_allclose(drawn.normals[at].detach(), normal, atol=1e-3)
    assert drawn.median_depth[at].item() == 4  # T is 0.6 behind the first and 0.3 behind the second
    drawn.median_depth[at].backward()
    assert means.grad is not None and means.grad.tolist() == [[0, 0, 1], [0, 0, 0]]


def test_empty_pixels_have_zero_depth_and_normals(backend, axis_camera):
    splats = isotropic([2.0], 0.02, [0.4], [[1.0, 1.0, 1.0]])
    drawn = rasterize(splats, axis_camera, outputs=OUTPUTS, backend=backend)
    empty = drawn.alpha == 0
    assert 0 < empty.sum() < empty.numel()
    assert (drawn.depth[empty] == 0).all() and (drawn.normals[empty] == 0).all()
    assert torch.allclose(drawn.depth[~empty], torch.tensor(2.0))
    assert (drawn.median_depth == 0).all(), "alpha 0.4 does not reach the median"
    (drawn.depth.sum() + drawn.normals.sum()).backward()
    assert all(t.grad is None or t.grad.isfinite().all() for t in vars(splats).values())


def test_median_depth_matches_reference(kernels, make_splats, odd_camera):
    """Pixels may differ if rounding decides which splat reaches the median."""
    splats = make_splats(300)
    exact = rasterize(splats, odd_camera, outputs=["median_depth"], backend="reference")
    single = splats.to(dtype=torch.float32)
    actual = rasterize(single, odd_camera, outputs=["median_depth"], backend=kernels)
    same = (actual.median_depth - exact.median_depth).abs() < 1e-4
    assert same.float().mean() > 0.999
    assert 0.2 < (exact.median_depth > 0).float().mean() < 1


def test_contributions_of_two_splats_to_two_views(backend, axis_camera):
    """The near splat contributes alpha, the far one the remainder; the second view halves their size."""
    splats = isotropic([4.0, 2.0], 0.3, [0.9, 0.5], [[1.0, 1.0, 1.0]] * 2)
    half_size = Camera("half", 32, 32, 20.0, 20.0, 16.0, 16.0, np.eye(4))
    opposite = Camera("away", 32, 32, 20.0, 20.0, 16.0, 16.0, np.diag([-1.0, 1.0, -1.0, 1.0]))
    measured = contributions(splats, [axis_camera, half_size, opposite], backend=backend)
    expected = np.zeros((3, 2))
    for focal in (40, 20):
        far, near = (
            opacity * np.exp(-squared_distance() / (2 * ((focal * 0.3 / z) ** 2 + 0.3)))
            for opacity, z in ((0.9, 4), (0.5, 2))
        )
        far[far < 1 / 255] = near[near < 1 / 255] = 0
        weights = (1 - near) * far, near
        expected[0] = np.maximum(expected[0], [w.max() for w in weights])
        expected[1] += [w.sum() for w in weights]
        expected[2] += [(w > 0).sum() for w in weights]
    np.testing.assert_allclose(measured.largest, expected[0], rtol=1e-5)
    np.testing.assert_allclose(measured.total, expected[1], rtol=1e-5)
    np.testing.assert_array_equal(measured.pixels, expected[2])
    assert measured.views.tolist() == [2, 2]
    np.testing.assert_allclose(
        measured.radius, [3 * math.sqrt((40 * 0.3 / z) ** 2 + 0.3) for z in (4, 2)], rtol=1e-6
    )


@pytest.mark.parametrize("name", CONTRIBUTING)
def test_contributions_match_reference(name, kernels, make_splats, odd_camera):
    (actual, alpha), (exact, _) = (
        contributed(name, make_splats, odd_camera, backend, kind)
        for backend, kind in ((kernels, torch.float32), ("reference", torch.float64))
    )
    torch.testing.assert_close(actual["largest"], exact["largest"], rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(actual["total"], exact["total"], rtol=1e-3, atol=2e-2)
    assert (actual["pixels"] - exact["pixels"]).abs().sum() <= 1e-3 * exact["pixels"].sum()
    assert torch.equal(actual["views"], exact["views"])
    assert actual["total"].sum().item() == pytest.approx(alpha, rel=1e-4)  # Σ w = alpha


def test_empty_scene_renders_background(backend, axis_camera):
    shapes = (3,), (4,), (3,), (), (16, 3)
    empty = Gaussians(*(torch.zeros(0, *shape, requires_grad=True) for shape in shapes))
    drawn = rasterize(empty, axis_camera, background=(0.2, 0.4, 0.6), backend=backend)
    (drawn.image.sum() + drawn.alpha.sum()).backward()
    assert torch.equal(drawn.image.detach(), torch.tensor([0.2, 0.4, 0.6]).expand(32, 32, 3))
    assert drawn.alpha.abs().max() == 0
    assert all(
        tensor.grad is not None and tensor.grad.shape == tensor.shape for tensor in vars(empty).values()
    )


def test_extreme_image_and_splat_sizes(kernels):
    """One pixel, and splats from 2e-9 to 1.6e5 units: results are finite and match the reference."""
    camera = Camera("dot", 1, 1, 20.0, 20.0, 0.5, 0.5, np.eye(4))
    means = torch.tensor([[0.0, 0, 2], [1e4, 0, 3], [0, 0, -2], [0, 1e-3, 1e5], [0, 0, 0.0101]]).double()
    count = len(means)
    log_scales = torch.tensor([-3.0, 12, 0, 9, -20]).double()[:, None].expand(count, 3).contiguous()
    quats = torch.eye(4).double()[[0, 1, 2, 3, 0]]
    splats = Gaussians(
        means, quats, log_scales, torch.zeros(count).double(), torch.ones(count, 4, 3).double()
    )
    results = []
    for backend, kind in ((kernels, torch.float32), ("reference", torch.float64)):
        leaves = splats.map(lambda t, kind=kind: t.to(kind, copy=True).requires_grad_())
        drawn = rasterize(leaves, camera, backend=backend)
        (drawn.image * torch.tensor([1, 2, 3])).sum().backward()
        gradients = [leaf.grad for leaf in vars(leaves).values()]
        results.append([drawn.image.detach(), drawn.alpha.detach(), drawn.tile_counts, *gradients])
    for actual, truth in zip(*results, strict=True):
        torch.testing.assert_close(actual.double(), truth.double(), rtol=1e-3, atol=1e-5)


@pytest.mark.slow
def test_reference_gradients_match_finite_differences(make_splats):
    camera = Camera("small", 9, 7, 12.0, 11.0, 4.2, 3.3, np.eye(4))
    splats = make_splats(3, seed=4, coefficients=4).map(torch.Tensor.requires_grad_)
    weights = torch.tensor([0.9, 0.5, 0.7], dtype=torch.float64, requires_grad=True)

    def draw(*tensors):
        *splats, weights = tensors
        splats = Gaussians(*splats)
        drawn = rasterize(splats, camera, weights=weights, min_scale=0.05, backend="reference")
        return drawn.image, drawn.alpha

    tensors = (*vars(splats).values(), weights)
    assert torch.autograd.gradcheck(draw, tensors, eps=1e-7, atol=1e-6, check_undefined_grad=False)


@pytest.mark.parametrize("name", SCENES)
def test_kernels_match_reference(name, kernels, make_splats, odd_camera):
    """Relative L2 errors of images and gradients are at most 5e-4, typically 1e-6."""
    actual = drawn_and_differentiated(name, make_splats, odd_camera, kernels, torch.float32)
    exact = exact_results(name, make_splats, odd_camera)
    assert exact["grad2d"].norm() > 0
    for output, expected in exact.items():
        error = (actual[output] - expected).norm() / expected.norm().clamp_min(1e-12)
        # rounding decides if an ellipse just touches a tile
        assert error <= (5e-3 if output == "tile_counts" else 5e-4), f"{output}: {error:.1e}"


def test_crowd_scene_blends_thousands_of_splats_per_pixel(make_splats, odd_camera):
    """Opacities are so low that a pixel is finished only after more than a thousand splats."""
    splats, _ = scene("crowd", make_splats)
    alpha = torch.sigmoid(splats.opacity_logits)
    assert math.log(1e-4) / math.log(1 - alpha.mean().item()) > 1000
    drawn = rasterize(splats.to(dtype=torch.float32), odd_camera)
    assert drawn.alpha[25, 37] > 0.99


def test_zero_weight_removes_splat(backend, make_splats, odd_camera):
    splats = make_splats(60).to(dtype=torch.float32)
    weights = (torch.arange(60) % 3 > 0).float()
    splats.means[0] = float("nan")  # dropped before projection, so never read
    weighted = rasterize(splats, odd_camera, weights=weights, backend=backend)
    selected = rasterize(splats.select(weights > 0), odd_camera, backend=backend)
    torch.testing.assert_close(weighted.image, selected.image)
    torch.testing.assert_close(weighted.radii[weights > 0], selected.radii)
    assert backend not in ("cpu", "gpu") or torch.equal(weighted.image, selected.image)
    assert weighted.radii[weights == 0].max() == 0


@pytest.mark.parametrize("name", ["means", "quats"])
def test_splats_that_are_not_numbers_are_not_drawn(kernels, make_splats, odd_camera, name):
    splats = make_splats(60).to(dtype=torch.float32)
    getattr(splats, name)[7] = float("nan")
    drawn = rasterize(splats, odd_camera, backend=kernels)
    expected = rasterize(splats.select(torch.arange(60) != 7), odd_camera, backend=kernels)
    assert drawn.radii[7] == 0 and torch.equal(drawn.image, expected.image)


def test_unselected_rows_act_like_zero_weights(backend, make_splats, odd_camera):
    splats = make_splats(300).to(dtype=torch.float32)
    weights = torch.rand(300, generator=torch.Generator().manual_seed(1))
    rows = torch.arange(0, 300, 3, dtype=torch.int32)
    mask = torch.zeros(300)
    mask[rows.long()] = 1
    for row_weights in (None, weights):
        masked = mask if row_weights is None else mask * row_weights
        selected = rasterize(splats, odd_camera, weights=row_weights, rows=rows, backend=backend)
        expected = rasterize(splats, odd_camera, weights=masked, backend=backend)
        assert torch.equal(selected.image, expected.image) and torch.equal(selected.radii, expected.radii)
        largest = [
            contributions(splats, [odd_camera], weights=w, rows=r, backend=backend).largest
            for w, r in ((row_weights, rows), (masked, None))
        ]
        assert torch.equal(*largest) and largest[0].any()


def test_render_matches_rasterize(backend, make_splats, odd_camera, axis_camera):
    """Render complete images and strips of 16 rows, in every dtype."""
    splats = make_splats(150).to(dtype=torch.float32)
    options = {"background": (0.9, 0.2, 0.4), "sh_degree": 1, "min_scale": 0.01, "backend": backend}
    cameras = [odd_camera, axis_camera]
    for camera, complete, strips, small, half in zip(
        cameras,
        render(splats, cameras, **options),
        render(splats, cameras, strip=1, **options),
        render(splats, cameras, dtype="uint8", **options),
        render(splats, cameras, dtype="float16", **options),
        strict=True,
    ):
        drawn = rasterize(splats, camera, **options)
        expected = torch.cat([drawn.image, drawn.alpha[..., None]], 2).numpy()
        np.testing.assert_array_equal(complete, expected)
        np.testing.assert_allclose(strips, expected, atol=2e-5)
        assert small.dtype == np.uint8 and half.dtype == np.float16
        np.testing.assert_array_equal(small, np.round(expected.clip(0, 1) * 255))
        np.testing.assert_allclose(half, expected, atol=2e-3)
    with pytest.raises(ValueError, match="dtype must be"):
        next(render(splats, cameras, dtype="int8"))


def test_inconsistent_arguments_raise(make_splats, odd_camera):
    splats = make_splats(5).to(dtype=torch.float32)
    with pytest.raises(ValueError, match=r"quats must have shape \(5, 4\)"):
        replace(splats, quats=splats.quats[:4])
    with pytest.raises(ValueError, match="sh_degree 4 exceeds degree 3"):
        rasterize(splats, odd_camera, sh_degree=4)
    with pytest.raises(ValueError, match="outputs must be among depth"):
        rasterize(splats, odd_camera, outputs=["depths"])
    with pytest.raises(LodgsError, match="abacus"):
        rasterize(splats, odd_camera, backend="abacus")
    with pytest.raises(ValueError, match="differ in shape"):
        photometric_loss(torch.zeros(4, 5, 3), Target(torch.zeros(5, 4, 3)))


def test_other_dtypes_and_devices_raise(kernels, make_splats, odd_camera):
    splats = make_splats(5)
    with pytest.raises(ValueError, match=f"the {kernels} backend requires float32 on the CPU, not"):
        rasterize(splats, odd_camera, backend=kernels)
    with pytest.raises(ValueError, match="on meta"):
        rasterize(splats.to("meta", torch.float32), odd_camera, backend=kernels)
