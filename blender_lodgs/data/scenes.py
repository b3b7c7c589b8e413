"""Splat scenes in Blender: a root, a collection, and in it cameras, points and levels.

The scene root is an empty; ``root.lodgs`` holds what belongs to the scene (see ``properties.SplatScene``).
Everything else hangs on its axes in COLMAP coordinates (see ``placement``). These functions are what
operators call and what scripts may call.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ...training.errors import LodgsError
from ...training.lod import look, placing
from ...training.lod.paging import TreeFile, is_tree, read_within
from ...training.lod.rule import Control, Tables, find_rule
from ...training.lod.selection import complete, known_rule, not_alone, unknown_rule
from ...training.methods import METHODS
from ...training.scenes.cameras import Camera, extent_of
from ...training.scenes.colmap import Scene, read_scene
from ...training.scenes.formats import colmap_scene
from ...training.scenes.undistort import already_undistorted
from ...training.scenes.views import VIEWS, tables_of, views_in
from ...training.scenes.views import placed as placed_views
from ...training.splats.bundle import Bundle, Level, read_bundle, read_folder, read_head
from ...training.splats.formats import STREAMED, as_ply, is_ply
from ...training.splats.gaussians import Splats
from .. import compat, extension
from ..nodes import ellipsoids
from . import cleaning, crops, looks, objects, painting, selection, streams, tables
from .objects import root_of
from .photographs import camera_of, is_held_out, match_render, new_camera, photographed, views
from .placement import axes_of, new_axes, placement_of

ABOUT = "About these splats"
"""The name of the text that tells of LODGS where it is not installed."""
LINKED = (
    "This splat scene is linked from another file, where its settings are. To change them here, append it "
    "instead of linking it (File, Append), or make it local (Object, Relations, Make Local, All)."
)


def roots(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The splat scenes' roots in a Blender scene."""
    return [obj for obj in scene.objects if obj.lodgs.is_root]


def active_root(context: bpy.types.Context) -> bpy.types.Object | None:
    """The splat scene that is meant: the active object's, else the only one there is."""
    root = root_of(context.active_object)
    found = [root] if root is not None else roots(context.scene)
    return found[0] if len(found) == 1 else None


def shows_splats(scene: bpy.types.Scene) -> bool:
    """Whether a Blender scene has splat scenes, its own or in instances of collections."""
    return bool(roots(scene)) or any(map(_instanced, scene.objects))


def shows_levels(scene: bpy.types.Scene) -> bool:
    """Whether a Blender scene has levels of splats, its own or in instances of collections."""
    own = any(item.exists for root in roots(scene) for item in root.lodgs.levels)
    return own or any(map(_instanced, scene.objects))


def linked(context: bpy.types.Context) -> bool:
    """Whether the splat scene that is meant is another file's, or the selected instance shows such a one."""
    root, obj = active_root(context), context.active_object
    found = [root] if root is not None else [] if obj is None else _instanced(obj)
    return any(not one.is_editable for one in found)


