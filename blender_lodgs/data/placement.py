"""Placement of a splat scene by its root and its axes.

The axes are an empty below the root; its local space has the coordinates of the files, and all parts of the
scene are its children. The transform of the axes turns a scene upright, aligns it with the ground and scales
it. The root starts without a transform, so that artists can move, rotate (Euler angles) and scale it, and
Alt+R resets only their changes. The axes are locked against Alt+R. If the axes are missing, as for a copy of
the root alone, the root takes their place.
"""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ...training.errors import LodgsError
from ...training.scenes.cameras import MAX_COORDINATE
from ...training.splats.similarity import Similarity, is_similarity

DISPLAY_SIZE = 1e-4
"""Display size of axes, too small to be clicked instead of the root."""


def axes_of(root: bpy.types.Object) -> bpy.types.Object:
    """Return the empty whose local space has the coordinates of a scene's files.

    This is the root itself if the axes are missing.
    """
    axes = root.lodgs.axes
    return axes if isinstance(axes, bpy.types.Object) and axes.parent == root else root


def new_axes(root: bpy.types.Object) -> bpy.types.Object:
    """Create the axes of a new root, in its collection."""
    axes = bpy.data.objects.new(f"{root.name} axes", None)
    axes.parent, axes.rotation_mode, axes.empty_display_size = root, "QUATERNION", DISPLAY_SIZE
    lock_transform(axes)
    root.users_collection[0].objects.link(axes)
    root.lodgs.axes = axes
    return axes


def lock_transform(obj: bpy.types.Object) -> None:
    """Keep Blender's tools from moving, rotating and scaling an object by itself."""
    obj.lock_location = obj.lock_rotation = obj.lock_scale = (True, True, True)
    obj.lock_rotation_w = obj.lock_rotations_4d = True


def world_matrix(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> Matrix:
    """Return the matrix from an object's space to Blender's world, also if Blender has not evaluated it.

    After a file is opened, Blender evaluates neither hidden objects nor those of other Blender scenes, and
    their matrix is that of an object at the origin. It is then derived from their parents.

    Args:
        depsgraph: use the evaluated transform; None for the original one.
    """
    evaluated = obj.evaluated_get(depsgraph) if depsgraph else obj
    matrix = evaluated.matrix_world.copy()
    if matrix != Matrix() or obj.constraints or (obj.parent and obj.parent_type != "OBJECT"):
        return matrix
    local = evaluated.matrix_basis.copy()
    return world_matrix(obj.parent, depsgraph) @ obj.matrix_parent_inverse @ local if obj.parent else local


def matrix_in_world(root: bpy.types.Object) -> Matrix:
    """Return the matrix from a splat scene's coordinates to Blender's world.

    It is valid before Blender evaluates the objects of a root without parent, such as a new one.
    """
    axes = axes_of(root)
    if root.parent is not None:
        return axes.matrix_world.copy()
    root_matrix = root.matrix_basis
    return (
        root_matrix.copy() if axes == root else root_matrix @ axes.matrix_parent_inverse @ axes.matrix_basis
    )


def matrix_of(root: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> np.ndarray:
    """Return the (4, 4) float64 matrix from a splat scene's coordinates to Blender's world, unrounded.

    Args:
        depsgraph: use the evaluated transform; None for the original one.

    Raises:
        LodgsError: the root is scaled differently along its axes, or its transform is not finite.
    """
    matrix = np.array(world_matrix(axes_of(root), depsgraph), np.float64)
    require_finite(root, matrix)
    if not is_similarity(_orthogonal(matrix)):
        raise LodgsError(
            f"Cannot use the transform of '{root.name}': its scale is stretched or mirrored.",
            "Give it one positive scale for all axes.",
        )
    return matrix


def require_finite(obj: bpy.types.Object, matrix: np.ndarray) -> None:
    """Raise LodgsError if a matrix (4, 4) of an object has numbers that are not finite or too large."""
    if not (np.abs(matrix) <= MAX_COORDINATE).all():
        raise LodgsError(
            f"Cannot use the transform of '{obj.name}': it has numbers that are not finite or above "
            f"{MAX_COORDINATE:g}.",
            "Clear it (Object > Clear) and those of its parents, or correct their animation and constraints.",
        )


def placement_of(root: bpy.types.Object) -> Similarity:
    """Return the transform of :func:`matrix_of` with exactly orthogonal axes.

    Raises:
        LodgsError: the root is scaled differently along its axes.
    """
    return Similarity.from_matrix(_orthogonal(matrix_of(root)))


def move(root: bpy.types.Object, further: Similarity) -> None:
    """Apply a transform in Blender's world to a splat scene; the root stays unchanged.

    Raises:
        LodgsError: the root is scaled differently along its axes.
    """
    placement = further.compose(placement_of(root))
    axes_of(root).matrix_world = Matrix(placement.matrix.tolist())


def _orthogonal(matrix: np.ndarray) -> np.ndarray:
    """Return a matrix (4, 4) with orthogonal columns in float64 if they are orthogonal in float32.

    Other matrices are returned unchanged.
    """
    u, scales, vh = np.linalg.svd(matrix[:3, :3])
    if scales[2] > 0 and scales[0] < 1.0001 * scales[2]:
        matrix = matrix.copy()
        matrix[:3, :3] = u @ vh * scales.mean()
    return matrix
