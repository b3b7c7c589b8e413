"""Compositing of splats (LODGS) and meshes (another engine) by depth."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import bpy

from ...training.errors import LodgsError
from .. import compat
from ..data import roots, selection
from ..data.cameras import scene_camera
from . import engine

_COPIED = (
    "resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y",
    "use_border", "use_crop_to_border", "border_min_x", "border_max_x", "border_min_y", "border_max_y",
    "fps", "fps_base", "use_multiview", "views_format", "use_motion_blur", "motion_blur_shutter",
    "motion_blur_position",
)  # fmt: skip


Z_COMBINE = "CompositorNodeZcombine"
ALPHA_OVER = "CompositorNodeAlphaOver"

SAMPLES = 128
"""Initial number of Cycles samples for the meshes. Blender's default of 4096 is slow."""


def combine_with_meshes(scene: bpy.types.Scene, mesh_engine: str = "CYCLES") -> bpy.types.Scene:
    """Set a scene up to render splats with LODGS and meshes with another engine, combined by depth.

    A second scene renders the meshes: it has the same objects without the splats. With a mesh holdout
    (:func:`render_mesh_depth`), the splat image is simply placed over the mesh image.

    A repeated call copies the current size, camera, frame range and holdout to the second scene.

    Args:
        scene: scene with splats.
        mesh_engine: render engine for the meshes.

    Returns:
        The scene that renders the meshes.

    Raises:
        LodgsError: the scene has no splats, or it has compositor nodes of the user.
    """
    if not roots.roots(scene):
        raise LodgsError(
            f"Cannot combine with meshes: the scene '{scene.name}' has no splats.",
            "Import or train splats first.",
        )
    meshes = scene.lodgs_render.meshes
    tree = compat.compositor_tree(scene)
    previous = _changed_settings(scene)
    join = ALPHA_OVER if scene.lodgs_render.holdout else Z_COMBINE
    if meshes is None:
        if not _is_ours(tree):
            raise LodgsError(
                f"Cannot combine with meshes: the scene '{scene.name}' has compositor nodes.",
                "Add a Z Combine node for both images and depths (manual: Rendering).",
            )
        meshes = scene.lodgs_render.meshes = bpy.data.scenes.new(f"{scene.name} Meshes")
        meshes.render.engine = mesh_engine
        meshes.cycles.samples = SAMPLES
        scene.lodgs_render.before_meshes = json.dumps(previous)
        _build_nodes(tree, join, scene, meshes)
    elif _is_ours(tree) and join not in _node_types(tree):
        _build_nodes(tree, join, scene, meshes)
    engine.use(scene)
    for rendered in (scene, meshes):
        rendered.render.film_transparent = True
        for layer in rendered.view_layers:
            layer.use_pass_z = True
    _copy_settings(scene, meshes)
    return meshes


def separate_meshes(scene: bpy.types.Scene) -> None:
    """Undo :func:`combine_with_meshes`: remove the second scene and the nodes, and restore the settings.

    Raises:
        LodgsError: the scene is not combined, or its compositor has nodes of the user.
    """
    meshes = scene.lodgs_render.meshes
    tree = compat.compositor_tree(scene)
    if meshes is None:
        raise LodgsError(f"Cannot separate: the scene '{scene.name}' is not combined with meshes.")
    if not _is_ours(tree):
        raise LodgsError(
            f"Cannot separate: the scene '{scene.name}' has additional compositor nodes.",
            f"Remove the nodes that combine the images, then delete the scene '{meshes.name}'.",
        )
    previous = selection.read_json(scene.lodgs_render.before_meshes)
    scene.render.film_transparent = bool(previous.get("film_transparent"))
    for layer in scene.view_layers:
        layer.use_pass_z = layer.name in previous.get("use_pass_z", ())
    compat.reset_compositor(scene)
    scene.lodgs_render.before_meshes = ""
    bpy.data.scenes.remove(meshes)


