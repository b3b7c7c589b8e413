"""Every backend against cases worked by hand, and our kernels against the float64 reference."""

import math
import os
import subprocess
import sys
import threading
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.training.rasterize.comparison import (
    CONTRIBUTING,
    SCENES,
    contributed,
    drawn_and_differentiated,
    scene,
)
from training.errors import LodgsError
from training.rasterize import (
    OUTPUTS,
    Gaussians,
    Target,
    contributions,
    cpu,
    photometric_loss,
    rasterize,
    rasterize_strips,
    render,
)
from training.rasterize.cpu.bin import TILE, bin_splats
from training.rasterize.cpu.compile import Buffers, _idle, numba, run_parallel, set_thread_count, thread_count
from training.rasterize.cpu.fastmath import exp2
from training.rasterize.cpu.project import (
    COLUMNS,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    HALF_HEIGHT,
    HALF_WIDTH,
    LOG2_OPACITY,
    RISE,
    SLOPE,
    X_OF_TOP,
    strip_rows,
)
from training.scenes.cameras import Camera

SH_C0 = 0.28209479177387814


def isotropic(depths, sigma, opacities, colours, kind=torch.float32):
    """Round splats on the z axis."""
    count = len(depths)
    means = torch.zeros(count, 3)
    means[:, 2] = torch.tensor(depths)
    quats = torch.tensor([[2.0, 0.0, 0.0, 0.0]]).repeat(count, 1)
    logits = torch.logit(torch.tensor(opacities))
    sh = (torch.tensor(colours).reshape(count, 1, 3) - 0.5) / SH_C0
    log_scales = torch.full((count, 3), math.log(sigma))
    return Gaussians(means, quats, log_scales, logits, sh).map(lambda t: t.to(kind).requires_grad_())


def squared_distance():
    """From the image point (16, 16) to the pixel centres of a 32x32 image."""
    offset = np.arange(32) + 0.5 - 16
    return offset[None, :] ** 2 + offset[:, None] ** 2


def test_one_round_splat_on_the_axis(backend, axis_camera):
    """Its variance is (f sigma / z)² + 0.3; it lies across four tiles."""
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


def test_colours_may_be_given_as_they_are(backend, axis_camera):
    """The picture is alpha times the colour, the gradient by a colour Σ alpha; below 0 there is neither."""
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
    (picture,) = render(splats, [axis_camera], backend=backend)
    np.testing.assert_array_equal(picture[..., :3], drawn.image.detach())
    with pytest.raises(ValueError, match=r"sh must be \(1, coefficients, 3\) or \(1, 3\)"):
        replace(splats, sh=colours[:, :2])
    with pytest.raises(ValueError, match="exceeds degree 0"):
        rasterize(splats, axis_camera, sh_degree=1, backend=backend)


def test_a_splat_smaller_than_a_pixel_keeps_its_light_when_antialiased(backend, axis_camera):
    """Its opacity times its area: 0.8 · 2 pi sigma² before and after the filter."""
    sigma = 0.004
    splats = isotropic([2.0], sigma, [0.8], [[1.0, 1.0, 1.0]])
    drawn = rasterize(splats, axis_camera, antialias=True, backend=backend)
    variance = (40 * sigma / 2) ** 2
    opacity = 0.8 * variance / (variance + 0.1)
    expected = opacity * np.exp(-squared_distance() / (2 * (variance + 0.1)))
    expected[expected < 1 / 255] = 0
    assert expected.max() > 0
    np.testing.assert_allclose(drawn.alpha.detach(), expected, atol=1e-6)


def test_two_splats_blend_front_to_back_whatever_their_order(backend, axis_camera):
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


