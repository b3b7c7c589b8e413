"""LODGS' picture of the splats and Cycles' of the meshes as one, joined by depth in the compositor."""

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
    "fps", "fps_base",
)  # fmt: skip


NEARER, OVER = _JOINS = "CompositorNodeZcombine", "CompositorNodeAlphaOver"

SAMPLES = 128
"""Of Cycles for the meshes, to begin with: Blender's 4096 are for who has the time."""


def combine_with_meshes(scene: bpy.types.Scene, mesh_engine: str = "CYCLES") -> bpy.types.Scene:
    """Lets a scene render with LODGS, and over it or behind it, by depth, its meshes with another engine.

    Where the meshes hold out, depth is dealt with and the splats are simply over them.

    The meshes are rendered by a second scene that has the same objects without the splats. Called again, it
    takes over the size, camera, range and holdout that the scene has now.

    Returns:
        The meshes' scene.

    Raises:
        LodgsError: the scene has a compositor tree of the artist's own, or no splats.
    """
    if not roots.roots(scene):
        raise LodgsError(f"The scene '{scene.name}' has no splats.", "Import or train some first.")
    meshes = scene.lodgs_render.meshes
    tree, before = compat.compositor_tree(scene), _switched(scene)
    join = OVER if scene.lodgs_render.holdout else NEARER
    if meshes is None:
        if not _is_ours(tree):
            raise LodgsError(
                "This scene has compositor nodes already.",
                "Add a Z Combine node with the depth of both pictures; docs/rendering.md shows which.",
            )
        meshes = scene.lodgs_render.meshes = bpy.data.scenes.new(f"{scene.name} Meshes")
        meshes.render.engine = mesh_engine
        meshes.cycles.samples = SAMPLES
        scene.lodgs_render.before_meshes = json.dumps(before)
        _join(tree, join, scene, meshes)
    elif _is_ours(tree) and join not in _kinds(tree):
        _join(tree, join, scene, meshes)
    engine.use(scene)
    for one in (scene, meshes):
        one.render.film_transparent = True
        for layer in one.view_layers:
            layer.use_pass_z = True
    _match(scene, meshes)
    return meshes


def separate_meshes(scene: bpy.types.Scene) -> None:
    """Takes back :func:`combine_with_meshes`: the meshes' scene, the nodes, and what it has switched on.

    Raises:
        LodgsError: the scene is not combined, or its compositor has further nodes by now.
    """
    meshes, tree = scene.lodgs_render.meshes, compat.compositor_tree(scene)
    if meshes is None:
        raise LodgsError(f"The scene '{scene.name}' is not combined with meshes.")
    if not _is_ours(tree):
        raise LodgsError(
            "This scene has compositor nodes of your own beside those that join the pictures.",
            f"Take the join out there, then delete the scene '{meshes.name}'.",
        )
    before = selection.read_json(scene.lodgs_render.before_meshes)
    scene.render.film_transparent = bool(before.get("film_transparent"))
    for layer in scene.view_layers:
        layer.use_pass_z = layer.name in before.get("use_pass_z", ())
    compat.reset_compositor(scene)
    scene.lodgs_render.before_meshes = ""
    bpy.data.scenes.remove(meshes)


def _switched(scene: bpy.types.Scene) -> dict:
    """What combining switches on, as it is now."""
    return {
        "film_transparent": scene.render.film_transparent,
        "use_pass_z": [layer.name for layer in scene.view_layers if layer.use_pass_z],
    }


def _kinds(tree: bpy.types.NodeTree) -> set[str]:
    return {node.bl_idname for node in tree.nodes}


def _is_ours(tree: bpy.types.NodeTree) -> bool:
    """Whether nobody but combining has worked on a compositor tree."""
    return _kinds(tree) <= {*compat.COMPOSITOR_START, *_JOINS, "CompositorNodePremulKey"}


def render_mesh_depth(scene: bpy.types.Scene, frames: Iterable[int]) -> Iterator[Path]:
    """Renders the depth of a scene's meshes with Cycles, a multilayer EXR a frame, and has them hold out.

    The ray goes through each pixel's centre, where splats are looked at as well.

    Yields:
        Each frame's file (:func:`depth_files`), when it is written. Meshes hold out after the last one.

    Raises:
        LodgsError: the scene has no camera, or the files cannot be written.
    """
    scene_camera(scene)
    pattern = depth_files(scene)
    meshes = bpy.data.scenes.new(f"{scene.name} Depth")
    try:
        _match(scene, meshes)
        _only_depth(meshes)
        for frame in frames:
            path = engine.at_frame(str(pattern), scene, frame)
            # as an animation: a still of a scene in no window shows the frame of another
            meshes.frame_start = meshes.frame_end = frame
            meshes.render.filepath = str(path.parent / pattern.name)
            bpy.ops.render.render(scene=meshes.name, animation=True)
            yield path
    except RuntimeError as error:
        raise LodgsError(
            f"The depth of the meshes could not be rendered: {error}", "Choose another folder for the .blend."
        ) from error
    finally:
        bpy.data.scenes.remove(meshes)
    scene.lodgs_render.holdout = bpy.path.relpath(str(pattern)) if bpy.data.filepath else str(pattern)
    if scene.lodgs_render.meshes is not None:
        combine_with_meshes(scene)