def _changed_settings(scene: bpy.types.Scene) -> dict:
    """Return the current values of the settings that combining changes."""
    return {
        "film_transparent": scene.render.film_transparent,
        "use_pass_z": [layer.name for layer in scene.view_layers if layer.use_pass_z],
    }


def _node_types(tree: bpy.types.NodeTree) -> set[str]:
    return {node.bl_idname for node in tree.nodes}


def _is_ours(tree: bpy.types.NodeTree) -> bool:
    """Return whether a compositor tree has only default nodes and nodes of :func:`combine_with_meshes`."""
    ours = {*compat.COMPOSITOR_START, Z_COMBINE, ALPHA_OVER, "CompositorNodePremulKey"}
    return _node_types(tree) <= ours


def render_mesh_depth(scene: bpy.types.Scene, frames: Iterable[int]) -> Iterator[Path]:
    """Render the depth of a scene's meshes with Cycles, so that meshes occlude splats.

    Each frame is a multilayer EXR file with one ray through each pixel centre, where splats are evaluated
    too. After the last frame, the files become the holdout of the scene.

    Args:
        scene: scene with meshes and a camera.
        frames: frame numbers.

    Yields:
        The written file of each frame (:func:`depth_file_pattern`).

    Raises:
        LodgsError: the scene has no camera or several views, or a file cannot be written.
    """
    scene_camera(scene)
    if scene.render.use_multiview:
        raise LodgsError(
            "Cannot render mesh depth for a stereo or multi-view render.",
            "Use Combine with Meshes, or disable Stereoscopy.",
        )
    pattern = depth_file_pattern(scene)
    meshes = bpy.data.scenes.new(f"{scene.name} Depth")
    try:
        _copy_settings(scene, meshes)
        _set_depth_only(meshes)
        for frame in frames:
            path = engine.frame_path(str(pattern), scene, frame)
            # as an animation, because a still of an inactive scene shows another frame
            meshes.frame_start = meshes.frame_end = frame
            meshes.render.filepath = str(path.parent / pattern.name)
            bpy.ops.render.render(scene=meshes.name, animation=True)
            yield path
    except RuntimeError as error:
        raise LodgsError(
            f"Cannot render the depth of the meshes: {error}", "Save the .blend file in another folder."
        ) from error
    finally:
        bpy.data.scenes.remove(meshes)
    scene.lodgs_render.holdout = bpy.path.relpath(str(pattern)) if bpy.data.filepath else str(pattern)
    if scene.lodgs_render.meshes is not None:
        combine_with_meshes(scene)


def depth_file_pattern(scene: bpy.types.Scene) -> Path:
    """Return the path of the depth files with #### for the frame number.

    The folder is next to the .blend file, or a private temporary folder if the file is not saved.
    """
    name = f"{bpy.path.clean_name(scene.name)}_####.exr"
    if bpy.data.filepath:
        return Path(bpy.path.abspath("//")) / f"{Path(bpy.data.filepath).stem}_depth" / name
    return Path(bpy.app.tempdir or _temporary_folder()) / "depth" / name


@cache
def _temporary_folder() -> str:
    """Create a temporary folder for this process, in case Blender has none."""
    return tempfile.mkdtemp(prefix="lodgs-")


def _set_depth_only(scene: bpy.types.Scene) -> None:
    """Set a scene up to render depth with one ray per pixel to multilayer EXR files."""
    render, settings = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.use_compositing = render.use_sequencer = render.use_motion_blur = False
    compat.set_multilayer_exr(render.image_settings)
    for layer in scene.view_layers:
        layer.use_pass_z, layer.use_pass_combined = True, False
    settings.samples, settings.max_bounces = 1, 0
    settings.use_denoising = settings.use_adaptive_sampling = False
    settings.pixel_filter_type, settings.filter_width = "BOX", 0.01


