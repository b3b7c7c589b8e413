"""Wipe between a photo and its rendered image."""

import numpy as np
import pytest


def test_wipe_draws_both_images(bpy, lodgs):
    """The photo is on the left, the rendered image on the right, upright and linear."""
    import gpu

    from training.color import linear_from_srgb

    if not hasattr(gpu, "init"):
        pytest.skip("no graphics in background before Blender 5.2")
    try:
        gpu.init()
    except Exception as error:
        pytest.skip(f"no graphics: {error}")
    rng = np.random.default_rng(0)
    photo, rendered = (rng.uniform(size=(32, 48, 3)).astype(np.float32) for _ in range(2))
    comparison = lodgs("viewport.wipe").Comparison(0, photo, rendered, 10.0)
    screen = gpu.types.GPUOffScreen(96, 64, format="RGBA32F")
    with screen.bind():
        frame = gpu.state.active_framebuffer_get()
        frame.clear(color=(0, 0, 0, 0))
        lodgs("viewport.wipe").draw(comparison, 1 / 3, [(-0.5, -0.5), (0.5, 0.5)], 0.001)
        buffer = frame.read_color(0, 0, 96, 64, 4, 0, "FLOAT")
    buffer.dimensions = 96 * 64 * 4
    image = np.array(buffer, np.float32).reshape(64, 96, 4)[::-1]
    assert (image[:16] == 0).all() and (image[:, :24] == 0).all() and (image[:, 72:] == 0).all()
    inside = image[16:48, 24:72, :3]
    np.testing.assert_allclose(inside[:, :15], linear_from_srgb(photo[:, :15]), atol=3e-3)
    np.testing.assert_allclose(inside[:, 17:], linear_from_srgb(rendered[:, 17:]), atol=3e-3)