def _instanced(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """The roots in the collection that an object is an instance of."""
    collection = obj.instance_collection if obj.instance_type == "COLLECTION" else None
    return [] if collection is None else [each for each in collection.all_objects if each.lodgs.is_root]


def root_with_levels(context: bpy.types.Context) -> bpy.types.Object | None:
    """:func:`active_root`, where it has levels."""
    root = active_root(context)
    return root if root is not None and any(item.exists for item in root.lodgs.levels) else None


def import_colmap(
    context: bpy.types.Context,
    folder: Path | str,
    *,
    model: Path | str | None = None,
    images: Path | str | None = None,
    upright: bool = True,
    photographs: bool = True,
    warn: Callable[[str], object] = print,
) -> bpy.types.Object:
    """A COLMAP scene as a new splat scene: cameras, their photographs and the coloured points.

    Where the Blender scene has no camera, the first view becomes its camera and gives the render its size.

    Args:
        folder: the scene's folder, or that of a model in it; or another program's export, which is then made
            a COLMAP scene (``formats.colmap_scene``).
        model: folder of the model; by default the largest one. Training takes the same one.
        images: folder of the photographs; by default found beside the model. Training takes the same one.
        upright: turn the root so that the cameras' mean up direction is +z; otherwise leave COLMAP's axes.
        photographs: show each camera's photograph behind its view.
        warn: receives one sentence for each thing that was left out or is odd.

    Returns:
        The scene root.

    Raises:
        LodgsError: the folder holds no scene that can be read. Nothing is left behind in that case.
    """
    manager = context.window_manager
    manager.progress_begin(0, 1)  # at the mouse pointer
    try:
        model, images = (Path(path) if path else None for path in (model, images))
        folder = Path(folder) if model else colmap_scene(Path(folder), warn)
        scene = read_scene(folder, model, images, manager.progress_update)
    finally:
        manager.progress_end()
    for message in scene.warnings:
        warn(message)
    straight = already_undistorted(scene)
    shown = {camera.name: camera for camera in straight.cameras} if straight else {}
    extent, near = _extent(scene), _near(scene)
    with new_scene(context, scene.folder.name) as root:
        axes = axes_of(root)
        if upright:
            axes.rotation_quaternion = Matrix(scene.up_rotation().tolist()).to_quaternion()
        root.empty_display_size = extent / 4
        root.lodgs.scene_folder = str(scene.folder)
        root.lodgs.camera_center = scene.center
        root.lodgs.training.median_depth = _median_depth(scene)
        root.lodgs.training.model = str(scene.model) if model else ""
        root.lodgs.training.images = str(scene.images_folder) if images else ""

        seen = [shown.get(camera.name, camera) for camera in scene.cameras]
        distorted = set(scene.distorted) - shown.keys()
        _add_views(context, root, seen, extent, near, photographs, distorted, scene.names)
        if len(scene.points):
            points = objects.new_points(
                f"{root.name} points", scene.points, scene.point_colors, radius=extent / 400
            )
            points.parent = axes
            _collection(root).objects.link(points)
            root.lodgs.points = points
    return root


def _add_views(
    context: bpy.types.Context,
    root: bpy.types.Object,
    cameras: Sequence[Camera],
    extent: float,
    near: float,
    photographs: bool = False,
    distorted: Collection[str] = (),
    names: Sequence[str] = (),
) -> None:
    """Gives a scene a camera object for each view; see :func:`new_camera`.

    Args:
        names: of all views of the model, in order; none: there are no others.
    """
    root.lodgs.cameras = bpy.data.collections.new(f"{root.name} cameras")
    _collection(root).children.link(root.lodgs.cameras)
    place_of = {name: place for place, name in enumerate(names or [camera.name for camera in cameras])}
    for camera in cameras:
        view = new_camera(camera, extent, near, photograph=photographs, distorted=camera.name in distorted)
        view.parent, view.data.lodgs.place = axes_of(root), place_of[camera.name]
        root.lodgs.cameras.objects.link(view)
    if context.scene.camera is None and cameras:
        context.scene.camera = root.lodgs.cameras.objects[0]
        match_render(context.scene, cameras[0], context.scene.render.resolution_percentage)


def import_splats(
    context: bpy.types.Context,
    path: Path | str,
    *,
    upright: bool = True,
    budget: int = 0,
    warn: Callable[[str], object] = print,
) -> bpy.types.Object:
    """A bundle, a folder of levels, or any 3DGS PLY as a single level, as a new splat scene.

    Args:
        budget: see :func:`read_splats_file`.
        upright: turn the scene as the bundle says, or without that so that -y, which is up in most splat
            files, is up; otherwise leave the axes.
        warn: receives a sentence for each thing that is shown otherwise than the file's maker shows it.

    Returns:
        The scene root.

    Raises:
        LodgsError: the file cannot be read, or what it says is not possible. Nothing is left behind then.
    """
    pieces = place_splats(context, read_splats_file(path, budget), upright, warn)
    while True:
        try:
            next(pieces)
        except StopIteration as end:
            return end.value


@dataclass(frozen=True)
class SplatsFile:
    """What a file of splats holds.

    Attributes:
        bundle: its levels; the coarsest splats of a tree that stays in its file.
        total: splats of such a tree; 0 where all are in the bundle.
        budget: most splats of such a tree in memory.
        warnings: a sentence for each thing that is shown otherwise than the file's maker shows it.
    """

    path: Path
    bundle: Bundle
    total: int
    budget: int
    warnings: list[str]


def read_splats_file(path: Path | str, budget: int = 0) -> SplatsFile:
    """What :func:`place_splats` places: a bundle, a folder of levels, or any other file of splats (see
    ``training.splats.formats``) as a single level.

    Nothing of Blender is touched, so that a thread may do it.

    Args:
        budget: most splats of a tree of splats in memory; 0: all. Of a larger one the coarsest are imported,
            which stand for the others; where LODGS itself draws, others are read from the file as the eye
            comes near (``streams``).

    Raises:
        LodgsError: the file cannot be read.
    """
    path, warnings, total = Path(path), [], 0
    if path.name == STREAMED:
        path = path.resolve().parent
    if budget and not path.is_dir() and is_ply(path) and is_tree(read_head(path)):
        total = TreeFile(path).total
        bundle, _ = read_within(path, budget if total <= budget else streams.held_of(budget))
        here = sum(len(level.splats) for level in bundle.levels)
        if here < total:
            warnings.append(
                f"{here:,} of {total:,} splats are here: coarser ones stand for the others, which are read "
                f"from {path.name} where viewports and renders of LODGS need them."
            )
        total = total if here < total else 0
    else:
        with as_ply(path) as there:
            bundle = (read_folder if there.is_dir() else read_bundle)(there, warnings.append)
    return SplatsFile(path, bundle, total, budget, warnings)


def place_splats(
    context: bpy.types.Context, file: SplatsFile, upright: bool, warn: Callable[[str], object]
) -> Generator[None, None, bpy.types.Object]:
    """Makes a new splat scene of what a file holds, level by level, and yields between two; see
    :func:`import_splats`. Ended early, it leaves nothing behind."""
    for message in file.warnings:
        warn(message)
    bundle, made = file.bundle, []
    cameras, near, unseen = views_in(bundle.tables)
    try:
        for level in bundle.levels:
            made.append(objects.new_splats(f"{file.path.stem} {level.number}", level.splats))
            yield
        with new_scene(context, file.path.stem.removesuffix(".compressed")) as root:
            if upright:
                axes_of(root).rotation_quaternion = Matrix(bundle.upright.tolist()).to_quaternion()
            _fill(root, file, made)
            if cameras:
                _add_views(context, root, cameras, extent_of(cameras) or 1.0, near)
                for facts in (view.data.lodgs for view in views(root)):
                    facts.held_out = cameras[facts.place].name in unseen
            root.lodgs.training.method = next(info.name for info in METHODS.values() if info.for_splats)
    except BaseException:
        bpy.data.batch_remove([obj.data for obj in made])  # which takes the objects along
        raise
    if bundle.rule and not root.lodgs.by_distance:
        warn(" ".join(unknown_rule(bundle.rule)))
    return root


def refill(root: bpy.types.Object, file: SplatsFile) -> None:
    """Gives a splat scene what a file holds, in place of the levels that it has."""
    make_room(root, file.bundle.levels[-1].number)
    _fill(root, file, [None] * len(file.bundle.levels))


def _fill(root: bpy.types.Object, file: SplatsFile, made: Sequence[bpy.types.Object | None]) -> None:
    """Puts a file's levels, of which there may be objects, and all that it says of them into a scene."""
    for level, obj in zip(file.bundle.levels, made, strict=True):
        put_level(root, level, obj)
    set_bundle_facts(root, file.bundle)
    set_tables(root, file.bundle.tables)
    root.lodgs.single_level = file.bundle.levels[-1].number
    if file.total:
        streams.begin(root, file.path, file.budget, file.total)
        root.lodgs.eye = "VIEW"  # so that what is looked at comes


def set_bundle_facts(root: bpy.types.Object, bundle: Bundle) -> None:
    """Takes over what a bundle says beside its splats. Levels whose objects are gone leave the list.

    Controls take the values that it records, but for those that somebody has set. The bundle may have levels
    without splats, or none at all while they are on their way.

    Raises:
        LodgsError: a value that it records is not possible, or it contradicts its rule. Nothing is taken over
            in that case.
    """
    settings, rule = root.lodgs, known_rule(bundle)
    for control in rule.controls if rule else ():
        control.checked(bundle.controls.get(control.name, control.default))
    if rule is not None and (rule.always or not rule.complete) and settings.rule != bundle.rule:
        settings.mode = "SELECTIVE"
    settings.method, settings.rule, settings.cumulative = bundle.method, bundle.rule, bundle.cumulative
    settings.facts, settings.meta = json.dumps(bundle.facts), json.dumps(bundle.meta)
    for view in views(root):
        view.data.lodgs.property_unset("held_out")
    _begin_controls(root, bundle.controls)
    facts = {level.number: level.facts for level in bundle.levels}
    for item in settings.levels:
        if item.number in facts:
            item.facts = json.dumps(facts[item.number])
    if "camera_center" in bundle.meta:
        settings.camera_center = bundle.meta["camera_center"]
    levels_changed(root)


def set_tables(root: bpy.types.Object, given: Tables) -> None:
    """Gives a splat scene the tables of its bundle, in place of those that it has.

    Apart from :func:`set_bundle_facts`: while levels are on their way, there are none yet.
    """
    tables.set_tables(root, given)
    selection.update_inputs(root)


def set_level(root: bpy.types.Object, level: Level) -> bpy.types.Object:
    """Adds a level to a splat scene, or replaces the one of its number; a new finest one is shown.

    COLMAP's points are hidden when the first level arrives.

    Returns:
        The level's object.
    """
    first = not root.lodgs.levels
    obj = put_level(root, level)
    levels_changed(root)
    if level.number == root.lodgs.levels[-1].number:
        root.lodgs.single_level = level.number
        root.lodgs.active_level = len(root.lodgs.levels) - 1
    if first and root.lodgs.points:  # the splats stand where the points were
        root.lodgs.points.hide_viewport = root.lodgs.points.hide_render = True
    return obj


def contents(root: bpy.types.Object) -> str:
    """What a splat scene holds, in a few words: photographs, points, levels and their splats."""
    levels = [item.object for item in root.lodgs.levels if item.exists]
    counts = (
        (len(photographed(root)), "photograph"),
        (len(views(root)) - len(photographed(root)), "view"),
        (len(root.lodgs.points.data.points) if root.lodgs.points else 0, "point"),
        (len(levels), "level"),
        (sum(len(obj.data.points) for obj in levels), "splat"),
    )
    return ", ".join(f"{count:,} {what}{'s' * (count != 1)}" for count, what in counts if count)


def make_room(root: bpy.types.Object, number: int) -> None:
    """Removes tables and all levels but one, whose object the next set's first level takes over, and ends
    reading from a file.

    Args:
        number: of that level. Where there is none of this number, the finest of those here takes it.
    """
    tables.remove_tables(root)
    streams.end(root)
    painting.keep(root)
    there = [item for item in root.lodgs.levels if item.exists]
    kept = next((item for item in there if item.number == number), there[-1] if there else None)
    for item in there:
        if item != kept:
            cloud = item.object.data
            bpy.data.objects.remove(item.object)
            if not cloud.users:
                bpy.data.pointclouds.remove(cloud)
    if kept is not None:
        if kept.object.name == _level_name(root, kept.number):
            kept.object.name = _level_name(root, number)
        kept.number = number
    levels_changed(root)


def read_levels(root: bpy.types.Object, placed: bool = False, looked: bool = False) -> Bundle:
    """The levels of a splat scene with all that artists have changed in them, modifiers not applied.

    What is hidden, and what crops leave out, is not among them.

    Args:
        placed: where the scene stands in Blender, upright there; otherwise in the splats' own world. What of
            its objects has been moved by itself counts in neither.
        looked: as paint and the scene's look have them (``looks``); otherwise as they were trained, with
            their paint beside.

    Raises:
        LodgsError: there are none, or crops leave nothing; or of a placed one, its root is stretched or its
            rule unknown.
    """
    levels = [
        Level(item.number, objects.read_splats(item.object), selection.read_facts(item.facts))
        for item in root.lodgs.levels
        if item.exists
    ]
    if not levels:
        raise LodgsError(f"{root.name} has no levels yet.", "Train it or import splats first.")
    settings = root.lodgs
    facts, meta = selection.read_facts(settings.facts), selection.read_json(settings.meta)
    bundle = Bundle(
        settings.method, levels, settings.rule, facts, _set_controls(root), settings.cumulative, meta,
        tables.read_tables(root) | view_tables(root),
    )  # fmt: skip
    bundle = cleaning.left(root, bundle, bpy.context.evaluated_depsgraph_get())
    if looked:
        bundle = look.looked_levels(bundle, _looks(root))
    if placed:
        bundle = placing.placed(bundle, placement_of(root))
        bundle.meta["up_rotation"] = np.eye(3)
    return bundle


def view_tables(root: bpy.types.Object, placed: bool = False) -> dict[str, dict[str, np.ndarray]]:
    """A scene's views as tables of its bundle, in the order in which they came.

    Args:
        placed: see :func:`read_levels`.
    """
    found = sorted(
        (view for view in views(root) if view.data.lodgs.width), key=lambda view: view.data.lodgs.place
    )
    near = min((view.data.clip_start for view in found), default=0.0)
    axes = axes_of(root)
    unit = 1.0 if axes == root else axes.matrix_basis.to_scale().x  # ``ground.scale`` takes clips along
    unseen = {view.name for view in found if is_held_out(root, view)}
    made = tables_of([camera_of(view) for view in found], near / unit, unseen)
    if placed and VIEWS in made:
        made[VIEWS] = placed_views(made[VIEWS], placement_of(root))
    return made


def delete_left_out(root: bpy.types.Object) -> int:
    """Deletes what is hidden and what crops leave out, of every level, and the crops, but for their looks;
    how many splats.

    Raises:
        LodgsError: as :func:`read_levels`, or the levels are only the top of a tree in a file.
    """
    file = streams.file_of(root)
    if file is not None:
        raise LodgsError(
            f"Most of these splats are in {file.name}, which stays as it is.",
            "Keep the crops; or edit the file with the command lodgs edit, and import what that writes.",
        )
    before = sum(len(item.object.data.points) for item in root.lodgs.levels if item.exists)
    bundle = read_levels(root)
    for level in bundle.levels:
        put_level(root, level)
    for item in root.lodgs.levels:
        item.lost = 0
    for obj in crops.cutting(root):
        if looks.is_set(obj):  # which stays with what is left there
            obj.lodgs_crop.keep = "ALL"
        else:
            bpy.data.objects.remove(obj)
    levels_changed(root)
    return before - sum(len(level.splats) for level in bundle.levels)


def read_level(root: bpy.types.Object, number: int, placed: bool = False, looked: bool = False) -> Splats:
    """One level with all that artists have changed in it; where levels add up, with all coarser ones.

    Args:
        placed, looked: see :func:`read_levels`.

    Raises:
        LodgsError: there is no such level, or it is no scene by itself; or as :func:`read_levels`.
    """
    bundle = read_levels(root, placed, looked)
    for level in bundle.levels:
        if level.number == number:
            _require_alone(root, number)
            return complete(bundle, level)
    raise LodgsError(f"{root.name} has no level {number}.", "Choose one from the list of levels.")


def shown_splats(
    context: bpy.types.Context, root: bpy.types.Object, placed: bool = False, looked: bool = False
) -> Splats:
    """The splats that the detail settings, and artists' own modifiers, leave visible in the view layer.

    Columns that not every visible level has are left out.

    Args:
        placed, looked: see :func:`read_levels`.

    Raises:
        LodgsError: nothing is visible, or the levels have spherical harmonics of different degrees; or of
            placed ones, the root is stretched.
    """
    with _drawn_by_lodgs(context):
        depsgraph = context.evaluated_depsgraph_get()
        parts = [
            objects.read_splats(item.object, depsgraph)
            for item in root.lodgs.levels
            if _visible(context, item)
        ]
    if looked:
        parts = [look.looked(part, _looks(root)) for part in parts]
    if not any(len(part) for part in parts):
        raise LodgsError(f"No splats of {root.name} are shown.", "Look at the detail settings.")
    if len({part.sh_degree for part in parts}) > 1:
        raise LodgsError(
            f"The levels of {root.name} have spherical harmonics of different degrees.", "Export one level."
        )
    shared = [name for name in parts[0].extras if all(name in part.extras for part in parts)]
    arrays = ("means", "quats", "log_scales", "opacity_logits", "sh")
    splats = Splats(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays},
        extras={name: np.concatenate([part.extras[name] for part in parts]) for name in shared},
    )
    rule = find_rule(root.lodgs.rule)
    if not placed:
        return splats
    return placement_of(root).splats(splats, *((rule.lengths, rule.places) if rule else ()))


