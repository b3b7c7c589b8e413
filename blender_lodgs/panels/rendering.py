"""The Rendering panel of the sidebar, and the engine's panels in the Properties editor."""

from __future__ import annotations

import bpy

from ...training.errors import LodgsError
from ..data import roots
from ..render import engine
from ..runs import environment
from .parts import Panel, draw_environment, say, split_column


class LODGS_PT_rendering(Panel):
    bl_label = "Rendering"
    bl_order = 5
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        return roots.shows_levels(context.scene)

    def draw(self, context):
        layout, scene = self.layout, context.scene
        if scene.render.engine != engine.ID:
            layout.operator("lodgs.use_engine", icon="RENDER_STILL")
            layout.prop(scene.lodgs_render, "ellipsoids")
            if scene.lodgs_render.ellipsoids:
                text = "Slow, and without view-dependent colours. Use it up to some hundred thousand splats."
                say(layout, text, "INFO")
            return
        _draw_film(layout, scene)
        missing = _missing_trainer()
        column = layout.column(align=True)
        if missing:
            draw_environment(column, missing)
            say(column, "Viewport Quality renders without the trainer.", "INFO")
        else:
            _draw_passes(layout, scene, context.view_layer)
            _draw_lens(layout, scene)
            column = layout.column(align=True)
            _draw_render(column, "render.render", "Render Image", "RENDER_STILL")
        _draw_render(column, "lodgs.render_quick", "Viewport Quality", "RESTRICT_VIEW_OFF")
        _draw_holdout(layout, scene)
        _draw_meshes(layout, scene)
        layout.operator("lodgs.export_camera", icon="CAMERA_DATA", text="Export Camera…")


class _Properties(bpy.types.Panel):
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    COMPAT_ENGINES = {engine.ID}

    @classmethod
    def poll(cls, context):
        return context.engine in cls.COMPAT_ENGINES


class LODGS_RENDER_PT_film(_Properties):
    bl_label = "Film"
    bl_context = "render"

    def draw(self, context):
        _draw_film(self.layout, context.scene)
        missing = _missing_trainer()
        if missing:
            draw_environment(self.layout, missing)


class LODGS_RENDER_PT_lens(_Properties):
    bl_label = "Depth of Field and Motion Blur"
    bl_context = "render"

    def draw(self, context):
        _draw_lens(self.layout, context.scene)
        _draw_shutter(self.layout, context.scene)


class LODGS_VIEWLAYER_PT_passes(_Properties):
    bl_label = "Passes"
    bl_context = "view_layer"

    def draw(self, context):
        _draw_passes(self.layout, context.scene, context.view_layer)


def _draw_film(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    column = split_column(layout)
    column.prop(scene.render, "film_transparent", text="Transparent")
    row = column.row()
    row.enabled = not scene.render.film_transparent
    row.prop(scene.lodgs_render, "background")
    if scene.view_settings.view_transform != "Standard":
        name = scene.view_settings.view_transform
        say(layout, f"View transform {name} changes the colours of the photos. Standard keeps them.", "INFO")
        layout.operator("lodgs.use_engine", text="Use Standard", icon="COLOR")


def _missing_trainer() -> str:
    """Return the problem to show if the trainer is not installed, else an empty string."""
    try:
        environment.trainer_python()
    except LodgsError as error:
        return error.what
    return ""


def _draw_render(layout: bpy.types.UILayout, operator: str, text: str, icon: str) -> None:
    """Draw a button that renders one image, and a small one that renders every frame."""
    row = layout.row(align=True)
    row.operator_context = "INVOKE_DEFAULT"  # Blender stays responsive and shows the progress
    row.operator(operator, text=text, icon=icon).animation = False
    row.operator(operator, text="", icon="RENDER_ANIMATION").animation = True


def _draw_meshes(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Draw the button that combines splats with meshes, or the scene that renders the meshes."""
    meshes = scene.lodgs_render.meshes
    column = layout.column(align=True)
    if meshes is None:
        column.operator("lodgs.combine_with_meshes", icon="NODE_COMPOSITING")
        return
    column.label(text=f"Meshes: '{meshes.name}'", icon="NODE_COMPOSITING")
    if meshes.render.engine == "CYCLES":
        settings = split_column(column)
        settings.prop(meshes.cycles, "samples", text="Samples")
        settings.prop(scene.lodgs_render, "shadows")
        column.operator("lodgs.add_shadow_catcher", icon="MESH_PLANE")
    row = column.row(align=True)
    row.operator("lodgs.combine_with_meshes", text="Update", icon="FILE_REFRESH")
    row.operator("lodgs.separate_meshes", text="Remove", icon="X")


def _draw_passes(layout: bpy.types.UILayout, scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
    column = split_column(layout, heading="Passes")
    column.prop(layer, "use_pass_z", text="Depth")
    column.prop(scene.lodgs_render, "use_pass_levels")


def _draw_lens(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Draw the settings of blur, and the settings of camera and scene that LODGS cannot render."""
    camera = scene.camera if scene.camera and scene.camera.type == "CAMERA" else None
    column = split_column(layout, heading="Blur")
    if camera is not None:
        row = column.row()
        row.active = camera.data.type != "PANO"
        row.prop(camera.data.dof, "use_dof", text="Depth of Field")
        if camera.data.dof.use_dof:
            column.prop(camera.data.dof, "aperture_fstop")
            column.prop(camera.data.dof, "focus_object", text="Focus On")
            if camera.data.dof.focus_object is None:
                column.prop(camera.data.dof, "focus_distance", text="Distance")
    column.prop(scene.render, "use_motion_blur", text="Motion Blur")
    if engine.is_blurred(scene):
        column.prop(scene.lodgs_render, "samples")
    for text in engine.limitations(scene):
        say(layout, text, "ERROR")


def _draw_shutter(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    column = split_column(layout)
    column.active = scene.render.use_motion_blur
    column.prop(scene.render, "motion_blur_position", text="Position")
    column.prop(scene.render, "motion_blur_shutter")
    column.prop(scene.eevee, "motion_blur_steps", text="Steps")


def _draw_holdout(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    column = split_column(layout, align=True)
    column.prop(scene.lodgs_render, "holdout")
    row = column.row(align=True)
    row.operator("lodgs.render_mesh_depth", icon="RENDER_STILL").animation = False
    row.operator("lodgs.render_mesh_depth", icon="RENDER_ANIMATION", text="").animation = True


CLASSES = (
    LODGS_PT_rendering, LODGS_RENDER_PT_film, LODGS_RENDER_PT_lens, LODGS_VIEWLAYER_PT_passes,
)  # fmt: skip
