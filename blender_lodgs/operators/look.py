"""The look of a splat scene: back to how it was trained."""

from __future__ import annotations

import bpy

from ...training.errors import LodgsError
from ..data import crops, looks, scenes
from .base import SceneOperator, report_errors


class LODGS_OT_reset_look(SceneOperator, bpy.types.Operator):
    """Show the splats as they were trained"""

    bl_idname = "lodgs.reset_look"
    bl_label = "Reset Look"
    bl_options = {"REGISTER", "UNDO"}

    name: bpy.props.StringProperty(
        name="Crop", description="Name of the crop whose look is reset; empty: the look everywhere"
    )

    @report_errors
    def execute(self, context):
        reset_look(scenes.active_root(context), self.name)
        return {"FINISHED"}


def reset_look(root: bpy.types.Object, name: str = "") -> None:
    """Gives a scene, or one of its crops by name, the look that changes nothing.

    Raises:
        LodgsError: there is no such crop.
    """
    named = {obj.name: obj for obj in crops.crops_of(root)} | {"": root}
    if name not in named:
        raise LodgsError(f"'{root.name}' has no crop of the name '{name}'.", "Choose one of the panel's.")
    looks.reset(root, named[name])


CLASSES = (LODGS_OT_reset_look,)
