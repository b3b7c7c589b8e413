"""The sRGB transfer function at values from the standard."""

import numpy as np

from training.color import linear_from_srgb, srgb_from_linear


def test_reference_values():
    """IEC 61966-2-1: the linear part and its end, middle grey, a half, white."""
    linear = np.array([0.0, 0.002, 0.0031308, 0.18, 0.5, 1.0])
    coded = np.array([0.0, 0.02584, 0.04045, 0.46136, 0.73536, 1.0])
    np.testing.assert_allclose(srgb_from_linear(linear), coded, atol=2e-5)
    np.testing.assert_allclose(linear_from_srgb(coded), linear, atol=2e-5)


def test_functions_are_inverse_above_white_too():
    values = np.linspace(0, 4, 1001)
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(values)), values, atol=1e-6)
    assert (np.diff(srgb_from_linear(values)) > 0).all()
    assert srgb_from_linear(values.astype(np.float32)).dtype == np.float32