def depth_files(scene: bpy.types.Scene) -> Path:
    """The files of :func:`render_mesh_depth`, #### for the frame.

    They lie in a folder beside the .blend, or before that is saved in a temporary one that nobody else knows.
    """
    name = f"{bpy.path.clean_name(scene.name)}_####.exr"
    if bpy.data.filepath:
        return Path(bpy.path.abspath("//")) / f"{Path(bpy.data.filepath).stem}_depth" / name
    return Path(bpy.app.tempdir or _own_folder()) / "depth" / name


@cache
def _own_folder() -> str:
    """A temporary folder of this process alone, for where Blender has none."""
    return tempfile.mkdtemp(prefix="lodgs-")


def _only_depth(scene: bpy.types.Scene) -> None:
    """Has a scene render one ray a pixel, and into multilayer EXRs."""
    render, settings = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.use_compositing = render.use_sequencer = render.use_motion_blur = False
    compat.multilayer_exr(render.image_settings)
    for layer in scene.view_layers:
        layer.use_pass_z, layer.use_pass_combined = True, False
    settings.samples, settings.max_bounces = 1, 0
    settings.use_denoising = settings.use_adaptive_sampling = False
    settings.pixel_filter_type, settings.filter_width = "BOX", 0.01


def _match(scene: bpy.types.Scene, meshes: bpy.types.Scene) -> None:
    """What the meshes' scene has of the scene: everything but the splats."""
    for name in _COPIED:
        setattr(meshes.render, name, getattr(scene.render, name))
    meshes.camera, meshes.world = scene.camera, scene.world
    meshes.frame_start, meshes.frame_end = scene.frame_start, scene.frame_end
    meshes.view_settings.view_transform = scene.view_settings.view_transform
    for kind in ("children", "objects"):
        there, here = getattr(meshes.collection, kind), getattr(scene.collection, kind)
        for part in set(there) - set(here):
            there.unlink(part)
        for part in set(here) - set(there):
            there.link(part)
    meshes.timeline_markers.clear()
    for marker in scene.timeline_markers:
        if marker.camera is not None:
            meshes.timeline_markers.new(marker.name, frame=marker.frame).camera = marker.camera
    left_out = {
        collection
        for root in roots.roots(scene)
        for obj in (root, *(item.object for item in root.lodgs.levels if item.exists))
        for collection in obj.users_collection
    }
    shown = {part.collection: part for part in _parts(scene.view_layers[0].layer_collection)}
    for layer in meshes.view_layers:
        layer.update()  # a new scene's has no parts yet
        while parts := [
            part
            for part in _parts(layer.layer_collection)
            if part.collection in left_out or part.collection not in shown
        ]:
            parts[0].exclude = True  # which makes all the parts anew
        for part in _parts(layer.layer_collection):
            like = shown[part.collection]
            part.holdout, part.indirect_only = like.holdout, like.indirect_only


def _parts(part: bpy.types.LayerCollection):
    """The parts of a view layer below one that are not excluded."""
    for child in part.children:
        if not child.exclude:
            yield child
            yield from _parts(child)


def _join(tree: bpy.types.NodeTree, kind: str, scene: bpy.types.Scene, meshes: bpy.types.Scene) -> None:
    """The tree: in each pixel the nearer of both scenes' layers, over the other where it is transparent; or
    the first scene's over the other's."""
    tree.nodes.clear()
    join, by_depth = tree.nodes.new(kind), kind == NEARER
    join.location = (400, 0)
    if by_depth:
        join.inputs["Use Alpha"].default_value = join.inputs["Anti-Alias"].default_value = True
    pictures = [socket for socket in join.inputs if socket.type == "RGBA"]
    for place, one in enumerate((scene, meshes)):
        one.view_layers[0].use_pass_z = True  # before the node, whose sockets are the layer's passes
        layers = tree.nodes.new("CompositorNodeRLayers")
        layers.location = (0, -420 * place)
        layers.scene, layers.layer = one, one.view_layers[0].name
        layers.label = one.name
        if by_depth:  # Z Combine multiplies by alpha, which pictures are already
            straight = compat.to_straight(tree)
            straight.location = (180, -420 * place)
            tree.links.new(layers.outputs["Image"], straight.inputs["Image"])
            tree.links.new(straight.outputs["Image"], pictures[place])
            tree.links.new(layers.outputs["Depth"], join.inputs[2 * place + 1])
        else:
            tree.links.new(layers.outputs["Image"], pictures[1 - place])
    tree.links.new(join.outputs[0], compat.compositor_output(tree))
