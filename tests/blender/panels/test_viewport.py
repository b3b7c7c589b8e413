"""A drawing that fails: the panel says so, Blender goes on, and the next one tries anew."""

import pytest


@pytest.fixture
def viewport(bpy, lodgs, monkeypatch):
    """The module, with what it does around drawing: no graphics are needed."""
    module = lodgs("viewport")
    monkeypatch.setattr(module.splats, "reset_state", lambda: None)
    yield module
    module.problem = ""


def fails(context):
    raise RuntimeError("no more memory on the card")


def test_a_failure_is_told_and_ends_that_drawing_only(bpy, viewport, draw_panel, monkeypatch, capsys):
    other = bpy.data.scenes.new("other")
    monkeypatch.setattr(viewport, "_draw_view", fails)
    for _ in range(3):
        viewport._draw()
    said = [text for text in draw_panel("viewport", "LODGS_PT_viewport").texts if "memory" in text]
    assert said == [
        "The viewport could not be drawn (RuntimeError: no more memory on the card). "
        "Untick Gaussian Splats for points."
    ]
    assert capsys.readouterr().err.count("Traceback") == 1
    assert bpy.context.scene.lodgs_viewport.splats and other.lodgs_viewport.splats
    monkeypatch.setattr(viewport, "_draw_view", lambda context: None)
    viewport._draw()
    assert not any("memory" in text for text in draw_panel("viewport", "LODGS_PT_viewport").texts)


def test_another_file_begins_without_it(bpy, viewport, monkeypatch):
    monkeypatch.setattr(viewport, "_draw_view", fails)
    viewport._draw()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert viewport.problem == ""


def test_a_broken_off_drawing_leaves_the_state_as_it_was(bpy, lodgs, frame):
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
