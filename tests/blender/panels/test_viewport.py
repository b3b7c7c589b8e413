"""Errors while drawing the viewport: the panel shows them, and the next redraw tries again."""

import pytest


@pytest.fixture
def viewport(bpy, lodgs, monkeypatch):
    """The viewport module without GPU state, so that the tests need no graphics."""
    module = lodgs("viewport")
    monkeypatch.setattr(module.splats, "reset_state", lambda: None)
    yield module
    module.problem = ""


def fails(context):
    raise RuntimeError("no more memory on the card")


def test_an_error_is_shown_until_the_next_redraw_succeeds(bpy, viewport, draw_panel, monkeypatch, capsys):
    second_scene = bpy.data.scenes.new("other")
    monkeypatch.setattr(viewport, "_draw_view", fails)
    for _ in range(3):
        viewport._draw()
    messages = [text for text in draw_panel("viewport", "LODGS_PT_viewport").texts if "memory" in text]
    assert messages == [
        "Cannot draw splats: RuntimeError: no more memory on the card. "
        "Disable Gaussian Splats to draw points."
    ]
    assert capsys.readouterr().err.count("Traceback") == 1
    assert bpy.context.scene.lodgs_viewport.splats and second_scene.lodgs_viewport.splats
    monkeypatch.setattr(viewport, "_draw_view", lambda context: None)
    viewport._draw()
    assert not any("memory" in text for text in draw_panel("viewport", "LODGS_PT_viewport").texts)


def test_a_new_file_has_no_error(bpy, viewport, monkeypatch):
    monkeypatch.setattr(viewport, "_draw_view", fails)
    viewport._draw()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert viewport.problem == ""


def test_an_aborted_draw_restores_the_gpu_state(bpy, lodgs, frame):
    import gpu

    def break_off():
        gpu.state.depth_test_set("ALWAYS")
        gpu.state.depth_mask_set(True)
        gpu.state.blend_set("ALPHA_PREMULT")
        gpu.state.color_mask_set(False, False, False, False)
        lodgs("viewport.splats").reset_state()
        assert (gpu.state.depth_test_get(), gpu.state.depth_mask_get()) == ("NONE", False)
        assert gpu.state.blend_get() == "NONE"
        gpu.state.active_framebuffer_get().clear(color=(0.25, 0.5, 1, 1))

    assert frame(8, break_off)[0, 0].tolist() == [0.25, 0.5, 1, 1]