def test_alpha_is_capped_and_dark_pixels_take_no_more(backend, axis_camera):
    """The first takes 0.99; the second leaves 1e-4, at the bound; the third must not be seen.

    gsplat's cap is 0.999, so that there the second is beyond the bound.
    """
    cap = 0.999 if backend == "cuda" else 0.99
    splats = isotropic([2.0, 3.0, 4.0], 50.0, [0.9999] * 3, [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    pixel = rasterize(splats, axis_camera, backend=backend).image[16, 16].detach()
    # rounding decides on which side of the bound the second falls
    assert pixel[0].item() == pytest.approx(cap, abs=1e-6)
    assert pixel[1].item() in (pytest.approx(cap * (1 - cap), abs=1e-6), 0.0)
    assert pixel[2].item() == 0


def test_depths_and_normals_of_two_discs(backend, axis_camera):
    """A disc of opacity 0.4, tilted and turned away, before one of 0.5 that faces the camera."""
    tilt = math.radians(30)
    means = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 2.0]], requires_grad=True)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0], [math.cos(tilt / 2), math.sin(tilt / 2), 0.0, 0.0]])
    log_scales = torch.tensor([[1.0, 1.0, 0.001], [1.0, 1.0, 0.001]]).mul(5).log()
    logits = torch.logit(torch.tensor([0.5, 0.4]))
    splats = Gaussians(means, quats, log_scales, logits, torch.zeros(2, 1, 3))
    drawn = rasterize(splats, axis_camera, outputs=OUTPUTS, backend=backend)
    front, back = 0.4, 0.6 * 0.5  # weights at the middle, where both are at their full opacity
    at = 15, 15
    assert drawn.alpha[at].item() == pytest.approx(front + back, rel=1e-3)
    assert drawn.depth[at].item() == pytest.approx((front * 2 + back * 4) / (front + back), rel=1e-3)
    normal = front * np.array([0, math.sin(tilt), -math.cos(tilt)]) + back * np.array([0, 0, -1])
    np.testing.assert_allclose(drawn.normals[at].detach(), normal, atol=1e-3)
    assert drawn.median_depth[at].item() == 4  # 0.6 is left behind the first, 0.3 behind the second
    drawn.median_depth[at].backward()
    assert means.grad is not None and means.grad.tolist() == [[0, 0, 1], [0, 0, 0]]


def test_what_is_empty_has_no_depth(backend, axis_camera):
    splats = isotropic([2.0], 0.02, [0.4], [[1.0, 1.0, 1.0]])
    drawn = rasterize(splats, axis_camera, outputs=OUTPUTS, backend=backend)
    empty = drawn.alpha == 0
    assert 0 < empty.sum() < empty.numel()
    assert (drawn.depth[empty] == 0).all() and (drawn.normals[empty] == 0).all()
    assert torch.allclose(drawn.depth[~empty], torch.tensor(2.0))
    assert (drawn.median_depth == 0).all(), "0.4 leaves more than a half"
    (drawn.depth.sum() + drawn.normals.sum()).backward()
    assert all(t.grad is None or t.grad.isfinite().all() for t in vars(splats).values())


def test_a_limit_leaves_out_what_lies_behind_it(backend, axis_camera):
    """Worked by hand: splats at 2 and at 4, a limit of 3 on the left half and none on the right."""
    splats = isotropic([4.0, 2.0], 0.3, [0.9, 0.5], [[1.0, 0.0, 0.2], [0.0, 1.0, 0.2]]).detach()
    limit = torch.full((32, 32), 1e10)
    limit[:, :16] = 3
    options = {"background": (0.0, 0.0, 0.5), "outputs": ("depth", "median_depth"), "backend": backend}
    drawn = rasterize(splats, axis_camera, features=torch.eye(2), limit=limit, **options)
    far, near = (
        opacity * np.exp(-squared_distance() / (2 * ((40 * 0.3 / z) ** 2 + 0.3)))
        for opacity, z in ((0.9, 4), (0.5, 2))
    )
    far[far < 1 / 255] = near[near < 1 / 255] = 0
    far[:, :16] = 0
    weights = (1 - near) * far, near
    alpha = sum(weights)
    np.testing.assert_allclose(drawn.image[..., 0], weights[0], atol=5e-6)
    np.testing.assert_allclose(drawn.image[..., 1], near, atol=5e-6)
    np.testing.assert_allclose(drawn.image[..., 2], 0.2 * alpha + 0.5 * (1 - alpha), atol=5e-6)
    np.testing.assert_allclose(drawn.alpha, alpha, atol=5e-6)
    np.testing.assert_allclose(drawn.features, np.stack(weights, 2), atol=5e-6)
    some = alpha > 0
    expected = (weights[0] * 4 + near * 2)[some] / alpha[some]
    np.testing.assert_allclose(drawn.depth[some], expected, rtol=1e-5)
    assert drawn.median_depth[16, 14:18].tolist() == [0, 0, 4, 4]  # the first leaves more than a half
    limit[:] = 1  # before everything
    empty = rasterize(splats, axis_camera, limit=limit, **options)
    assert empty.alpha.max() == 0 and empty.median_depth.max() == 0
    assert torch.equal(empty.image, torch.tensor([0.0, 0.0, 0.5]).expand(32, 32, 3))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["degree 3", "antialiased", "needles", "screen-filling", "caps", "crowd"])
