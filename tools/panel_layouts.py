"""Digests of the layouts of all panels: a test compares them with those at the time of the pictures."""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools.blender_module import EXTENSION, start_blender  # noqa: E402

DIGESTS = ROOT / "docs" / "images" / "panels.json"
"""Digest of each panel's layout at the time of ``make pictures``, by class name."""


class LayoutRecorder:
    """A layout that records all calls, and is its own row, column and box."""

    def __init__(self) -> None:
        self.calls: list[list] = []

    def __getattr__(self, name: str):
        if name.startswith("__"):
            raise AttributeError(name)

        def call(*arguments, **options):
            values = [*arguments, *(options[key] for key in sorted(options))]
            self.calls.append([name, *(value for value in values if isinstance(value, str | int | bool))])
            if name == "operator":
                return SimpleNamespace()
            return (self, self) if name == "panel" else self

        return call


def panel_digests(bpy) -> dict[str, str]:
    """Return a digest of each panel's layout with the example scene: without and with levels.

    The texts, properties and buttons of panels count. Numbers and paths in texts do not.
    """
    os.environ["LODGS_TRAINER_PYTHON"] = sys.executable
    package = f"{EXTENSION}.blender_lodgs"
    names = sorted(path.stem for path in (ROOT / "blender_lodgs" / "panels").glob("[a-z]*.py"))
    modules = [importlib.import_module(f"{package}.panels.{name}") for name in names]
    for module in modules:
        if hasattr(module, "say"):
            vars(module)["say"] = lambda layout, text, icon: layout.label(text=text)
        if hasattr(module, "sidebar_width"):
            vars(module)["sidebar_width"] = lambda: 292
    layouts: dict[str, list] = {}
    for prepare in (lambda bpy: None, _import_scene, _add_levels):
        prepare(bpy)
        bpy.context.view_layer.update()
        for module in modules:
            for panel in getattr(module, "CLASSES", ()):
                if not issubclass(panel, bpy.types.Panel) or not getattr(panel, "poll", lambda _: True)(
                    bpy.context
                ):
                    continue
                recorder = LayoutRecorder()
                panel.draw(SimpleNamespace(layout=recorder), bpy.context)
                texts = json.dumps([panel.bl_label, recorder.calls], ensure_ascii=False)
                digitless = "".join(letter for letter in texts.replace(str(ROOT), "") if not letter.isdigit())
                layouts.setdefault(panel.__name__, []).append(digitless)
    return {
        name: hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]
        for name, texts in sorted(layouts.items())
    }


def _import_scene(bpy) -> None:
    bpy.ops.lodgs.import_colmap(directory=str(ROOT / "examples" / "lantern_garden"))


def _add_levels(bpy) -> None:
    package = EXTENSION
    np = importlib.import_module("numpy")
    gaussians = importlib.import_module(f"{package}.training.splats.gaussians")
    levels = importlib.import_module(f"{package}.training.splats.levels")
    scenes = importlib.import_module(f"{package}.blender_lodgs.data.scenes")
    roots = importlib.import_module(f"{package}.blender_lodgs.data.roots")
    splats = gaussians.Splats(
        np.zeros((4, 3), np.float32), np.tile(np.float32([1, 0, 0, 0]), (4, 1)), np.zeros((4, 3), np.float32),
        np.zeros(4, np.float32), np.zeros((4, 4, 3), np.float32), {},
    )  # fmt: skip
    root = roots.active_root(bpy.context)
    root.lodgs.rule = "bands"
    for number in (1, 2):
        scenes.set_level(root, levels.Level(number, splats, {"s_min": 4.0 - number}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", nargs="?", type=Path, default=DIGESTS, help="file to write")
    out = parser.parse_args().out
    text = json.dumps(panel_digests(start_blender()), indent=1) + "\n"
    out.write_text(text, encoding="utf-8")
    os._exit(0)  # Blender as a module can hang when Python ends
