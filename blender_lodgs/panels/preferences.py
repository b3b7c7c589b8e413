"""The extension's preferences: which Python trains, on what, and which farm."""

from __future__ import annotations

import bpy

from .. import extension
from ..runs import environment
from .parts import draw_environment, say

_items: list[tuple[str, str, str, int]] = []
"""What :func:`_backends` gave last: Blender wants such texts kept."""


def _backends(_self: object, _context: object) -> list[tuple[str, str, str, int]]:
    """The trainer's backends but for the reference, which is slow."""
    card = environment.report.graphics if environment.report else ""
    _items[:] = [
        ("auto", "Automatic", "An NVIDIA card where training works on it with CUDA, else the processor", 0),
        ("cpu", "CPU", "The processor: works on every computer", 1),
        ("cuda", "NVIDIA GPU (CUDA)", "The graphics card: needs gsplat in the trainer's Python", 2),
        (
            "gpu",
            f"Graphics Card ({card})" if card else "Graphics Card",
            "Any graphics card, by Vulkan, Metal or Direct3D 12. It is tried before it is first used: where "
            "it draws otherwise than it should, the processor takes its place",
            3,
        ),
    ]
    return _items


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
        items=_backends,
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
            if report.devices:
                say(layout, report.devices, "INFO")
                if self.backend == "gpu" and not report.graphics:
                    say(layout, "There is no graphics card to train on: choose Automatic or CPU.", "ERROR")


CLASSES = (LodgsPreferences,)