@contextmanager
def _drawn_by_lodgs(context: bpy.types.Context) -> Iterator[None]:
    """Evaluate objects without the modifiers that apply weights and looks for Blender's own drawing."""
    settings = context.scene.lodgs_viewport
    before = settings.splats, settings.drawn_by
    if compat.NATIVE_SPLATS is None or not settings.points:
        yield
        return
    settings.splats, settings.drawn_by = True, "LODGS"
    try:
        context.view_layer.update()
        yield
    finally:
        settings.splats, settings.drawn_by = before


def count_shown(context: bpy.types.Context, root: bpy.types.Object) -> tuple[int, int]:
    """How many splats are visible as of the last evaluation, and how many there are in all levels."""
    depsgraph, shown, everything = context.view_layer.depsgraph, 0, 0
    for item in root.lodgs.levels:
        if item.exists:
            everything += len(item.object.data.points)
            if depsgraph is not None and _visible(context, item):
                shown += len(item.object.evaluated_get(depsgraph).data.points)
    return shown, everything


def show_only(root: bpy.types.Object, number: int) -> None:
    """Shows one level everywhere; where levels add up, with all coarser ones.

    Raises:
        LodgsError: it is no scene by itself.
    """
    _require_alone(root, number)
    root.lodgs.mode, root.lodgs.single_level = "SINGLE", number
    for item in root.lodgs.levels:
        if item.number == number or (root.lodgs.cumulative and item.number < number):
            item.show = True


