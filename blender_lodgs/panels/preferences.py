"""The extension's preferences: which Python trains, on what, and which farm."""

from __future__ import annotations

import bpy

from .. import extension
from ..runs import environment
from .parts import draw_environment, say

_BACKENDS = [
    ("auto", "Automatic", "The NVIDIA graphics card where training works on it, else the processor"),
    ("cpu", "CPU", "The processor: works on every computer"),
    ("cuda", "NVIDIA GPU (CUDA)", "The graphics card: needs gsplat in the trainer's Python"),
]
"""The trainer's backends but for the reference, which is slow."""


class LodgsPreferences(bpy.types.AddonPreferences):
    """What ``extension.Settings`` declares."""

    bl_idname = extension.ID

    python: bpy.props.StringProperty(
        name="Trainer's Python",
        description="Python outside Blender that has PyTorch; empty: the environment made below",
        subtype="FILE_PATH",
    )
    backend: bpy.props.EnumProperty(
        name="Train On",
        description="What draws the splats while training; a run may go on with another one",
        items=_BACKENDS,
    )
    flamenco: bpy.props.StringProperty(
        name="Flamenco Manager",
        description="Address of the manager of a render farm that is to train cells, such as "
        "http://farm:8080; empty: no farm",
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "python")
        layout.prop(self, "backend")
        layout.prop(self, "flamenco")
        draw_environment(layout)
        layout.operator("lodgs.check_environment", icon="CHECKMARK")
        report = environment.report
        if report is not None:
            torch = report.versions.get("torch", "")
            say(layout, f"Ready to train: PyTorch {torch}" if report.ok else report.python, "INFO")
            for problem in report.problems:
                say(layout, problem, "ERROR")


CLASSES = (LodgsPreferences,)
