"""A layout that records the texts, properties and operators that panels draw."""

from types import SimpleNamespace

import pytest


class RecordingLayout:
    """A layout that records its texts and operators and is its own row, column and box."""

    def __init__(self):
        self.texts: list[str] = []
        self.operators: list[str] = []
        self.buttons: list[str] = []
        self.colors: list[tuple[float, ...]] = []
        self.properties: list[str] = []
        self.sliders: list[str] = []
        self.collapsed: list[str] = []

    def row(self, **_):
        return self

    column = box = grid_flow = split = row

    def panel(self, name, default_closed=False):
        if default_closed:
            self.collapsed.append(name)
        return self, self

    def label(self, text="", **_):
        assert len(text) <= 24, f"Narrow sidebars cut off {text!r}. Use say."
        self.texts.append(text)

    def progress(self, text, factor):
        assert 0 <= factor <= 1
        self.texts.append(text)

    def operator(self, name, text="", **_):
        self.operators.append(name)
        self.buttons.append(text)
        return SimpleNamespace()

    def menu(self, name, **_):
        self.texts.append(name)

    def separator(self, **_):
        pass

    def template_list(self, *_, **__):
        pass

    def template_node_socket(self, color):
        self.colors.append(tuple(color))

    def prop(self, owner, name, slider=False, index=-1, text="", **_):
        assert hasattr(owner, name)
        self.properties.append(name if index < 0 else f"{name}[{index}] {text}")
        if slider:
            self.sliders.append(name)

    def prop_enum(self, owner, name, value):
        assert value in owner.bl_rna.properties[name].enum_items
        self.properties.append(f"{name} {value}")


@pytest.fixture
def draw_panel(bpy, lodgs, monkeypatch):
    """``draw_panel("levels", "LODGS_PT_detail")``: draw a panel of a module and return its layout."""

    def draw(name, panel):
        module = lodgs(f"panels.{name}")
        layout = RecordingLayout()
        for patched in (module, lodgs("panels.parts")):
            monkeypatch.setattr(
                patched, "say", lambda layout, text, icon: layout.texts.append(text), raising=False
            )
            monkeypatch.setattr(patched, "sidebar_width", lambda: 292, raising=False)
        getattr(module, panel).draw(SimpleNamespace(layout=layout), bpy.context)
        return layout

    return draw