def offer_ellipsoids(scene: bpy.types.Scene) -> None:
    """Gives every level of a scene's splats the modifier that makes ellipsoids where they are wanted."""
    for root in roots(scene):
        for item in root.lodgs.levels:
            if item.exists:
                ellipsoids.attach(item.object)
    cycles = getattr(scene, "cycles", None)
    for limit in ("transparent_max_bounces", "min_transparent_bounces") if cycles else ():
        setattr(cycles, limit, max(getattr(cycles, limit), ellipsoids.BOUNCES))


@contextmanager
def new_scene(context: bpy.types.Context, name: str) -> Iterator[bpy.types.Object]:
    """A new root in a new collection; both, and all in them, vanish again if the block fails."""
    if context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    with objects.all_or_nothing():
        collection = bpy.data.collections.new(name)
        root = bpy.data.objects.new(name, None)
        root.lodgs.is_root = True
        collection.objects.link(root)
        context.scene.collection.children.link(collection)
        new_axes(root)
        _tell_others()
        yield root
    for obj in context.selected_objects:
        obj.select_set(False)
    context.view_layer.objects.active = root
    root.select_set(True)


def _tell_others() -> None:
    """Leaves a text in the file for whoever opens it without LODGS, and sees points."""
    if ABOUT not in bpy.data.texts:
        bpy.data.texts.new(ABOUT).write(
            "The point clouds in this file are Gaussian splats. Without the extension LODGS, Blender shows "
            "the finest level of each scene as points.\n\nWith it they are drawn as splats, in viewports and "
            "in renders, with detail by distance, and can be cleaned, placed and exported: Edit, "
            "Preferences, Get Extensions, Install from Disk. Nothing is lost without it.\n"
        )


