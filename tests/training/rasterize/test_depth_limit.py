"""Compare renderings with a depth limit per pixel with analytic cases and the reference."""

import math

import numpy as np
import pytest
import torch

from tests.training.rasterize.comparison import isotropic, scene, squared_distance
from training.rasterize import rasterize, rasterize_strips


def test_splats_behind_limit_are_hidden(backend, axis_camera):
    """Splats at depths 2 and 4, with a limit of 3 on the left half and none on the right."""
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
    visible = alpha > 0
    expected = (weights[0] * 4 + near * 2)[visible] / alpha[visible]
    np.testing.assert_allclose(drawn.depth[visible], expected, rtol=1e-5)
    assert drawn.median_depth[16, 14:18].tolist() == [0, 0, 4, 4]  # T is above a half behind the first
    limit[:] = 1  # in front of all splats
    empty = rasterize(splats, axis_camera, limit=limit, **options)
    assert empty.alpha.max() == 0 and empty.median_depth.max() == 0
    assert torch.equal(empty.image, torch.tensor([0.0, 0.0, 0.5]).expand(32, 32, 3))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["degree 3", "antialiased", "caps",
     *(pytest.param(name, marks=pytest.mark.nightly) for name in ("needles", "screen-filling", "crowd"))],
)  # fmt: skip
def test_limits_match_reference(name, backend, make_splats, odd_camera):
    """With a different limit in every pixel, relative L2 errors are at most 5e-4."""
    splats, options = scene(name, make_splats)
    random = torch.Generator().manual_seed(2)
    limit = 2 + 2 * torch.rand(50, 75, generator=random).double()
    limit[::3] = 1e10
    features = torch.rand(len(splats), 4, generator=random).double()
    options |= {"background": (0.1, 0.5, 0.3), "outputs": ("depth", "median_depth", "normals")}
    exact = rasterize(splats, odd_camera, features=features, limit=limit, backend="reference", **options)
    free = rasterize(splats, odd_camera, backend="reference", **options)
    assert (free.alpha - exact.alpha).abs().mean() > 0.01
    actual = rasterize(
        splats.to(dtype=torch.float32), odd_camera, features=features.float(), limit=limit.float(),
        backend=backend, **options,
    )  # fmt: skip
    for output in ("image", "alpha", "depth", "normals", "features"):
        value, truth = getattr(actual, output).double(), getattr(exact, output)
        assert (value - truth).norm() <= 5e-4 * truth.norm(), output
    same = (actual.median_depth - exact.median_depth).abs() < 1e-4
    assert same.float().mean() > 0.999


def test_limits_of_strips_and_windows(backend, make_splats, odd_camera):
    """Strips and windows match the complete image; an infinite limit has no effect."""
    splats = make_splats(150).to(dtype=torch.float32)
    limit = 2 + 2 * torch.rand(50, 75, generator=torch.Generator().manual_seed(3))
    options = {"outputs": ("median_depth",), "backend": backend}
    complete = rasterize(splats, odd_camera, limit=limit, **options)
    for left, top, width, height in ((0, 0, 75, 50), (20, 7, 41, 36)):
        inside = slice(top, top + height), slice(left, left + width)
        window = {"window": (left, top, width, height), "limit": limit[inside]}
        parts = [drawn for _, drawn in rasterize_strips(splats, odd_camera, strip=1, **window, **options)]
        assert len(parts) > 2
        for output in ("image", "alpha", "median_depth"):
            combined = torch.cat([getattr(part, output) for part in parts])
            torch.testing.assert_close(combined, getattr(complete, output)[inside], atol=2e-5, rtol=1e-4)
    free = rasterize(splats, odd_camera, **options)
    boundless = rasterize(splats, odd_camera, limit=torch.full((50, 75), math.inf), **options)
    for output in ("image", "alpha", "median_depth"):
        limited, unlimited = getattr(boundless, output), getattr(free, output)
        if backend == "cuda":  # its limited images use the reference's alpha cap
            torch.testing.assert_close(limited, unlimited, atol=0.01, rtol=1e-4)
        else:
            assert torch.equal(limited, unlimited)


def test_limit_rejects_gradients_and_wrong_shapes(backend, make_splats, odd_camera):
    splats = make_splats(5).map(lambda t: t.float().requires_grad_())
    with pytest.raises(ValueError, match="not differentiable"):
        rasterize(splats, odd_camera, limit=torch.ones(50, 75), backend=backend)
    with pytest.raises(ValueError, match=r"limit must have shape \(50, 75\)"):
        next(rasterize_strips(splats, odd_camera, limit=torch.ones(75, 50), backend=backend))