def test_limits_agree_with_the_reference(name, backend, make_splats, odd_camera):
    """A depth of its own in every pixel: relative L2 at most 5e-4, median depths but for rounding."""
    splats, options = scene(name, make_splats)
    random = torch.Generator().manual_seed(2)
    limit = 2 + 2 * torch.rand(50, 75, generator=random).double()
    limit[::3] = 1e10
    features = torch.rand(len(splats), 4, generator=random).double()
    options |= {"background": (0.1, 0.5, 0.3), "outputs": ("depth", "median_depth", "normals")}
    exact = rasterize(splats, odd_camera, features=features, limit=limit, backend="reference", **options)
    free = rasterize(splats, odd_camera, backend="reference", **options)
    assert (free.alpha - exact.alpha).abs().mean() > 0.01
    found = rasterize(
        splats.to(dtype=torch.float32), odd_camera, features=features.float(), limit=limit.float(),
        backend=backend, **options,
    )  # fmt: skip
    for output in ("image", "alpha", "depth", "normals", "features"):
        value, truth = getattr(found, output).double(), getattr(exact, output)
        assert (value - truth).norm() <= 5e-4 * truth.norm(), output
    same = (found.median_depth - exact.median_depth).abs() < 1e-4
    assert same.float().mean() > 0.999


def test_limits_of_strips_and_windows(backend, make_splats, odd_camera):
    """Are those of the whole; an infinite one is none."""
    splats = make_splats(150).to(dtype=torch.float32)
    limit = 2 + 2 * torch.rand(50, 75, generator=torch.Generator().manual_seed(3))
    options = {"outputs": ("median_depth",), "backend": backend}
    whole = rasterize(splats, odd_camera, limit=limit, **options)
    for left, top, width, height in ((0, 0, 75, 50), (20, 7, 41, 36)):
        inside = slice(top, top + height), slice(left, left + width)
        window = {"window": (left, top, width, height), "limit": limit[inside]}
        parts = [drawn for _, drawn in rasterize_strips(splats, odd_camera, strip=1, **window, **options)]
        assert len(parts) > 2
        for output in ("image", "alpha", "median_depth"):
            found = torch.cat([getattr(part, output) for part in parts])
            torch.testing.assert_close(found, getattr(whole, output)[inside], atol=2e-5, rtol=1e-4)
    free = rasterize(splats, odd_camera, **options)
    boundless = rasterize(splats, odd_camera, limit=torch.full((50, 75), math.inf), **options)
    for output in ("image", "alpha", "median_depth"):
        one, other = getattr(boundless, output), getattr(free, output)
        if backend == "cuda":  # its limited pictures have the definition's cap
            torch.testing.assert_close(one, other, atol=0.01, rtol=1e-4)
        else:
            assert torch.equal(one, other)


def test_a_limit_is_for_pictures(backend, make_splats, odd_camera):
    splats = make_splats(5).map(lambda t: t.float().requires_grad_())
    with pytest.raises(ValueError, match="not differentiable"):
        rasterize(splats, odd_camera, limit=torch.ones(50, 75), backend=backend)
    with pytest.raises(ValueError, match=r"limit must have shape \(50, 75\)"):
        next(rasterize_strips(splats, odd_camera, limit=torch.ones(75, 50), backend=backend))


def test_median_depths_agree_with_the_reference(kernels, make_splats, odd_camera):
    """Pixel for pixel, but for those where rounding decides which splat reaches the half."""
    splats = make_splats(300)
    exact = rasterize(splats, odd_camera, outputs=["median_depth"], backend="reference")
    single = splats.to(dtype=torch.float32)
    found = rasterize(single, odd_camera, outputs=["median_depth"], backend=kernels)
    same = (found.median_depth - exact.median_depth).abs() < 1e-4
    assert same.float().mean() > 0.999
    assert 0.2 < (exact.median_depth > 0).float().mean() < 1