def _looks(root: bpy.types.Object) -> look.Looks:
    """The looks of a scene as it stands now."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    to_own = axes_of(root).evaluated_get(depsgraph).matrix_world.inverted_safe()
    return looks.looks_of(root, depsgraph, to_own)


def _require_alone(root: bpy.types.Object, number: int) -> None:
    finest = max((item.number for item in root.lodgs.levels if item.exists), default=number)
    if number < finest and not root.lodgs.complete:
        raise LodgsError(*not_alone(number, finest))


def _visible(context: bpy.types.Context, item) -> bool:
    return item.exists and item.object.visible_get(view_layer=context.view_layer)


def _collection(root: bpy.types.Object) -> bpy.types.Collection:
    return root.users_collection[0]


def _extent(scene: Scene) -> float:
    """The scene's size, for what must be neither too small nor too large to see."""
    try:
        return scene.extent()
    except LodgsError:  # one place to stand, and no points: nothing tells the size
        return 1.0


def _median_depth(scene: Scene) -> float:
    """0 where no camera sees a point."""
    try:
        return scene.median_depth()
    except LodgsError:
        return 0.0


def _near(scene: Scene) -> float:
    """The depth before which training and evaluation draw nothing."""
    try:
        return scene.near()
    except LodgsError:  # no camera sees a point
        return _extent(scene) / 1000


