"""Spherical-harmonics basis: orthonormality, conventions, and derivatives compared with autograd."""

import numpy as np
import pytest
import torch

from training.splats.sh import basis, basis_gradient, coefficient_count, degree_from_count


def directions(count: int) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_basis_is_orthonormal_on_the_sphere():
    cos_theta, weights = np.polynomial.legendre.leggauss(12)
    phi = np.arange(24) * 2 * np.pi / 24
    sin_theta = np.sqrt(1 - cos_theta**2)
    x, y = sin_theta[:, None] * np.cos(phi), sin_theta[:, None] * np.sin(phi)
    values = [None] * 25
    basis(x, y, cos_theta[:, None] + 0 * phi, 4, values)
    stacked = np.stack(values)
    gram = np.einsum("iab,jab,a->ij", stacked, stacked, weights) * 2 * np.pi / 24
    np.testing.assert_allclose(gram, np.eye(25), atol=1e-12)


def test_signs_and_order_match_3dgs():
    """Degree 1 is (-y, z, -x), and m runs from -l to l: x² - y² comes last of degree 2."""
    values = [None] * 9
    basis(0.0, 0.0, 1.0, 2, values)
    np.testing.assert_allclose(values[:4], [0.28209479, 0, 0.48860251, 0], atol=1e-8)
    basis(1.0, 0.0, 0.0, 2, values)
    assert values[3] == pytest.approx(-0.48860251)
    assert values[8] == pytest.approx(0.54627422)


@pytest.mark.parametrize("degree", range(5))
def test_derivatives_match_autograd(degree):
    count = coefficient_count(degree)
    points = torch.tensor(directions(20), requires_grad=True)
    values = [None] * count
    basis(*points.unbind(1), degree, values)
    by = [[None] * count for _ in range(3)]
    basis_gradient(*(axis.detach() for axis in points.unbind(1)), degree, *by)
    for k in range(count):
        (expected,) = torch.autograd.grad(values[k].sum(), points, retain_graph=True)
        for axis in range(3):
            actual = torch.as_tensor(by[axis][k], dtype=torch.float64).expand(20)
            torch.testing.assert_close(actual, expected[:, axis], atol=1e-12, rtol=1e-12)


def test_invalid_coefficient_count_is_refused():
    assert [degree_from_count(n) for n in (1, 4, 9, 16, 25)] == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="12"):
        degree_from_count(12)
