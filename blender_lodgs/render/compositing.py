"""Compositing of splats (LODGS) and meshes (another engine) by depth."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...training.errors import LodgsError
from ...training.scenes.ground import find_ground
from .. import compat
from ..data import cleaning, ground, metadata, roots
from ..data.placement import placement_of
from ..data.properties import RenderSettings
from ..data.property_callbacks import ON_CHANGE
from ..nodes import ellipsoids
from . import engine
from .compositor_nodes import ALPHA_OVER, MIN_DEPTH, TreeBuilder

_COPIED = (
    "resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y",
    "use_border", "use_crop_to_border", "border_min_x", "border_max_x", "border_min_y", "border_max_y",
    "fps", "fps_base", "use_multiview", "views_format", "use_motion_blur", "motion_blur_shutter",
    "motion_blur_position", "frame_map_old", "frame_map_new",
)  # fmt: skip
_NODES = {
    ALPHA_OVER, MIN_DEPTH, "CompositorNodeAntiAliasing", compat.COMPOSITOR_MATH, compat.COMPOSITOR_MIX,
    "CompositorNodeZcombine", "CompositorNodePremulKey",  # of older versions
}  # fmt: skip

CENTER_FILTER = "BLACKMAN_HARRIS", 0.01
"""Pixel filter of Cycles with all samples at the pixel centre; the width of its box filter is fixed."""
CATCHERS = "Shadow Catcher"
"""Name of Cycles' pass with the light on shadow catchers relative to that without other objects, and of the
collection, mesh and view layer of catchers."""
SAMPLES = 128
"""Initial number of Cycles samples for the meshes. Blender's default of 4096 is slow."""


def combine_with_meshes(scene: bpy.types.Scene, mesh_engine: str = "CYCLES") -> bpy.types.Scene:
    """Set a scene up to render splats with LODGS and meshes with another engine, combined by depth.

    A second scene renders the meshes: it has the same objects without the splats. With a mesh holdout
    (``mesh_depth``), the splat image is simply placed over the mesh image. With *Splat Shadows*,
    the second scene has the splats as ellipsoids that only shadows, reflections and bounced light show.

    A repeated call copies the current size, camera, frame range and holdout to the second scene.

    Args:
        scene: scene with splats.
        mesh_engine: render engine for the meshes.

    Returns:
        The scene that renders the meshes.

    Raises:
        LodgsError: the scene has no splats, or it has compositor nodes of the user; or Cycles is disabled.
    """
    require_cycles(scene)
    if not roots.shows_splats(scene):
        raise LodgsError(
            f"Cannot combine with meshes: the scene '{scene.name}' has no splats.",
            "Import or train splats first.",
        )
    meshes = scene.lodgs_render.meshes
    tree = compat.compositor_tree(scene)
    previous, is_new = _changed_settings(scene), meshes is None or _is_shared(meshes)
    if is_new:
        if not _is_ours(tree):
            raise LodgsError(
                f"Cannot combine with meshes: the scene '{scene.name}' has compositor nodes.",
                "Add nodes for both images and depths (manual: Rendering).",
            )
        if meshes is None:
            meshes = bpy.data.scenes.new("Meshes")
            meshes.render.engine, meshes.cycles.samples = mesh_engine, SAMPLES
        else:
            meshes = meshes.copy()
        meshes.name = f"{scene.name} Meshes"
        scene.lodgs_render.meshes = meshes
        if not scene.lodgs_render.before_meshes:  # set if the user deleted the second scene
            scene.lodgs_render.before_meshes = json.dumps(previous)
    engine.use(scene)
    meshes.lodgs_render.is_for_meshes = True
    for rendered in (scene, meshes):
        rendered.render.film_transparent = True
        for layer in rendered.view_layers:
            layer.use_pass_z = True
    built = MIN_DEPTH in _node_types(tree), _used_catcher_layer(tree)  # nodes forget a removed layer
    catchers = _catcher_layer(scene, meshes)
    copy_settings(scene, meshes, scene.lodgs_render.shadows)
    meshes.lodgs_render.ellipsoids = scene.lodgs_render.shadows
    needed = not scene.lodgs_render.holdout, catchers
    if is_new or (_is_ours(tree) and built != needed):
        _build_nodes(tree, *needed, scene, meshes)
    return meshes


def require_cycles(scene: bpy.types.Scene) -> None:
    """Raise LodgsError if Blender has no Cycles, which is an add-on that users can disable."""
    if not hasattr(scene, "cycles"):
        raise LodgsError(
            "Cannot render meshes: Cycles is disabled.",
            "Enable the add-on Cycles Render Engine in Blender's preferences.",
        )