def _set_controls(root: bpy.types.Object) -> dict[str, float]:
    """The values of the rule's controls that are not the rule's own, by name."""
    rule = find_rule(root.lodgs.rule)
    if rule is None:
        return {}
    own = rule.defaults([item.number for item in root.lodgs.levels if item.exists])
    values = {control.name: control.checked(_value(root, control)) for control in rule.controls}
    return {name: value for name, value in values.items() if value != own[name]}


def _begin_controls(root: bpy.types.Object, recorded: dict[str, float] | None = None) -> None:
    """Controls that nobody has set take what a bundle or a run records, else the rule's own for these levels.

    Args:
        recorded: values by name; None: those of before.

    Raises:
        LodgsError: a value is not possible.
    """
    settings, rule = root.lodgs, find_rule(root.lodgs.rule)
    before = selection.read_facts(settings.recorded)
    recorded = before if recorded is None else recorded
    if rule is not None:
        numbers = [item.number for item in settings.levels if item.exists]
        own = {control.name: control.default for control in rule.controls}
        begun = own | before | selection.read_facts(settings.begun)
        begins = (rule.defaults(numbers) if numbers else own) | recorded
        begins = {control.name: control.checked(begins[control.name]) for control in rule.controls}
        unset = [
            control
            for control in rule.controls
            if begins[control.name] != begun[control.name]
            and _value(root, control) == _short(begun[control.name])
        ]
        unset.sort(key=lambda control: control.follows != "finest")  # which takes the coarsest along
        for control in unset:
            setattr(settings.controls, control.name, begins[control.name])
        settings.begun = json.dumps(begins)
    settings.recorded = json.dumps(recorded)


