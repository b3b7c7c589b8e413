"""Reset the look of a splat scene or of one of its crops, or tint it by the light of the Blender scene."""

from __future__ import annotations

import bpy
from mathutils import Vector

from ...training.editing.look import GAMMA
from ...training.errors import LodgsError
from ..data import cleaning, crops, lighting, looks, roots
from .base import EditLevelsOperator, SceneOperator, report_errors


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


class LODGS_OT_tint_by_light(EditLevelsOperator, bpy.types.Operator):
    """Set the tint to the colour of the light from the lamps and the world, so that splats match meshes"""

    bl_idname = "lodgs.tint_by_light"
    bl_label = "Tint by Light"
    bl_options = {"REGISTER", "UNDO"}

    name: bpy.props.StringProperty(
        name="Crop", description="Crop whose look is tinted; empty for the look of the whole scene"
    )

    @report_errors
    def execute(self, context):
        root = roots.active_root(context)
        obj = _target(root, self.name, "tint look")
        depsgraph = context.evaluated_depsgraph_get()
        low, high = cleaning.bounds(root)
        position = Vector((low + high) / 2) if obj == root else obj.matrix_world.translation
        light = lighting.mean_light(context.scene, depsgraph, position)
        if not light.max() > 0:
            raise LodgsError("Cannot tint look: the scene has no light.", "Add a lamp or a world background.")
        obj.lodgs_look.tint = (light / light.max()) ** (1 / GAMMA)
        return {"FINISHED"}


def reset_look(root: bpy.types.Object, name: str = "") -> None:
    """Reset the look of a scene, or of one of its crops by name, to the neutral look.

    Raises:
        LodgsError: the scene has no such crop.
    """
    looks.reset(root, _target(root, name, "reset look"))


def _target(root: bpy.types.Object, name: str, action: str) -> bpy.types.Object:
    """Return a crop of a scene by name, or the root for an empty name."""
    targets = {obj.name: obj for obj in crops.crops_of(root)} | {"": root}
    if name not in targets:
        raise LodgsError(
            f"Cannot {action}: '{root.name}' has no crop '{name}'.", "Choose a crop of the Look panel."
        )
    return targets[name]


CLASSES = (LODGS_OT_reset_look, LODGS_OT_tint_by_light)