def separate_meshes(scene: bpy.types.Scene) -> None:
    """Undo :func:`combine_with_meshes`: remove the second scene and the nodes, and restore the settings.

    Raises:
        LodgsError: the scene is not combined, or its compositor has nodes of the user.
    """
    meshes = scene.lodgs_render.meshes
    tree = compat.compositor_tree(scene)
    if meshes is None:
        raise LodgsError(
            f"Cannot separate: the scene '{scene.name}' is not combined with meshes.",
            "Choose the scene of the splats.",
        )
    if not _is_ours(tree):
        raise LodgsError(
            f"Cannot separate: the scene '{scene.name}' has additional compositor nodes.",
            f"Remove the nodes that combine the images, then delete the scene '{meshes.name}'.",
        )
    previous = metadata.read_json(scene.lodgs_render.before_meshes)
    scene.render.film_transparent = bool(previous.get("film_transparent"))
    for layer in scene.view_layers:
        layer.use_pass_z = layer.name in previous.get("use_pass_z", ())
    compat.reset_compositor(scene)
    scene.lodgs_render.before_meshes = ""
    if _is_shared(meshes):
        scene.lodgs_render.meshes = None
    else:
        bpy.data.scenes.remove(meshes)


def _is_shared(meshes: bpy.types.Scene) -> bool:
    """Return whether several scenes have this scene of meshes, after a user has copied one of them."""
    return sum(scene.lodgs_render.meshes == meshes for scene in bpy.data.scenes) > 1


def _changed_settings(scene: bpy.types.Scene) -> dict:
    """Return the current values of the settings that combining changes."""
    return {
        "film_transparent": scene.render.film_transparent,
        "use_pass_z": [layer.name for layer in scene.view_layers if layer.use_pass_z],
    }


def _node_types(tree: bpy.types.NodeTree) -> set[str]:
    return {node.bl_idname for node in tree.nodes}


def _catcher_layer(scene: bpy.types.Scene, meshes: bpy.types.Scene) -> str:
    """Return the name of the view layer that renders shadow catchers; "" if there are none.

    It is a layer of its own if another one has the splats, which would shadow the catchers.
    """
    has_catchers = any(obj.is_shadow_catcher for obj in scene.objects)
    layers, needs_own = meshes.view_layers, has_catchers and scene.lodgs_render.shadows
    if needs_own:
        layer = layers.get(CATCHERS) or layers.new(CATCHERS)
        layer.use_pass_z, layer[ellipsoids.HIDDEN] = True, 1.0  # instances of splats cannot be excluded
    elif CATCHERS in layers:
        layers.remove(layers[CATCHERS])
    return CATCHERS if needs_own else layers[0].name if has_catchers else ""


def _used_catcher_layer(tree: bpy.types.NodeTree) -> str:
    """Return the name of the view layer whose shadows on catchers a compositor tree uses; "" if none."""
    links = [link for link in tree.links if link.from_socket.name == CATCHERS]
    return links[0].from_node.layer if links else ""


def _is_ours(tree: bpy.types.NodeTree) -> bool:
    """Return whether a compositor tree has only default nodes and nodes of :func:`combine_with_meshes`."""
    return _node_types(tree) <= {*compat.COMPOSITOR_START, *_NODES}


def copy_settings(
    scene: bpy.types.Scene, meshes: bpy.types.Scene, shadows: bool = False, catchers: bool = True
) -> None:
    """Copy objects, camera and render settings of a scene to its mesh scene.

    Args:
        shadows: copy the splats for indirect rays only; otherwise leave them out.
        catchers: copy collections of shadow catchers.
    """
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
    _exclude_collections(scene, meshes, shadows, catchers)


def _copy_views(source: bpy.types.RenderSettings, target: bpy.types.RenderSettings) -> None:
    """Copy the views of stereo and multi-view renders."""
    for view in source.views:
        copy = target.views.get(view.name) or target.views.new(view.name)
        copy.use, copy.camera_suffix = view.use, view.camera_suffix
    for view in [view for view in target.views if view.name not in source.views]:
        target.views.remove(view)


def _exclude_collections(
    scene: bpy.types.Scene, meshes: bpy.types.Scene, shadows: bool, catchers: bool
) -> None:
    """Exclude the same collections as in the scene, and unwanted ones; see :func:`copy_settings`."""
    splat_collections = {
        collection
        for root in roots.roots(scene)
        for obj in (root, *(item.object for item in root.lodgs.existing_levels))
        for collection in obj.users_collection
        if not _has_meshes(collection)
    }
    scene.view_layers[0].update()  # creates the layer collections of new collections
    visible = {item.collection: item for item in _included(scene.view_layers[0].layer_collection)}

    has_own = CATCHERS in meshes.view_layers
    for layer in meshes.view_layers:
        unwanted = set() if shadows and layer.name != CATCHERS else splat_collections
        if not catchers or (has_own and layer.name != CATCHERS):
            unwanted = unwanted | {collection for collection in visible if _has_only_catchers(collection)}
        layer.update()  # creates the layer collections of a new scene
        wanted = visible.keys() - unwanted
        while wrong := next(_wrongly_excluded(layer.layer_collection, wanted), None):
            wrong.exclude = not wrong.exclude  # invalidates all layer collections
        for item in _included(layer.layer_collection):
            original = visible[item.collection]
            item.holdout = original.holdout
            item.indirect_only = original.indirect_only or item.collection in splat_collections