def _value(root: bpy.types.Object, control: Control) -> float:
    """What a control is set to."""
    return _short(getattr(root.lodgs.controls, control.name))


def _short(value: float) -> float:
    """A number to as many digits as Blender's floats have, which are shorter than the files'."""
    return value if isinstance(value, int) else float(f"{value:.7g}")


def put_level(root: bpy.types.Object, level: Level, made: bpy.types.Object | None = None) -> bpy.types.Object:
    """The level's object in the scene and its entry in the list, without what depends on the whole list.

    Args:
        made: an object of the level's splats that is in no collection; None: there is none yet.
    """
    settings = root.lodgs
    fresh = made or objects.new_splats("", painting.carried(root, level).splats)
    fresh.name = fresh.data.name = _level_name(root, level.number)
    item = next((entry for entry in settings.levels if entry.number == level.number), None)
    if item is None:
        item = settings.levels.add()
        item.number = level.number
        position = sum(entry.number < level.number for entry in settings.levels)
        settings.levels.move(len(settings.levels) - 1, position)
        item = settings.levels[position]
    elif item.exists:
        # The object stays, with all that artists have hung on it; only its splats change.
        old, obj = item.object.data, item.object
        if obj.mode != "OBJECT":  # where Blender gives it no other splats
            with extension.in_window():
                bpy.ops.object.mode_set(mode="OBJECT")
        item.lost = int(cleaning.hidden(old).sum())
        obj.data, obj.color = fresh.data, fresh.color
        bpy.data.objects.remove(fresh)
        name = old.name
        bpy.data.pointclouds.remove(old)
        obj.data.name = name
        fresh = obj
    if fresh.parent is None:
        fresh.parent = axes_of(root)
        _collection(root).objects.link(fresh)
    item.object = fresh
    item.facts = json.dumps(level.facts)
    return fresh


