"""The wipe over a photograph and its rendered picture."""

import numpy as np
import pytest


def test_the_wipe_draws_both_pictures(bpy, lodgs):
    """Left of the wipe the photograph, right of it the rendering, rows the right way up, linear."""
    import gpu

    from training.scenes.color import linear_from_srgb

    if not hasattr(gpu, "init"):
        pytest.skip("no graphics in background before Blender 5.2")
    try:
        gpu.init()
    except Exception as error:
        pytest.skip(f"no graphics here: {error}")
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
    seen = np.array(buffer, np.float32).reshape(64, 96, 4)[::-1]
    assert (seen[:16] == 0).all() and (seen[:, :24] == 0).all() and (seen[:, 72:] == 0).all()
    inside = seen[16:48, 24:72, :3]
    np.testing.assert_allclose(inside[:, :15], linear_from_srgb(photo[:, :15]), atol=3e-3)
    np.testing.assert_allclose(inside[:, 17:], linear_from_srgb(rendered[:, 17:]), atol=3e-3)