def test_what_two_splats_contribute_to_two_views(backend, axis_camera):
    """Worked by hand: the nearer takes alpha, the farther what is left; one view sees them half as large."""
    splats = isotropic([4.0, 2.0], 0.3, [0.9, 0.5], [[1.0, 1.0, 1.0]] * 2)
    half = Camera("half", 32, 32, 20.0, 20.0, 16.0, 16.0, np.eye(4))
    away = Camera("away", 32, 32, 20.0, 20.0, 16.0, 16.0, np.diag([-1.0, 1.0, -1.0, 1.0]))
    found = contributions(splats, [axis_camera, half, away], backend=backend)
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
    np.testing.assert_allclose(found.largest, expected[0], rtol=1e-5)
    np.testing.assert_allclose(found.total, expected[1], rtol=1e-5)
    np.testing.assert_array_equal(found.pixels, expected[2])
    assert found.views.tolist() == [2, 2]
    np.testing.assert_allclose(
        found.radius, [3 * math.sqrt((40 * 0.3 / z) ** 2 + 0.3) for z in (4, 2)], rtol=1e-6
    )


@pytest.mark.parametrize("name", CONTRIBUTING)
def test_contributions_agree_with_the_reference(name, kernels, make_splats, odd_camera):
    (found, alpha), (exact, _) = (
        contributed(name, make_splats, odd_camera, backend, kind)
        for backend, kind in ((kernels, torch.float32), ("reference", torch.float64))
    )
    torch.testing.assert_close(found["largest"], exact["largest"], rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(found["total"], exact["total"], rtol=1e-3, atol=2e-2)
    assert (found["pixels"] - exact["pixels"]).abs().sum() <= 1e-3 * exact["pixels"].sum()
    assert torch.equal(found["views"], exact["views"])
    assert found["total"].sum().item() == pytest.approx(alpha, rel=1e-4)  # Σ w = alpha


def test_no_splats_leave_the_background(backend, axis_camera):
    shapes = (3,), (4,), (3,), (), (16, 3)
    empty = Gaussians(*(torch.zeros(0, *shape, requires_grad=True) for shape in shapes))
    drawn = rasterize(empty, axis_camera, background=(0.2, 0.4, 0.6), backend=backend)
    (drawn.image.sum() + drawn.alpha.sum()).backward()
    assert torch.equal(drawn.image.detach(), torch.tensor([0.2, 0.4, 0.6]).expand(32, 32, 3))
    assert drawn.alpha.abs().max() == 0
    assert all(
        tensor.grad is not None and tensor.grad.shape == tensor.shape for tensor in vars(empty).values()
    )


def test_a_picture_may_be_one_pixel_and_a_splat_larger_than_the_world(kernels):
    """All finite, and what the reference has."""
    camera = Camera("dot", 1, 1, 20.0, 20.0, 0.5, 0.5, np.eye(4))
    means = torch.tensor([[0.0, 0, 2], [1e4, 0, 3], [0, 0, -2], [0, 1e-3, 1e5], [0, 0, 0.0101]]).double()
    count = len(means)
    log_scales = torch.tensor([-3.0, 12, 0, 9, -20]).double()[:, None].expand(count, 3).contiguous()
    quats = torch.eye(4).double()[[0, 1, 2, 3, 0]]
    splats = Gaussians(
        means, quats, log_scales, torch.zeros(count).double(), torch.ones(count, 4, 3).double()
    )
    found = []
    for backend, kind in ((kernels, torch.float32), ("reference", torch.float64)):
        leaves = splats.map(lambda t, kind=kind: t.to(kind, copy=True).requires_grad_())
        drawn = rasterize(leaves, camera, backend=backend)
        (drawn.image * torch.tensor([1, 2, 3])).sum().backward()
        gradients = [leaf.grad for leaf in vars(leaves).values()]
        found.append([drawn.image.detach(), drawn.alpha.detach(), drawn.tile_counts, *gradients])
    for one, truth in zip(*found, strict=True):
        torch.testing.assert_close(one.double(), truth.double(), rtol=1e-3, atol=1e-5)


@pytest.mark.slow
def test_the_references_gradients_are_finite_differences(make_splats):
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
def test_our_kernels_agree_with_the_reference(name, kernels, make_splats, odd_camera):
    """Images and every gradient, relative L2 at most 5e-4 (most are near 1e-6)."""
    found, exact = (
        drawn_and_differentiated(name, make_splats, odd_camera, backend, kind)
        for backend, kind in ((kernels, torch.float32), ("reference", torch.float64))
    )
    assert exact["grad2d"].norm() > 0
    for output, expected in exact.items():
        error = (found[output] - expected).norm() / expected.norm().clamp_min(1e-12)
        # whether an ellipse just touches a tile is a matter of rounding
        assert error <= (5e-3 if output == "tile_counts" else 5e-4), f"{output}: {error:.1e}"


def test_thousands_of_splats_are_blended_on_a_pixel_of_the_crowd(make_splats, odd_camera):
    """What the scene above claims: opacities so low that darkness comes after more than a thousand."""
    splats, _ = scene("crowd", make_splats)
    alpha = torch.sigmoid(splats.opacity_logits)
    assert math.log(1e-4) / math.log(1 - alpha.mean().item()) > 1000
    drawn = rasterize(splats.to(dtype=torch.float32), odd_camera)
    assert drawn.alpha[25, 37] > 0.99


def test_weight_zero_is_as_if_the_splat_were_not_there(backend, make_splats, odd_camera):
    splats = make_splats(60).to(dtype=torch.float32)
    weights = (torch.arange(60) % 3 > 0).float()
    splats.means[0] = float("nan")  # dropped before projection: not even looked at
    some = rasterize(splats, odd_camera, weights=weights, backend=backend)
    kept = rasterize(splats.select(weights > 0), odd_camera, backend=backend)
    torch.testing.assert_close(some.image, kept.image)
    torch.testing.assert_close(some.radii[weights > 0], kept.radii)
    assert backend not in ("cpu", "gpu") or torch.equal(some.image, kept.image)
    assert some.radii[weights == 0].max() == 0


def test_rows_that_are_not_looked_at_are_as_if_they_had_weight_zero(backend, make_splats, odd_camera):
    splats = make_splats(300).to(dtype=torch.float32)
    weights = torch.rand(300, generator=torch.Generator().manual_seed(1))
    rows = torch.arange(0, 300, 3, dtype=torch.int32)
    some = torch.zeros(300)
    some[rows.long()] = 1
    for given in (None, weights):
        zeroed = some if given is None else some * given
        ours = rasterize(splats, odd_camera, weights=given, rows=rows, backend=backend)
        theirs = rasterize(splats, odd_camera, weights=zeroed, backend=backend)
        assert torch.equal(ours.image, theirs.image) and torch.equal(ours.radii, theirs.radii)
        found = [
            contributions(splats, [odd_camera], weights=w, rows=r, backend=backend).largest
            for w, r in ((given, rows), (zeroed, None))
        ]
        assert torch.equal(*found) and found[0].any()


def everything(splats, camera, truth, backend="cpu"):
    leaves = splats.map(lambda tensor: tensor.float().clone().requires_grad_())
    drawn = rasterize(leaves, camera, backend=backend)
    loss = photometric_loss(drawn.image, truth, backend=backend)
    loss.backward()
    return [drawn.image.detach(), drawn.alpha.detach(), drawn.radii, drawn.grad2d, loss.detach()] + [
        leaf.grad for leaf in vars(leaves).values()
    ]


def test_rendered_pictures_are_what_training_sees(backend, make_splats, odd_camera, axis_camera):
    """In one piece and in strips of 16 rows, of every kind."""
    splats = make_splats(150).to(dtype=torch.float32)
    options = {"background": (0.9, 0.2, 0.4), "sh_degree": 1, "min_scale": 0.01, "backend": backend}
    cameras = [odd_camera, axis_camera]
    for camera, whole, parts, small, half in zip(
        cameras,
        render(splats, cameras, **options),
        render(splats, cameras, strip=1, **options),
        render(splats, cameras, dtype="uint8", **options),
        render(splats, cameras, dtype="float16", **options),
        strict=True,
    ):
        drawn = rasterize(splats, camera, **options)
        expected = torch.cat([drawn.image, drawn.alpha[..., None]], 2).numpy()
        np.testing.assert_array_equal(whole, expected)
        np.testing.assert_allclose(parts, expected, atol=2e-5)
        assert small.dtype == np.uint8 and half.dtype == np.float16
        np.testing.assert_array_equal(small, np.round(expected.clip(0, 1) * 255))
        np.testing.assert_allclose(half, expected, atol=2e-3)
    with pytest.raises(ValueError, match="dtype must be"):
        next(render(splats, cameras, dtype="int8"))


def test_the_same_bits_whatever_the_number_of_threads(make_splats, odd_camera):
    splats, truth = make_splats(2000), Target(torch.rand(50, 75, 3))
    before, results = thread_count(), []
    try:
        for count in (1, 2, 16, 1):
            set_thread_count(count)
            results.append(everything(splats, odd_camera, truth))
    finally:
        set_thread_count(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.fixture
def sixteen_threads():
    before = thread_count()
    set_thread_count(16)
    yield
    set_thread_count(before)


@pytest.mark.parametrize("name", ["degree 3", "antialiased some", "crowd"])
def test_the_same_bits_wherever_the_system_puts_arrays(name, make_splats, odd_camera):
    """A loop that adds up and writes may be compiled twice: for arrays that overlap, and for others."""
    random = np.random.default_rng(0)
    first = None
    for _ in range(25):
        taken = [np.empty(size, np.uint8) for size in random.integers(1, 200_000, 40)]
        _idle.clear()  # or the kernels' own arrays would lie where they lay
        del taken[::2]
        found = drawn_and_differentiated(name, make_splats, odd_camera, "cpu", torch.float32)
        first = first or found
        assert all(torch.equal(found[key], first[key]) for key in first)


def test_sixteen_threads_take_every_range_once_and_none_more_than_another(sixteen_threads):
    """All sixteen are held until each has a range, so five ranges apiece is the only way through."""
    together, taken = threading.Barrier(16, timeout=20), []

    def work(begin, end, width):
        assert end - begin == width
        taken.append((begin, threading.get_ident()))
        together.wait()

    run_parallel(work, 16 * 5 * 7, 7, 7)
    assert sorted(begin for begin, _ in taken) == list(range(0, 16 * 5 * 7, 7))
    by_thread = Counter(thread for _, thread in taken)
    assert len(by_thread) == 16 and set(by_thread.values()) == {5}


def test_the_last_range_ends_where_the_work_does(sixteen_threads):
    taken = []
    run_parallel(lambda begin, end: taken.append((begin, end)), 10, 4)
    assert sorted(taken) == [(0, 4), (4, 8), (8, 10)]
    with pytest.raises(ZeroDivisionError):  # what goes wrong in a thread goes wrong for the caller
        run_parallel(lambda begin, end: 1 // (begin - 8), 10, 4)


def test_ranges_are_fine_enough_for_sixteen_threads(make_splats, sixteen_threads, monkeypatch):
    """Work counted in pairs for tiles, in rows for the rest: whoever is free takes the next range."""
    width, height = 640, 480
    camera = Camera("even", width, height, 500.0, 500.0, 320.0, 240.0, np.eye(4))
    splats = make_splats(40_000).to(dtype=torch.float32)
    splats.means[:, :2] *= splats.means[:, 2:] * 0.7
    splats.log_scales.sub_(2)
    leaves = splats.map(torch.Tensor.requires_grad_)
    dealt = []

    def spy(kernel, total, grain, *args):
        dealt.append((kernel.__name__, total, grain))
        run_parallel(kernel, total, grain, *args)

    monkeypatch.setattr(cpu, "run_parallel", spy)
    drawn = rasterize(leaves, camera)
    drawn.image.sum().backward()
    tiles = drawn.tile_counts.flatten().numpy()
    assert {name for name, *_ in dealt} >= {"project_forward", "blend_forward", "blend_backward"}
    for name, total, grain in dealt:
        work = tiles if total == len(tiles) else np.ones(total)
        loads = np.zeros(16)
        for begin in range(0, total, grain):
            loads[loads.argmin()] += work[begin : begin + grain].sum()
        assert loads.max() <= 1.35 * loads.mean(), name


def test_the_same_bits_from_run_to_run(kernels, make_splats, odd_camera):
    splats, truth = make_splats(2000), Target(torch.rand(50, 75, 3))
    first, *others = (everything(splats, odd_camera, truth, kernels) for _ in range(3))
    for other in others:
        assert all(torch.equal(a, b) for a, b in zip(first, other, strict=True))


def test_two_renderings_may_wait_for_their_backward(kernels, make_splats, odd_camera, axis_camera):
    splats = make_splats(100)
    alone = []
    for camera in (odd_camera, axis_camera):
        leaves = splats.map(lambda tensor: tensor.float().clone().requires_grad_())
        rasterize(leaves, camera, backend=kernels).image.square().sum().backward()
        alone.append([leaf.grad for leaf in vars(leaves).values()])
    leaves = splats.map(lambda tensor: tensor.float().clone().requires_grad_())
    cameras = odd_camera, axis_camera
    images = [rasterize(leaves, camera, backend=kernels).image.square().sum() for camera in cameras]
    sum(images).backward()
    for leaf, first, second in zip(vars(leaves).values(), *alone, strict=True):
        torch.testing.assert_close(leaf.grad, first + second)


def test_buffers_go_to_the_next_only_when_their_owner_is_gone():
    one, other = Buffers(), Buffers()
    first, second = (owner.take("of a test", np.float32, 100, 16) for owner in (one, other))
    first[:], second[:] = 1, 2
    assert (first == 1).all() and not np.shares_memory(first, second)
    assert first.ctypes.data % 64 == 0
    address = first.ctypes.data
    del one, first
    assert Buffers().take("of a test", np.int32, 3).ctypes.data == address
    assert Buffers().take("of a test", np.uint8, 1 << 20).size == 1 << 20, "one too small is not given"


def test_every_splat_is_in_every_tile_it_touches_once_and_front_to_back():
    """Against a plain count over all pixels in float64."""
    random = np.random.default_rng(3)
    count, width, height = 400, 100, 60
    projected = np.zeros((count, COLUMNS), np.float32)
    mean = random.uniform((-20, -20), (120, 80), (count, 2))
    axis, angle = np.exp(random.uniform(0, 3.5, (count, 2))), random.uniform(0, np.pi, count)
    cos, sin = np.cos(angle), np.sin(angle)
    xx = (axis[:, 0] * cos) ** 2 + (axis[:, 1] * sin) ** 2
    yy = (axis[:, 0] * sin) ** 2 + (axis[:, 1] * cos) ** 2
    xy = (axis[:, 0] ** 2 - axis[:, 1] ** 2) * cos * sin
    opacity = random.uniform(0.01, 1, count)
    unit = math.log2(math.e) / (xx * yy - xy**2)
    reach = np.sqrt(2 * np.log(255 * opacity))
    projected[:, :2] = mean
    projected[:, CONIC_XX], projected[:, CONIC_XY], projected[:, CONIC_YY] = (
        unit * yy / 2,
        -unit * xy,
        unit * xx / 2,
    )
    projected[:, LOG2_OPACITY] = np.log2(opacity)
    projected[:, 9], projected[:, 10] = reach * np.sqrt(xx), reach * np.sqrt(yy)
    depth = random.uniform(1, 9, count).astype(np.float32)
    radii = np.ones(count, np.float32)
    radii[::9] = 0
    drawn = np.flatnonzero(radii).astype(np.int32)
    pairs = bin_splats(projected, drawn, depth[drawn], width, height, Buffers())

    row = projected.astype(np.float64)[:, :, None, None]
    dx = np.arange(112) + 0.5 - row[:, 0]
    dy = (np.arange(64) + 0.5)[:, None] - row[:, 1]
    log2_alpha = (
        row[:, LOG2_OPACITY]
        - row[:, CONIC_XX] * dx**2
        - row[:, CONIC_XY] * dx * dy
        - row[:, CONIC_YY] * dy**2
    )
    seen = (log2_alpha >= math.log2(1 / 255)) & (radii > 0)[:, None, None]
    expected = seen.reshape(count, 4, TILE, 7, TILE).any((2, 4)).reshape(count, 28)
    listed = np.zeros((count, 28), int)
    for tile in range(28):
        splats = pairs.splat[pairs.tile_start[tile] : pairs.tile_start[tile + 1]]
        np.add.at(listed[:, tile], splats, 1)
        assert (np.diff(depth[splats]) >= 0).all()
    assert listed.max() == 1
    assert (listed[expected] == 1).all()
    # the test is exact on the rectangle, so what is listed besides lies between the pixel centres
    assert listed.sum() <= 1.15 * expected.sum()
    assert (listed.sum(1) == pairs.count).all()
    for i in np.flatnonzero(pairs.count):
        assert (pairs.splat[pairs.row[pairs.first[i] : pairs.first[i] + pairs.count[i]]] == i).all()


def ellipses(count, random, largest):
    """Projected splats as ``project_forward`` makes them, and their covariances and reaches in float64."""
    angle, axes = random.uniform(0, np.pi, count), np.exp(random.uniform(-0.5, math.log(largest), (2, count)))
    cos, sin = np.cos(angle), np.sin(angle)
    xx, yy = (axes[0] * cos) ** 2 + (axes[1] * sin) ** 2, (axes[0] * sin) ** 2 + (axes[1] * cos) ** 2
    xy = (axes[0] ** 2 - axes[1] ** 2) * cos * sin
    reach = random.uniform(0.3, 3.3, count)
    projected = np.zeros((count, COLUMNS), np.float32)
    projected[:, HALF_WIDTH], projected[:, HALF_HEIGHT] = reach * np.sqrt(xx), reach * np.sqrt(yy)
    projected[:, SLOPE], projected[:, RISE] = xy / xx, reach * axes[0] * axes[1] / np.sqrt(xx)
    projected[:, X_OF_TOP] = xy / yy * projected[:, HALF_HEIGHT]
    return projected, np.array([[xx, xy], [xy, yy]]).transpose(2, 0, 1), reach


@numba.njit
def rows_over(projected):
    return [strip_rows(row, np.float32(0.5), np.float32(15), np.float32(0.5), 16) for row in projected]


def test_the_rows_of_a_tile_hold_every_pixel_of_the_ellipse_and_hardly_more():
    """Against all 256 pixel centres in float64."""
    random = np.random.default_rng(4)
    projected, covariance, reach = ellipses(3000, random, 30.0)
    projected[:, :2] = random.uniform(-15, 31, (3000, 2))
    rows = np.array(rows_over(projected))
    centres = np.stack(np.meshgrid(np.arange(16) + 0.5, np.arange(16) + 0.5), -1)
    offset = centres - projected[:, None, None, :2].astype(np.float64)
    squared = np.einsum("nyxi,nij,nyxj->nyx", offset, np.linalg.inv(covariance), offset)
    inside = (squared <= (reach**2)[:, None, None]).any(2)
    assert 0.2 < inside.any(1).mean() < 0.9
    listed = (np.arange(16) >= rows[:, :1]) & (np.arange(16) < rows[:, 1:])
    assert listed[inside].all()
    # besides, a row whose centres the ellipse passes between
    assert listed.sum() < 1.1 * inside.sum()


def test_rows_stay_in_the_tile_whatever_rounding_does():
    """Kernels write where these rows say: a mean and a reach of 1e9 pixels differ by rows of rounding."""
    random = np.random.default_rng(0)
    projected, _, _ = ellipses(3000, random, 1e9)
    half = projected[:, [HALF_WIDTH, HALF_HEIGHT]]
    projected[:, :2] = random.choice([-1, 1], (3000, 2)) * half * random.choice([0, 0.5, 1], (3000, 2))
    rows = np.array(rows_over(projected))
    assert rows[:, 0].min() == 0 and rows[:, 0].max() == 16 and rows[:, 1].max() == 16
    assert (rows[:, 0] <= rows[:, 1]).all()


def test_exp2_is_right_to_a_few_parts_in_a_million():
    @numba.njit
    def over(xs):
        return np.array([exp2(x) for x in xs])

    xs = np.linspace(-29.9, 20, 5000).astype(np.float32)
    np.testing.assert_allclose(over(xs), np.exp2(xs.astype(np.float64)), rtol=4e-6)


def test_what_does_not_belong_together_is_refused(make_splats, odd_camera):
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


def test_float32_on_the_cpu_is_asked_for(kernels, make_splats, odd_camera):
    splats = make_splats(5)
    with pytest.raises(ValueError, match=f"the {kernels} backend takes float32 on the CPU, not"):
        rasterize(splats, odd_camera, backend=kernels)
    with pytest.raises(ValueError, match="on meta"):
        rasterize(splats.to("meta", torch.float32), odd_camera, backend=kernels)


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are not forked elsewhere")
def test_the_first_time_two_processes_compile_every_kernel_once(tmp_path):
    program = """
import os, sys
from training import rasterize
step = rasterize._step
def noting_who(backend):
    open(os.path.join(sys.argv[1], f"{os.getpid()}.pid"), "w").close()
    step(backend)
rasterize._step = noting_who
rasterize.warm_up("cpu")
from training.rasterize.cpu import adam, bin, blend, loss, project
modules = adam, bin, blend, loss, project
kernels = {k for m in modules for k in vars(m).values() if hasattr(k, "stats") and k.stats.cache_path}
compiled = sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels)
read = sum(sum(kernel.stats.cache_hits.values()) for kernel in kernels)
print(compiled, read)
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "LODGS_THREADS": "2"}
    said = subprocess.run(
        [sys.executable, "-c", program, tmp_path], env=environment, stdout=subprocess.PIPE, check=True
    )
    assert len(list(tmp_path.glob("*.pid"))) == 1  # torch may not take gradients in a process that was forked
    compiled, read = map(int, said.stdout.split())
    assert compiled > 0 and read > 0
    assert compiled + read == len(list(tmp_path.rglob("*.nbi")))