def _level_name(root: bpy.types.Object, number: int) -> str:
    return f"{root.name} level {number}"


def levels_changed(root: bpy.types.Object) -> None:
    """Drops levels whose objects are gone, keeps the settings within the rest, and renews the drivers."""
    settings = root.lodgs
    for index in reversed(range(len(settings.levels))):
        if not settings.levels[index].exists:
            settings.levels.remove(index)
    if settings.levels:
        finest = settings.levels[-1].number
        settings.single_level = min(settings.single_level, finest)
        _begin_controls(root)
        rule = find_rule(settings.rule)
        for control in rule.controls if rule else ():
            if control.follows and getattr(settings.controls, control.name) > finest:
                setattr(settings.controls, control.name, finest)
    settings.active_level = min(settings.active_level, len(settings.levels) - 1)
    selection.attach(root)
    for scene in root.users_scene:
        if scene.lodgs_render.ellipsoids:
            offer_ellipsoids(scene)


@bpy.app.handlers.persistent
def _on_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Follows artists: a deleted level leaves no gap in the distances, a new material is shown."""
    editable = [root for root in roots(scene) if root.is_editable]  # others are linked from their own file
    if depsgraph.id_type_updated("COLLECTION"):
        for root in editable:
            if not all(item.exists for item in root.lodgs.levels):
                levels_changed(root)
    if depsgraph.id_type_updated("OBJECT"):
        for root in editable:
            if crops.outdated(root) or looks.outdated(root):
                selection.follow_crops(root)
    if any(update.is_updated_geometry for update in depsgraph.updates):
        for root in editable:
            selection.update_inputs(root)


@bpy.app.handlers.persistent
def _before_undo(*_) -> None:
    for root in _all_editable():
        selection.let_go(root)


@bpy.app.handlers.persistent
def _after_undo(*_) -> None:
    for root in _all_editable():
        selection.follow_crops(root)


def _all_editable() -> list[bpy.types.Object]:
    return [obj for obj in bpy.data.objects if obj.lodgs.is_root and obj.is_editable]


def _handlers():
    """Lists of Blender's handlers, and ours for each."""
    handlers = bpy.app.handlers
    yield handlers.depsgraph_update_post, _on_update
    for before in (handlers.undo_pre, handlers.redo_pre):
        yield before, _before_undo
    for after in (handlers.undo_post, handlers.redo_post):
        yield after, _after_undo


def register() -> None:
    for handlers, ours in _handlers():
        handlers.append(ours)


def unregister() -> None:
    for handlers, ours in _handlers():
        handlers.remove(ours)
