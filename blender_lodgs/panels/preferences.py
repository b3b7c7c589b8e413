"""The extension's preferences: trainer Python, training device and render farm."""

from __future__ import annotations

import bpy

from .. import extension
from ..runs import environment
from .parts import draw_environment, say

_items: list[tuple[str, str, str, int]] = []
"""Last items of :func:`_backends`: Blender requires a reference to their texts."""


def _backends(_self: object, _context: object) -> list[tuple[str, str, str, int]]:
    """Return the trainer's backends as enum items, without the slow reference backend."""
    card = environment.report.graphics if environment.report else ""
    _items[:] = [
        ("auto", "Automatic", "Use the device with the fastest training step, measured once per computer", 0),
        ("cpu", "CPU", "Train on the processor, which works on every computer", 1),
        ("cuda", "NVIDIA GPU (CUDA)", "Train on an NVIDIA card with CUDA kernels", 2),
        (
            "gpu",
            f"GPU ({card})" if card else "GPU",
            "Train with Vulkan, Metal or Direct3D 12 on any GPU; falls back to the CPU if the GPU fails a "
            "test on first use",
            3,
        ),
    ]
    return _items


class LodgsPreferences(bpy.types.AddonPreferences):
    """The preferences declared by ``extension.PreferenceValues``."""

    bl_idname = extension.ID

    python: bpy.props.StringProperty(
        name="Trainer Python",
        description="Python executable with PyTorch; empty for the trainer installed below",
        subtype="FILE_PATH",
    )
    backend: bpy.props.EnumProperty(
        name="Training Device",
        description="Device that renders the splats during training; a resumed run may use another one",
        items=_backends,
    )
    flamenco: bpy.props.StringProperty(
        name="Flamenco Manager",
        description="Address of the Flamenco Manager that trains cells, such as http://farm:8080; empty "
        "without a render farm",
    )

    notices: bpy.props.BoolProperty(
        name="System Notices",
        description="Show a notice of the operating system when a training ends; never in background mode",
        default=False,
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "python")
        layout.prop(self, "backend")
        layout.prop(self, "flamenco")
        layout.prop(self, "notices")
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
                    say(layout, "No usable GPU found. Choose Automatic or CPU.", "ERROR")


CLASSES = (LodgsPreferences,)
