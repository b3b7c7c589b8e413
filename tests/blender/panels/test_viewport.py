"""Errors while drawing the viewport: the panel shows them, and the next redraw tries again."""

from types import SimpleNamespace

import numpy as np
import pytest


@pytest.fixture
def viewport(bpy, lodgs, monkeypatch):
    """The viewport module without GPU state, so that the tests need no graphics."""
    module = lodgs("viewport")
    monkeypatch.setattr(module.splats, "reset_state", lambda: None)
    yield module
    module.problem = ""


def fail(context):
    raise RuntimeError("no more memory on the card")


def test_error_is_shown_until_the_next_redraw_succeeds(bpy, viewport, draw_panel, monkeypatch, capsys):
    second_scene = bpy.data.scenes.new("other")
    monkeypatch.setattr(viewport, "_draw_view", fail)
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


def test_new_file_has_no_error(bpy, viewport, monkeypatch):
    monkeypatch.setattr(viewport, "_draw_view", fail)
    viewport._draw()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert viewport.problem == ""


def test_aborted_draw_restores_the_gpu_state(bpy, lodgs, frame):
    import gpu

    def abort_draw():
        gpu.state.depth_test_set("ALWAYS")
        gpu.state.depth_mask_set(True)
        gpu.state.blend_set("ALPHA_PREMULT")
        gpu.state.color_mask_set(False, False, False, False)
        lodgs("viewport.splats").reset_state()
        assert (gpu.state.depth_test_get(), gpu.state.depth_mask_get()) == ("NONE", False)
        assert gpu.state.blend_get() == "NONE"
        gpu.state.active_framebuffer_get().clear(color=(0.25, 0.5, 1, 1))

    assert frame(8, abort_draw)[0, 0].tolist() == [0.25, 0.5, 1, 1]


def test_panel_and_header_show_the_splats_within_the_budget(bpy, lodgs, viewport, draw_panel, monkeypatch):
    views = lodgs("viewport.views")
    assert not any("budget" in text for text in draw_panel("viewport", "LODGS_PT_viewport").texts)
    arrangement = SimpleNamespace(count=1_204_000, excluded=1_800_000)
    monkeypatch.setattr(views, "_views", {7: SimpleNamespace(arrangement=arrangement)})
    text = "1.2 M of 3.0 M splats (budget)"
    assert text in draw_panel("viewport", "LODGS_PT_viewport").texts
    region = SimpleNamespace(type="WINDOW", as_pointer=lambda: 7)
    layout = SimpleNamespace(label=lambda text: texts.append(text))
    for regions, expected in (([region], ["Budget: 1.2 M of 3.0 M"]), ([], [])):
        texts = []
        context = SimpleNamespace(scene=bpy.context.scene, area=SimpleNamespace(regions=regions))
        lodgs("panels.viewport")._header(SimpleNamespace(layout=layout), context)
        assert texts == expected


@pytest.mark.parametrize(
    ("count", "text"),
    [(999, "999"), (1000, "1.0 k"), (54_321, "54.3 k"), (999_600, "1.0 M"), (123_456_789, "123 M")],
)
def test_counts_are_short(lodgs, count, text):
    assert lodgs("panels.parts").short_count(count) == text


@pytest.mark.parametrize(("gigabytes", "budget"), [(2, 1_000_000), (16, 2_000_000), (500, 8_000_000)])
def test_default_budget_follows_the_memory(lodgs, monkeypatch, gigabytes, budget):
    properties = lodgs("data.properties")
    monkeypatch.setattr(properties, "free_memory", lambda: gigabytes << 30)
    assert properties.default_budget() == budget


@pytest.mark.parametrize(("seconds", "budget"), [(0.15, None), (0.8, "200,000"), (50.0, "10,000")])
def test_panel_suggests_a_budget_for_the_measured_speed(bpy, lodgs, viewport, draw_panel, seconds, budget):
    """1 M splats in 0.8 s are 250,000 in 0.2 s, rounded to one digit."""
    state = lodgs("viewport.view_state")
    view = state.ViewState(cost=(1_000_000, seconds))
    state.active_views.clear()
    state.active_views.add(view)
    texts = [text for text in draw_panel("viewport", "LODGS_PT_viewport").texts if "quick redraws" in text]
    expected = (
        f"A redraw at rest takes {seconds:.1f} s for 1.0 M splats. For quick redraws, set Splat Budget to "
    )
    assert texts == ([expected + f"{budget}."] if budget else [])


def test_panel_states_the_splats_of_a_moving_view(lodgs, viewport, draw_panel):
    state = lodgs("viewport.view_state")
    request = SimpleNamespace(motion=(120_000, (0.0, 0.0, 0.0)))
    arrangement = SimpleNamespace(count=1_000_000, motion=np.zeros((119_876, 4)), excluded=0, request=request)
    view = state.ViewState(arrangement=arrangement)
    state.active_views.clear()
    state.active_views.add(view)
    texts = draw_panel("viewport", "LODGS_PT_viewport").texts
    assert "A moving view draws 120 k of 1.0 M splats, the small ones enlarged." in texts
    stated = state.simplified_counts()
    arrangement.motion = np.zeros((120_123, 4))  # another view keeps others
    assert state.simplified_counts() == stated, "the panel is not drawn again for each view"
    arrangement.motion = None
    texts = draw_panel("viewport", "LODGS_PT_viewport").texts
    assert not any("moving view" in text for text in texts)


@pytest.fixture
def wrap(lodgs, monkeypatch):
    """``wrap(270, text)``: draw a text in a region with this width and return its lines."""
    parts = lodgs("panels.parts")

    def draw(width, text, icon="INFO"):
        lines = []
        preferences = SimpleNamespace(system=SimpleNamespace(ui_scale=1.5))
        context = SimpleNamespace(region=SimpleNamespace(width=1.5 * width), preferences=preferences)
        monkeypatch.setattr(parts, "bpy", SimpleNamespace(context=context))
        column = SimpleNamespace(label=lambda text, icon: lines.append((text, icon)))
        parts.say(SimpleNamespace(column=lambda align: column), text, icon)
        return [text for text, _ in lines], [icon for _, icon in lines]

    return draw


def test_wrapped_texts_keep_units_with_their_numbers(wrap):
    lines, _ = wrap(270, "Half the views are 44.7 m or 89.4 m from the centre of the splats.")
    assert lines == ["Half the views are 44.7 m or", "89.4 m from the centre of the", "splats."]


def test_wrapped_texts_keep_decibels_with_their_number(wrap):
    assert wrap(210, "Training views: 44.7 dB")[0] == ["Training views:", "44.7 dB"]


def test_texts_fit_a_narrow_sidebar(wrap):
    lines, icons = wrap(180, "For quick redraws, set Splat Budget to 20,000.")
    assert lines == ["For quick", "redraws, set", "Splat Budget to", "20,000."]
    assert icons == ["INFO", "BLANK1", "BLANK1", "BLANK1"]
    assert set(wrap(180, "57,644 of 108,804 splats shown", "NONE")[1]) == {"NONE"}
    assert len(wrap(230, "Level 1: 1,926 of 1,926 splats", "NONE")[0]) == 2
    assert len(wrap(234, "Level 1: 1,926 of 1,926 splats", "NONE")[0]) == 1, "There is no icon."