def _copy_settings(scene: bpy.types.Scene, meshes: bpy.types.Scene) -> None:
    """Copy objects, camera and render settings of a scene to its mesh scene, without the splats."""
    for name in _COPIED:
        setattr(meshes.render, name, getattr(scene.render, name))
    _copy_views(scene.render, meshes.render)
    meshes.camera, meshes.world = scene.camera, scene.world
    meshes.frame_start, meshes.frame_end = scene.frame_start, scene.frame_end
    meshes.view_settings.view_transform = scene.view_settings.view_transform
    for kind in ("children", "objects"):
        target = getattr(meshes.collection, kind)
        source = getattr(scene.collection, kind)
        for item in set(target) - set(source):
            target.unlink(item)
        for item in set(source) - set(target):
            target.link(item)
    meshes.timeline_markers.clear()
    for marker in scene.timeline_markers:
        if marker.camera is not None:
            meshes.timeline_markers.new(marker.name, frame=marker.frame).camera = marker.camera
    _exclude_splats(scene, meshes)


def _copy_views(source: bpy.types.RenderSettings, target: bpy.types.RenderSettings) -> None:
    """Copy the views of stereo and multi-view renders."""
    for view in source.views:
        copy = target.views.get(view.name) or target.views.new(view.name)
        copy.use, copy.camera_suffix = view.use, view.camera_suffix
    for view in [view for view in target.views if view.name not in source.views]:
        target.views.remove(view)


def _exclude_splats(scene: bpy.types.Scene, meshes: bpy.types.Scene) -> None:
    """Exclude the same collections as in the scene, and those of splat scenes."""
    splat_collections = {
        collection
        for root in roots.roots(scene)
        for obj in (root, *(item.object for item in root.lodgs.levels if item.exists))
        for collection in obj.users_collection
    }
    visible = {item.collection: item for item in _included(scene.view_layers[0].layer_collection)}
    for layer in meshes.view_layers:
        layer.update()  # creates the layer collections of a new scene
        while unwanted := [
            item
            for item in _included(layer.layer_collection)
            if item.collection in splat_collections or item.collection not in visible
        ]:
            unwanted[0].exclude = True  # invalidates all layer collections
        for item in _included(layer.layer_collection):
            original = visible[item.collection]
            item.holdout, item.indirect_only = original.holdout, original.indirect_only


def _included(collection: bpy.types.LayerCollection) -> Iterator[bpy.types.LayerCollection]:
    """Yield the layer collections below another one that are not excluded."""
    for child in collection.children:
        if not child.exclude:
            yield child
            yield from _included(child)


def _build_nodes(
    tree: bpy.types.NodeTree, kind: str, scene: bpy.types.Scene, meshes: bpy.types.Scene
) -> None:
    """Build compositor nodes that combine two scenes.

    With Z_COMBINE, the nearer pixel is placed over the other one. With ALPHA_OVER, ``scene`` is placed over
    ``meshes``.
    """
    tree.nodes.clear()
    join = tree.nodes.new(kind)
    by_depth = kind == Z_COMBINE
    join.location = (400, 0)
    if by_depth:
        join.inputs["Use Alpha"].default_value = join.inputs["Anti-Alias"].default_value = True
    image_inputs = [socket for socket in join.inputs if socket.type == "RGBA"]
    for index, rendered in enumerate((scene, meshes)):
        rendered.view_layers[0].use_pass_z = True  # before the node, whose sockets are the passes
        layers = tree.nodes.new("CompositorNodeRLayers")
        layers.location = (0, -420 * index)
        layers.scene, layers.layer = rendered, rendered.view_layers[0].name
        layers.label = rendered.name
        if by_depth:  # Z Combine multiplies by alpha, but images are premultiplied
            straight = compat.to_straight(tree)
            straight.location = (180, -420 * index)
            tree.links.new(layers.outputs["Image"], straight.inputs["Image"])
            tree.links.new(straight.outputs["Image"], image_inputs[index])
            tree.links.new(layers.outputs["Depth"], join.inputs[2 * index + 1])
        else:
            tree.links.new(layers.outputs["Image"], image_inputs[1 - index])
    tree.links.new(join.outputs[0], compat.compositor_output(tree))
