"""Reset the look of a splat scene or of one of its crops."""

from __future__ import annotations

import bpy

from ...training.errors import LodgsError
from ..data import crops, looks, roots
from .base import SceneOperator, report_errors


class LODGS_OT_reset_look(SceneOperator, bpy.types.Operator):
    """Reset the look, so that the splats appear as trained"""

    bl_idname = "lodgs.reset_look"
    bl_label = "Reset Look"
    bl_options = {"REGISTER", "UNDO"}

    name: bpy.props.StringProperty(
        name="Crop", description="Crop whose look is reset; empty for the look of the whole scene"
    )

    @report_errors
    def execute(self, context):
        reset_look(roots.active_root(context), self.name)
        return {"FINISHED"}


def reset_look(root: bpy.types.Object, name: str = "") -> None:
    """Reset the look of a scene, or of one of its crops by name, to the neutral look.

    Raises:
        LodgsError: the scene has no such crop.
    """
    targets = {obj.name: obj for obj in crops.crops_of(root)} | {"": root}
    if name not in targets:
        raise LodgsError(
            f"Cannot reset look: '{root.name}' has no crop '{name}'.", "Choose a crop of the Look panel."
        )
    looks.reset(root, targets[name])


CLASSES = (LODGS_OT_reset_look,)