def _has_meshes(collection: bpy.types.Collection) -> bool:
    """Return whether a collection of a splat scene, or one below it, has rendered objects of the user."""
    return any(
        obj.instance_type == "COLLECTION" or obj.type not in ("EMPTY", "CAMERA", "POINTCLOUD")
        for obj in collection.all_objects
        if not obj.hide_render
    )


def _has_only_catchers(collection: bpy.types.Collection) -> bool:
    return bool(collection.objects) and all(obj.is_shadow_catcher for obj in collection.objects)


def _wrongly_excluded(
    collection: bpy.types.LayerCollection, wanted: Collection[bpy.types.Collection], excluded: bool = False
) -> Iterator[bpy.types.LayerCollection]:
    """Yield the layer collections below another one that are excluded or included by mistake.

    Args:
        wanted: collections to include.
        excluded: exclude all of them, as children of an excluded collection.
    """
    for child in collection.children:
        without = excluded or child.collection not in wanted
        if child.exclude != without:
            yield child
        yield from _wrongly_excluded(child, wanted, without)


def _included(collection: bpy.types.LayerCollection) -> Iterator[bpy.types.LayerCollection]:
    """Yield the layer collections below another one that are not excluded."""
    for child in collection.children:
        if not child.exclude:
            yield child
            yield from _included(child)


def _build_nodes(
    tree: bpy.types.NodeTree,
    by_depth: bool,
    catchers: str,
    scene: bpy.types.Scene,
    meshes: bpy.types.Scene,
) -> None:
    """Build compositor nodes that combine two scenes: by depth, or ``scene`` over ``meshes``.

    Shadow catchers, in the layer of this name, darken the splats at them and behind them.

    The mesh image gets the samples that fit: soft edges by depth, and otherwise one sample at each pixel
    centre, as in the holdout. Soft edges over a holdout would leave dark seams.
    """
    tree.nodes.clear()
    nodes = TreeBuilder(tree)
    scene.view_layers[0].use_pass_z = meshes.view_layers[0].use_pass_z = True  # before nodes with its socket
    for layer in meshes.view_layers:
        layer.cycles.use_pass_shadow_catcher = layer.name == catchers
        layer.update_render_passes()
    splats = nodes.render_layer(scene, scene.view_layers[0].name, 0)
    mesh = nodes.render_layer(meshes, meshes.view_layers[0].name, 1)
    splat_image, mesh_image = splats.outputs["Image"], mesh.outputs["Image"]
    if catchers:
        is_own = catchers != meshes.view_layers[0].name
        catcher = nodes.render_layer(meshes, catchers, 2) if is_own else mesh
        behind = nodes.is_near_catcher(catcher, splats)
        splat_image = nodes.mix(behind, splat_image, catcher.outputs[CATCHERS], "MULTIPLY")
    result = nodes.over(splat_image, mesh_image)
    if by_depth:
        near = nodes.nearer(mesh, splats)
        result = nodes.mix(near, result, nodes.over(mesh_image, splat_image))
    _sample_meshes(meshes, soft=by_depth)
    tree.links.new(result, compat.compositor_output(tree))


def _sample_meshes(meshes: bpy.types.Scene, soft: bool) -> None:
    """Set the pixel filter of the mesh image: Blender's default, or one sample at each pixel centre."""
    settings = meshes.cycles
    settings.pixel_filter_type, settings.filter_width = ("BLACKMAN_HARRIS", 1.5) if soft else CENTER_FILTER
    meshes.render.filter_size = 1.5 if soft else 0.0


def add_shadow_catcher(root: bpy.types.Object, scene: bpy.types.Scene) -> bpy.types.Object:
    """Add a plane on the ground of a splat scene that shows the shadows of meshes in the combined image.

    Raises:
        LodgsError: no ground is detected, the root is scaled differently along its axes, or as
            :func:`combine_with_meshes`.
    """
    combine_with_meshes(scene)
    points = placement_of(root).transform_points(ground.ground_points(root))
    normal, center = find_ground(points, np.array([0.0, 0.0, 1.0]))
    low, high = cleaning.bounds(root)
    center = (low + high) / 2 - ((low + high) / 2 - center) @ normal * normal
    half = (high - low).max() / 2
    mesh = bpy.data.meshes.new(CATCHERS)
    mesh.from_pydata([(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)], [], [range(4)])
    obj = bpy.data.objects.new(CATCHERS, mesh)
    obj.matrix_world = Matrix.LocRotScale(
        Vector(center),
        Vector((0, 0, 1)).rotation_difference(Vector(normal)), None,
    )  # fmt: skip
    obj.is_shadow_catcher, obj.display_type = True, "WIRE"
    collection = bpy.data.collections.get(CATCHERS) or bpy.data.collections.new(CATCHERS)
    if collection not in scene.collection.children_recursive:
        scene.collection.children.link(collection)
    collection.objects.link(obj)
    combine_with_meshes(scene)
    return obj


def _shadows_changed(settings: RenderSettings, context: bpy.types.Context) -> None:
    if settings.meshes is not None and roots.shows_splats(settings.id_data):
        combine_with_meshes(settings.id_data)


def register() -> None:
    ON_CHANGE["shadows"] = _shadows_changed
